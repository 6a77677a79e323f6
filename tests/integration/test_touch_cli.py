"""Touch from the command line: measured, fitted, and bad touches refused by name."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibrations import write_fresh
from lab_files import with_serials
from operators import Person
from typer.testing import CliRunner

from viskill_deploy.calibrate.measurements import ARM_KEY, load
from viskill_deploy.calibrate.study import Study, Trial
from viskill_deploy.calibrate.truths import draw_robot, hidden_robot
from viskill_deploy.cli import touching
from viskill_deploy.cli.main import app
from viskill_deploy.core.arm_errors import with_errors
from viskill_deploy.core.calibration_files import calibrated, read_calibration
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError, SafetyStop
from viskill_deploy.drivers.crtk.driver import CrtkDriver
from viskill_deploy.drivers.crtk.inproc import Inproc
from viskill_deploy.drivers.crtk.listening import listening
from viskill_deploy.drivers.crtk.simulated import SteppedCrtk
from viskill_deploy.sim.seeing import seen_from_board
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

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


def test_points_of_other_arms_are_not_fitted(points: Path, tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(with_serials("bipegtransfer"))
    fit = ["calibrate", "fit", str(points), "-o", str(tmp_path / "cell.json")]
    done = RUN.invoke(app, [*fit, "--robot", str(tmp_path / "lab.toml")])
    assert isinstance(done.exception, CalibrationError)
    assert "PSM1 psm_classic simulated" in str(done.exception)
    assert "PSM1 psm_classic 100000" in str(done.exception)
    assert "--robot" in str(done.exception)
    assert not (tmp_path / "cell.json").exists()


HEAD = 4
"""Lines before the first touch."""


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def swapped(folder: Path) -> None:
    one, other = folder / "PSM1.csv", folder / "PSM2.csv"
    one.rename(folder / "spare")
    other.rename(one)
    (folder / "spare").rename(other)
    for path in (one, other):  # as in a file that people wrote themselves
        path.write_text("\n".join(x for x in lines(path) if not x.startswith(ARM_KEY)) + "\n")


def few(folder: Path) -> None:
    path = folder / "PSM1.csv"
    path.write_text("\n".join(lines(path)[: HEAD + 5]) + "\n")


def one_pose(folder: Path) -> None:
    path = folder / "PSM1.csv"
    path.write_text("\n".join(lines(path)[:HEAD] + lines(path)[HEAD : HEAD + 1] * 9) + "\n")


def columns(folder: Path, change: dict[int, str]) -> None:
    path = folder / "PSM1.csv"
    rows = [line.split(",") for line in lines(path)]
    for row in rows[HEAD:]:
        for at, word in change.items():
            row[at] = word if word == "nan" else repr(float(row[at]) * float(word))
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")


def in_mm(folder: Path) -> None:
    columns(folder, {16: "1000", 17: "1000", 18: "1000"})


def in_degrees(folder: Path) -> None:
    columns(folder, dict.fromkeys((1, 2, 4, 5, 6), "57.3"))


def partly_in_mm(folder: Path) -> None:
    path = folder / "PSM1.csv"
    rows = [line.split(",") for line in lines(path)]
    for row in rows[HEAD + 5 :]:
        row[16:19] = [repr(1e3 * float(word)) for word in row[16:19]]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")


def not_a_number(folder: Path) -> None:
    columns(folder, {17: "nan"})


def another_frame(folder: Path) -> None:
    columns(folder, {16: "-1", 17: "-1"})


def wrong_order(folder: Path) -> None:
    """As if every point had been taken for the next one."""
    path = folder / "PSM1.csv"
    rows = [line.split(",") for line in lines(path)]
    joints = [row[:16] for row in rows[HEAD:]]
    moved = [
        [*joint, *row[16:]] for joint, row in zip(joints[1:] + joints[:1], rows[HEAD:], strict=True)
    ]
    path.write_text("\n".join(",".join(row) for row in rows[:HEAD] + moved) + "\n")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (swapped, "other arm|no rigid move"),
        (few, "at least 6"),
        (one_pose, "one line"),
        (in_mm, "look like mm"),
        (partly_in_mm, r"row 6 lies .* \(5 such rows\)"),
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


def test_a_person_at_arms_over_crtk_is_asked_for_every_point_and_nothing_is_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = load_cell("bipegtransfer")
    robot = SteppedCrtk(cell)
    robot.connect()
    robot.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    robot.enable()
    robot.home()
    lines = robot.exchange.lines
    spoken = {topic: len(line.mouths) for topic, line in lines.items()}
    person = Person(thinks=1)

    def listen(*where: object) -> CrtkDriver:
        return listening(cell, Inproc(robot.exchange), robot.clock)

    monkeypatch.setattr(touching, "listen", listen)
    monkeypatch.setattr(touching, "Terminal", lambda *how, **more: person)
    collect = ["calibrate", "collect", str(tmp_path), "--source", "touch", "--driver", "crtk"]
    done = RUN.invoke(app, [*collect, "--points", "8"])
    assert "name the robot's own cell" in str(done.exception)
    assert not person.asked
    lab = tmp_path / "lab.toml"
    lab.write_text(with_serials("bipegtransfer"))
    done = RUN.invoke(app, [*collect, "--robot", str(lab), "--points", "8", "--json"])
    assert done.exit_code == 0, done.output
    assert len(json.loads(done.stdout)["touched"]["PSM2"]) == 8
    assert "PSM1: touch corner" in person.asked[0]
    assert "8 to go" in person.asked[0]
    assert "one line" in person.asked[8], "the arms have not moved, and that is noticed"
    np.testing.assert_allclose(
        load(tmp_path / "PSM2.csv").joints[5], robot.world.measured(1).jp, atol=1e-4
    )
    assert {topic: len(line.mouths) for topic, line in lines.items()} == spoken
    robot.close()


def test_a_board_that_was_moved_is_registered_anew_and_the_arms_stay(tmp_path: Path) -> None:
    cell = load_cell("bipegtransfer")
    old = write_fresh(tmp_path / "old.json", cell)
    still = {"schema": 1, "cell": cell.name, "arms": {arm.name: {} for arm in cell.arms}}
    shift, turn = [0.006, -0.004, 0.001], [0.0, 0.0, 0.05]
    truth = tmp_path / "truth.json"
    truth.write_text(json.dumps(still | {"board_translation_m": shift, "board_rotation_rad": turn}))
    folder = tmp_path / "touched"
    collect = ["calibrate", "collect", str(folder), "--source", "touch", "--truth", str(truth)]
    assert RUN.invoke(app, [*collect, "--points", "8"]).exit_code == 0
    fit = ["calibrate", "fit", str(folder), "--calibration", str(old), "-o"]
    done = RUN.invoke(app, [*fit, str(tmp_path / "new.json"), "--json"])
    assert done.exit_code == 0, done.output
    board = json.loads(done.stdout)["board"]
    T = np.array(board["T_task"])
    np.testing.assert_allclose(T[:3, 3], shift, atol=3.0 * max(board["sigma"][:3]))
    assert board["held_out_median_m"] < 2e-3
    made = read_calibration(tmp_path / "new.json")
    assert made.created == read_calibration(old).created
    assert made.arms[0].sigma["base_translation_x_m"] > 0.0
    moved = calibrated(cell, made, tmp_path / "new.json").arms[1].T_task_base
    np.testing.assert_allclose(T @ moved, cell.arms[1].T_task_base, atol=1e-9)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-9)
    done = RUN.invoke(app, [*fit, str(tmp_path / "new.json")])
    assert "turned by 2." in done.stdout
    empty = ["calibrate", "fit", str(tmp_path / "none"), "--calibration", str(old), "-o", "x.json"]
    assert "holds no touches" in str(RUN.invoke(app, empty).exception)


def test_shafts_beside_the_points_register_the_ports(points: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(points, tmp_path / "with_shafts")
    cell, truth = load_cell("bipegtransfer"), draw_robot(load_cell("bipegtransfer"), 3)
    true = seen_from_board(
        with_errors(cell, truth.arms), hidden_robot("3", cell).world(cell, WorldOptions())
    )
    rng, port = np.random.default_rng(0), true.arms[0].T_task_base[:3, 3]
    u = np.column_stack([rng.uniform(-0.4, 0.4, (15, 2)), -np.ones(15)])
    rows = np.hstack([port + 0.06 * u + rng.normal(0.0, 2e-4, (15, 3)), u])
    text = "\n".join(",".join(map(repr, row)) for row in rows.tolist())
    (folder / "PSM1_shaft.csv").write_text(f"x_m,y_m,z_m,ux,uy,uz\n{text}\n")
    done = RUN.invoke(
        app, ["calibrate", "fit", str(folder), "-o", str(tmp_path / "c.json"), "--json"]
    )
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)["arms"]
    assert "port" not in facts["PSM2"]
    one, other = read_calibration(tmp_path / "c.json").arms
    assert other.port_in_base_m is None
    assert np.linalg.norm(one.port_in_base_m or (1.0,)) < 4e-3, "its base is as wrong as this"
    assert one.sigma["port_z_m"] == pytest.approx(facts["PSM1"]["port"]["sigma_m"][2], rel=1e-6)
    (folder / "PSM2_shaft.csv").write_text(f"x_m,y_m,z_m,ux,uy,uz\n{text}\n")
    wrong = RUN.invoke(app, ["calibrate", "port", str(folder)])
    assert "remote centre" in str(wrong.exception)


def test_touch_alone_can_be_studied(tmp_path: Path) -> None:
    study = ["calibrate", "study", "--truths", "1", "--only", "touch", "--json"]
    done = RUN.invoke(app, [*study, "--output", str(tmp_path / "trials.jsonl")])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert "tip_error_median_m" not in told
    found = told["touch"]
    assert (found["arms"], found["samples_median"]) == (2, 12)
    assert found["tip_error_median_m"] < 1e-3 < found["uncalibrated_tip_error_median_m"]
    assert 0.1 < found["tip_turn_median_deg"] < 5.0
    table = RUN.invoke(app, [*study[:-1], "--output", str(tmp_path / "trials.jsonl")])
    assert "touch" in table.stdout


def test_a_robot_that_cannot_be_calibrated_is_named_and_does_not_end_a_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Study.truth

    def truth(self: Study, number: int, record: Any) -> dict[str, list[Trial]]:
        if number == 0:
            raise SafetyStop("the gate stepped in (S17)")
        return real(self, number, record)

    monkeypatch.setattr(Study, "truth", truth)
    study = ["calibrate", "study", "--only", "touch", "--output", str(tmp_path / "trials.jsonl")]
    none = RUN.invoke(app, [*study, "--truths", "1"])
    assert "no robot was calibrated: truth 0: the gate stepped in" in str(none.exception)
    done = RUN.invoke(app, [*study, "--truths", "2", "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert (told["truths"], told["touch"]["arms"]) == (2, 2)
    assert told["failed"] == ["truth 0: the gate stepped in (S17)"]
    assert "truth 0" in RUN.invoke(app, [*study, "--truths", "2"]).stdout


def test_a_touch_has_no_point_but_the_jaws_end(tmp_path: Path) -> None:
    collect = ["calibrate", "collect", str(tmp_path / "points"), "--source", "touch"]
    done = RUN.invoke(app, [*collect, "--point", "0.01"])
    assert done.exit_code == 2
    assert "--point is the tracker's" in done.output


@pytest.mark.parametrize("source", ["touch", "tracker"])
def test_simulated_arms_do_not_stand_in_for_real_ones(source: str, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    text = load_cell("bipegtransfer").files[0].read_text()
    path.write_text(text.replace("\ntool = ", '\nserial = "29662"\ntool = ', 1))
    collect = ["calibrate", "collect", str(tmp_path / "points"), "--cell", str(path)]
    done = RUN.invoke(app, [*collect, "--source", source])
    assert isinstance(done.exception, CalibrationError)
    assert "PSM1 has a serial number" in str(done.exception)
    assert not (tmp_path / "points").exists()
