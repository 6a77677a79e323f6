"""The gate between other people's CRTK programs and a robot: `viskill guard`.

The client's own stream is the clock: a setpoint is judged when it comes and goes on at once, bit
for bit. While nothing comes the gate looks once a period, so that consent, feedback and watchdog
are kept an eye on. Only the operator's pedal arms the gate and lets a held run go on.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Final

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import (
    Action,
    ArmState,
    CellState,
    JointSetpoint,
    Mode,
    Request,
    Verdict,
)
from viskill_deploy.drivers.crtk.driver import CrtkDriver, nothing
from viskill_deploy.drivers.crtk.offered_arm import MOST, OfferedArm
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.motion.links import CellLinks
from viskill_deploy.runtime.client_stream import ClientStream
from viskill_deploy.runtime.delivery import Delivery
from viskill_deploy.runtime.record import Recorder
from viskill_deploy.runtime.telling import Telling, silent
from viskill_deploy.safety.decision import Decision
from viskill_deploy.safety.supervisor import Supervisor

STOP_S: Final = 2.0
"""What the gate's own stop gets before the guard ends anyway."""

AHEAD_S: Final = 0.0015
"""The robot's state is read so long before a setpoint is due, which then need not wait for it. From
667 Hz on there is no time for that."""

FRESH_S: Final = 0.003
"""A state that was read longer ago is read anew."""


@dataclass(frozen=True, slots=True)
class GuardCounts:
    """What came of the client's setpoints.

    Attributes:
        passed: cycles in which they went on to the robot, bit for bit.
        stopped: times that the gate stepped in.
        filled: setpoints that were lost on the way and judged by what lay between, not sent.
    """

    passed: int = 0
    stopped: int = 0
    filled: int = 0


HOLDS: Final = {"pause", "hold"}
ENDS: Final = {"disable", "unhome"} | HOLDS
"""Commands that end enabling and homing."""


