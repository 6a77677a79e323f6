"""One run on one driver: read, decide, gate, send, record, once in every control period."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Self

from viskill_deploy.core import realtime
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError, Interrupted, SafetyStop, ViskillError
from viskill_deploy.core.types import (
    Action,
    CellState,
    FloatArray,
    Inputs,
    Mode,
    ObservationRange,
    Request,
    Scene,
    Verdict,
    Waypoint,
)
from viskill_deploy.drivers.base import Driver
from viskill_deploy.drivers.watch import OwnTime
from viskill_deploy.runtime.consent import Consent, consent_of
from viskill_deploy.runtime.delivery import Delivery
from viskill_deploy.runtime.ledger import EpisodeResult, Ledger
from viskill_deploy.runtime.line import Coming, Line
from viskill_deploy.runtime.planning import Plan
from viskill_deploy.runtime.poses import Things
from viskill_deploy.runtime.record import Recorder
from viskill_deploy.runtime.scene_watch import SceneWatch
from viskill_deploy.safety.decision import Decision
from viskill_deploy.safety.supervisor import Supervisor

HOLDING_RAD = 0.08
"""A jaw that is told to close and stays open farther than this has something in it."""

SIMULATED = "simulated"
"""Source of the consent that the loopback's own operator gives; no real arm moves on it."""

READY_PERIODS = 50
"""Control periods that the arms get, at least, to become READY."""

LAST_CYCLES = 5
"""The last sample of a motion that ends at rest still moves by a micrometre; more are sent."""

SURE_S = 0.3
"""Before a HOLD is cleared the gate looks on for this long, and more than its own clean while."""

STOP_S = 2.0
"""Time that the gate's own stop gets before the session gives up waiting for rest."""


