"""Time from `kill -9` of the runtime to held arms: `python benchmarks/watchdog.py [trials] [FILE]`.

Every trial starts runtime, served loopback, watchdog and recorder anew and kills the runtime at
another moment of a motion at up to 45 mm/s. The times are those at which the served arms were told,
by the machine's monotonic clock; how far a tip still moved is what their own encoders say. One JSON
line a trial goes to FILE; trials that stand there already are not run again. Exits with 1 when arms
were not held within 100 ms, or a recording is not complete.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/support"))

from runtime_to_kill import RuntimeToKill

from viskill_deploy.core import realtime
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import CellState
from viskill_deploy.motion.links import CellLinks
from viskill_deploy.observe.reading import read_recording

GOAL_S = 0.1
LINKS = CellLinks(load_cell("bipegtransfer"))


def tips(state: CellState) -> np.ndarray:
    return np.array([T[:3, 3] for T in LINKS.tips([arm.measured_jp for arm in state.arms])])


def trial(number: int, folder: Path) -> dict[str, float | bool]:
    """One kill; s and m."""
    with RuntimeToKill(folder) as run:
        time.sleep(np.random.default_rng(number).uniform(0.0, 1.2))
        before = tips(run.look())
        killed = run.kill()
        run.look_until("disable")
        moved = float(np.linalg.norm(tips(run.look()) - before, axis=1).max())
        run.await_end("recorder")
    data = read_recording(run.recording)
    last = data.joints["/PSM1/setpoint_js"].time_s[-1] + data.origin_ns * 1e-9
    return {
        "trial": number,
        "hold_s": run.stopped_s["hold"] - killed,
        "disable_s": run.stopped_s["disable"] - killed,
        "moved_m": moved,
        "record_complete": data.complete,
        "record_lacks_s": killed + time.time() - time.monotonic() - last,
    }


def main(trials: int, file: Path) -> int:
    """Runs what is missing, then prints what all of it came to; 1 when that is not good."""
    done = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    for number in range(len(done), trials):
        with tempfile.TemporaryDirectory() as folder:
            done.append(trial(number, Path(folder)))
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a") as out:
            out.write(json.dumps(done[-1]) + "\n")
    for note in realtime.refusals():
        print(f"note: {note}")
    held = np.array([row["hold_s"] for row in done]) * 1e3
    disabled = np.array([row["disable_s"] for row in done]) * 1e3
    lacks = np.array([row["record_lacks_s"] for row in done]) * 1e3
    moved = np.array([row["moved_m"] for row in done]) * 1e3
    print(f"{len(done)} kills: held within 100 ms in {(held <= GOAL_S * 1e3).sum()}")
    print(f"to hold: median {np.median(held):.0f} ms, longest {held.max():.0f} ms")
    print(f"to disable: median {np.median(disabled):.0f} ms, longest {disabled.max():.0f} ms")
    print(f"farthest that a tip moved after the kill: {moved.max():.1f} mm")
    print(f"recordings complete: {sum(row['record_complete'] for row in done)}")
    print(f"last recorded cycle before the kill: at most {lacks.max():.1f} ms")
    return int((held > GOAL_S * 1e3).any() or not all(row["record_complete"] for row in done))


if __name__ == "__main__":
    sys.exit(
        main(
            int(sys.argv[1]) if len(sys.argv) > 1 else 50,
            Path(sys.argv[2]) if len(sys.argv) > 2 else Path("build/watchdog.jsonl"),
        )
    )
