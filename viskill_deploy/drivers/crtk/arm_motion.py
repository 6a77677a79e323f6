"""What one simulated arm is told to hold at each moment: servo goals, trajectories, standing still.

As on a dVRK, arm and jaw share one mode: a servo command ends every trajectory, and a new
trajectory takes the place of the one before. A goal that nobody renews is held for ever.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import ruckig

from viskill_deploy.core.description import ArmDescription
from viskill_deploy.core.types import Joints, JointSetpoint

AXES, JAW = 7, 6

SPEED = (1.5708, 1.5708, 0.2, 18.85, 18.85, 18.85, 18.85)
ACCELERATION = (1.5708, 1.5708, 0.2, 12.57, 12.57, 12.57, 12.57)
"""Bounds of dVRK's own trajectories; rad or m, s. Its generator does not bound jerk."""

SILENCE_S = 0.02
"""The velocity of a servo goal is forgotten when no other has come for this long."""

Mode = Literal["position", "trajectory", "free"]


class Profile:
    """The fastest motion of some axes to rest, all arriving together.

    Args:
        axes: which of an arm's seven.
    """

    def __init__(self, axes: range) -> None:
        self._axes, self._count = axes, len(axes)
        self._ruckig = ruckig.Ruckig(self._count)
        self._trajectory: Any = None
        self._passed_s = 0.0
        self.goal: list[float] = []

    @property
    def is_running(self) -> bool:
        """Whether the goal is still ahead."""
        return self._trajectory is not None

    def start(
        self, p: Sequence[float], v: Sequence[float], goal: Sequence[float], ratio: float
    ) -> None:
        """Begins at `p` and `v`, towards `goal`; positions (n,), and `ratio` of speed in ]0, 1]."""
        request = ruckig.InputParameter(self._count)
        request.current_position, request.current_velocity = list(p), list(v)
        request.target_position = self.goal = list(goal)
        request.max_velocity = [ratio * SPEED[axis] for axis in self._axes]
        request.max_acceleration = [ratio * ACCELERATION[axis] for axis in self._axes]
        self._trajectory, self._passed_s = ruckig.Trajectory(self._count), 0.0
        self._ruckig.calculate(request, self._trajectory)

    def step(self, dt_s: float) -> tuple[list[float], list[float]]:
        """Position and velocity after another `dt_s`; at the end the goal, and rest."""
        self._passed_s += dt_s
        if self._passed_s >= self._trajectory.duration:
            self.stop()
            return list(self.goal), [0.0] * self._count
        p, v, _ = self._trajectory.at_time(self._passed_s)
        return list(p), list(v)

    def stop(self) -> None:
        """There is no way to go any more."""
        self._trajectory = None


class ArmMotion:
    """The setpoint of one arm and its jaw.

    Args:
        arm: whose limits hold.
        setpoint: where it stands.

    Attributes:
        ratio: part of `SPEED` and `ACCELERATION` that trajectories use, in ]0, 1].
        p: position of the setpoint, (7,), jaw last.
        v: its velocity, (7,).
        reached: how trajectories have ended since this list was last emptied.
    """

    def __init__(self, arm: ArmDescription, setpoint: JointSetpoint) -> None:
        self._lower = (*arm.limit(0), arm.jaw.lower_rad)
        self._upper = (*arm.limit(1), arm.jaw.upper_rad)
        self._arm, self._jaw = Profile(range(JAW)), Profile(range(JAW, AXES))
        self.ratio, self.reached = 1.0, list[bool]()
        self.place(setpoint)

    @property
    def is_moving(self) -> bool:
        """Whether a trajectory runs."""
        return self._arm.is_running or self._jaw.is_running

    @property
    def setpoint(self) -> JointSetpoint:
        """What the drives are told."""
        return JointSetpoint(tuple(self.p[:JAW]), tuple(self.v[:JAW]), self.p[JAW], self.v[JAW])

    @property
    def goal(self) -> Joints:
        """Where the arm's joints are on their way to, (6,); where they are held otherwise."""
        return tuple(self._arm.goal if self._arm.is_running else self.p[:JAW])

    def place(self, setpoint: JointSetpoint) -> None:
        """Stands still at a setpoint, whatever ran before."""
        self._enter("position")
        self.p = [*setpoint.jp, setpoint.jaw]

    def servo(self, q: Sequence[float], v: Sequence[float]) -> None:
        """Joints (6,) to be at now, clipped without a word as dVRK does.

        Velocities that are not given stay what they were: so does dVRK's bridge.
        """
        if self._mode != "position":
            self._enter("position")
        self._told_v[: len(v)] = v
        self._silent_s = 0.0
        self.p[:JAW], self.v[:JAW] = self._clipped(q), self._told_v

    def servo_jaw(self, angle: float) -> None:
        """The jaw's opening to be at now; the arm stays at its setpoint."""
        if self._mode != "position":
            self._enter("position")
        self.p[JAW], self.v[JAW] = self._clipped_jaw(angle), 0.0

    def move(self, q: Sequence[float]) -> None:
        """Joints (6,) to go to, from the setpoint; a motion of the jaw goes on."""
        self._enter_trajectory()
        self._arm.start(self.p[:JAW], self.v[:JAW], self._clipped(q), self.ratio)

    def move_jaw(self, angle: float) -> None:
        """The jaw's opening to go to; a motion of the arm goes on."""
        self._enter_trajectory()
        self._jaw.start(self.p[JAW:], self.v[JAW:], [self._clipped_jaw(angle)], self.ratio)

    def hold(self) -> None:
        """Stays at the setpoint, at rest."""
        self._enter("position")

    def free(self) -> None:
        """No drive holds the arm: the setpoint is where the arm is."""
        self._enter("free")

    def tick(self, dt_s: float, measured: Sequence[float]) -> None:
        """A moment passes.

        Args:
            dt_s: how long.
            measured: where the joints are, (7,), jaw last.
        """
        self._silent_s += dt_s
        if self._mode == "free":
            self.p = list(measured)
        elif self._mode == "trajectory":
            self._follow(dt_s)
        elif self._silent_s > SILENCE_S:
            self.v = [0.0] * AXES

    def _follow(self, dt_s: float) -> None:
        was_moving = self.is_moving
        if self._arm.is_running:
            self.p[:JAW], self.v[:JAW] = self._arm.step(dt_s)
        if self._jaw.is_running:
            self.p[JAW:], self.v[JAW:] = self._jaw.step(dt_s)
        self.p = [*self._clipped(self.p[:JAW]), self._clipped_jaw(self.p[JAW])]
        if was_moving and not self.is_moving:
            self.reached.append(True)

    def _enter_trajectory(self) -> None:
        if self._mode != "trajectory":
            self._enter("trajectory")

    def _enter(self, mode: Mode) -> None:
        self._stop_profiles()
        self._mode: Mode = mode
        self._told_v, self._silent_s = [0.0] * JAW, 0.0
        self.v = [0.0] * AXES

    def _stop_profiles(self) -> None:
        if self.is_moving:
            self._arm.stop()
            self._jaw.stop()
            self.reached.append(False)

    def _clipped(self, q: Sequence[float]) -> list[float]:
        rows = zip(q, self._lower, self._upper, strict=False)
        return [min(max(x, low), high) for x, low, high in rows]

    def _clipped_jaw(self, angle: float) -> float:
        return min(max(angle, self._lower[JAW]), self._upper[JAW])
