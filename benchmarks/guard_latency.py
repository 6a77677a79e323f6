"""What the guard adds to the way of a setpoint, between processes on this machine.

    python benchmarks/guard_latency.py [--transport dds] [--seconds 20] [--output FILE]

Starts a simulated dVRK and `viskill guard`, agrees to motion, and streams a slow swing of one joint
at 200 Hz. The same message goes to the guard and to a topic that nobody guards; both ways are
timed from the moment of publishing to the arrival at one listener, so that what is left is the
guard's. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from viskill_deploy.core import realtime
from viskill_deploy.drivers.crtk.messages import (
    Header,
    JointState,
    Joy,
    OperatingState,
    StringStamped,
    Time,
)
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.drivers.crtk.transport import Transport

RATE_HZ, SWING_RAD, SWING_S = 200.0, 0.05, 4.0
JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
ARMS = ("PSM1", "PSM2")
PATIENCE_S = 180.0
KEPT = 32
STILL_S = 0.05
"""At rest before the stream ends: what ends in mid-motion is stopped."""


class Client:
    """A CRTK program that moves PSM1 through a guard, and listens to what comes out of it."""

    def __init__(self, node: Transport) -> None:
        self.node = node
        self.states: dict[str, OperatingState] = {}
        self.start: tuple[float, ...] = ()
        self.sent: dict[int, float] = {}
        self.guarded_ms: list[float] = []
        self.direct_ms: list[float] = []
        for arm in ARMS:
            node.subscribe(
                f"/guarded/{arm}/operating_state",
                OperatingState,
                lambda word, _, arm=arm: self.states.update({arm: word}),
                is_latched=True,
            )
        node.subscribe("/guarded/PSM1/setpoint_js", JointState, self._hear_start)
        node.subscribe("/PSM1/servo_jp", JointState, self._hear_robot, kept=KEPT)
        node.subscribe("/direct/servo_jp", JointState, self._hear_direct, kept=KEPT)
        self._commands = {
            arm: node.publisher(f"/guarded/{arm}/state_command", StringStamped) for arm in ARMS
        }
        self._servo = node.publisher("/guarded/PSM1/servo_jp", JointState)
        self._direct = node.publisher("/direct/servo_jp", JointState)
        self._pedal = node.publisher("/console/emulate_operator_present", Joy)

    def command(self, word: str) -> None:
        """Says a state command to all arms."""
        for arm in ARMS:
            stamp = Time.of_ns(self.node.stamp_ns())
            self._commands[arm](StringStamped(Header(stamp), word))

    def press(self, is_pressed: bool) -> None:
        """The operator's pedal."""
        stamp = Time.of_ns(self.node.stamp_ns())
        self._pedal(Joy(Header(stamp), (), (int(is_pressed),)))

    def until(self, done, say=lambda: None) -> None:
        """Waits, saying something again and again."""
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            if time.monotonic() > deadline:
                raise SystemExit(f"the guard is not ready: {self.states}")
            say()
            time.sleep(0.3)

    def is_in(self, state: str, is_homed: bool, is_busy: bool) -> bool:
        """Whether all guarded arms are as wished."""
        wanted = (state, is_homed, is_busy)
        return len(self.states) == len(ARMS) and all(
            (s.state, s.is_homed, s.is_busy) == wanted for s in self.states.values()
        )

    def make_ready(self) -> None:
        """Enabled, homed, and agreed to."""
        self.until(lambda: self.start and len(self.states) == len(ARMS))
        self.until(lambda: self.is_in("ENABLED", False, False), lambda: self.command("enable"))
        self.until(lambda: self.is_in("ENABLED", True, True), lambda: self.command("home"))
        self.press(False)
        time.sleep(0.5)
        self.until(lambda: self.is_in("ENABLED", True, False), lambda: self.press(True))

    def stream(self, seconds: float) -> None:
        """Swings one joint, from rest to rest."""
        began, period, start = time.monotonic(), 1.0 / RATE_HZ, self.start
        for k in range(1, round(seconds * RATE_HZ) + 1):
            time.sleep(max(began + k * period - time.monotonic(), 0.0))
            phase = 2.0 * math.pi * k * period / SWING_S
            ease = _ease(k * period) * _ease(seconds - STILL_S - k * period)
            q = start[0] + 0.5 * SWING_RAD * (1.0 - math.cos(phase)) * ease
            position = (q, *start[1:])
            stamp_ns = self.node.stamp_ns()
            word = JointState(Header(Time.of_ns(stamp_ns)), JOINTS, position)
            self.sent[hash(position)] = time.monotonic()
            self._servo(word)
            self.sent[stamp_ns] = time.monotonic()
            self._direct(word)
        time.sleep(0.2)

    def _hear_start(self, word: JointState, received_s: float) -> None:
        self.start = self.start or word.position

    def _hear_robot(self, word: JointState, received_s: float) -> None:
        sent_s = self.sent.pop(hash(word.position), None)  # bit for bit, or it is not ours
        if sent_s is not None:
            self.guarded_ms.append((received_s - sent_s) * 1e3)

    def _hear_direct(self, word: JointState, received_s: float) -> None:
        self.direct_ms.append((received_s - self.sent[word.header.stamp.ns]) * 1e3)


def _ease(t: float) -> float:
    """From 0 to 1 within a second, without a jerk."""
    t = min(max(t, 0.0), 1.0)
    return t**4 * (35.0 - 84.0 * t + 70.0 * t**2 - 20.0 * t**3)


@contextlib.contextmanager
def running(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """A `viskill` command, ended by Ctrl-C."""
    command = [sys.executable, "-m", "viskill_deploy.cli.main", *arguments]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=sys.stderr)
    try:
        yield process
    finally:
        process.send_signal(2)
        process.wait(timeout=30)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transport", choices=("dds", "ros1", "ros2"), default="dds")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--domain", type=int, default=77)
    parser.add_argument("--output", type=Path)
    args = parser.parse_args()
    way = ("--transport", args.transport, "--domain", str(args.domain), "--interface", LOOPBACK)
    with (
        tempfile.TemporaryDirectory() as folder,
        running("serve", "crtk", "--homing", "stay", *way),
        running("guard", "--simulated", *way, "--output", f"{folder}/guard"),
    ):
        realtime.prepare()  # a client that is late would be taken for a slow guard
        client = Client(open_transport(args.transport, Network(args.domain, LOOPBACK)))
        client.make_ready()
        client.stream(args.seconds)
        states = {arm: state.state for arm, state in client.states.items()}
        client.node.close()
    sent = round(args.seconds * RATE_HZ)
    figures = {
        "transport": args.transport,
        "sent": sent,
        "passed_bit_for_bit": len(client.guarded_ms),
        "states": states,
        **{
            f"guarded_p{p}_ms": round(float(np.percentile(client.guarded_ms, p)), 3)
            for p in (50, 99)
        },
        **{
            f"direct_p{p}_ms": round(float(np.percentile(client.direct_ms, p)), 3) for p in (50, 99)
        },
    }
    figures["added_p50_ms"] = round(figures["guarded_p50_ms"] - figures["direct_p50_ms"], 3)
    print(json.dumps(figures, indent=2))
    if args.output:
        args.output.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
