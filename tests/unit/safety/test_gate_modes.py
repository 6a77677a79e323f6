import pytest

from viskill_deploy.core.types import Action, Mode
from viskill_deploy.safety.modes import CLEARS, LATCHED_MODE, WAITING, Clear, Modes


def armed() -> Modes:
    modes = Modes()
    modes.observe(True, True)
    modes.arm()
    return modes


def test_every_action_says_who_clears_it():
    assert set(CLEARS) == set(Action)
    assert CLEARS[Action.HOLD] is Clear.ON_OPERATOR
    assert CLEARS[Action.FAULT] is Clear.ON_REARM
    assert CLEARS[Action.ESTOP] is Clear.NEVER


@pytest.mark.parametrize(
    ("evidence", "mode"),
    [
        ((False, False), Mode.CONNECTED),
        ((False, True), Mode.CONNECTED),
        ((True, False), Mode.HOMED),
        ((True, True), Mode.READY),
    ],
)
@pytest.mark.parametrize("before", WAITING)
def test_before_arming_the_mode_is_what_the_evidence_says(before, evidence, mode):
    modes = Modes()
    modes.mode = before
    modes.observe(*evidence)
    assert modes.mode is mode


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode not in WAITING])
def test_after_arming_evidence_changes_nothing(mode):
    modes = Modes()
    modes.mode = mode
    modes.observe(False, False)
    modes.observe(True, True)
    assert modes.mode is mode


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.READY])
def test_only_a_ready_cell_is_armed(mode):
    modes = Modes()
    modes.mode = mode
    modes.arm()
    assert modes.mode is mode


def test_a_first_setpoint_makes_an_armed_cell_run():
    modes = armed()
    assert modes.mode is Mode.ARMED
    modes.run()
    assert modes.mode is Mode.RUNNING
    modes.run()
    assert modes.mode is Mode.RUNNING


@pytest.mark.parametrize("first", Action)
@pytest.mark.parametrize("second", Action)
def test_the_worst_action_wins_in_any_order(first, second):
    one, other = armed(), armed()
    for modes, order in ((one, (first, second)), (other, (second, first))):
        for action in order:
            modes.escalate(action)
    worst = max(first, second)
    assert one.latched == other.latched == (worst if worst >= Action.HOLD else Action.PASS)
    assert one.mode is other.mode
    assert one.mode is LATCHED_MODE.get(worst, Mode.ARMED)


@pytest.mark.invariant("S31")
@pytest.mark.parametrize("action", Action)
def test_resume_clears_a_hold_and_nothing_else(action):
    modes = armed()
    modes.escalate(action)
    before = modes.mode
    assert modes.resume() is (action is Action.HOLD)
    assert modes.mode is (Mode.RUNNING if action is Action.HOLD else before)


@pytest.mark.invariant("S31")
@pytest.mark.parametrize("action", Action)
def test_reset_clears_all_but_an_emergency_stop(action):
    modes = armed()
    modes.escalate(action)
    cleared = Action.HOLD <= action <= Action.FAULT
    assert modes.reset() is cleared
    if cleared:
        assert (modes.mode, modes.latched) == (Mode.CONNECTED, Action.PASS)
    else:
        assert modes.latched is (Action.ESTOP if action is Action.ESTOP else Action.PASS)
