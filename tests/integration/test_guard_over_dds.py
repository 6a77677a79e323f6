"""The guard between processes: a simulated dVRK, `viskill guard` and a client, over DDS."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from crtk_domain import DOMAIN

pytestmark = [pytest.mark.quiet, pytest.mark.timeout(900)]
ROOT = Path(__file__).resolve().parents[2]


def test_what_a_client_streams_reaches_the_robot_bit_for_bit(tmp_path: Path) -> None:
    script = [sys.executable, ROOT / "benchmarks/guard_latency.py", "--seconds", "2"]
    output = tmp_path / "figures.json"
    subprocess.run(
        [*script, "--domain", str(DOMAIN + 9), "--output", output],
        check=True,
        timeout=240,
        stdout=subprocess.DEVNULL,
    )
    figures = json.loads(output.read_text())
    # a busy machine may be too late for the gate, which then stops the arms; not before it has
    # passed what it could
    assert 0 < figures["passed_bit_for_bit"] <= figures["sent"] == 400
