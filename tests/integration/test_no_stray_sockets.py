"""What is kept to this machine opens no socket that another one could reach."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from crtk_domain import DOMAIN

PROGRAM = Path(__file__).parents[1] / "support" / "tell_strays.py"
NETWORK = ("--transport", "dds", "--domain", str(DOMAIN + 3), "--interface", "127.0.0.1")
PATIENCE_S = 60.0


@contextmanager
def running(told: Path, *words: str) -> Iterator["subprocess.Popen[str]"]:
    """A `viskill` command that says in `told` which sockets it has, at SIGUSR1."""
    command = [sys.executable, str(PROGRAM), str(told), *words, *NETWORK]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=PATIENCE_S)


def has_none(process: "subprocess.Popen[str]", told: Path, last_line: str) -> None:
    """Once it has said that line of its output."""
    assert process.stdout
    for line in process.stdout:
        if line.startswith(last_line):
            break
    process.send_signal(signal.SIGUSR1)
    deadline = time.monotonic() + PATIENCE_S
    while not told.exists():
        assert time.monotonic() < deadline, f"{told.stem} says nothing"
        time.sleep(0.02)
    assert json.loads(told.read_text()) == []


@pytest.mark.no_cover
def test_a_served_robot_and_a_guard_before_it_are_not_reached_from_outside(tmp_path: Path) -> None:
    one, two = tmp_path / "serve.json", tmp_path / "guard.json"
    with running(one, "serve", "crtk") as robot:
        has_none(robot, one, "stop with Ctrl-C")
        words = ("guard", "--simulated", "--output", str(tmp_path / "guard"))
        with running(two, *words) as guard:
            has_none(guard, two, "stop with Ctrl-C")


OPEN = "import socket, time; one = socket.socket(); one.bind(('0.0.0.0', 0)); one.listen(); "


@pytest.mark.parametrize("is_childs", [False, True])
def test_a_socket_for_everybody_would_be_found(is_childs: bool) -> None:
    code = "import json, os, time; from crtk_peer import strays; "
    if is_childs:
        code += "up, told = os.pipe(); child = os.fork()\nif not child:\n  "
        code += OPEN + "os.write(told, b'x'); time.sleep(60)\n"
        code += "os.read(up, 1); print(json.dumps(strays())); os.kill(child, 9)"
    else:
        code += OPEN + "print(json.dumps(strays()))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=PROGRAM.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    assert len(json.loads(done.stdout)) == 1
