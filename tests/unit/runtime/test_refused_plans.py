"""A plan file that is refused before anything moves: no figures of a motion, and an exit code."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.core.errors import MotionError, SafetyStop, ViskillError
from viskill_deploy.core.types import Waypoint
from viskill_deploy.motion.trajectory import write_plan
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.sim.tasks.base import load_task

pytestmark = pytest.mark.no_cover

TASK = load_task("bipegtransfer")
OF_A_MOTION = ("rcm_error_max_m", "joint_margin_min", "tip_speed_max_m_s")


def plan_through(folder: Path, places: Sequence[Sequence[float]], turn: float = 0.0) -> Path:
    """A plan that takes the arms from their start to places, (arms, 3), m; PSM1 turned, rad."""
    begin = start_waypoint(TASK.cell)
    begin = Waypoint(begin.T_task_tip, begin.jaw, 0.2)
    tips = [T.copy() for T in begin.T_task_tip]
    for tip, place in zip(tips, places, strict=True):
        tip[:3, 3] = place
    c, s = np.cos(turn), np.sin(turn)
    tips[0][:3, :3] = tips[0][:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    path = folder / "refused.plan.json"
    write_plan(path, TASK.cell, [begin, replace(begin, T_task_tip=tuple(tips))], "a test")
    return path


MEETING = [(0.0, 0.0, 0.05)] * 2
START = [tuple(T[:3, 3]) for T in start_waypoint(TASK.cell).T_task_tip]


@pytest.mark.parametrize(
    ("places", "turn", "error", "code"),
    [(MEETING, 0.0, SafetyStop, 5), (START, 2.6, MotionError, 3)],
    ids=["arms that meet", "out of reach"],
)
def test_a_refused_plan_file_has_no_figures_of_a_motion_and_an_exit_code(
    tmp_path: Path,
    places: Sequence[Sequence[float]],
    turn: float,
    error: type[ViskillError],
    code: int,
) -> None:
    plan = plan_through(tmp_path, places, turn)
    folder = tmp_path / "run"
    options = ["--episodes", "3", "--no-video", "--output", str(folder)]
    ran = CliRunner().invoke(app, ["dry-run", str(plan), *options])
    assert isinstance(ran.exception, error)
    assert ran.exception.exit_code == code
    result = json.loads((folder / "result.json").read_text())
    assert (result["setpoints"], result["refused"], result["episodes"]) == (0, 1, 1)
    assert [result[key] for key in OF_A_MOTION] == [None] * 3
    assert result["margins"] == {}
    page = (folder / "report.html").read_text()
    for words in ("100.0 %", "Joint margin", "Remote centre<", "Smallest margin"):
        assert words not in page
        assert words.rstrip("<").lower() not in ran.output.lower()
    assert result["episode_results"][0]["refused"] == str(ran.exception)
