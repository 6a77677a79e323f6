"""A bundle on simulated dVRK arms, through gate and driver, from the command line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TRIALS = 6
LATE = ("S18", "S19", "S20", "S25")
"""Rules by which the gate stops arms whose machine is late."""

BUNDLE = Path(__file__).parents[2] / "policies" / "bipegtransfer-viskill"


def dry_run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", "dry-run", str(BUNDLE)]
    command += ["--driver", "crtk", "--no-video", "--json", "--output", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})


@pytest.mark.no_cover
def test_a_bundle_does_its_task_on_stepped_dvrk_arms_at_200_hz(tmp_path: Path):
    done = dry_run(tmp_path / "run", "--seed", "1")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert (figures["success_rate"], figures["interventions"]) == (1.0, 0)
    assert (figures["driver"], figures["rate_hz"]) == ("crtk", 200.0)
    assert figures["margins"]["S24"] > 0.5


@pytest.mark.quiet
@pytest.mark.timeout(900)
@pytest.mark.parametrize("transport", ["dds", pytest.param("ros2", marks=pytest.mark.ros2)])
def test_two_episodes_through_the_wire_against_the_clock(tmp_path: Path, transport: str):
    """A machine that is too busy holds the arms (S18, S20), which is no fault of the wire."""
    done = 0
    for trial in range(TRIALS):
        network = ("--transport", transport, "--rate", "200", "--seed", str(trial))
        run = dry_run(tmp_path / str(trial), "--realtime", *network)
        figures = json.loads(run.stdout)
        way = figures["on_the_way"]
        assert way["sent"] >= way["heard"] > 100
        assert way["lost"] <= 0.05 * way["sent"]
        assert 0.0 < way["age_p50_ms"] <= way["age_p99_ms"]
        assert figures["rate_hz"] == 200.0
        assert {e["stopped_by"] for e in figures["episode_results"]} <= {"", *LATE}
        assert run.returncode == (5 if figures["interventions"] else 0), run.stderr
        done += figures["success_rate"] == 1.0
        if done == 2:
            return
    pytest.fail(f"{TRIALS} runs were ended by the gate; make the machine less busy")


@pytest.mark.parametrize("arguments", [[], ["--driver", "loopback", "--realtime"]])
def test_a_transport_needs_dvrk_arms_in_a_process_of_their_own(
    tmp_path: Path, arguments: list[str]
):
    done = dry_run(tmp_path / "run", "--transport", "dds", *arguments)
    assert done.returncode == 2
    assert "--driver crtk --realtime" in done.stderr
