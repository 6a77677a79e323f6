"""Robots with their tools, and cells with their robots, put together from the files in `robots/`.

Pinocchio's model, MuJoCo's model and the gate's own kinematics are all built from these values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viskill_deploy.core import data
from viskill_deploy.core.cables import STIFF, Cables
from viskill_deploy.core.cell_files import CellArmEntry, CellFile
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.robot_files import (
    GateThresholds,
    Jaw,
    PrismaticJoint,
    RevoluteJoint,
    RobotFile,
    Shape,
    ToolFile,
    read_toml,
)
from viskill_deploy.core.types import FloatArray

PLAN_FRACTION = 0.9
"""Plans use this part of what the gate allows, so that the gate never fires on a nominal run."""


@dataclass(frozen=True)
class ArmDescription:
    """A robot with an instrument in it: six joints, a jaw and a tip.

    Attributes:
        joints: the six rows in order.
        tip_rotation: rotation from the last joint's frame to the tip, (3, 3).
        files: every file that this came from.
    """

    robot: str
    tool: str
    joints: tuple[RevoluteJoint | PrismaticJoint, ...]
    tip_rotation: FloatArray
    jaw: Jaw
    shape: Shape
    gate: GateThresholds
    actuator_to_joint: FloatArray
    files: tuple[Path, ...]

    @property
    def wrist_offset_m(self) -> float:
        """Distance from RCM to wrist-pitch axis along the shaft at zero insertion, m."""
        return self.joints[2].offset + self.joints[3].d_m

    @property
    def insertion_min_m(self) -> float:
        """Smallest insertion at which the wrist is outside the cannula (S13), m."""
        return self.gate.insertion_past_rcm_m - self.wrist_offset_m

    def limit(self, which: int) -> tuple[float, ...]:
        """One limit of every joint: 0 lower, 1 upper, 2 velocity, 3 acceleration, 4 jerk."""
        return tuple(joint.limits[which] for joint in self.joints)


@dataclass(frozen=True)
class CellArm:
    """An arm in its place.

    Attributes:
        T_task_base: pose of the arm's base (its RCM frame) in the task frame, (4, 4).
        port_in_base: registered port in the arm's base frame, (3,) m.
        cables: of its wrist; without play and stretch unless the arm was calibrated.
    """

    name: str
    arm: ArmDescription
    T_task_base: FloatArray
    entry: CellArmEntry
    cables: Cables = STIFF

    @property
    def port_in_base(self) -> FloatArray:
        """Registered port in the arm's base frame, (3,) m."""
        return np.array(self.entry.port_in_base_m)


@dataclass(frozen=True)
class CellDescription:
    """A cell: arms in their places, speed limits, and the board.

    Attributes:
        filed: the cell as its files alone have it, where this one was calibrated.
    """

    name: str
    arms: tuple[CellArm, ...]
    file: CellFile
    files: tuple[Path, ...]
    filed: CellDescription | None = None


def rpy_matrix(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Rotation from fixed-axis x, y, z angles in rad, (3, 3)."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def join(robot: RobotFile, tool: ToolFile, files: tuple[Path, ...]) -> ArmDescription:
    """Puts an instrument into a robot.

    Raises:
        DataFileError: the two are of different generations, or do not make six joints.
    """
    if robot.generation != tool.generation:
        raise DataFileError(
            files[-1],
            "generation",
            f"a {tool.generation} tool does not fit the {robot.generation} arm {robot.name}",
        )
    joints = (*robot.joint, *tool.joint)
    if len(joints) != 6 or [j.type[0] for j in joints] != list("rrprrr"):
        raise DataFileError(files[-1], "joint", "arm and tool must make the six joints R R P R R R")
    return ArmDescription(
        robot=robot.name,
        tool=tool.name,
        joints=joints,
        tip_rotation=np.array(tool.tip_rotation),
        jaw=tool.jaw,
        shape=tool.shape,
        gate=robot.gate,
        actuator_to_joint=np.array(tool.actuator_to_joint),
        files=files,
    )


def load_robot(name: str, tool: str) -> ArmDescription:
    """The robot `name` of `robots/` with the instrument `tool` of `robots/tools/`."""
    robot_path, tool_path = data.find(f"robots/{name}.toml"), data.find(f"robots/tools/{tool}.toml")
    robot, instrument = read_toml(robot_path, RobotFile), read_toml(tool_path, ToolFile)
    return join(robot, instrument, (robot_path, tool_path))


def load_cell(name: str | Path) -> CellDescription:
    """The cell `name` of `robots/cells/`, or the one in a TOML file, with its arms."""
    is_file = isinstance(name, Path) or name.endswith(".toml")
    path = Path(name) if is_file else data.find(f"robots/cells/{name}.toml")
    cell = read_toml(path, CellFile)
    arms = []
    for entry in cell.arm:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rpy_matrix(*entry.base_rpy_rad), entry.base_position_m
        pose.flags.writeable = False
        arms.append(CellArm(entry.name, load_robot(entry.robot, entry.tool), pose, entry))
    files = dict.fromkeys([path, *(f for arm in arms for f in arm.arm.files)])
    return CellDescription(cell.name, tuple(arms), cell, tuple(files))
