"""Play and stretch of the cables that drive a wrist: they change with pose and direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import ConfigDict

from viskill_deploy.core.types import FloatArray

WRIST = slice(3, 6)
"""Joints that are driven through cables: roll, wrist pitch, wrist yaw."""

ROUNDS = 4
"""Rounds of taking the stretch off: it is a few percent, so four leave 1e-6 of it."""

STILL_RAD = 1e-4
"""A wrist joint that is told to move by less has not turned."""


@dataclass(frozen=True, slots=True)
class Cables:
    """The cables of one arm's wrist.

    Attributes:
        backlash_rad: half the play of each joint, (3,): it lags behind by that.
        coupling: stretch, (3, 3): error of a wrist joint per reported wrist angle.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    backlash_rad: tuple[float, ...] = (0.0,) * 3
    coupling: tuple[tuple[float, ...], ...] = ((0.0,) * 3,) * 3

    def error(self, q: FloatArray, turns: FloatArray) -> FloatArray:
        """True minus reported wrist angles, (..., 3) rad.

        Args:
            q: reported joints, (..., 6).
            turns: which way the wrist's joints moved last, -1, 0 or 1, (..., 3).
        """
        stretch = q[..., WRIST] @ np.array(self.coupling).T
        return np.asarray(stretch - turns * np.array(self.backlash_rad))

    def reported(self, q: FloatArray, turns: FloatArray) -> FloatArray:
        """The joints to command so that the wrist, cables and all, is at `q`, (..., 6).

        Args:
            q: where the joints shall be, (..., 6).
            turns: as in `error`.
        """
        command = np.array(q)
        for _ in range(ROUNDS):
            command[..., WRIST] = q[..., WRIST] - self.error(command, turns)
        return command

    def follow(
        self, q: FloatArray, told: FloatArray, turns: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The joints to command next, (6,), and which way the wrist then has turned, (3,).

        Args:
            q: where the joints shall be, (6,).
            told: what was commanded before, (6,).
            turns: which way the wrist had moved to get there, (3,).
        """
        change = self.reported(q, turns)[WRIST] - told[WRIST]
        turns = np.where(np.abs(change) > STILL_RAD, np.sign(change), turns)
        return self.reported(q, turns), turns

    def along(self, q: FloatArray) -> FloatArray:
        """Commands for a path (n, 6) whose first row is where the joints are told to be now."""
        commands, turns = np.array(q), np.zeros(3)
        for i in range(1, len(q)):
            commands[i], turns = self.follow(q[i], commands[i - 1], turns)
        return commands


STIFF = Cables()
"""Cables without play and stretch, as the arms' files have them."""
