"""Between the task frame and the joints of every arm, one moment at a time.

`resolve.py` does the same for whole paths at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from viskill_deploy.core.cables import STIFF, WRIST
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray, Waypoint
from viskill_deploy.kinematics.straight import placed_arm
from viskill_deploy.motion.smoothing import AxisMotion


class CellLinks:
    """The arms of a cell in their places.

    Args:
        cell: the cell.

    Attributes:
        arms: kinematics of every arm.
        turns: which way each wrist's joints were sent last, (3,) an arm; never changed in place.
    """

    def __init__(self, cell: CellDescription) -> None:
        self.arms = [placed_arm(entry) for entry in cell.arms]
        self._T_task_base = [entry.T_task_base for entry in cell.arms]
        self._T_base_task = [np.linalg.inv(T) for T in self._T_task_base]
        self._cables = [entry.cables for entry in cell.arms]
        self.turns = [np.zeros(3) for _ in cell.arms]

    def tips(self, joints: Sequence[Sequence[float]]) -> list[FloatArray]:
        """T_task_tip of every arm for its reported joints (n,), (4, 4) each."""
        return [
            T.dot(arm.pose(self._true(index, q)))
            for index, (T, arm, q) in enumerate(
                zip(self._T_task_base, self.arms, joints, strict=True)
            )
        ]

    def targets(self, waypoint: Waypoint, start: Sequence[AxisMotion]) -> list[list[float]]:
        """Axis positions at a waypoint, (axes,) an arm; of all solutions the nearest to `start`.

        Raises:
            NoSolutionError: the waypoint is out of a PSM's reach.
            KinematicsError: it is out of another arm's.
        """
        return [
            [*self._told(index, arm.inverse(back @ T, motion.p[:-1]), motion), jaw]
            for index, (arm, back, T, motion, jaw) in enumerate(
                zip(
                    self.arms,
                    self._T_base_task,
                    waypoint.T_task_tip,
                    start,
                    waypoint.jaw,
                    strict=True,
                )
            )
        ]

    def _true(self, arm: int, q: Sequence[float]) -> Sequence[float] | FloatArray:
        """Where the joints are when they are reported at `q`."""
        cables = self._cables[arm]
        if cables == STIFF:
            return q
        true = np.array(q)
        true[WRIST] += cables.error(true, self.turns[arm])
        return true

    def _told(self, arm: int, q: FloatArray, motion: AxisMotion) -> list[float]:
        """What to command so that the joints come to `q`; remembers the way that it turns."""
        if self._cables[arm] != STIFF:
            told = np.array(motion.p[:-1])
            q, self.turns[arm] = self._cables[arm].follow(q, told, self.turns[arm])
        return list(map(float, q))
