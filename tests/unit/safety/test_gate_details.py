"""Details of the gate that only mutation testing found to be untested."""

import pytest
from gate_rig import PERIOD, RULES, Rig, asking, words, worst

from viskill_deploy.core.types import Action


@pytest.mark.parametrize("rest_s", [0.3, 2.0, 60.0])
def test_s05_finds_a_burst_after_a_long_rest(rest_s):
    """The window is 250 ms and no longer: rest before it buys no speed."""
    rule = RULES["S05"](Rig().gate.envelope)
    resting, _ = asking(0, 3, 0.1)
    fast, _ = asking(0, 3, 0.1, 18.8 * PERIOD, 18.8 * PERIOD)
    for k in range(round(rest_s / PERIOD)):
        resting.now = 1.0 + k * PERIOD
        resting.is_first = k == 0
        assert words(rule, resting) == []
    actions = []
    for k in range(round(0.3 / (0.7 * PERIOD))):
        fast.now, fast.is_first = resting.now + k * 0.7 * PERIOD, False
        actions.append(worst(words(rule, fast)))
    assert max(actions) is Action.HOLD
