"""A driver of a simulated cell between which and the runtime things go wrong."""

from __future__ import annotations

import math
import os
import signal
import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ActiveObject, ArmState, CellState, JointSetpoint, Scene
from viskill_deploy.drivers.base import Driver
from viskill_deploy.drivers.watch import Watch
from viskill_deploy.runtime.faults import Injection
from viskill_deploy.safety.checked import CheckedSetpoint
from viskill_deploy.safety.watchdog import RELEASED, Reaction, Watchdog

DELAY_S = 0.08
BIAS_RAD_S = 0.2
ENCODER_JUMP_RAD = 0.08
BACK_S = 1.0
EXPONENT_BIT = 1 << 62
"""The highest bit of a float's exponent: a joint of less than 1 rad becomes 2 rad or more."""

HOUR_S = 3600.0
JUMPS_S = {
    "clock+1h": HOUR_S,
    "clock-1h": -HOUR_S,
    "clock+1d": 24 * HOUR_S,
    "clock-1d": -24 * HOUR_S,
}


class Faults(Protocol):
    """What says which faults act."""

    def on(self, name: str) -> Injection | None:
        """The injection of the fault that is called so, if it acts now."""
        ...

    def elapsed_s(self) -> float:
        """Time since the first setpoint, s."""
        ...

    def update(self) -> None:
        """Begins what is due and ends what is over."""
        ...

    def sees_setpoints(self, setpoints: Sequence[JointSetpoint]) -> None:
        """Setpoints go out."""
        ...


class _FaultyClock:
    """The driver's clock, which may go back."""

    def __init__(self, clock: Clock, faults: Faults) -> None:
        self._clock, self._faults = clock, faults

    def now(self) -> float:
        return self._clock.now() - self._back_s()

    def sleep_until(self, deadline_s: float) -> float:
        self._clock.sleep_until(deadline_s + self._back_s())
        return self.now()

    def _back_s(self) -> float:
        return BACK_S if self._faults.on("clock-back") else 0.0


