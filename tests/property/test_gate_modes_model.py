"""The gate's modes against a reference model that knows nothing of the gate's code.

The model is a table in words of docs/safety.md: what each event does in each mode. Hypothesis
walks both at random; a search of the whole model finds a way to every change of mode that there
is, and the gate is led along each of them.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
from gate_rig import Rig
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from viskill_deploy.core.types import Mode

O, C, H, R = Mode.OFF, Mode.CONNECTED, Mode.HOMED, Mode.READY  # noqa: E741
SEVERITY = {"": 0, "hold": 1, "stop": 2, "fault": 3, "estop": 4}
LATCHED = {
    "hold": Mode.HOLDING,
    "stop": Mode.HOLDING,
    "fault": Mode.FAULT,
    "estop": Mode.ESTOPPED,
}


@dataclass(frozen=True)
class Model:
    """What the documents say of the gate; every event gives the next state.

    Attributes:
        evidence: what the state shows: "sound" measurements, a "homed" arm, or "ready".
        fresh: a state without consent was seen since the last arming.
        pending: "" or the worst that was reported and not yet taken up.
        in_charge: the gate answers for what the robot was sent.
        stopping: the gate sends its own stop.
        clean: nothing was wrong for long enough that a hold may be cleared.
        pressed: the emergency stop.
    """

    mode: Mode = Mode.OFF
    latched: str = ""
    evidence: str = "ready"
    fresh: bool = False
    pending: str = ""
    in_charge: bool = False
    stopping: bool = False
    clean: bool = False
    pressed: bool = False

    def latch(self, what: str) -> "Model":
        if SEVERITY[what] <= SEVERITY[self.latched]:
            return self
        return replace(self, latched=what, mode=LATCHED[what])

    def see(self) -> "Model":
        """Before arming a state moves the mode; an emergency stop acts at once."""
        if self.in_charge:
            return self
        seen = self.latch("estop") if self.pressed else self
        if seen.mode not in (O, C, H, R):
            return seen
        able = seen.evidence in ("homed", "ready") and not seen.pressed
        mode = R if able and seen.evidence == "ready" else H if able else C
        return replace(seen, mode=mode)

    def connect(self) -> "Model":
        return self.see()

    def edge(self) -> "Model":
        """Consent is withdrawn for one state and given again."""
        return replace(self, fresh=True).see()

    def arm(self) -> "Model":
        seen = self.see()
        if seen.mode is not R or not seen.fresh:
            return seen
        if seen.pending:
            return replace(seen.latch("fault"), pending="")
        return replace(
            seen, mode=Mode.ARMED, in_charge=True, fresh=False, stopping=False, clean=False
        )

    def cycle(self, wrong: str = "", count: int = 1) -> "Model":
        """Some cycles; `wrong` is what the request or the report in them is."""
        if not self.in_charge:
            now = self.latch("estop") if self.pressed else self
            return replace(now.latch("fault") if now.pending else now, pending="")
        worst = max(wrong, self.pending, "estop" * self.pressed, key=SEVERITY.__getitem__)
        if self.evidence != "ready":
            worst = max(worst, "fault", key=SEVERITY.__getitem__)
        if worst:
            return replace(self.latch(worst), pending="", stopping=True, clean=False)
        if self.stopping:
            return replace(self, clean=self.clean or count > 50)
        return replace(self, mode=Mode.RUNNING)

    def resume(self) -> "Model":
        able = self.mode is Mode.HOLDING and self.latched == "hold" and self.clean
        if not able or self.pending:
            return self.press_seen()
        return replace(self, mode=Mode.RUNNING, latched="", stopping=False, clean=False)

    def press_seen(self) -> "Model":
        """Resume looks at the people's inputs, too."""
        return self.latch("estop") if self.pressed and not self.in_charge else self

    def reset(self) -> "Model":
        if self.latched in ("", "estop") or (self.in_charge and not self.stopping):
            return self
        return replace(
            self, mode=C, latched="", in_charge=False, stopping=False, pending="", clean=False
        )

    def disarm(self) -> "Model":
        if self.mode in (Mode.ARMED, Mode.RUNNING) and not self.stopping:
            return replace(self, mode=C, in_charge=False)
        return self

    def report(self, what: str) -> "Model":
        return replace(self, pending=max(what, self.pending, key=SEVERITY.__getitem__))

    def show(self, evidence: str) -> "Model":
        return replace(self, evidence=evidence)

    def press(self) -> "Model":
        return replace(self, pressed=True)

    def release(self) -> "Model":
        return replace(self, pressed=False)


EVIDENCE = {
    "nothing": {"tool": "another"},
    "sound": {"is_homed": False},
    "homed": {"is_busy": True},
    "ready": {},
}
"""What a driver reports of an arm in each case. A busy arm is no fault once the gate is in charge,
so that evidence is shown to the gate before arming only."""


def edge(rig: Rig) -> None:
    rig.consent = False
    rig.gate.connect(rig.state())
    rig.consent = True


def many(rig: Rig) -> None:
    for _ in range(60):
        rig.ask(rig.stay())


def report(rig: Rig, rule_id: str) -> None:
    rig.gate.report_fault(rule_id, rig.now)


