"""The soak itself: it drives the gate, and it would notice."""

import pytest
from gate_oracle import Oracle, Trail
from gate_rig import CELL, PERIOD, Rig

import tests.soak.run as soak
from viskill_deploy.core.types import Action, JointSetpoint
from viskill_deploy.safety import supervisor


def test_some_hundred_steps_pass_stop_and_escape_nowhere():
    chunk = soak.run_chunk(seed=3, steps=600)
    assert chunk.escapes == []
    assert chunk.steps >= 600
    assert {"PASS", "HOLD"} <= set(chunk.counts)
    assert 0.0 < chunk.worst["joint position"] <= 1.0


def test_a_gate_that_asks_no_rule_is_found_out(monkeypatch):
    monkeypatch.setattr(supervisor.Supervisor, "_judge", lambda *args: ())
    found = []
    for seed in range(3):
        chunk = soak.Chunk(seed)
        walk = soak.Walk.__new__(soak.Walk)
        try:
            walk.__init__(chunk)
            walk.run(300)
        except (RuntimeError, ValueError, TypeError):  # numbers that are none reach the oracle
            found.append(seed)
        found += chunk.escapes
    assert found


def trail_of(*places: tuple[int, float], passed: bool) -> Trail:
    """A joint at some places in turn, the others at home."""
    home = Rig().held[0]
    trail = Trail()
    for joint, by in places:
        jp = tuple(q + by * (i == joint) for i, q in enumerate(home.jp))
        trail.add(JointSetpoint(jp, (0.0,) * 6, home.jaw, 0.0), passed)
    return trail


@pytest.mark.parametrize("passed", [True, False])
@pytest.mark.parametrize(
    ("places", "what"),
    [
        ([(0, 0.0)] * 5, ""),
        ([(3, 0.0), (3, 9.0)], "joint position"),
        ([(0, 0.0), (0, 0.1)], "joint speed"),
        ([(3, 0.0), (3, 0.0), (3, 0.002)], "joint acceleration"),
        ([(3, 0.0)] * 3 + [(3, 0.0005)], "joint jerk"),
        ([(2, 0.0), (2, 0.0), (2, 0.1)], "way out of the workspace"),
    ],
)
def test_the_oracle_finds_what_is_beyond_each_limit(places, what, passed):
    found = Oracle(CELL, PERIOD).escapes(0, trail_of(*places, passed=passed))
    assert bool(found) is bool(what)
    assert any(text.startswith(what) for text in found) or not what


def test_the_oracle_finds_a_request_on_its_way_out_of_the_workspace():
    trail = trail_of(*[(2, 0.0005 * k) for k in range(150)], passed=True)
    assert any("passed on the way out" in text for text in Oracle(CELL, PERIOD).escapes(0, trail))


def test_a_passed_request_that_is_another_object_is_an_escape():
    chunk = soak.Chunk(5)
    walk = soak.Walk(chunk)
    rig = walk.rig
    ask = rig.ask

    def copied(setpoints, dt=None, **said):
        again = tuple(JointSetpoint(s.jp, s.jv, s.jaw, s.jaw_v) for s in setpoints)
        return ask(again, dt, **said)

    rig.ask = copied
    walk.cycle(rig.stay(), "good")
    assert "not the request" in chunk.escapes[0]
    assert chunk.counts == {Action.PASS.name: 1}
