"""A bundle on simulated dVRK arms, through gate and driver, from the command line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BUNDLE = Path(__file__).parents[2] / "policies" / "bipegtransfer-viskill"


def dry_run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", "dry-run", str(BUNDLE)]
    command += ["--driver", "crtk", "--no-video", "--json", "--output", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})


def test_a_bundle_does_its_task_on_stepped_dvrk_arms_at_200_hz(tmp_path: Path):
    done = dry_run(tmp_path / "run", "--seed", "1")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert (figures["success_rate"], figures["interventions"]) == (1.0, 0)
    assert (figures["driver"], figures["rate_hz"]) == ("crtk", 200.0)
    assert figures["margins"]["S24"] > 0.5


@pytest.mark.parametrize("arguments", [[], ["--driver", "loopback", "--realtime"]])
def test_a_transport_needs_dvrk_arms_in_a_process_of_their_own(
    tmp_path: Path, arguments: list[str]
):
    done = dry_run(tmp_path / "run", "--transport", "dds", *arguments)
    assert done.returncode == 2
    assert "--driver crtk --realtime" in done.stderr
