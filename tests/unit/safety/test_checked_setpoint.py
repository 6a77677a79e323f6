import copy
import dataclasses
import pickle
import re
from pathlib import Path

import pytest
from gate_rig import Rig

import viskill_deploy.safety
from viskill_deploy.core.errors import SafetyStop
from viskill_deploy.core.types import JointSetpoint
from viskill_deploy.safety.checked import CheckedSetpoint

ZERO = JointSetpoint((0.0,) * 6, (0.0,) * 6, 0.0, 0.0)


@pytest.fixture
def passed() -> CheckedSetpoint:
    rig = Rig.running()
    return rig.ask(rig.stay()).setpoints[0]


@pytest.mark.parametrize("token", [None, object(), "token", 0])
def test_nobody_makes_one_without_the_supervisors_token(token):
    with pytest.raises(SafetyStop, match=r"Supervisor\.check"):
        CheckedSetpoint(0, ZERO, token)


@pytest.mark.parametrize(
    "duplicate",
    [
        copy.copy,
        copy.deepcopy,
        pickle.dumps,
        lambda c: pickle.dumps(c, 0),
        lambda c: dataclasses.replace(c, arm=1),
        lambda c: copy.copy([c])[0].__class__(1, c.setpoint),
    ],
)
def test_no_copy_comes_into_being(passed, duplicate):
    with pytest.raises((SafetyStop, TypeError)):
        duplicate(passed)


def test_it_cannot_be_changed(passed):
    with pytest.raises(SafetyStop):
        passed.setpoint = ZERO
    with pytest.raises(SafetyStop):
        passed.arm = 1
    with pytest.raises(SafetyStop):
        del passed.setpoint
    with pytest.raises((SafetyStop, AttributeError)):
        passed.other = 1


def test_it_cannot_be_subclassed():
    with pytest.raises(SafetyStop):
        type("Mine", (CheckedSetpoint,), {})


def test_an_empty_shell_holds_no_setpoint():
    shell = object.__new__(CheckedSetpoint)
    with pytest.raises(AttributeError):
        _ = shell.setpoint


def test_it_shows_what_it_holds(passed):
    assert "arm=0" in repr(passed)
    assert repr(passed.setpoint) in repr(passed)


def test_only_the_supervisor_knows_the_token():
    package = Path(viskill_deploy.safety.__file__).parents[1]
    users = {
        path.name
        for path in package.rglob("*.py")
        if re.search(r"\b_TOKEN\b", path.read_text(encoding="utf-8"))
    }
    assert users == {"checked.py", "supervisor.py"}
