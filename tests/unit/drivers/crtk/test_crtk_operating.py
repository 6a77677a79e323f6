"""The operating state of a simulated dVRK arm: every command in every state."""

from __future__ import annotations

import pytest

from viskill_deploy.drivers.crtk.operating import (
    COMMANDS,
    ENGAGING_S,
    POWER_TIMEOUT_S,
    POWERING_S,
    Operating,
)

OK, NO = True, False
TABLE = {
    #            enable disable home unhome pause resume
    "DISABLED": (OK, OK, NO, OK, NO, NO),
    "ENABLED": (OK, OK, OK, OK, OK, NO),
    "PAUSED": (NO, OK, NO, OK, OK, OK),
    "FAULT": (OK, OK, NO, OK, NO, NO),
}
AFTER = {
    ("DISABLED", "enable"): "ENABLED",
    ("ENABLED", "disable"): "DISABLED",
    ("ENABLED", "pause"): "PAUSED",
    ("PAUSED", "disable"): "DISABLED",
    ("PAUSED", "resume"): "ENABLED",
    ("FAULT", "disable"): "DISABLED",
}
"""All others leave the state as it is."""


def in_state(state: str) -> Operating:
    operating = Operating()
    if state != "DISABLED":
        operating.command("enable")
        operating.pass_time(POWERING_S, True)
    if state == "PAUSED":
        operating.command("pause")
    if state == "FAULT":
        operating.fail("on purpose")
    assert operating.state == state
    return operating


@pytest.mark.parametrize("command", ["enable", "disable", "home", "unhome", "pause", "resume"])
@pytest.mark.parametrize("state", TABLE)
def test_every_command_in_every_state_does_what_the_table_says(state: str, command: str) -> None:
    operating = in_state(state)
    refusal = operating.command(command)
    operating.pass_time(POWERING_S, True)
    assert operating.state == AFTER.get((state, command), state)
    if TABLE[state][COMMANDS.index(command)]:
        assert refusal == ""
    else:
        assert refusal == f'command "{command}" is not supported in state {state}'


def test_a_word_that_is_no_command_is_refused_in_every_state() -> None:
    for state in TABLE:
        assert in_state(state).command("reset") == 'unknown state command "reset"'


def test_powering_takes_a_moment_in_the_state_disabled() -> None:
    operating = Operating()
    operating.command("enable")
    operating.pass_time(POWERING_S / 2, True)
    assert (operating.state, operating.phase) == ("DISABLED", "powering")
    operating.pass_time(POWERING_S / 2, True)
    assert (operating.state, operating.phase) == ("ENABLED", "idle")


def test_power_that_does_not_come_ends_in_a_fault() -> None:
    operating = Operating()
    operating.command("enable")
    assert operating.pass_time(POWER_TIMEOUT_S - 0.1, False) == ""
    assert operating.pass_time(0.2, False) == "failed to enable power"
    assert operating.state == "FAULT"


def test_the_way_out_of_a_fault_is_disable_enable_home() -> None:
    operating = in_state("FAULT")
    assert operating.command("enable") == ""
    operating.pass_time(POWERING_S, True)
    assert operating.state == "FAULT"
    for word in ("disable", "enable"):
        operating.command(word)
    operating.pass_time(POWERING_S, True)
    assert (operating.state, operating.is_homed) == ("ENABLED", False)
    operating.command("home")
    operating.arrive()
    assert operating.is_ready


def test_disabling_forgets_that_the_arm_was_homed_but_not_its_encoders() -> None:
    operating = in_state("ENABLED")
    operating.command("home")
    operating.arrive()
    operating.command("disable")
    assert (operating.is_homed, operating.has_reference) == (False, True)


def test_unhome_forgets_the_encoders_too() -> None:
    operating = in_state("ENABLED")
    operating.command("home")
    operating.arrive()
    operating.command("unhome")
    assert (operating.state, operating.is_homed, operating.has_reference) == (
        "ENABLED",
        False,
        False,
    )


def test_pausing_while_homing_ends_the_homing() -> None:
    operating = in_state("ENABLED")
    operating.command("home")
    operating.command("pause")
    assert (operating.state, operating.phase, operating.is_homed) == ("PAUSED", "idle", False)


def test_power_that_goes_away_is_a_fault_in_every_state_that_has_power() -> None:
    for state in ("ENABLED", "PAUSED"):
        operating = in_state(state)
        assert operating.pass_time(0.001, False) == "detected power loss (actuators / brakes)"
        assert operating.state == "FAULT"
    assert in_state("DISABLED").pass_time(0.001, False) == ""


def test_an_instrument_put_into_a_homed_arm_has_to_be_engaged_first() -> None:
    operating = in_state("ENABLED")
    operating.command("home")
    operating.arrive()
    operating.engage()
    assert not operating.is_ready
    operating.pass_time(ENGAGING_S, True)
    assert operating.is_ready