EVENTS = {
    "connect": (lambda m: m.connect(), lambda rig: rig.gate.connect(rig.state())),
    "edge of consent": (lambda m: m.edge(), edge),
    "arm": (lambda m: m.arm(), lambda rig: rig.gate.arm(rig.state(), rig.now)),
    "good cycle": (lambda m: m.cycle(), lambda rig: rig.ask(rig.stay())),
    "many good cycles": (lambda m: m.cycle(count=60), many),
    "no solution": (lambda m: m.cycle("hold"), lambda rig: rig.ask(None, failure="infeasible")),
    "resume": (lambda m: m.resume(), lambda rig: rig.gate.resume(rig.state(), rig.now)),
    "reset": (lambda m: m.reset(), lambda rig: rig.gate.reset(rig.now)),
    "disarm": (lambda m: m.disarm(), lambda rig: rig.gate.disarm()),
    "recorder fails": (lambda m: m.report("stop"), lambda rig: report(rig, "S32")),
    "driver raises": (lambda m: m.report("fault"), lambda rig: report(rig, "S24")),
    "stop pressed": (lambda m: m.press(), lambda rig: setattr(rig, "estop", True)),
    "stop released": (lambda m: m.release(), lambda rig: setattr(rig, "estop", False)),
    **{
        f"evidence: {name}": (
            lambda m, name=name: m.show(name),
            lambda rig, fields=fields: rig.broken.update({0: fields}),
        )
        for name, fields in EVIDENCE.items()
    },
}


def is_possible(model: Model, event: str) -> bool:
    """Left out: an arm that is busy, or no solution three times in a row, in mid-run.

    The first is no evidence there, the second is a count that the unit tests of S16 hold.
    """
    if event in ("evidence: homed", "evidence: sound", "evidence: nothing"):
        return not (model.in_charge and event == "evidence: homed")
    if event == "no solution":
        return not model.stopping
    if event == "arm":
        return model.evidence != "homed" or model.mode is not R
    return True


START = ("connect", "edge of consent", "arm", "good cycle", "no solution", "many good cycles")
"""A walk begins somewhere on the way that a run takes."""


class Walk(RuleBasedStateMachine):
    """Any order of events, on the gate and on the model."""

    seen: ClassVar[set[tuple[Mode, Mode]]] = set()

    @initialize(length=st.integers(0, len(START)))
    def start(self, length: int) -> None:
        self.rig, self.model = Rig(), Model()
        for event in START[:length]:
            self.step(event)

    def step(self, event: str) -> None:
        if not is_possible(self.model, event):
            return
        on_model, on_gate = EVENTS[event]
        before = self.model.mode
        self.model = on_model(self.model)
        on_gate(self.rig)
        assert self.rig.gate.mode is self.model.mode, (event, before)
        self.seen.add((before, self.model.mode))

    @rule(event=st.sampled_from(sorted(EVENTS)))
    def happens(self, event: str) -> None:
        self.step(event)


Walk.TestCase.settings = settings(
    max_examples=60, stateful_step_count=40, deadline=None, derandomize=True, database=None
)


@pytest.mark.invariant("S31")
def test_a_random_walk_of_events_leads_gate_and_model_to_the_same_modes():
    Walk.seen.clear()
    Walk.TestCase("runTest").runTest()
    assert {mode for pair in Walk.seen for mode in pair} == set(Mode)


def ways() -> dict[tuple[Mode, Mode], list[str]]:
    """A shortest way to every change of mode that the model allows."""
    start = Model()
    found: dict[tuple[Mode, Mode], list[str]] = {}
    known, queue = {start}, deque([(start, [])])
    while queue:
        model, way = queue.popleft()
        for event, (on_model, _) in EVENTS.items():
            if is_possible(model, event):
                after = on_model(model)
                found.setdefault((model.mode, after.mode), [*way, event])
                if after not in known:
                    known.add(after)
                    queue.append((after, [*way, event]))
    return found


WAYS = ways()
CHANGES = sorted(
    (pair for pair in WAYS if pair[0] is not pair[1]), key=lambda p: (p[0].value, p[1].value)
)


@pytest.mark.invariant("S31")
@pytest.mark.parametrize("pair", CHANGES, ids=lambda p: f"{p[0].value} to {p[1].value}")
def test_every_change_of_mode_happens_as_in_the_model(pair):
    rig, model = Rig(), Model()
    for event in WAYS[pair]:
        on_model, on_gate = EVENTS[event]
        model = on_model(model)
        on_gate(rig)
        assert rig.gate.mode is model.mode, event
    assert rig.gate.mode is pair[1]


def test_the_model_has_every_mode_and_no_way_out_of_an_emergency_stop():
    assert {mode for pair in WAYS for mode in pair} == set(Mode)
    assert {after for before, after in WAYS if before is Mode.ESTOPPED} == {Mode.ESTOPPED}
    assert {after for before, after in CHANGES if before is Mode.FAULT} == {
        Mode.CONNECTED,
        Mode.ESTOPPED,
    }
    assert (Mode.HOLDING, Mode.RUNNING) in WAYS
    assert not {b for b, after in CHANGES if after is Mode.ARMED} - {Mode.READY, *([C, H, O])}
