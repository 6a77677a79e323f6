"""Positions that the drives say, as the states of arms: speeds are differences of them."""

from __future__ import annotations

from collections.abc import Sequence

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import PSM_JOINTS, ArmState, JointSetpoint
from viskill_deploy.drivers.base import DISABLED, ENABLED
from viskill_deploy.drivers.can.master import BusMaster

SMOOTHING = 0.5
"""Part of a new speed that counts: a difference of two positions jumps by the encoder's counts."""


class Measured:
    """Where the arms are and how fast they move.

    Args:
        cell: the arms.
        period_s: control period.
    """

    def __init__(self, cell: CellDescription, period_s: float) -> None:
        self._cell, self._period_s = cell, period_s
        self._last: list[tuple[float, list[float], list[float]]] = []  # stamp, joints, speeds

    def forget(self) -> None:
        """The arms were put somewhere else: no speed follows from that."""
        self._last = []

    def update(self, masters: Sequence[BusMaster]) -> None:
        """Speeds from positions, where new ones have come."""
        if not self._last:
            self._last = [(m.stamp_s, m.joints(), [0.0] * 7) for m in masters]
        for index, master in enumerate(masters):
            stamp, old, speeds = self._last[index]
            if master.stamp_s > stamp:
                new, dt = master.joints(), max(master.stamp_s - stamp, self._period_s / 2)
                pairs = zip(new, old, speeds, strict=True)
                speeds = [v + SMOOTHING * ((b - a) / dt - v) for b, a, v in pairs]
                self._last[index] = (master.stamp_s, new, speeds)

    def arms(
        self, held: Sequence[JointSetpoint], is_enabled: bool, is_homed: bool
    ) -> tuple[ArmState, ...]:
        """The state of every arm; `held` are the setpoints that the drives have."""
        return tuple(
            [
                self._arm(index, setpoint, is_enabled, is_homed)
                for index, setpoint in enumerate(held)
            ]
        )

    def _arm(self, index: int, held: JointSetpoint, is_enabled: bool, is_homed: bool) -> ArmState:
        arm = self._cell.arms[index]
        stamp, q, v = self._last[index]
        return ArmState(
            name=arm.name,
            stamp_s=stamp,
            valid=True,
            operating_state=ENABLED if is_enabled else DISABLED,
            is_homed=is_homed,
            is_busy=False,
            measured_jp=tuple(q[:6]),
            measured_jv=tuple(v[:6]),
            jaw_measured_jp=q[6],
            jaw_measured_jv=v[6],
            setpoint_jp=held.jp,
            jaw_setpoint_jp=held.jaw,
            joint_names=PSM_JOINTS,
            tool=arm.arm.tool,
        )


def standing(masters: Sequence[BusMaster]) -> list[JointSetpoint]:
    """Setpoints at which every arm stays where it is measured."""
    rows = [master.joints() for master in masters]
    return [JointSetpoint(tuple(q[:6]), (0.0,) * 6, q[6], 0.0) for q in rows]
