"""The main job through simulated CiA 402 drives; `make can` runs twenty episodes of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BUNDLE = Path(__file__).resolve().parents[2] / "policies" / "bipegtransfer-viskill"


@pytest.mark.no_cover
def test_an_episode_through_the_drives_succeeds_and_nothing_trips(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", "dry-run", str(BUNDLE)]
    # half the usual rate, half the time
    command += ["--driver", "can", "--rate", "125", "--no-video", "--json"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    assert (result["driver"], result["rate_hz"]) == ("can", 125.0)
    assert result["success_rate"] == 1.0
    assert result["interventions"] == 0
    standing_s = 0.6  # at the start, while the empty jaws are measured, nothing is sent
    streamed_s = result["setpoints"] / (2 * 125)
    assert result["simulated_s"] - standing_s < streamed_s <= result["simulated_s"]