class Session:
    """Drives a cell through the gate.

    Args:
        cell: the arms in their places.
        driver: a connected driver.
        line: from waypoints to requests.
        recorder: where the run is recorded.
        training: what the policy has seen in training; None where no policy is asked.
        consent: who lets the arms move; by default, the driver's simulated operator.
        things: who knows where the things are; by default, the driver.

    Raises:
        DriverError: the driver's time goes on by itself, and it brings no watchdog.

    Attributes:
        cause: id of the rule for which the gate first stepped in since `begin`; "" if it did not.
        is_stop_wanted: a person has asked for the end of the run.
        thinking_s: how much longer the policy takes to decide than it does by itself; for tests.
        empty_jaw_rad: how far each jaw is open when it closes on nothing; () until measured.
    """

    def __init__(
        self,
        cell: CellDescription,
        driver: Driver,
        line: Line,
        recorder: Recorder,
        training: ObservationRange | None = None,
        consent: Consent | None = None,
        things: Things | None = None,
    ) -> None:
        if isinstance(driver.watch, OwnTime) and not driver.capabilities.stepped:
            raise DriverError("a driver whose time goes on without us needs a watchdog; add one")
        self.cell, self.driver, self.line, self.recorder = cell, driver, line, recorder
        self.gate = Supervisor(cell, driver.period_s, training, line.speed)
        self._delivery = Delivery(driver, self.gate)
        self._consent = consent or consent_of(driver)
        self._scenes = SceneWatch(driver, things, recorder)
        self.ledger = Ledger(cell, driver.period_s, self.gate.rules)
        self.overruns, self.cause = 0, ""
        self.thinking_s: Callable[[], float] = lambda: 0.0
        self._deadline = 0.0
        self._waypoint: Waypoint | None = None
        self._is_stopping, self._at_rest, self._is_moving = False, False, False
        self.is_stop_wanted = False
        self.empty_jaw_rad: tuple[float, ...] = ()
        self._state = CellState((), Inputs(False, 0.0, "", True))  # closed until one is read

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Whatever ended the run, also Ctrl-C: the arms come to rest before the driver closes."""
        try:
            self.settle()
        finally:
            self.driver.close()
            if not self.driver.capabilities.stepped:
                realtime.release()

    @property
    def is_armed(self) -> bool:
        """Whether the arms may move: between `begin` and `finish`, or until they are stopped."""
        return self._is_moving

    def settle(self) -> None:
        """Brings arms that are still under way to rest."""
        if self._is_moving:
            self.line.fail("the run was ended")
            self.come_to_rest()

    def make_ready(self) -> CellState:
        """Enables and homes the arms, which may move them; returns their state."""
        if not self.driver.capabilities.stepped:
            realtime.settle()  # takes its time: before arms have power and count on us
        self.driver.enable()
        self.driver.home()
        self._deadline = self.driver.clock.now()
        self._wait_for_next_period()
        return self.driver.state()

    def go_on(self) -> None:
        """Raises Interrupted when a person has asked for the end while nothing moves."""
        if self.is_stop_wanted:
            raise Interrupted("interrupted; the arms are at rest")

    def check(self, plan: Plan, state: CellState) -> dict[str, float]:
        """Puts a plan before a gate that lets nothing out: `Plan.check` as this session runs."""
        line = self.line
        return plan.check(self.cell, self.driver.period_s, state, line.ik_solver, line.speed)

    def begin(self) -> None:
        """Gets the operator's consent and arms the gate; the arms are ready.

        What an earlier episode has latched is cleared by the simulated operator; on a real cell
        that is a person's business, and an emergency stop is nobody's in this process.

        Raises:
            SafetyStop: the gate refuses; names the rules.
        """
        if not self.driver.capabilities.stepped:
            realtime.prepare()
        try:
            state = self._armed()
        except ViskillError:
            self._stand_easy()
            raise
        self._set_out(state)

    def _set_out(self, state: CellState) -> None:
        """The gate lets the arms move from here on."""
        self.line.start(state)
        self._state, self._waypoint = state, None
        self.cause = ""
        self._delivery.begin()
        self._is_stopping, self._at_rest, self._is_moving = False, False, True

    def _armed(self) -> CellState:
        """The state in which the operator agreed and the gate was armed."""
        consent, self._deadline = self._consent, self.driver.clock.now()
        consent.clear(self.gate, self._deadline)
        consent.want(False)
        self._watch(lambda state: not state.inputs.consent)
        consent.want(True)
        state = self._watch(lambda state: state.inputs.consent)
        if state.inputs.consent_source == SIMULATED and not self.driver.capabilities.simulated:
            raise SafetyStop(
                "the operator is simulated and the arms are not; a person has to agree to motion"
            )
        against = self.gate.arm(state, self.driver.clock.now())
        if against:
            reasons = ", ".join(f"{v.rule} ({v.value:.4g}, limit {v.limit:.4g})" for v in against)
            raise SafetyStop(f"the gate refuses to arm: {reasons}; put that right and start again")
        return state

    def finish(self) -> None:
        """The motion has ended by itself, at rest: the gate is disarmed. May be called twice."""
        if not self._is_moving:
            return
        for _ in range(LAST_CYCLES):
            if not self.cycle() or self.gate.disarm() is Mode.CONNECTED:
                break
        self._stand_easy()

    def ask_to_stop(self) -> None:
        """A person wants the run to end: acts at the end of the present cycle."""
        self.is_stop_wanted = True

    def stand(self, periods: int) -> list[CellState]:
        """Lets time pass while nothing moves and nothing is sent; the states that were seen.

        Raises:
            DriverError: the driver failed.
        """
        self._deadline, states = self.driver.clock.now(), []
        for _ in range(periods):
            self._wait_for_next_period()
            states.append(self.driver.state())
        return states

    def _watch(self, seen: Callable[[CellState], bool]) -> CellState:
        """Shows the gate states until one is as awaited, or people and arms had time enough."""
        patience_s = self._consent.patience_s
        deadline, periods = self.driver.clock.now() + patience_s, READY_PERIODS
        while periods > 0 or self.driver.clock.now() < deadline:
            periods -= 1
            self._wait_for_next_period()
            state = self.driver.state()
            self.gate.connect(state)
            if seen(state) and self.gate.mode is Mode.READY:
                break
            self.go_on()
        return state

    def go_to(self, waypoint: Waypoint, last: bool = False, coming: Coming | None = None) -> float:
        """Begins the motion to a waypoint; returns its stretch."""
        self._waypoint = waypoint
        return self.line.go_to(waypoint, last, coming)

    def allow(self, waypoint: Waypoint | None) -> None:
        """Says which waypoint a motion that goes on by itself is at, for the jaw rule."""
        self._waypoint = waypoint

    def cycle(self) -> bool:
        """One control period. True while the gate passes what the line asks for.

        Whatever goes wrong with the driver becomes a verdict, never an exception: the gate stops
        the arms with what it knows.
        """
        now = self.driver.clock.now()
        state = self.read()
        request = self._request(now, state)
        if not self.recorder.alive:
            self.gate.report_fault("S32", now)
        decision = self.gate.check(state, request, now)
        sent = tuple(checked.setpoint for checked in decision.setpoints)
        self._delivery.send(decision, now)
        if self._is_moving:  # arms that rest need nobody who would take a slow look for a hang
            self.driver.watch.beat(self.driver.clock.now())
        self._note(decision)
        if self.is_stop_wanted and not self._is_stopping:
            self.line.fail("the operator ended the run")
        mode, verdicts = decision.mode, decision.verdicts
        # a faulty arm may report numbers that have no pose
        tips = self.tips(state) if decision.action < Action.FAULT else None
        gone_out = () if self._delivery.missed else sent
        self.recorder.cycle(now, state, request, gone_out, decision.action, verdicts, mode, tips)
        self._follow_things(now, state)
        self._scenes.record(now)
        self.ledger.cycle(sent, decision.action, decision.margins)
        self.line.advance(decision.speed_scale)
        self._wait_for_next_period()
        return decision.passed

    @property
    def is_held(self) -> bool:
        """Whether the gate holds the arms, and for nothing worse: an operator may resume."""
        return self.gate.latched is Action.HOLD

    def attend(self) -> None:
        """Punctual again under the gate's stop, while people and plans take their time."""
        if not self.driver.capabilities.stepped:
            realtime.first_in_line()

    def resume(self) -> tuple[Verdict, ...]:
        """The operator clears a HOLD; the line stands where the arms are held.

        Returns:
            What the gate has against it; empty when the run may go on.
        """
        if not self.driver.capabilities.stepped:
            realtime.prepare(sweeps=False)
        for _ in range(round(SURE_S / self.driver.period_s)):
            self.cycle()
        state = self.read()
        against = self.gate.resume(state, self.driver.clock.now())
        if not against:
            self._set_out(state)
        return against

    def come_to_rest(self, result: EpisodeResult | None = None) -> None:
        """After the gate has stepped in: lets its stop run out, and notes the cause.

        From arms that do not come to rest in time the watchdog takes the power: no beat is its cue.
        """
        deadline = self.driver.clock.now() + STOP_S
        while self.driver.clock.now() < deadline and not self._at_rest:
            self.cycle()
        self.cycle()  # the last sample of the stop once more: the record ends at rest
        self._stand_easy(self._at_rest)
        if result is not None:
            result.stopped_by = self.cause
            result.reason = self.trouble or self.line.fault

    def _stand_easy(self, is_at_rest: bool = True) -> None:
        """Needs no punctuality from here on; arms that may still move are left to the watchdog."""
        self._is_moving = False
        if is_at_rest:
            self.driver.watch.release()
        if not self.driver.capabilities.stepped:
            realtime.pause()

    def read(self) -> CellState:
        """The newest state; the last one, and a report to the gate, when the driver fails."""
        self._state = self._delivery.read(self._state)
        return self._state

    @property
    def trouble(self) -> str:
        """What the driver first complained of since the motion began, in words; or ""."""
        return self._delivery.trouble

    def _request(self, now: float, state: CellState) -> Request:
        """What the line asks for; once the gate is stopping the arms, to stay where it leads."""
        if self._is_stopping:
            return Request(self.ledger.last_sent)
        try:
            return self.line.request(now, self._waypoint, self._holding(state))
        except (ViskillError, ValueError) as error:
            return Request(None, failure=str(error))

    def _note(self, decision: Decision) -> None:
        """Remembers what the gate first stepped in for, and whether its stop is over."""
        self._at_rest, self._is_stopping = decision.at_rest, not decision.passed
        if not self.cause:
            severest = max(decision.verdicts, key=lambda v: v.action, default=None)
            if severest is not None and severest.action >= Action.HOLD:
                self.cause = severest.rule

    def tips(self, state: CellState) -> list[FloatArray]:
        """Measured T_task_tip of every arm."""
        return self.line.links.tips([arm.measured_jp for arm in state.arms])

    def _holding(self, state: CellState) -> tuple[bool, ...]:
        """Per arm, whether its jaw is told to close and something keeps it open."""
        return tuple(
            [arm.jaw_measured_jp > HOLDING_RAD > arm.jaw_setpoint_jp for arm in state.arms]
        )

    def scene(self) -> Scene:
        """Where the things are; raises DriverError where nothing tells, or not any more."""
        return self._scenes.scene()

    def seen(self) -> Scene:
        """The things that somebody sees; raises DriverError as `scene` does."""
        return self._scenes.seen()

    def _follow_things(self, now: float, state: CellState) -> None:
        """What is not seen for too long ends the motion."""
        if self._scenes.has_things and not (self._is_stopping or self.line.fault):
            try:
                self._scenes.follow(now, self.tips(state), self._holding(state))
            except DriverError as error:
                self.line.fail(str(error))

    def _wait_for_next_period(self) -> None:
        now, period_s = self.driver.clock.now(), self.driver.period_s
        is_back = now < self._deadline - 0.5 * period_s  # S21: the gate is to see that at once
        self._deadline = now if is_back else self._deadline + period_s
        woke = self.driver.clock.sleep_until(self._deadline)
        late = woke - self._deadline
        if late > self.driver.period_s:  # a missed period is not made up for by a burst
            self.overruns += 1
            self._deadline = woke
