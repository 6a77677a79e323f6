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
from viskill_deploy.drivers.crtk.messages import Empty, JointState, OperatingState
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.observe.reading import read_recording

pytestmark = [pytest.mark.quiet, pytest.mark.timeout(900)]
ROOT = Path(__file__).resolve().parents[2]
TRIALS = 4
HELD_S, REST_S, OFF_S, PATIENCE_S = 0.1, 0.5, 1.0, 20.0


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
    """Hears when the guard or its watchdog holds the arms, and when they were last told to move."""

    def __init__(self, domain: int) -> None:
        self.node = open_transport("dds", Network(domain, LOOPBACK))
        self.held_s = self.moved_s = 0.0
        self.is_held, self.is_off = threading.Event(), threading.Event()
        self.stopped_s = self.off_s = 0.0
        self._last: tuple[float, ...] = ()
        state = "/guarded/PSM1/operating_state"
        self.node.subscribe(state, OperatingState, self._hear_state, is_latched=True)
        self.node.subscribe("/PSM1/hold", Empty, self._hear_hold)
        self.node.subscribe("/PSM1/operating_state", OperatingState, self._hear_robot, True)
        self.node.subscribe("/PSM1/servo_jp", JointState, self._hear_setpoint, kept=32)

    def _hear_state(self, word: OperatingState, received_s: float) -> None:
        if word.state == "PAUSED" and not self.is_held.is_set():
            self.held_s = received_s
            self.is_held.set()

    def _hear_hold(self, word: Empty, received_s: float) -> None:
        self.stopped_s = self.stopped_s or received_s

    def _hear_robot(self, word: OperatingState, received_s: float) -> None:
        if word.state == "DISABLED" and self.stopped_s and not self.is_off.is_set():
            self.off_s = received_s
            self.is_off.set()

    def _hear_setpoint(self, word: JointState, received_s: float) -> None:
        if max((abs(a - b) for a, b in zip(word.position, self._last, strict=False)), default=0.0):
            self.moved_s = received_s
        self._last = word.position


@pytest.mark.slow
def test_the_arms_are_held_within_100_ms_when_the_client_is_killed(tmp_path: Path) -> None:
    onlooker, killed_s, folder = killed_in_mid_motion("client", DOMAIN + 6, tmp_path)
    if not realtime.refusals():
        assert onlooker.held_s - killed_s < HELD_S
        assert onlooker.moved_s - killed_s < REST_S
    recording = read_recording(folder / "recording")
    assert recording.complete
    assert "S16" in {row.rule for row in recording.verdicts}


@pytest.mark.slow
def test_the_watchdog_holds_and_disables_the_arms_when_the_guard_is_killed(tmp_path: Path) -> None:
    onlooker, killed_s, _ = killed_in_mid_motion("guard", DOMAIN + 7, tmp_path)
    if not realtime.refusals():
        assert onlooker.stopped_s - killed_s < HELD_S
        assert onlooker.off_s - killed_s < OFF_S
    assert onlooker.moved_s - killed_s < 0.01, "nobody moves them"


def killed_in_mid_motion(who: str, domain: int, folder: Path) -> tuple[Onlooker, float, Path]:
    """What was seen of it, and when it was; a machine that is late holds the arms before, and then
    all is done once more."""
    for trial in range(TRIALS):
        onlooker, place = Onlooker(domain), folder / str(trial)
        killed_s = killed(who, onlooker, domain, place)
        onlooker.node.close()
        if killed_s:
            return onlooker, killed_s, place
    pytest.fail(f"the gate held the arms early in all of {TRIALS} runs; make the machine less busy")


def killed(who: str, onlooker: Onlooker, domain: int, folder: Path) -> float:
    """When client or guard was killed in mid-motion; 0.0 where the arms were held before."""
    way = ("--transport", "dds", "--domain", str(domain), "--interface", LOOPBACK)
    viskill = [sys.executable, "-m", "viskill_deploy.cli.main"]
    guarding = ["guard", "--simulated", *way]
    client = [sys.executable, ROOT / "tests/support/dying_client.py", str(domain)]
    pipe = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL}
    with (
        subprocess.Popen([*viskill, "serve", "crtk", "--homing", "stay", *way], **pipe) as robot,
        subprocess.Popen([*viskill, *guarding, "--output", str(folder)], **pipe) as guard,
        subprocess.Popen(client, stdout=subprocess.PIPE, text=True) as dying,
    ):
        try:
            assert dying.stdout
            assert dying.stdout.readline() == "moving\n"
            killed_s = 0.0
            if not onlooker.is_held.is_set():
                killed_s = time.monotonic()
                (dying if who == "client" else guard).kill()
                (onlooker.is_held if who == "client" else onlooker.is_off).wait(PATIENCE_S)
                time.sleep(1.0)
        finally:
            for process, number in ((dying, 9), (guard, 2), (robot, 2)):
                process.send_signal(number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=PATIENCE_S)
                process.kill()
    if who == "guard":
        return 0.0 if onlooker.is_held.is_set() else killed_s
    return killed_s if onlooker.held_s > killed_s else 0.0
