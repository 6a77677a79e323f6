"""A driver that reads the arms and sends them nothing: every setpoint is judged and kept.

What the gate then sees are the real readings, their ages, the pedal and the emergency stop, with
arms that follow perfectly: nobody else can follow what was not sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import (
    PSM_JOINTS,
    ActiveObject,
    ArmState,
    CellState,
    Inputs,
    JointSetpoint,
    Scene,
)
from viskill_deploy.drivers.base import ENABLED, Capabilities, Driver, accepted
from viskill_deploy.drivers.watch import Watch
from viskill_deploy.runtime.air import start_axes
from viskill_deploy.safety.checked import CheckedSetpoint

REST = (0.0,) * 6


class UnheardWatch:
    """A watchdog that is not told of the run: what is not moved needs no stopping.

    Args:
        watch: the robot's own; its signs of life are real.
    """

    def __init__(self, watch: Watch) -> None:
        self._watch = watch

    def beat(self, now: float) -> None:
        """It is not to step in."""

    def release(self) -> None:
        """It was never engaged."""

    def told(self, inputs: Inputs, now: float) -> Inputs:
        """Its own newest word."""
        return self._watch.told(inputs, now)

    def close(self) -> None:
        """The driver ends it."""


class UnsentDriver:
    """Reads another driver's arms and sends nothing.

    Args:
        driver: connected; only its readings, its clock and, where it is simulated, its operator
            are used.
        cell: the arms in their places.

    Attributes:
        assumed: arms that do not know where they are; they are taken to be in the start pose.
    """

    def __init__(self, driver: Driver, cell: CellDescription) -> None:
        self._driver = driver
        self.clock: Clock = driver.clock
        self.period_s = driver.period_s
        given = driver.capabilities
        self.capabilities = Capabilities(given.simulated, given.stepped, False, given.sees_scene)
        self.watch: Watch = driver.watch if given.stepped else UnheardWatch(driver.watch)
        state = driver.state()
        self._tools = [arm.arm.tool for arm in cell.arms]
        self.assumed = tuple(arm.name for arm in state.arms if not _knows_itself(arm))
        self._kept = [_held(arm) for arm in state.arms]
        if self.assumed:
            start = start_axes(cell, np.zeros((len(cell.arms), 7))).tolist()
            for index, (arm, row) in enumerate(zip(state.arms, start, strict=True)):
                if arm.name in self.assumed:
                    self._kept[index] = JointSetpoint(tuple(row[:6]), REST, row[6], 0.0)

    def connect(self) -> None:
        """It is connected."""

    def enable(self) -> None:
        """Not sent."""

    def home(self) -> None:
        """Not sent."""

    def hold(self) -> None:
        """Not sent."""

    def disable(self) -> None:
        """Not sent."""

    def close(self) -> None:
        """Ends the other driver, which never had its arms enabled."""
        self._driver.close()

    def state(self) -> CellState:
        """The newest reading, with arms that are where they would have been sent."""
        state = self._driver.state()
        now = self.clock.now()
        arms = [
            _followed(arm, kept, tool, now if arm.name in self.assumed else arm.stamp_s)
            for arm, kept, tool in zip(state.arms, self._kept, self._tools, strict=True)
        ]
        return replace(state, arms=tuple(arms))

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        """Kept, not sent."""
        self._kept = accepted(setpoints)

    def scene(self) -> Scene | None:
        """Where the other driver sees the things."""
        return self._driver.scene()

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does: it is no word to the arms."""
        self._driver.say(consent, estop)

    def break_drive(self, joint: str, kind: str) -> None:
        """Nothing is broken where nothing is sent."""
        raise DriverError("nothing is sent to the arms; break drives in a dry run")

    def active_object(self) -> ActiveObject:
        """Nothing moves, so nothing is to be judged."""
        raise DriverError("nothing is sent to the arms; judge things in a dry run")

    def reset(self, layout: Scene) -> None:
        """Nothing is sent."""
        raise DriverError("nothing is sent to the arms; put things in place before")


def _knows_itself(arm: ArmState) -> bool:
    return arm.is_homed and arm.valid


def _held(arm: ArmState) -> JointSetpoint:
    return JointSetpoint(arm.setpoint_jp, REST, arm.jaw_setpoint_jp, 0.0)


def _followed(arm: ArmState, kept: JointSetpoint, tool: str, stamp_s: float) -> ArmState:
    """An arm that is enabled, homed and where it was sent; everything else as it was read."""
    return replace(
        arm,
        stamp_s=stamp_s,
        valid=True,
        operating_state=ENABLED,
        is_homed=True,
        is_busy=False,
        measured_jp=kept.jp,
        measured_jv=kept.jv,
        jaw_measured_jp=kept.jaw,
        jaw_measured_jv=kept.jaw_v,
        setpoint_jp=kept.jp,
        jaw_setpoint_jp=kept.jaw,
        joint_names=PSM_JOINTS,
        tool=arm.tool or tool,
    )
