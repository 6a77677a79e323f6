"""The gate: every setpoint is passed bit for bit, or replaced by the gate's own stop.

There is no switch, option or file that turns any of it off. It fails closed: what was not shown to
be good is bad, and a verdict on one arm stops the whole cell.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import nan

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import (
    Action,
    CellState,
    JointSetpoint,
    Mode,
    ObservationRange,
    Request,
    Verdict,
)
from viskill_deploy.safety.checked import _TOKEN, CheckedSetpoint
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.decision import Decision
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.modes import Modes
from viskill_deploy.safety.rule_base import Needs, Rule, find_rules, verdicts_of
from viskill_deploy.safety.stopping import ArmStop, CommonStop

CLEAN_S = 0.2
"""How long nothing must have been wrong before an operator may clear a HOLD."""

STILL = 1e-6
"""Way of an axis over the last period, rad or m, below which it is at rest."""

REPORTED_ACTION = {"S32": Action.STOP}
"""What a report asks for; FAULT for every id that is not here."""


class Supervisor:
    """Decides, one cycle at a time, what goes to the driver of a cell.

    Attributes:
        envelope: the thresholds in force.
        rules: ids of all rules, in the order of `Decision.margins`.
    """

    def __init__(
        self,
        cell: CellDescription,
        period_s: float,
        training: ObservationRange | None = None,
        speed: float = 1.0,
    ) -> None:
        """Reads the thresholds of a cell.

        Args:
            cell: the cell's description.
            period_s: time between two checks, 1 to 10 ms.
            training: what the policy has seen in training; None where no policy is asked.
            speed: part of every speed limit that is left, in (0, 1].

        Raises:
            DataFileError: a threshold makes no sense or is looser than the gate's ceiling.
            SafetyStop: the installation lacks a rule.
        """
        self.envelope = CellEnvelope.of(cell, period_s, training, speed)
        self._classes = find_rules()
        self.rules = tuple(rule.id for rule in self._classes)
        self._modes = Modes()
        self._cycle = Cycle(self.envelope)
        self._is_armed = False  # the tracks hold what the robot was sent
        self._saw_no_consent = False
        self._pending: list[Verdict] = []
        self._stops: list[ArmStop | CommonStop] = []
        self._stop_cycles: int  # of the latest stop, like the next two: they begin with it
        self._dirty_at: float
        self._cause: tuple[Verdict, ...]
        self._stopped_by: set[str] = set()
        self._renew_rules()

    @property
    def mode(self) -> Mode:
        """The present mode."""
        return self._modes.mode

    @property
    def latched(self) -> Action:
        """Worst action that nobody has cleared; PASS when none is."""
        return self._modes.latched

    def connect(self, state: CellState) -> Mode:
        """Follows the evidence from OFF up to READY; call it with each state until armed."""
        self._watch_people(state)
        if not self._is_armed:
            self._cycle.state = state
            homed = self._is_kept("S02") and self._is_kept("S23")
            idle = homed and all(arm.is_busy is False for arm in state.arms)
            self._modes.observe(homed, idle and self._is_kept("S04"))
        return self.mode

    def arm(self, state: CellState, now: float) -> tuple[Verdict, ...]:
        """Takes responsibility for the cell: READY → ARMED.

        All rules are asked whether the cell may stay where its driver holds it. Needs a rising
        edge of consent: a state without it since the last arming, then this one with it.

        Returns:
            Why not; empty when the cell is armed.
        """
        self.connect(state)
        if self.mode is not Mode.READY:
            return self._reasons_against_ready()
        if not (self._saw_no_consent and state.inputs.consent is True):
            return (Verdict("S22", Action.HOLD),)
        stay = tuple(
            JointSetpoint(arm.setpoint_jp, (0.0,) * len(arm.setpoint_jp), arm.jaw_setpoint_jp, 0.0)
            for arm in state.arms
        )
        if self._pending:
            return self._take_reports()
        self._renew_rules()
        for track, setpoint in zip(self._cycle.tracks, stay, strict=True):
            track.begin(setpoint)
        self._cycle.is_first, self._cycle.is_stopping = True, False
        self._cycle.stopped_before = frozenset(self._stopped_by)
        verdicts = self._judge(state, Request(stay), now)
        against = tuple(verdict for verdict in verdicts if verdict.action >= Action.HOLD)
        if not against:
            self._modes.arm()
            self._is_armed, self._saw_no_consent = True, False
        return against

    def check(self, state: CellState, request: Request, now: float) -> Decision:
        """One cycle: what goes to the driver now.

        Args:
            state: all arms and inputs as the driver reports them.
            request: what the line asks for.
            now: driver's clock, s.
        """
        self._watch_people(state)
        if not self._is_armed:
            return self._refuse()
        cycle = self._cycle
        verdicts = self._judge(state, request, now)
        worst = max([verdict.action for verdict in verdicts], default=Action.PASS)
        asked = request.setpoints
        if cycle.is_stopping or worst >= Action.HOLD or asked is None:
            return self._stop_on(verdicts, worst)
        for track in cycle.tracks:
            track.accept()
        cycle.is_first = False
        self._modes.run()
        return Decision(
            tuple([CheckedSetpoint(arm, asked[arm], _TOKEN) for arm in range(len(asked))]),
            worst,
            verdicts,
            self._modes.mode,
            _speed_scale(verdicts) if verdicts else 1.0,
            True,
            False,
            tuple(self._margins),
        )

    def resume(self, state: CellState, now: float) -> tuple[Verdict, ...]:
        """The operator clears a HOLD: HOLDING → RUNNING from rest.

        Returns:
            Why not: what caused the hold when the arms are not at rest or something was wrong
            within the last 0.2 s; empty when the run goes on.
        """
        self._watch_people(state)
        if self.mode is not Mode.HOLDING:
            return (Verdict("S09", Action.HOLD),)
        if state.inputs.consent is not True:
            return (Verdict("S22", Action.HOLD),)
        waited = self._cycle.now - self._dirty_at + ROUNDING
        is_early = not (self._is_at_rest and waited >= CLEAN_S and now >= self._cycle.now)
        if is_early or self._pending or not self._modes.resume():
            return self._cause
        self._cycle.is_first, self._cycle.is_stopping = True, False
        return ()

    def reset(self, now: float) -> Mode:
        """The operator clears a FAULT or a STOP at rest → CONNECTED; then a fresh arm is needed.

        Does nothing while the arms still move, and never clears an emergency stop.
        """
        del now  # a reset does not depend on time; the next arm() checks the clock
        if (self._is_at_rest or not self._is_armed) and self._modes.reset():
            self._is_armed = False
            self._cycle.is_stopping = False
            self._pending.clear()
        return self.mode

    def disarm(self) -> Mode:
        """A run has ended at rest: ARMED or RUNNING → CONNECTED; then a fresh arm is needed.

        Does nothing while the arms move or a stop is latched.
        """
        if self._is_armed and not self._cycle.is_stopping:
            tracks = self._cycle.tracks
            still = all(abs(step) <= STILL for track in tracks for step in track.step)
            self._is_armed = not (still and self._modes.disarm())
        return self.mode

    def report_fault(self, rule: str, now: float, value: float = nan) -> None:
        """Tells the gate of a failure elsewhere; it enters the ladder at the next check.

        Args:
            rule: "S32" when the recorder failed (STOP), "S24" for the driver (FAULT); any other
                id is a FAULT too.
            now: driver's clock, s, kept as the verdict's limit.
            value: a number that says more, for the record.
        """
        action = REPORTED_ACTION.get(rule, Action.FAULT)
        self._pending.append(Verdict(rule, action, value=value, limit=now))

    def _judge(self, state: CellState, request: Request, now: float) -> tuple[Verdict, ...]:
        """Asks every rule whose needs are sound; verdicts of those that are broken."""
        cycle, margins = self._cycle, self._margins
        cycle.begin(state, request, now)
        cycle.reports = tuple(self._pending)
        self._pending.clear()
        margins[:] = self._full_margins
        broken = self._ask(self._on_nothing)
        if margins[self._s02] >= 0.0:
            broken += self._ask(self._on_state)
            asked = request.setpoints
            if margins[self._s01] >= 0.0 and asked is not None and not cycle.is_stopping:
                for track, setpoint in zip(cycle.tracks, asked, strict=True):
                    track.ask(setpoint)
                broken += self._ask(self._on_request)
        if not broken:
            return ()
        return tuple(verdict for rule in broken for verdict in verdicts_of(rule, cycle))

    def _ask(self, rules: Iterable[tuple[int, Rule]]) -> list[Rule]:
        cycle, margins, broken = self._cycle, self._margins, []
        for index, rule in rules:
            margin = margins[index] = rule.margin(cycle)
            if not margin >= 0.0:  # also true for NaN
                broken.append(rule)
        return broken

    def _stop_on(self, verdicts: tuple[Verdict, ...], worst: Action) -> Decision:
        """Begins the gate's own stop or goes on with it; both arms, whoever is to blame."""
        cycle, modes = self._cycle, self._modes
        if not cycle.is_stopping:
            cycle.is_stopping = True
            self._stops = [track.stop() for track in cycle.tracks]
            self._stop_cycles, worst = 0, max(worst, Action.HOLD)
        self._stop_cycles += 1
        time = self._stop_cycles * self.envelope.period
        for track, stop in zip(cycle.tracks, self._stops, strict=True):
            track.ask(stop.at(time))
            track.accept()
            if not track.jerkiest <= 1.0:  # a stop that is none: the gate itself is broken
                worst = max(worst, Action.FAULT)
                rough = Verdict("S07", Action.FAULT, track.index, -1, track.jerkiest, 1.0)
                verdicts = (*verdicts, rough)
        if worst >= Action.HOLD:
            self._cause, self._dirty_at = verdicts, cycle.now
        self._stopped_by.update(v.rule for v in verdicts if v.action >= Action.STOP)
        modes.escalate(worst)
        return Decision(
            tuple([CheckedSetpoint(track.index, track.sent, _TOKEN) for track in cycle.tracks]),
            max(worst, modes.latched),
            verdicts,
            modes.mode,
            1.0,
            False,
            self._is_at_rest,
            tuple(self._margins),
        )

    @property
    def _is_at_rest(self) -> bool:
        """The gate's own stop has ended, and was sent."""
        if not (self._is_armed and self._cycle.is_stopping):
            return False
        time = self._stop_cycles * self.envelope.period
        return all(time >= stop.duration_s for stop in self._stops)

    def _refuse(self) -> Decision:
        """Before arming nothing goes out; emergency stop and reports are latched all the same."""
        verdicts = (*self._take_reports(), Verdict("S09", Action.HOLD))
        action = max(Action.HOLD, self._modes.latched)
        margins = tuple(self._full_margins)
        return Decision((), action, verdicts, self.mode, 1.0, False, False, margins)

    def _watch_people(self, state: CellState) -> None:
        """Remembers consent that was withdrawn; an emergency stop acts in every mode."""
        if state.inputs.consent is False:
            self._saw_no_consent = True
        if state.inputs.estop is not False and not self._is_armed:
            self._modes.escalate(Action.ESTOP)

    def _take_reports(self) -> tuple[Verdict, ...]:
        """What was reported while nothing moves: all of it is a fault, there is no run to end."""
        reports = tuple(self._pending)
        self._pending.clear()
        if reports:
            self._modes.escalate(Action.FAULT)
        return reports

    def _reasons_against_ready(self) -> tuple[Verdict, ...]:
        """Verdicts of the pre-checks; S09 when the mode alone forbids it."""
        if not self._is_armed:
            for rule_id in ("S02", "S23", "S04"):
                if not self._is_kept(rule_id):
                    rule = self._rule(rule_id)
                    return verdicts_of(rule, self._cycle)
        return (Verdict("S09", Action.HOLD),)

    def _is_kept(self, rule_id: str) -> bool:
        return self._rule(rule_id).margin(self._cycle) >= 0.0

    def _rule(self, rule_id: str) -> Rule:
        return self._instances[self.rules.index(rule_id)]

    def _renew_rules(self) -> None:
        """Fresh rules without memory, sorted by what they need."""
        self._instances = [rule(self.envelope) for rule in self._classes]
        numbered = list(enumerate(self._instances))
        self._on_nothing = [pair for pair in numbered if pair[1].needs is Needs.NOTHING]
        self._on_state = [pair for pair in numbered if pair[1].needs is Needs.STATE]
        self._on_request = [pair for pair in numbered if pair[1].needs is Needs.REQUEST]
        self._s01, self._s02 = self.rules.index("S01"), self.rules.index("S02")
        self._full_margins = [1.0] * len(self._instances)
        self._margins = list(self._full_margins)


def _speed_scale(verdicts: Iterable[Verdict]) -> float:
    """What the time base shall multiply its speed with: the strictest of all SCALE verdicts."""
    asked = [v.limit / v.value for v in verdicts if v.action is Action.SCALE]
    return min(asked, default=1.0)
