"""What a clock that goes back and an operator who is too early do to the gate: nothing."""

from gate_rig import Rig

from viskill_deploy.core.types import Mode, Request
from viskill_deploy.safety.cycle import Cycle


def test_a_clock_that_goes_back_is_not_followed():
    rig = Rig()
    cycle = Cycle(rig.gate.envelope)
    cycle.is_first = False
    cycle.begin(rig.state(), Request(None), 1.0)
    cycle.begin(rig.state(), Request(None), 1.25)
    assert (cycle.now, cycle.dt) == (1.25, 0.25)
    cycle.begin(rig.state(), Request(None), 0.5)
    assert (cycle.now, cycle.dt, cycle.given_now) == (1.25, 0.25, 0.5)


def test_a_cell_that_is_not_armed_is_not_disarmed_either():
    rig = Rig()
    assert rig.gate.disarm() is Mode.OFF
    assert rig.arm() == ()
    assert rig.gate.disarm() is Mode.CONNECTED
