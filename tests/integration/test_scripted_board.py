"""BiPegBoard through the whole line: IK, smoothing, gate and loopback, driven by the script."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import manifest_of
from viskill_deploy.bundle.format import Bundle
from viskill_deploy.runtime.dry_run import DryRunOptions, Mode, dry_run
from viskill_deploy.runtime.preflight import Prepared
from viskill_deploy.sim.tasks import Task, load_task

TASK = load_task("bipegboard")


class ScriptedSkill:
    """Answers as the ONNX session of a perfectly trained skill would."""

    def __init__(self, task: Task, skill: str) -> None:
        self._task, self._skill = task, skill

    def run(self, names: list[str], feed: dict[str, Any]) -> list[np.ndarray]:
        obs, goal = (np.asarray(feed[key][0], dtype=np.float64) for key in ("obs", "goal"))
        return [self._task.scripted_action(self._skill, obs, goal)[None].astype(np.float32)]


class Blank:
    """A recorder that keeps nothing."""

    alive = True

    def cycle(self, *args: object) -> None:
        pass

    def scene(self, *args: object) -> None:
        pass

    def mark(self, *args: object) -> None:
        pass


def run(distribution: str, mode: Mode, episodes: int, seed: int = 0) -> dict[str, Any]:
    sessions: Any = {skill.name: ScriptedSkill(TASK, skill.name) for skill in TASK.skills}
    prepared = Prepared(Bundle(Path(), manifest_of(TASK), sessions), TASK, TASK.cell, (), ())
    options = DryRunOptions(episodes, seed, distribution, mode)
    outcome = dry_run(prepared, options, Blank())  # type: ignore[arg-type]
    assert outcome.failure is None, outcome.failure
    return outcome.figures


@pytest.mark.parametrize("mode", ["closed-loop", "plan"])
@pytest.mark.parametrize("distribution", ["reference", "wide"])
def test_the_gate_never_steps_in_and_every_ring_ends_on_its_peg(
    distribution: str, mode: Mode
) -> None:
    figures = run(distribution, mode, episodes=1)
    assert figures["success_rate"] == 1.0
    assert figures["interventions"] == figures["refused"] == 0
    assert figures["worst_action"] == "PASS"
    assert min(figures["margins"].values()) >= 0.0
    assert figures["tip_speed_max_m_s"] <= TASK.cell.file.motion.tip_speed_m_s
