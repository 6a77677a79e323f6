"""Hidden robots to learn on: each environment's arms, board and camera are a little wrong.

A policy that has met errors like those that a calibration leaves bears them better. What changes
from one look or message to the next (noise, delay) is not drawn here, nor is joint 1's offset and
what else no tip position tells apart from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from viskill_deploy.calibrate.truths import draw_robot
from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.cables import Cables
from viskill_deploy.core.description import CellDescription
from viskill_deploy.sim.world import WorldOptions


@dataclass(frozen=True, slots=True)
class HiddenSettings:
    """Which robots are learnt on.

    Attributes:
        scale: their errors as a part of those of a robot that nobody has calibrated
            (`calibrate.truths`); 0 for arms as the cell's files say.
        seed: of the first one.
    """

    scale: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0.0 <= self.scale <= 1.0 and self.seed >= 0):
            raise ValueError("hidden.scale is in [0, 1], hidden.seed not negative")


def hidden_robots(
    cell: CellDescription, settings: HiddenSettings, count: int
) -> tuple[WorldOptions, ...]:
    """A robot for each of `count` environments, by seeds; () where there are to be none."""
    if settings.scale == 0.0:
        return ()
    return tuple(_robot(cell, settings.seed + i, settings.scale) for i in range(count))


def _robot(cell: CellDescription, seed: int, scale: float) -> WorldOptions:
    truth = draw_robot(cell, seed)
    return WorldOptions(
        truth=tuple(scaled(errors, scale) for errors in truth.errors(cell)),
        board_translation_m=_three(truth.board_translation_m, scale),
        board_rotation_rad=_three(truth.board_rotation_rad, scale),
        object_error_m=_three(truth.object_error_m, scale),
        object_error_rad=scale * truth.object_error_rad,
    )


def scaled(errors: ArmErrors, scale: float) -> ArmErrors:
    """A part of an arm's errors."""
    cables = errors.cables
    return replace(
        errors,
        base_rotation_rad=_times(errors.base_rotation_rad, scale),
        base_translation_m=_times(errors.base_translation_m, scale),
        joint_offset=_times(errors.joint_offset, scale),
        tool_length_m=scale * errors.tool_length_m,
        point_m=scale * errors.point_m,
        cables=Cables(
            _times(cables.backlash_rad, scale),
            tuple(_times(row, scale) for row in cables.coupling),
        ),
        delay_s=scale * errors.delay_s,
    )


def _times(values: tuple[float, ...], scale: float) -> tuple[float, ...]:
    return tuple((scale * np.array(values)).tolist())


def _three(values: tuple[float, float, float], scale: float) -> tuple[float, float, float]:
    x, y, z = values
    return scale * x, scale * y, scale * z
