"""What a real arm is, beside what its file says, and the cell that follows from it.

Offsets of joints and the base's place change the description: kinematics, gate and simulator then
all speak of reported joints and true poses. What the wrist's cables do (`core.cables`) changes with
pose and direction; it is taken off the targets of the joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from pydantic import ConfigDict

from viskill_deploy.core.cables import STIFF, Cables
from viskill_deploy.core.description import ArmDescription, CellArm, CellDescription
from viskill_deploy.core.robot_files import PrismaticJoint, RevoluteJoint
from viskill_deploy.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class ArmErrors:
    """What an arm is, beside what its file says.

    Attributes:
        base_rotation_rad: rotation vector of the true base in the nominal base, (3,).
        base_translation_m: true minus nominal origin of the base, task axes, (3,).
        joint_offset: true minus reported joints, (6,), rad and m.
        tool_length_m: true minus nominal length of the tool's shaft.
        point_m: how much further along the tip's z the measured point is than stated.
        cables: play and stretch of what drives the wrist.
        delay_s: how much older the joints behind a measured point are than its stamp says.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    base_rotation_rad: tuple[float, ...] = (0.0,) * 3
    base_translation_m: tuple[float, ...] = (0.0,) * 3
    joint_offset: tuple[float, ...] = (0.0,) * 6
    tool_length_m: float = 0.0
    point_m: float = 0.0
    cables: Cables = STIFF
    delay_s: float = 0.0


def rotation(vector: tuple[float, ...]) -> FloatArray:
    """Rotation matrix of a rotation vector, (3, 3). Source: Rodrigues' formula."""
    v = np.array(vector)
    angle = float(np.linalg.norm(v))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = v / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


def with_errors(cell: CellDescription, errors: Mapping[str, ArmErrors]) -> CellDescription:
    """The cell as it really is: bases moved, joints shifted, shafts lengthened.

    Joint positions and their limits stay the reported ones.

    Args:
        cell: as its file says.
        errors: by arm; arms that are not named stay as they are.
    """
    arms = tuple(_arm(arm, errors[arm.name]) if arm.name in errors else arm for arm in cell.arms)
    return replace(cell, arms=arms)


def _arm(arm: CellArm, errors: ArmErrors) -> CellArm:
    pose = np.array(arm.T_task_base)
    pose[:3, :3] = pose[:3, :3] @ rotation(errors.base_rotation_rad)
    pose[:3, 3] += errors.base_translation_m
    pose.flags.writeable = False
    return replace(arm, arm=shifted(arm.arm, errors), T_task_base=pose, cables=errors.cables)


def shifted(arm: ArmDescription, errors: ArmErrors) -> ArmDescription:
    """The description of an arm whose joints read wrong, and whose shaft is longer.

    Joint positions and their limits stay the reported ones.
    """
    joints = [
        _read_wrong(joint, offset)
        for joint, offset in zip(arm.joints, errors.joint_offset, strict=True)
    ]
    roll = joints[3]
    joints[3] = roll.model_copy(update={"d_m": roll.d_m + errors.tool_length_m})
    return replace(arm, joints=tuple(joints))


def _read_wrong(
    joint: RevoluteJoint | PrismaticJoint, offset: float
) -> RevoluteJoint | PrismaticJoint:
    key = "offset_m" if joint.type == "prismatic" else "offset_rad"
    return joint.model_copy(update={key: joint.offset + offset})


def without_cables(cell: CellDescription) -> CellDescription:
    """The same cell with cables that neither play nor stretch: for simulators that have none."""
    return replace(cell, arms=tuple(replace(arm, cables=STIFF) for arm in cell.arms))
