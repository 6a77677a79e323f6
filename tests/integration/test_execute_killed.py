"""`viskill execute` is killed while dVRK arms move, over DDS."""

import subprocess
import threading
import time
from pathlib import Path

import lab
import pytest
from lab import Lab
from witness import Witness, assert_held_in_time

from viskill_deploy.runtime.consent import LET_GO, PRESS

TRIALS = 5
MOVING = 0.02
"""rad/s or m/s."""


def step_on_the_pedal(process: "subprocess.Popen[str]", arms: Lab) -> None:
    """Does what the program says, as long as it says something."""
    assert process.stdout
    for line in process.stdout:
        if line.strip() in {PRESS, LET_GO}:
            arms.say(line.strip() == PRESS)


def killed_in_mid_motion(process: "subprocess.Popen[str]", arms: Lab) -> float:
    """When it was killed; 0.0 where the gate has ended the run before: a busy machine."""
    deadline = time.monotonic() + 120.0
    while process.poll() is None:
        assert time.monotonic() < deadline, "the arms do not move"
        speeds = [abs(v) for arm in arms.server.truth().arms for v in arm.measured_jv]
        if max(speeds) > MOVING:
            since = time.monotonic()
            process.kill()
            return since
        time.sleep(0.005)
    return 0.0


@pytest.mark.quiet
@pytest.mark.timeout(900)
@pytest.mark.invariant("S25")
def test_arms_of_a_killed_execute_are_held_within_100_ms_and_then_without_power(
    tmp_path: Path,
) -> None:
    with lab.opened(tmp_path / "lab", "dds") as arms:
        for trial in range(TRIALS):
            witness = Witness(arms.network.domain)
            try:
                command = arms.command(tmp_path / f"run{trial}", "--mode", "closed-loop")
                with subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
                ) as process:
                    foot = threading.Thread(target=step_on_the_pedal, args=(process, arms))
                    foot.start()
                    since = killed_in_mid_motion(process, arms)
                    foot.join()
                if since:
                    assert_held_in_time(witness, since)
                    held = arms.server.truth()
                    time.sleep(0.1)
                    for then, now in zip(held.arms, arms.server.truth().arms, strict=True):
                        assert now.setpoint_jp == then.setpoint_jp
                    return
            finally:
                witness.node.close()
                process.kill()
    pytest.fail(f"{TRIALS} runs were ended by the gate; make the machine less busy")
