"""Touch from the command line: measured, fitted, and bad touches refused by name."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from viskill_deploy.calibrate.truths import draw_robot
from viskill_deploy.cli.main import app
from viskill_deploy.core.calibration_files import read_calibration
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError

RUN = CliRunner()


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("touched")
    collect = ["calibrate", "collect", str(folder), "--source", "touch", "--truth", "3"]
    done = RUN.invoke(app, [*collect, "--points", "10", "--json"])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    assert facts["files"]["PSM2"] == str(folder / "PSM2.csv")
    assert len(facts["touched"]["PSM1"]) == 10
    return folder


def fitted(folder: Path, output: Path) -> dict[str, float]:
    done = RUN.invoke(app, ["calibrate", "fit", str(folder), "-o", str(output), "--json"])
    if done.exception is not None:
        raise done.exception
    found: dict[str, float] = json.loads(done.stdout)["arms"]["PSM1"]["parameters"]
    return found


def test_ten_touches_an_arm_make_a_calibration(points: Path, tmp_path: Path) -> None:
    found = fitted(points, tmp_path / "cell.json")
    truth = draw_robot(load_cell("bipegtransfer"), 3).arms["PSM1"]
    depth = truth.joint_offset[2] + truth.tool_length_m
    assert found["offset_insertion_m"] == pytest.approx(depth, abs=2e-3)
    arm = read_calibration(tmp_path / "cell.json").arms[0]
    assert arm.samples <= 10
    assert 0.0 < arm.residual_rms_m < 1.5e-3


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def swapped(folder: Path) -> None:
    one, other = folder / "PSM1.csv", folder / "PSM2.csv"
    one.rename(folder / "spare")
    other.rename(one)
    (folder / "spare").rename(other)


def few(folder: Path) -> None:
    path = folder / "PSM1.csv"
    path.write_text("\n".join(lines(path)[:8]) + "\n")


def one_pose(folder: Path) -> None:
    path = folder / "PSM1.csv"
    path.write_text("\n".join(lines(path)[:3] + lines(path)[3:4] * 9) + "\n")


def columns(folder: Path, change: dict[int, str]) -> None:
    path = folder / "PSM1.csv"
    rows = [line.split(",") for line in lines(path)]
    for row in rows[3:]:
        for at, word in change.items():
            row[at] = word if word == "nan" else repr(float(row[at]) * float(word))
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")


def in_mm(folder: Path) -> None:
    columns(folder, {16: "1000", 17: "1000", 18: "1000"})


def in_degrees(folder: Path) -> None:
    columns(folder, dict.fromkeys((1, 2, 4, 5, 6), "57.3"))


def not_a_number(folder: Path) -> None:
    columns(folder, {17: "nan"})


def another_frame(folder: Path) -> None:
    columns(folder, {16: "-1", 17: "-1"})


def wrong_order(folder: Path) -> None:
    """As if every point had been taken for the next one."""
    path = folder / "PSM1.csv"
    rows = [line.split(",") for line in lines(path)]
    joints = [row[:16] for row in rows[3:]]
    moved = [
        [*joint, *row[16:]] for joint, row in zip(joints[1:] + joints[:1], rows[3:], strict=True)
    ]
    path.write_text("\n".join(",".join(row) for row in rows[:3] + moved) + "\n")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (swapped, "other arm|no rigid move"),
        (few, "at least 6"),
        (one_pose, "one line"),
        (in_mm, "look like mm"),
        (in_degrees, "look like degrees"),
        (not_a_number, "row 1 of points holds a number that is not finite"),
        (another_frame, "another frame"),
        (wrong_order, "no rigid move"),
    ],
)
def test_bad_touches_are_refused_by_name(points: Path, tmp_path: Path, spoil, words: str) -> None:
    folder = shutil.copytree(points, tmp_path / "spoiled")
    spoil(folder)
    with pytest.raises(CalibrationError, match=words) as caught:
        fitted(folder, tmp_path / "cell.json")
    assert caught.value.exit_code == 3
    assert not (tmp_path / "cell.json").exists()


def test_touches_in_one_plane_freeze_what_they_hide(points: Path, tmp_path: Path) -> None:
    """Peg tops alone: a base, and a tip that is right on that plane."""
    folder = shutil.copytree(points, tmp_path / "flat")
    for path in folder.glob("*.csv"):
        kept = [line for line in lines(path) if "corner" not in line]
        path.write_text("\n".join(kept) + "\n")
    fitted(folder, tmp_path / "cell.json")
    assert read_calibration(tmp_path / "cell.json").arms[0].samples >= 6


def test_too_few_points_or_a_truth_in_a_real_arm_are_wrong_uses(tmp_path: Path) -> None:
    touch = ["calibrate", "collect", str(tmp_path), "--source", "touch"]
    assert RUN.invoke(app, [*touch, "--points", "7"]).exit_code == 2
    assert RUN.invoke(app, [*touch, "--driver", "crtk", "--truth", "1"]).exit_code == 2
    alone = RUN.invoke(app, [*touch, "--cell", "bodytrainer"])
    assert isinstance(alone.exception, CalibrationError)
    many = RUN.invoke(app, [*touch, "--points", "99"])
    assert isinstance(many.exception, CalibrationError)
    assert "ask for fewer points" in str(many.exception)
