"""Hidden robots to learn on: each environment's arms, board and camera are a little wrong.

A policy that has met errors like those that a calibration leaves bears them better. What changes
from one look or message to the next (noise, delay) is not drawn here, nor is joint 1's offset and
what else no tip position tells apart from it.
"""

from __future__ import annotations

from dataclasses import dataclass

from viskill_deploy.calibrate.truths import draw_robot, scaled
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
    truth = scaled(draw_robot(cell, seed), scale)
    return WorldOptions(
        truth=truth.errors(cell),
        board_translation_m=truth.board_translation_m,
        board_rotation_rad=truth.board_rotation_rad,
        object_error_m=truth.object_error_m,
        object_error_rad=truth.object_error_rad,
    )