class Guard:
    """A gate with a client on one side and a robot on the other.

    Args:
        cell: the arms in their places.
        driver: the robot, connected.
        transport: where the client is.
        recorder: where every cycle is recorded.
        prefix: stands in front of the arms' names towards the client.
        tell: called with new verdicts and the mode; clients are told them on `warning`, and a
            mode without verdicts on `status`.
        recover: puts a robot right that was in FAULT, after a person has looked at it.
        named: words for a rule's id.
        say: called with why the arms are stopped, and what the driver complains of.

    Attributes:
        gate: the gate.
        counts: what came of the client's setpoints.
        is_reset_wanted: a person has looked at what ended the run, and clears it.
        is_stop_wanted: a person wants the end.
    """

    def __init__(
        self,
        cell: CellDescription,
        driver: CrtkDriver,
        transport: Transport,
        recorder: Recorder,
        prefix: str = "guarded",
        tell: Callable[[Sequence[Verdict], Mode], None] = silent,
        recover: Callable[[], None] = lambda: None,
        named: Callable[[str], str] = str,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.driver, self.gate = driver, Supervisor(cell, driver.period_s)
        self._delivery = Delivery(driver, self.gate)
        self._bell = threading.Event()
        self.arms = [OfferedArm(arm, transport, prefix, self._bell.set) for arm in cell.arms]
        jerks = [arm.max_jerk for arm in self.gate.envelope.arms]
        self._stream = ClientStream(self.arms, driver.period_s, jerks)
        self._telling = Telling(self.arms, tell, say, named)
        self._recorder, self._links, self._recover = recorder, CellLinks(cell), recover
        self._state, self._read_s = driver.state(), -inf
        self._last_s = driver.clock.now()
        self._halt = ""  # why the arms have to come to rest
        self._is_armed = self._is_stopping = self._at_rest = False
        self._had_consent = True  # only one that was seen to rise counts
        self._wants_on = self._wants_off = self.is_reset_wanted = self.is_stop_wanted = False
        self.counts = GuardCounts()

    def run(self) -> None:
        """Guards until somebody wants the end; the arms are at rest and without power then."""
        clock = self.driver.clock
        try:
            while not self.is_stop_wanted:
                self._bell.wait(max(self.turn(clock.now()) - clock.now(), 0.0))
                self._bell.clear()
        finally:
            self.close()

    def ask_to_stop(self) -> None:
        """A person wants the end: acts at the next look."""
        self.is_stop_wanted = True

    def turn(self, now: float) -> float:
        """Does what is due; returns when to look again at the latest, driver's clock."""
        self._obey(now)
        now = max(self.driver.clock.now(), now)  # enabling and homing take their time
        for _ in range(MOST):
            if not (self._is_armed and self._is_due(now)):
                break
            self._cycle(now)
            now = max(self.driver.clock.now(), now)  # of several that wait, each takes its time
            if self._is_stopping:
                break
        if self._is_armed:
            if now >= self._ahead_s > self._read_s:
                self._read(now)
                return self._next_s()  # what else there is to do would be in the setpoint's way
        elif now >= self._last_s + self.driver.period_s:
            self._await_operator(now)
        self._telling.states(self._state, self.gate.mode, self._is_armed, now)
        return self._next_s()

    def close(self) -> None:
        """Brings moving arms to rest, takes their power and closes the robot's side."""
        clock = self.driver.clock
        deadline = clock.now() + STOP_S
        self._halt = "the guard was ended"
        try:
            while self._is_armed and not self._at_rest and clock.now() < deadline:
                clock.sleep_until(self._last_s + self.driver.period_s)
                self._cycle(clock.now())
        finally:
            if self._at_rest or not self._is_armed:  # else the watchdog stays with the arms
                self.driver.watch.release()
            self.driver.close()

    def _is_due(self, now: float) -> bool:
        return now >= self._due_s

    @property
    def _due_s(self) -> float:
        """When the gate looks again, if nothing more comes before."""
        if not self._is_armed or self._is_stopping or self._halt:
            return self._last_s + self.driver.period_s
        return self._stream.due_s(self._last_s)

    def _next_s(self) -> float:
        is_streaming = self._is_armed and not (self._is_stopping or self._halt)
        is_unread = is_streaming and not self._stream.is_waiting and self._read_s < self._ahead_s
        return min(self._ahead_s, self._due_s) if is_unread else self._due_s

    @property
    def _ahead_s(self) -> float:
        """When the state is read that the next setpoint is judged by."""
        return self._last_s + self.driver.period_s - AHEAD_S

    def _cycle(self, now: float) -> None:
        """Judges what the client asks for, with what was lost before it, and sends it on."""
        state = self._state if self._is_fresh(now) else self._read(now)
        has_consent = state.inputs.consent is True
        self._wants_on = has_consent and (self._wants_on or not self._had_consent)
        self._had_consent = has_consent
        if self._wants_on and self.gate.mode is Mode.HOLDING:
            self._go_on(state, now)
        *lost, request = self._requests(now)
        for between in lost:
            if not self._judge(state, between, now, is_sent=False):
                return
            self.counts = replace(self.counts, filled=self.counts.filled + 1)
        self._judge(state, request, now)

    def _is_fresh(self, now: float) -> bool:
        """Whether the state that was read ahead is judged by; a person's no is, however old."""
        if self._read_s <= self._last_s:
            return False
        inputs = self._state.inputs
        is_no = inputs.consent is not True or inputs.estop is not False
        return is_no or 0.0 <= now - self._read_s < FRESH_S

    def _requests(self, now: float) -> list[Request]:
        """What the gate is asked, in order; all but the last were never heard."""
        if self._is_stopping:
            self._stream.forget()
            return [Request(self._stream.sent)]
        return self._stream.requests(self._halt, now)

    def _judge(self, state: CellState, request: Request, now: float, is_sent: bool = True) -> bool:
        """One cycle of the gate; whether the request passed."""
        if not self._recorder.alive:
            self.gate.report_fault("S32", now)
        is_new = request.failure and not self._is_stopping
        decision = self.gate.check(state, request, now)
        self._last_s = now
        if is_sent or not decision.passed:
            self._delivery.send(decision, now)
        self.driver.watch.beat(self.driver.clock.now())
        is_over = self._at_rest  # the last sample of the stop has gone out twice
        self._note(decision, now)
        has_gone_out = (is_sent or not decision.passed) and not self._delivery.missed
        sent = self._stream.sent if has_gone_out else ()
        tips = (
            self._links.tips([arm.measured_jp for arm in state.arms])
            if decision.action < Action.FAULT
            else None
        )
        record = (decision.action, decision.verdicts, decision.mode, tips)
        self._recorder.cycle(now, state, request, sent, *record)
        if is_new:
            self._telling.reason(request.failure, now)
        if is_over and self._wants_off:
            self._switch_off()
        return decision.passed

    def _note(self, decision: Decision, now: float) -> None:
        self._stream.note(tuple(checked.setpoint for checked in decision.setpoints))
        began = not decision.passed and not self._is_stopping
        counts = self.counts
        self.counts = replace(
            counts, passed=counts.passed + decision.passed, stopped=counts.stopped + began
        )
        self._is_stopping, self._at_rest = not decision.passed, decision.at_rest
        if self._is_stopping:
            self._halt = ""
        self._telling.cycle(decision.verdicts, decision.mode, decision.passed, now)

    def _read(self, now: float) -> CellState:
        """The newest state; the client is told when the driver complains."""
        self._state, self._read_s = self._delivery.read(self._state), now
        if self._delivery.trouble:
            self._telling.reason(self._delivery.trouble, now)
        return self._state

    def _await_operator(self, now: float) -> None:
        """Arms the gate when everything is ready and the operator presses the pedal."""
        self._last_s = now
        try:
            self._state = state = self.driver.state()
        except DriverError as error:
            self._telling.reason(str(error), now)
            return
        self._stream.forget()
        has_consent = state.inputs.consent is True
        rises = has_consent and not self._had_consent
        self._had_consent = has_consent
        if self.gate.connect(state) is not Mode.READY or not rises:
            return
        against = self.gate.arm(state, now)
        self._telling.verdicts(against, self.gate.mode, now)
        if not against:
            self._stream.begin(tuple(map(_held, state.arms)))
            self._delivery.begin()
            self._is_armed, self._halt = True, ""
            self._telling.begin(self.gate.mode)
            self._wants_on = self._is_stopping = self._at_rest = False

    def _go_on(self, state: CellState, now: float) -> None:
        """The operator has pressed the pedal anew: a held run goes on as soon as all is well."""
        if not self.gate.resume(state, now):
            self._wants_on = self._is_stopping = self._at_rest = False
            self._stream.begin(self._stream.sent)
            self._telling.verdicts((), self.gate.mode, now)

    def _obey(self, now: float) -> None:
        """What the client commands counts for all arms of the cell."""
        if self.is_reset_wanted:
            self.is_reset_wanted = False
            self._reset(now)
        for arm in self.arms:
            while arm.commands:
                self._follow(arm, arm.commands.popleft(), now)

    def _follow(self, arm: OfferedArm, word: str, now: float) -> None:
        try:
            match word:
                case "enable" | "home" if not self._is_armed:
                    self._make_ready(word, now)
                case "enable" | "home":
                    pass
                case "pause":
                    self._halt = self._halt or "the client asked for pause"
                case "hold" if self._stream.is_moving or self._stream.is_waiting:
                    self._halt = self._halt or "the client asked for hold"
                case "hold":
                    pass
                case "disable":
                    self._wants_off = True
                    self._halt = "the client disables the arms"
                    if not self._is_armed:
                        self._switch_off()
                case "resume":
                    arm.error("a held run goes on when the operator presses the pedal anew", now)
                case _:
                    arm.error(f'command "{word}" does not pass the guard', now)
        except DriverError as error:
            arm.error(str(error), self.driver.clock.now())

    def _make_ready(self, word: str, now: float) -> None:
        """Enabling and homing take a while, in which the client is told so and may end them.

        Raises:
            DriverError: the arms do not follow, or somebody wants something else.
        """
        if self.gate.latched is Action.ESTOP:
            raise DriverError(f"{word}: an emergency stop; start the guard anew without its cause")
        if self.gate.latched > Action.HOLD:
            raise DriverError(f'{word}: a person has to type "reset" at the guard first')
        for arm in self.arms:
            while arm.commands and arm.commands[0] in HOLDS:
                arm.commands.popleft()  # of before: nothing moves
        self._telling.busy(self._state, now)
        self.driver.meanwhile = self._attend
        try:
            (self.driver.enable if word == "enable" else self.driver.home)()
        except DriverError:
            if self._is_to_end():
                self.driver.disable()  # an arm that is homing goes on else, whatever it is told
                for arm in self.arms:
                    arm.commands.clear()  # the others' part of what was ended, and what ended it
            raise
        finally:
            self.driver.meanwhile = nothing

    def _is_to_end(self) -> bool:
        """Whether a person or a client wants no enabling and no homing any more."""
        waiting = {word for arm in self.arms for word in arm.commands}
        return self.is_stop_wanted or not waiting.isdisjoint(ENDS)

    def _attend(self) -> None:
        """Looks on while the arms are enabled or homed.

        Raises:
            DriverError: that is to end.
        """
        if self._is_to_end():
            raise DriverError("enabling or homing was ended: the arms lose their power")
        with contextlib.suppress(DriverError):  # the driver finds the same, and says so
            self._state = self.driver.state()
            self._had_consent = self._state.inputs.consent is True
        self._telling.busy(self._state, self.driver.clock.now())

    def _switch_off(self) -> None:
        """Power off at the client's wish; what is worse than a HOLD stays for a person to clear."""
        self._wants_off, self._halt, self._is_armed = False, "", False
        if self.gate.latched <= Action.HOLD:
            self.gate.reset(self.driver.clock.now())
        self.driver.watch.release()
        self.driver.disable()

    def _reset(self, now: float) -> None:
        """A person clears what has ended the run; never an emergency stop, never while moving."""
        if self.gate.reset(now) is Mode.CONNECTED:
            self._is_armed = self._is_stopping = self._wants_off = False
            self._telling.begin(self.gate.mode)
            self._had_consent = True
            self.driver.watch.release()
            try:
                self._recover()
            except DriverError as error:
                self._telling.reason(str(error), now)
        self._telling.verdicts((), self.gate.mode, now)


def _held(arm: ArmState) -> JointSetpoint:
    """What an arm holds, at rest."""
    rest = (0.0,) * len(arm.setpoint_jp)
    return JointSetpoint(arm.setpoint_jp, rest, arm.jaw_setpoint_jp, 0.0)
