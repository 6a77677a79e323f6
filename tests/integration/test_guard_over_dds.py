"""The guard between processes: a simulated dVRK, `viskill guard` and a client, over DDS."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from crtk_domain import DOMAIN

pytestmark = [pytest.mark.quiet, pytest.mark.timeout(900)]
ROOT = Path(__file__).resolve().parents[2]


TRIALS = 4


def test_what_a_client_streams_reaches_the_robot_bit_for_bit(tmp_path: Path) -> None:
    """A busy machine may be too late for the gate, which then holds the arms: tried again."""
    script = [sys.executable, ROOT / "benchmarks/guard_latency.py", "--seconds", "4"]
    output = tmp_path / "figures.json"
    for _ in range(TRIALS):
        subprocess.run(
            [*script, "--domain", str(DOMAIN + 9), "--output", output],
            check=True,
            timeout=240,
            stdout=subprocess.DEVNULL,
        )
        figures = json.loads(output.read_text())
        assert 0 < figures["passed_bit_for_bit"] <= figures["sent"] == 800
        if set(figures["states"].values()) == {"ENABLED"}:
            assert figures["passed_bit_for_bit"] == 800
            return
        assert set(figures["states"].values()) == {"PAUSED"}
    pytest.fail(f"the gate held the arms in all of {TRIALS} runs; make the machine less busy")
