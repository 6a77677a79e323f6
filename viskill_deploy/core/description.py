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
    Instrument,
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
    """A robot with an instrument in it: joints, a jaw and a tip.

    Attributes:
        joints: the rows in order: a PSM's six, or those of an arm of a lab's own.
        tip_rotation: rotation from the last joint's frame to the tip, (3, 3).
        actuator_to_joint: of a PSM's instrument; empty for another arm.
        files: every file that this came from.
        instrument: the straight instrument of an arm that has no remote centre by mechanism.
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
    instrument: Instrument | None = None

    @property
    def has_remote_centre(self) -> bool:
        """Whether a mechanism keeps the shaft in the port, so that software need not."""
        return self.instrument is None

    @property
    def axes(self) -> int:
        """Joints and jaw."""
        return len(self.joints) + 1

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def tip_position(self) -> tuple[float, float, float]:
        """The jaw's pivot in the last joint's frame, m: a PSM's last axis goes through it."""
        return self.instrument.tip_position_m if self.instrument else (0.0, 0.0, 0.0)

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
    def seed(self) -> tuple[float, ...]:
        """Joints near which the start pose is looked for, rad and m."""
        return self.entry.start_joints_si or (0.0,) * len(self.arm.joints)

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


def rpy_of(R: FloatArray) -> tuple[float, float, float]:
    """Fixed-axis x, y, z angles of a rotation (3, 3), rad; `rpy_matrix` brings it back."""
    r = R.tolist()
    return (
        math.atan2(r[2][1], r[2][2]),
        math.atan2(-r[2][0], math.hypot(r[0][0], r[1][0])),
        math.atan2(r[1][0], r[0][0]),
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


def own_arm(robot: RobotFile, tool: str, path: Path) -> ArmDescription:
    """An arm of a lab's own with the instrument that stands in its file.

    Raises:
        DataFileError: `tool` is not the name of that instrument.
    """
    instrument = robot.instrument
    if instrument is None or instrument.name != tool:
        has = instrument.name if instrument else "none"
        raise DataFileError(path, "instrument", f"holds {has}, not {tool}; name it in the cell")
    return ArmDescription(
        robot=robot.name,
        tool=tool,
        joints=robot.joint,
        tip_rotation=np.array(instrument.tip_rotation),
        jaw=instrument.jaw,
        shape=instrument.shape,
        gate=robot.gate,
        actuator_to_joint=np.zeros((0, 0)),
        files=(path,),
        instrument=instrument,
    )


def load_robot(name: str, tool: str) -> ArmDescription:
    """The robot `name` of `robots/` with the instrument `tool` of `robots/tools/`."""
    robot_path = data.find(f"robots/{name}.toml")
    robot = read_toml(robot_path, RobotFile)
    if robot.instrument is not None:
        return own_arm(robot, tool, robot_path)
    tool_path = data.find(f"robots/tools/{tool}.toml")
    return join(robot, read_toml(tool_path, ToolFile), (robot_path, tool_path))


def _check_start(path: Path, entry: CellArmEntry, arm: ArmDescription) -> None:
    """An arm with many ways to its start pose says near which joints it shall be."""
    wanted = 0 if arm.has_remote_centre else len(arm.joints)
    if len(entry.start_joints_si) != wanted:
        raise DataFileError(
            path,
            f"arm.{entry.name}.start_joints_si",
            f"has {len(entry.start_joints_si)} numbers; {arm.robot} needs {wanted}",
        )


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
        arm = load_robot(entry.robot, entry.tool)
        _check_start(path, entry, arm)
        arms.append(CellArm(entry.name, arm, pose, entry))
    if len({arm.arm.axes for arm in arms}) > 1:
        raise DataFileError(path, "arm", "all arms of a cell need the same number of joints")
    files = dict.fromkeys([path, *(f for arm in arms for f in arm.arm.files)])
    return CellDescription(cell.name, tuple(arms), cell, tuple(files))
