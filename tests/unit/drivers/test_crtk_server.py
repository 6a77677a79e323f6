"""The simulated dVRK as a CRTK client meets it."""

from __future__ import annotations

import pytest
from crtk_rig import Rig


def test_an_arm_is_enabled_homed_and_moved() -> None:
    rig = Rig()
    client = rig.client
    assert client.summary == ("DISABLED", False, False)
    rig.make_ready()
    start = client.last("setpoint_js").position
    goal = (start[0] + 0.1, *start[1:])
    client.joints("move_jp", *goal)
    rig.run(0.004)
    assert client.state.is_busy
    assert rig.until_idle() > 0.3
    assert client.last("setpoint_js").position == pytest.approx(goal)
    rig.run(0.3)
    assert rig.measured()[:6] == pytest.approx(goal, abs=1e-3)
    assert client.texts("error") == client.texts("warning") == []