class FaultyDriver:
    """Hands everything on to a driver, and spoils what the faults say.

    Args:
        driver: of a simulated cell.
        faults: what acts when.
    """

    def __init__(self, driver: Driver, faults: Faults) -> None:
        self._driver, self._faults = driver, faults
        self.period_s, self.capabilities = driver.period_s, driver.capabilities
        self.clock: Clock = _FaultyClock(driver.clock, faults)
        self._history: deque[CellState] = deque(maxlen=2 + math.ceil(DELAY_S / driver.period_s))
        self._count = 0
        self._frozen: CellState | None = None
        self._last: Sequence[CheckedSetpoint] = ()
        self._beat_s = RELEASED
        self._watchdog_gone_s = math.nan
        self._stepped_in = False

    @property
    def watch(self) -> Watch:
        """The watchdog of the driver."""
        return self._driver.watch

    def kill_watchdog(self) -> None:
        """Kills the watchdog's process; on a stepped cell, which has none, it looks no more."""
        process = getattr(self._driver.watch, "process", None)
        if process is None:
            self._watchdog_gone_s = self._driver.clock.now()
        else:
            os.kill(process.pid, signal.SIGKILL)

    def stand_still(self, time_s: float) -> None:
        """The world of a stepped cell goes on without the runtime, under its watchdog."""
        clock, watchdog = self._driver.clock, Watchdog()
        beat = clock.now()
        while clock.now() < beat + time_s - 1e-9:
            clock.sleep_until(clock.now() + self.period_s)
            match watchdog.look(beat, clock.now(), is_runtime_gone=False):
                case Reaction.HOLD:
                    self._stepped_in = True
                    self._driver.hold()
                case Reaction.DISABLE:
                    self._driver.disable()

    def connect(self) -> None:
        """Opens the connection."""
        self._driver.connect()

    def enable(self) -> None:
        """Asks every arm for ENABLED."""
        self._reach()
        self._driver.enable()

    def home(self) -> None:
        """Asks every enabled arm to home."""
        self._reach()
        self._driver.home()

    def hold(self) -> None:
        """Every arm stays at the setpoint that it holds."""
        self._reach()
        self._driver.hold()

    def disable(self) -> None:
        """Takes power from every arm."""
        self._reach()
        self._driver.disable()

    def close(self) -> None:
        """Closes the connection."""
        self._driver.close()

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does."""
        self._reach()
        self._driver.say(consent, estop)

    def active_object(self) -> ActiveObject:
        """The truth about the active object."""
        return self._driver.active_object()

    def break_drive(self, joint: str, kind: str) -> None:
        """A joint's drive breaks."""
        self._driver.break_drive(joint, kind)

    def reset(self, layout: Scene) -> None:
        """Puts arms and objects where `layout` says."""
        self._reach()
        self._history.clear()
        self._driver.reset(layout)

    def scene(self) -> Scene | None:
        """Where the objects are."""
        self._reach()
        return self._driver.scene()

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        """Sends setpoints, or as much of them as gets through."""
        self._faults.sees_setpoints([checked.setpoint for checked in setpoints])
        self._reach()
        if self._faults.on("partial-write") and self._last:
            self._driver.servo_jp((setpoints[0], *self._last[1:]))
            raise DriverError("the connection broke off within a message (fault)")
        self._last = setpoints
        self._driver.servo_jp(setpoints)

    def state(self) -> CellState:
        """The newest measurement, or what the faults make of it."""
        self._faults.update()
        self._reach()
        state = self._driver.state()
        if not self._history or state.arms[0].stamp_s > self._history[-1].arms[0].stamp_s:
            self._history.append(state)
            self._count += 1
        state = replace(self._arrived(state), inputs=state.inputs)
        arm = self._spoiled(state.arms[0])
        state = replace(state, arms=(arm, *state.arms[1:]))
        return self._under_watch(self._by_another_clock(state))

    def _reach(self) -> None:
        """Raises DriverError while there is no connection."""
        if self._faults.on("disconnect") or self._faults.on("reconnect"):
            raise DriverError("the connection to the robot is gone (fault)")

    def _arrived(self, newest: CellState) -> CellState:
        """Which of the measurements the runtime gets to see."""
        history, faults = self._history, self._faults
        if faults.on("drop"):
            if self._frozen is None:
                self._frozen = history[-2] if len(history) > 1 else newest
            return self._frozen
        if faults.on("freeze"):
            if self._frozen is None:
                self._frozen = newest
            arms = zip(newest.arms, self._frozen.arms, strict=True)
            return replace(newest, arms=tuple(_same(new, old) for new, old in arms))
        self._frozen = None
        late = faults.on("delay")
        if late:
            since = faults.elapsed_s() - late.start_s
            due = self._driver.clock.now() - min(since, DELAY_S)
            arrived = [state for state in history if state.arms[0].stamp_s <= due]
            return arrived[-1] if arrived else history[0]
        odd = self._count % 2 == 1
        if faults.on("duplicate") and odd and len(history) > 1:
            return history[-2]
        if faults.on("reorder") and odd and len(history) > 2:
            return history[-3]
        return newest

    def _spoiled(self, arm: ArmState) -> ArmState:
        """What is left of the measurement of the first arm's first joint."""
        for name, spoil in _SPOILERS.items():
            injection = self._faults.on(name)
            if injection is not None:
                first, *others = arm.measured_jp
                since = self._faults.elapsed_s() - injection.start_s
                arm = replace(arm, measured_jp=(spoil(first, since), *others))
        return arm

    def _by_another_clock(self, state: CellState) -> CellState:
        """The stamps of a robot whose clock has jumped."""
        jump = next((by for name, by in JUMPS_S.items() if self._faults.on(name)), 0.0)
        if not jump:
            return state
        return replace(
            state, arms=tuple(replace(arm, stamp_s=arm.stamp_s + jump) for arm in state.arms)
        )

    def _under_watch(self, state: CellState) -> CellState:
        """What a stepped cell's watchdog would say, had it one."""
        inputs = state.inputs
        if not math.isnan(self._watchdog_gone_s):
            inputs = replace(inputs, watchdog_stamp_s=self._watchdog_gone_s)
        if self._stepped_in:
            inputs = replace(inputs, watchdog_stepped_in=True)
        return replace(state, inputs=inputs)


def _same(new: ArmState, old: ArmState) -> ArmState:
    """A sample that is new by its stamp and old by what it says."""
    return replace(
        new,
        measured_jp=old.measured_jp,
        measured_jv=old.measured_jv,
        jaw_measured_jp=old.jaw_measured_jp,
        jaw_measured_jv=old.jaw_measured_jv,
    )


def flipped(value: float) -> float:
    """A number of which the highest bit of the exponent is flipped."""
    (bits,) = struct.unpack("<Q", struct.pack("<d", value))
    (result,) = struct.unpack("<d", struct.pack("<Q", bits ^ EXPONENT_BIT))
    return float(result)


_SPOILERS: dict[str, Callable[[float, float], float]] = {
    "nan": lambda q, since: math.nan,
    "bias": lambda q, since: q + BIAS_RAD_S * since,
    "bit-flip": lambda q, since: flipped(q),
    "encoder-jump": lambda q, since: q + ENCODER_JUMP_RAD,
}
