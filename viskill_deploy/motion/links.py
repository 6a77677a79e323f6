"""Between the task frame and the joints of every arm, one moment at a time.

`resolve.py` does the same for whole paths at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray, Waypoint
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.motion.smoothing import AxisMotion


class CellLinks:
    """The arms of a cell in their places.

    Args:
        cell: the cell.

    Attributes:
        arms: kinematics of every arm.
    """

    def __init__(self, cell: CellDescription) -> None:
        self.arms = [Arm(entry.arm) for entry in cell.arms]
        self._T_task_base = [entry.T_task_base for entry in cell.arms]
        self._T_base_task = [np.linalg.inv(T) for T in self._T_task_base]

    def tips(self, joints: Sequence[Sequence[float]]) -> list[FloatArray]:
        """T_task_tip of every arm for its joints (6,), (4, 4) each."""
        return [
            T @ arm.forward(q).homogeneous
            for T, arm, q in zip(self._T_task_base, self.arms, joints, strict=True)
        ]

    def targets(self, waypoint: Waypoint, start: Sequence[AxisMotion]) -> list[list[float]]:
        """Axis positions at a waypoint, (7,) an arm; the roll turn nearest to `start`.

        Raises:
            NoSolutionError: the waypoint is out of an arm's reach.
        """
        return [
            [*arm.inverse(back @ T, motion.p[:6]).tolist(), jaw]
            for arm, back, T, motion, jaw in zip(
                self.arms, self._T_base_task, waypoint.T_task_tip, start, waypoint.jaw, strict=True
            )
        ]
