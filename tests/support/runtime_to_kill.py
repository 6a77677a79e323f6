"""Starts `moving_runtime` in a process of its own, and watches its robot from outside."""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import CellState
from viskill_deploy.drivers.loopback_stop import StopHandle
from viskill_deploy.drivers.loopback_wire import unpack_state

SCRIPT = Path(__file__).with_name("moving_runtime.py")
PROCESSES = ("server", "watchdog", "recorder")


class EndedByItself(Exception):  # noqa: N818 - nothing that went wrong here
    """The gate ended the run before anybody could kill it; says why."""


class RuntimeToKill:
    """A runtime whose arms move, with its server, watchdog and recorder.

    Args:
        folder: where it records.
        driver: "loopback" or "crtk".

    Attributes:
        domain: where arms speak CRTK; -1 where they do not.
        process: the runtime.
        recording: folder of its recording.
        state: the robot's last known state.
        stopped_s: when the robot was first told by its watchdog to do what, monotonic clock.
    """

    def __init__(self, folder: Path, driver: str = "loopback") -> None:
        self.recording = folder / "recording"
        self.state = CellState((), None)  # type: ignore[arg-type]
        self.stopped_s: dict[str, float] = {}
        self.process = subprocess.Popen(
            [sys.executable, str(SCRIPT), str(self.recording), driver],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            self._pids = self.told()
        except ValueError:  # it said nothing: what it died of stands on its standard error
            self.process.kill()
            raise
        if "server" not in self._pids:
            self.process.kill()
            raise EndedByItself(str(self._pids))
        self._open = {name: os.pidfd_open(self._pids[name]) for name in PROCESSES}
        self.domain: int = self._pids["domain"]
        self._handle = StopHandle(Path(self._pids["socket"]))
        self.look()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.process.kill()
        self.process.wait()
        self._handle.close()
        for descriptor in self._open.values():
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(descriptor, signal.SIGKILL)
            os.close(descriptor)
        shutil.rmtree(Path(self._pids["socket"]).parent, ignore_errors=True)

    def told(self) -> dict[str, Any]:
        """The next thing that the runtime says."""
        assert self.process.stdout is not None
        said: dict[str, Any] = json.loads(self.process.stdout.readline())
        return said

    def kill(self, who: str = "runtime", what: int = signal.SIGKILL) -> float:
        """Sends a signal; returns when."""
        now = time.monotonic()
        os.kill(self.process.pid if who == "runtime" else self._pids[who], what)
        return now

    def look(self) -> CellState:
        """The robot now."""
        self._handle.ask()
        while not (answers := self._handle.answers()):
            time.sleep(0.001)
        self.state, self.stopped_s = unpack_state(answers[-1]["state"]), answers[-1]["stopped_s"]
        return self.state

    def look_until(self, done: str, timeout_s: float = 5.0) -> None:
        """Looks until the watchdog has done something, "hold" or "disable"."""
        deadline, longest, last = time.monotonic() + timeout_s, 0.0, time.monotonic()
        while done not in self.stopped_s:
            self.look()
            time.sleep(0.002)
            now = time.monotonic()
            longest, last = max(longest, now - last), now
            assert now < deadline or done in self.stopped_s, (
                f"no {done} within {timeout_s} s, only {self.stopped_s}; longest time between two "
                f"looks {longest:.3f} s; arms {self.state.arms[0].operating_state}; ended: "
                f"{[name for name, fd in self._open.items() if select.select([fd], [], [], 0)[0]]}"
            )

    def look_to_the_end(self) -> None:
        """Looks until the server has gone."""
        with contextlib.suppress(DriverError):
            while True:
                self.look()
                time.sleep(0.002)

    def await_end(self, who: str, timeout_s: float = 10.0) -> None:
        """Waits for one of the other processes to end by itself."""
        ended = select.select([self._open[who]], [], [], timeout_s)[0]
        assert ended, f"the {who} did not end within {timeout_s} s"
