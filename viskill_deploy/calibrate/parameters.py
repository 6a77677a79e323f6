"""How a real arm may differ from its file: names, units, usual sizes, and the vector of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.cables import Cables
from viskill_deploy.core.types import FloatArray

JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number that may be fitted.

    Attributes:
        name: with its unit.
        usual: size that is to be expected of an arm that was not calibrated.
        rank: of parameters that the data cannot tell apart, the one with the higher rank is frozen.
        told_by: another parameter that does exactly the same, so that nothing is lost by freezing.
    """

    name: str
    usual: float
    rank: int
    told_by: str = ""


def _all() -> tuple[Parameter, ...]:
    base = [Parameter(f"base_rotation_{axis}_rad", 0.05, 0) for axis in "xyz"]
    base += [Parameter(f"base_translation_{axis}_m", 0.02, 0) for axis in "xyz"]
    offsets = [
        Parameter("offset_yaw_rad", 0.03, 7, told_by="base_rotation"),
        Parameter("offset_pitch_rad", 0.03, 2),
        Parameter("offset_insertion_m", 0.01, 1),
        Parameter("offset_roll_rad", 0.05, 4),
        Parameter("offset_wrist_pitch_rad", 0.05, 3),
        Parameter("offset_wrist_yaw_rad", 0.05, 4),
    ]
    tool = [
        Parameter("tool_length_m", 0.003, 8, told_by="offset_insertion_m"),
        Parameter("point_m", 0.003, 5),
    ]
    backlash = [Parameter(f"backlash_{JOINTS[i]}_rad", 0.03, 5) for i in range(3, 6)]
    coupling = [
        Parameter(f"coupling_{JOINTS[i]}_by_{JOINTS[j]}", 0.05, 6)
        for i in range(3, 6)
        for j in range(3, 6)
    ]
    return (*base, *offsets, *tool, *backlash, *coupling, Parameter("delay_s", 0.03, 5))


PARAMETERS = _all()
"""In the order of the vector."""

NAMES = tuple(parameter.name for parameter in PARAMETERS)
USUAL: FloatArray = np.array([parameter.usual for parameter in PARAMETERS])

BASE_ROTATION, BASE_TRANSLATION = slice(0, 3), slice(3, 6)
OFFSETS, INSERTION = slice(6, 12), 8
TOOL_LENGTH, POINT = 12, 13
BACKLASH, COUPLING = slice(14, 17), slice(17, 26)
DELAY = 26


def errors_of(vector: FloatArray) -> ArmErrors:
    """Errors from the vector of all parameters, (27,)."""
    values = vector.tolist()
    rows = np.asarray(vector)[COUPLING].reshape(3, 3).tolist()
    return ArmErrors(
        tuple(values[BASE_ROTATION]),
        tuple(values[BASE_TRANSLATION]),
        tuple(values[OFFSETS]),
        values[TOOL_LENGTH],
        values[POINT],
        Cables(tuple(values[BACKLASH]), tuple(tuple(row) for row in rows)),
        values[DELAY],
    )


def vector_of(errors: ArmErrors) -> FloatArray:
    """All parameters in order, (27,)."""
    return np.array(
        [
            *errors.base_rotation_rad,
            *errors.base_translation_m,
            *errors.joint_offset,
            errors.tool_length_m,
            errors.point_m,
            *errors.cables.backlash_rad,
            *(value for row in errors.cables.coupling for value in row),
            errors.delay_s,
        ]
    )
