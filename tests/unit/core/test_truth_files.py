"""A hidden robot is read as it was written, or refused by name."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from typer.testing import CliRunner

from viskill_deploy.calibrate.truths import draw_robot, draw_truth, hidden_robot, scaled
from viskill_deploy.cli.main import app
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.truth_files import read_truth
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")


def _written(path: Path, change: Any = None) -> Path:
    content = json.loads(draw_robot(CELL, 3).text())
    if change is not None:
        change(content)
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_a_drawn_robot_is_the_same_from_its_seed_and_from_its_file(tmp_path: Path) -> None:
    path = _written(tmp_path / "robot.json")
    drawn, read = hidden_robot("3", CELL), hidden_robot(str(path), CELL)
    assert drawn.truth == read.truth == read_truth(path, CELL)
    assert drawn.about == {"seed": 3}
    assert read.about["file"] == str(path)
    assert len(read.about["sha256"]) == 64
    assert draw_robot(CELL, 4) != drawn.truth


def test_the_arms_of_a_drawn_robot_have_all_errors_that_a_study_draws_and_a_longer_shaft() -> None:
    arms = draw_robot(CELL, 3).errors(CELL)
    studied = draw_truth(np.random.default_rng([3, 0]))
    assert arms[0].joint_offset == studied.joint_offset
    assert arms[0].cables == studied.cables
    assert arms[0].tool_length_m != 0.0
    assert arms[0] != arms[1]


def test_a_robot_may_be_a_part_of_as_wrong(tmp_path: Path) -> None:
    path = tmp_path / "robot.json"
    arguments = ["calibrate", "truth", "3", "-o", str(path), "--scale", "0.25"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    whole, part = draw_robot(CELL, 3), read_truth(path, CELL)
    for one, other in zip(whole.errors(CELL), part.errors(CELL), strict=True):
        np.testing.assert_allclose(other.joint_offset, 0.25 * np.array(one.joint_offset))
        np.testing.assert_allclose(other.cables.coupling, 0.25 * np.array(one.cables.coupling))
        assert other.delay_s == 0.25 * one.delay_s
    assert part.object_error_rad == 0.25 * whole.object_error_rad
    assert scaled(whole, 1.0) == whole


def test_a_robots_world_has_its_errors_and_what_else_was_asked_for() -> None:
    robot = hidden_robot("3", CELL)
    world = robot.world(CELL, WorldOptions(period_s=0.002, object_noise_m=0.001, drop_rate=0.1))
    assert world.truth == robot.truth.errors(CELL)
    assert world.board_translation_m == robot.truth.board_translation_m
    assert (world.object_noise_m, world.drop_rate) == (0.001, 0.1)
    # as a process of its own is told it
    assert TypeAdapter(WorldOptions).validate_json(json.dumps(asdict(world))) == world
    assert world.delay_periods == round(robot.truth.command_delay_s / 0.002)
    delays = robot.tracker(CELL).delay_s
    assert delays == tuple(arm.delay_s for arm in world.truth)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.update(cell="bipegboard"), "bipegboard"),
        (lambda c: c["arms"].pop("PSM2"), "with PSM1"),
        (lambda c: c["arms"]["PSM1"].update(joint_ofset=[0.0] * 6), "PSM1.joint_ofset"),
        (lambda c: c["arms"]["PSM1"].update(joint_offset=[0.0] * 5), "joint_offset"),
        (lambda c: c["arms"]["PSM1"]["cables"].update(backlash_rad=[-0.1, 0.0, 0.0]), "play"),
        (lambda c: c.update(outlier_share=1.5), "outlier_share"),
        (lambda c: c.update(noise=1.0), "unknown key"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path: Path, change: Any, said: str) -> None:
    path = _written(tmp_path / "robot.json", change)
    with pytest.raises(DataFileError, match=said):
        read_truth(path, CELL)


def test_what_is_no_file_says_how_to_write_one(tmp_path: Path) -> None:
    with pytest.raises(DataFileError, match="viskill calibrate truth"):
        hidden_robot(str(tmp_path / "none.json"), CELL)
