"""A robot that nobody knows, from the first measurement to the task done, by the commands alone.

    python benchmarks/joined_run.py runs/joined [--truth 3] [--samples 120] [--episodes 5]
        [--trials 1] [--transport dds] [--speed 1.0] [--kill]

A hidden robot (docs/calibration.md) is served over CRTK as dVRK arms with a tracker beside them.
`viskill calibrate collect --driver crtk`, `fit`, `check` and `execute --mode plan` are run as a
person would run them; whoever stands at the pedal, answers, and puts the block back is simulated.
With --kill each of the commands is ended by SIGKILL once on its way and started again: what it had
written has to be there, and the arms have to be at rest without it. --trials is how often the task
is done, from another layout each time; a trial that ends because this machine stood still (S20) is
told and begun again, any other end counts. Then the same policy is run on the same robot on the
stepped loopback, calibrated and not. Prints one JSON object. Started again with the same folder it
goes on with what is there.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.calibrate.truths import MARKER_M, HiddenRobot, hidden_robot
from viskill_deploy.core.data import find
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.types import Scene
from viskill_deploy.drivers.crtk.private_network import PrivateNetwork
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated import served_arms
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

BUNDLE = Path(__file__).parents[1] / "policies" / "bipegtransfer-viskill"
PRESS, LET_GO, HELD = "press the consent pedal", "take your foot off", "resume?"
MACHINE = "S20"
RECORD = Path("recording/recording_0.mcap")
ON_ITS_WAY_BYTES = 200_000
"""What a recording holds after two seconds of motion."""

LOOK_S, TRIES, STILL_RAD_S, STOPPED_S = 0.05, 30, 0.02, 2.0


@dataclass
class Bench:
    """The served robot, and what the commands are told.

    Attributes:
        told: how often a person was asked for the pedal, and whether to resume.
        killed: how fast a joint moved at the last SIGKILL, and how long until all were at rest.
    """

    server: ServedLoopback
    folder: Path
    network: list[str]
    told: dict[str, int] = field(default_factory=lambda: {PRESS: 0, HELD: 0})
    killed: dict[str, float] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def run(
        self, *arguments: str, kill: str = "", grown: int = 2000, later_s: float = 0.0
    ) -> subprocess.CompletedProcess[str]:
        """A `viskill` command, with somebody at pedal and terminal.

        Args:
            arguments: of the command.
            kill: SIGKILL once this file has grown since the start, or, as "1.5", after so many s.
            grown: by how many bytes.
            later_s: so much later.
        """
        self.killed = {}
        command = [sys.executable, "-m", "viskill_deploy.cli.main", *arguments]
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        killer = threading.Thread(
            target=self._kill, args=(process, kill, grown, later_s), daemon=True
        )
        if kill:
            killer.start()
        lines = []
        assert process.stdout is not None
        assert process.stdin is not None
        for line in process.stdout:
            lines.append(line)
            if PRESS in line:
                self.told[PRESS] += 1
                self._say(consent=True)
            elif LET_GO in line:
                self._say(consent=False)
            elif HELD in line:
                self.told[HELD] += 1
                with contextlib.suppress(BrokenPipeError):
                    process.stdin.write("\n")
                    process.stdin.flush()
        code = process.wait()
        if kill:
            killer.join()
            if code != -signal.SIGKILL or not self.killed:
                raise RuntimeError(f"was not killed, exit code {code}: {' '.join(command)}")
        self._say(consent=False)
        return subprocess.CompletedProcess(command, code, "".join(lines), "")

    def _kill(self, process: subprocess.Popen[str], when: str, grown: int, later_s: float) -> None:
        path = Path(when)
        size = path.stat().st_size if path.exists() else 0
        if re.fullmatch(r"[0-9.]+", when):
            time.sleep(float(when))
        else:
            while process.poll() is None and not (
                path.exists() and path.stat().st_size > size + grown
            ):
                time.sleep(LOOK_S)
        time.sleep(later_s)
        speed = self._speed()
        process.send_signal(signal.SIGKILL)
        self.killed = {"speed_rad_s": speed, "at_rest_s": self._stopped_s()}

    def _say(self, consent: bool) -> None:
        with self.lock:
            self.server.say(consent=consent)

    def _speed(self) -> float:
        """Of the fastest joint, rad/s or m/s."""
        with self.lock:
            return max(max(map(abs, arm.measured_jv)) for arm in self.server.truth().arms)

    def _stopped_s(self) -> float:
        """How long the arms took to be at rest; more than `STOPPED_S` if they did not come to."""
        began = time.monotonic()
        while (took := time.monotonic() - began) < STOPPED_S:
            if self._speed() < STILL_RAD_S:
                break
            time.sleep(0.005)
        return took


def lab_cell(folder: Path) -> Path:
    """The cell with serial numbers: the served arms count as real ones."""
    text = find("robots/cells/bipegtransfer.toml").read_text(encoding="utf-8")
    path, serials = folder / "lab.toml", iter(["29662", "30100"])
    path.write_text(
        re.sub(r"^(tool = .*)$", lambda m: f'{m[1]}\nserial = "{next(serials)}"', text, flags=re.M),
        encoding="utf-8",
    )
    return path


def scene_file(folder: Path, cell: CellDescription, scene: Scene) -> Path:
    """What a person who has looked at the board writes down."""
    lines = ["schema = 1", f'cell = "{cell.name}"', f'active = "{scene.active}"']
    lines += [f"goal_m = {scene.goal.tolist()}"]
    for thing in scene.objects:
        T = thing.T_task_object
        yaw = float(np.arctan2(T[1, 0], T[0, 0]))
        lines += ["[[object]]", f'name = "{thing.name}"', f"position_m = {T[:3, 3].tolist()}"]
        lines += [f"rotation_rpy_rad = [0.0, 0.0, {yaw}]"]
        lines += ["sigma_position_m = [0.0005, 0.0005, 0.0002]"]
        lines += ["sigma_rotation_rad = [0.0, 0.0, 0.03]"]
    path = folder / "scene.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@contextlib.contextmanager
def served(
    folder: Path, transport: str, hidden: HiddenRobot, layout: Scene, seed: int
) -> Iterator[Bench]:
    """The hidden robot on a network of its own."""
    path = lab_cell(folder)
    cell, private = load_cell(path), PrivateNetwork(transport)
    tracker = hidden.tracker(cell)
    options = ServerOptions(homing="dvrk", tracker=tracker, seed=seed)
    world = hidden.world(cell, WorldOptions())
    server = served_arms(cell, transport, private.network, world, seed, options)
    server.connect()
    try:
        server.reset(layout)
        domain, address = private.network.domain_id(), private.network.interface
        where = ["--driver", "crtk", "--transport", transport, "--domain", str(domain)]
        yield Bench(server, folder, [*where, "--interface", address])
    finally:
        server.close()
        private.close()


def collected(bench: Bench, samples: int, speed: float, kill: bool) -> dict[str, Any]:
    """Measurements over the wire, begun again until they are all there."""
    points, cell = bench.folder / "points", str(bench.folder / "lab.toml")
    book = points / "PSM1.csv"
    command = ["calibrate", "collect", str(points), "--robot", cell, "--samples", str(samples)]
    command += ["--point", str(MARKER_M), *bench.network, "--speed", str(speed), "--yes"]
    found: dict[str, Any] = {"starts": 0}
    if kill:
        bench.run(*command, kill=str(book), later_s=0.3)
        found |= {"starts": 1, "killed": bench.killed}
        kept = book.read_text(encoding="utf-8")
        found["kept_rows"] = _rows(kept)
    last = ""
    for _ in range(TRIES):
        found["starts"] += 1
        done = bench.run(*command)
        if done.returncode == 0:
            break
        last = done.stdout[-300:]
        found.setdefault("ended_by", []).append(_why(last))
        print(f"collect, start {found['starts']}: {_why(last)}", file=sys.stderr, flush=True)
        time.sleep(1.0)
    else:
        raise RuntimeError(f"collect did not end well in {TRIES} starts: {last}")
    text = book.read_text(encoding="utf-8")
    if kill:
        whole = kept[: kept.rfind(" done\n") + 6]  # rows of the pose after it are measured again
        found["lost_nothing"] = text.startswith(whole)
    return found | {"rows": _rows(text)}


def _why(text: str) -> str:
    """The last line that a command has said."""
    return next((line for line in reversed(text.splitlines()) if line.strip()), "nothing")


def _rows(text: str) -> int:
    return sum(line[:1].isdigit() for line in text.splitlines())


def fitted(bench: Bench, kill: bool) -> dict[str, Any]:
    """The calibration, from what was measured."""
    file, cell = bench.folder / "lab.json", str(bench.folder / "lab.toml")
    command = ["calibrate", "fit", str(bench.folder / "points"), "-o", str(file), "--cell", cell]
    if kill:
        bench.run(*command, kill="1.0")
    done = bench.run(*command, "--json")
    if done.returncode:
        raise RuntimeError(done.stdout)
    arms = json.loads(done.stdout.splitlines()[-1])["arms"]
    check = ["check", str(BUNDLE), "--robot", cell, "--calibration", str(file)]
    return {
        "held_out_median_mm": {n: 1e3 * arm["held_out_median_m"] for n, arm in arms.items()},
        "check": bench.run(*check).returncode,
    }


def executed(bench: Bench, layout: Scene, speed: float, kill: bool) -> dict[str, Any]:
    """The task, planned, by a person who is asked; killed on the way if so wished."""
    folder, task = bench.folder, load_task("bipegtransfer")
    scene = scene_file(folder, load_cell(folder / "lab.toml"), layout)
    command = ["execute", str(BUNDLE), "--robot", str(folder / "lab.toml"), "--mode", "plan"]
    command += ["--calibration", str(folder / "lab.json"), "--scene", str(scene), *bench.network]
    command += ["--pose-topic", "/scene/{object}/measured_cp", "--speed", str(speed), "--yes"]
    command += ["--no-video"]
    found: dict[str, Any] = {}
    number = 0

    def run(kill: bool = False) -> tuple[Path, int]:
        nonlocal number
        while (output := folder / f"run-{number}").exists():
            number += 1
        bench.server.reset(layout)
        record = str(output / RECORD) if kill else ""
        done = bench.run(*command, "--output", str(output), kill=record, grown=ON_ITS_WAY_BYTES)
        return output, done.returncode

    if kill:
        output, _ = run(kill=True)
        found |= {"killed": bench.killed, "killed_record_bytes": (output / RECORD).stat().st_size}
    for start in range(1, TRIES + 1):
        output, code = run()
        found |= {"starts": start, "exit": code}
        print(f"execute, start {start}: exit code {code}", file=sys.stderr, flush=True)
        if (file := output / "result.json").exists():
            episode = json.loads(file.read_text(encoding="utf-8"))["episode_results"][0]
            if episode["stopped_by"] != MACHINE:
                break
        time.sleep(1.0)
    else:
        raise RuntimeError(f"execute came to no end of its own in {TRIES} starts")
    found |= {key: episode[key] for key in ("stopped_by", "refused", "resumed", "retries")}
    return found | {"success": bool(task.success(bench.server.active_object(), layout))}


def stepped(bench: Bench, truth: str, episodes: int) -> dict[str, Any]:
    """The same robot on the stepped loopback: successes with and without the calibration."""
    lab = ["--robot", str(bench.folder / "lab.toml")]
    lab += ["--calibration", str(bench.folder / "lab.json")]
    found: dict[str, Any] = {}
    for name, more in (("uncalibrated", []), ("calibrated", lab)):
        output = bench.folder / f"{name}-{time.time_ns()}"
        command = ["dry-run", str(BUNDLE), "--mode", "plan", "--truth", truth, "--no-video"]
        command += ["--distribution", "reference", "--output", str(output), *more]
        bench.run(*command, "--episodes", str(episodes))
        result = json.loads((output / "result.json").read_text(encoding="utf-8"))
        wins = sum(episode["success"] for episode in result["episode_results"])
        found[name] = f"{wins} of {len(result['episode_results'])}"
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--truth", default="3", help="seed, or file of `viskill calibrate truth`")
    parser.add_argument("--samples", type=int, default=120)
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--trials", type=int, default=1)
    parser.add_argument("--transport", default="dds", choices=("dds", "ros1", "ros2"))
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--kill", action="store_true", help="end every command once by SIGKILL")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    task = load_task("bipegtransfer")
    layouts = [
        task.sample_layout(np.random.default_rng(1 + trial), task.distributions[0])
        for trial in range(args.trials)
    ]
    hidden = hidden_robot(args.truth, load_cell("bipegtransfer"))
    report = args.folder / "joined.json"
    found: dict[str, Any] = {"truth": hidden.about, "transport": args.transport}
    if report.exists():
        found |= json.loads(report.read_text(encoding="utf-8"))
    with served(args.folder, args.transport, hidden, layouts[0], 1) as bench:
        stages: dict[str, Callable[[], dict[str, Any]]] = {
            "collect": lambda: collected(bench, args.samples, args.speed, args.kill),
            "fit": lambda: fitted(bench, args.kill),
            **{
                f"execute {trial}": partial(
                    executed, bench, layout, args.speed, args.kill and trial == 0
                )
                for trial, layout in enumerate(layouts)
            },
            "stepped": lambda: stepped(bench, args.truth, args.episodes),
        }
        for name, stage in stages.items():
            if name not in found:
                began = time.monotonic()
                asked = dict(bench.told)
                found[name] = stage()
                found[name]["pedal"] = bench.told[PRESS] - asked[PRESS]
                found[name]["held"] = bench.told[HELD] - asked[HELD]
                found[name]["wall_s"] = round(time.monotonic() - began, 1)
                report.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
                print(f"{name}: {json.dumps(found[name])}", file=sys.stderr, flush=True)
    done = [found[f"execute {trial}"]["success"] for trial in range(args.trials)]
    found["executed"] = f"{sum(done)} of {len(done)}"
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
