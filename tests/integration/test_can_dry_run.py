"""The main job through simulated CiA 402 drives; `make can` runs twenty episodes of it."""

import json
import subprocess
import sys
from pathlib import Path

BUNDLE = Path(__file__).resolve().parents[2] / "policies" / "bipegtransfer-viskill"


def test_two_episodes_through_the_drives_succeed_and_nothing_trips(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", "dry-run", str(BUNDLE)]
    # half the usual rate, half the time
    command += ["--driver", "can", "--rate", "125", "--episodes", "2", "--no-video", "--json"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    assert result["driver"] == "can"
    assert result["success_rate"] == 1.0
    assert result["interventions"] == 0
