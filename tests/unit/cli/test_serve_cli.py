"""`viskill serve crtk` at the command line: the operator who types."""

import pytest

from viskill_deploy.cli.serve import be_operator
from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.crtk.serving import set_up
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.sim.world import WorldOptions


def test_what_is_typed_is_done_as_by_the_operator(capsys: pytest.CaptureFixture[str]) -> None:
    cell = LoopbackCell(set_up(load_cell("bipegtransfer"), 0, WorldOptions()))
    seen = []
    for word in ("press", "stop", "clear", "relese", "release"):
        be_operator(cell, [f"{word}\n"])
        inputs = cell.inputs(0.0)
        seen.append((inputs.consent, inputs.estop))
    assert seen == [(True, False), (True, True), (True, False), (True, False), (False, False)]
    assert '"relese" is none of these: press or release' in capsys.readouterr().out
