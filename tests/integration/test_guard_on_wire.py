"""The guard between processes: a simulated dVRK, `viskill guard` and a client, over the wire."""

import contextlib
import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from crtk_domain import DOMAIN

from viskill_deploy.core import realtime
from viskill_deploy.drivers.crtk.messages import JointState, OperatingState
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.observe.reading import read_recording

pytestmark = [pytest.mark.quiet, pytest.mark.timeout(900)]
ROOT = Path(__file__).resolve().parents[2]
TRIALS = 4
HELD_S, REST_S, PATIENCE_S = 0.1, 0.5, 20.0


def test_what_a_client_streams_reaches_the_robot_bit_for_bit(tmp_path: Path) -> None:
    """A machine that is late makes the gate hold the arms; then all is done once more."""
    script = [sys.executable, ROOT / "benchmarks/guard_latency.py", "--seconds", "4"]
    script += ["--domain", str(DOMAIN + 5)]
    output = tmp_path / "figures.json"
    for _ in range(TRIALS):
        subprocess.run(
            [*script, "--output", output], check=True, timeout=240, stdout=subprocess.DEVNULL
        )
        figures = json.loads(output.read_text())
        assert 0 < figures["passed_bit_for_bit"] <= figures["sent"] == 800
        if set(figures["states"].values()) == {"ENABLED"}:
            assert figures["passed_bit_for_bit"] == 800
            return
    pytest.fail(f"the gate held the arms in all of {TRIALS} runs; make the machine less busy")


class Onlooker:
    """Hears when the guard holds the arms, and when they were last told to move."""

    def __init__(self, domain: int) -> None:
        self.node = open_transport("dds", Network(domain, LOOPBACK))
        self.held_s = self.moved_s = 0.0
        self.is_held = threading.Event()
        self._last: tuple[float, ...] = ()
        state = "/guarded/PSM1/operating_state"
        self.node.subscribe(state, OperatingState, self._hear_state, is_latched=True)
        self.node.subscribe("/PSM1/servo_jp", JointState, self._hear_setpoint, kept=32)

    def _hear_state(self, word: OperatingState, received_s: float) -> None:
        if word.state == "PAUSED" and not self.is_held.is_set():
            self.held_s = received_s
            self.is_held.set()

    def _hear_setpoint(self, word: JointState, received_s: float) -> None:
        if max((abs(a - b) for a, b in zip(word.position, self._last, strict=False)), default=0.0):
            self.moved_s = received_s
        self._last = word.position


@pytest.mark.slow
def test_the_arms_are_held_within_100_ms_when_the_client_is_killed(tmp_path: Path) -> None:
    """A machine that is late holds them before; then nothing moves, and all is done once more."""
    for trial in range(TRIALS):
        folder = tmp_path / str(trial)
        onlooker = Onlooker(DOMAIN + 6)
        killed_s = client_killed(onlooker, DOMAIN + 6, folder)
        onlooker.node.close()
        if not killed_s:
            continue
        if not realtime.refusals():
            assert onlooker.held_s - killed_s < HELD_S
            assert onlooker.moved_s - killed_s < REST_S
        recording = read_recording(folder / "recording")
        assert recording.complete
        assert "S16" in {row.rule for row in recording.verdicts}
        return
    pytest.fail(f"the gate held the arms early in all of {TRIALS} runs; make the machine less busy")


def client_killed(onlooker: Onlooker, domain: int, folder: Path) -> float:
    """When a client was killed in mid-motion; 0.0 where the arms were held before."""
    way = ("--transport", "dds", "--domain", str(domain), "--interface", LOOPBACK)
    viskill = [sys.executable, "-m", "viskill_deploy.cli.main"]
    client = [sys.executable, ROOT / "tests/support/dying_client.py", str(domain)]
    pipe = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL}
    with (
        subprocess.Popen([*viskill, "serve", "crtk", "--homing", "stay", *way], **pipe) as robot,
        subprocess.Popen([*viskill, "guard", *way, "--output", str(folder)], **pipe) as guard,
        subprocess.Popen(client, stdout=subprocess.PIPE, text=True) as dying,
    ):
        try:
            assert dying.stdout
            assert dying.stdout.readline() == "moving\n"
            killed_s = 0.0
            if not onlooker.is_held.is_set():
                killed_s = time.monotonic()
                dying.kill()
                onlooker.is_held.wait(PATIENCE_S)
                time.sleep(1.0)
        finally:
            for process, number in ((dying, 9), (guard, 2), (robot, 2)):
                process.send_signal(number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=PATIENCE_S)
                process.kill()
    return killed_s if onlooker.held_s > killed_s else 0.0
