"""The preflight: a line for everything that is looked at, with its margin. Nothing moves."""

import datetime
import time
from pathlib import Path

import numpy as np
import pytest
from calibrations import calibration_of, write_fresh
from lab_files import SCENE

from viskill_deploy.core import data
from viskill_deploy.core.calibration_files import write_calibration
from viskill_deploy.core.errors import CalibrationError, DataFileError
from viskill_deploy.core.scene_files import read_scene
from viskill_deploy.core.types import ObjectPose, Scene
from viskill_deploy.runtime.checklist import Checklist, Line
from viskill_deploy.runtime.preflight import Prepared, Sources, look_at_files, prepare
from viskill_deploy.runtime.rehearsing import as_measured, possible_scenes, preflight
from viskill_deploy.safety.rule_base import find_rules

ROOT = Path(__file__).resolve().parents[3]
BUNDLE = ROOT / "policies/bipegtransfer-viskill"
DAY = 86400.0


def scene_file(folder: Path, old: str = "", new: str = "") -> Path:
    assert old in SCENE
    path = folder / "scene.toml"
    path.write_text(SCENE.replace(old, new, 1), encoding="utf-8")
    return path


def named(checklist: Checklist, name: str) -> Line:
    (line,) = [line for line in checklist.lines if line.name == name and line.name != "plan"]
    return line


@pytest.mark.no_cover
@pytest.mark.parametrize("task", ["bipegtransfer", "bipegboard", "matchboardpanel"])
def test_the_shipped_bundles_pass_with_a_margin_to_every_rule(task: str) -> None:
    checklist, prepared = preflight(Sources(ROOT / "policies" / f"{task}-viskill"))
    assert checklist.error is None
    assert {line.status for line in checklist.lines} == {"pass"}
    rules = [line for line in checklist.lines if line.name == "plan" and line.rule]
    assert {line.rule for line in rules} == {rule.id for rule in find_rules()}
    assert all(0.02 < line.margin <= 1.0 for line in rules)
    assert [line.margin for line in rules] == sorted(line.margin for line in rules)
    assert [line.name for line in checklist.lines if line.name != "plan"] == [
        "bundle", "robot", "calibration", "limits", "things", "scene", "workspace",
        "every setpoint of the plan",
    ]  # fmt: skip
    assert prepared is not None
    for path, digest in prepared.files:
        assert data.sha256(Path(path)) == digest
    names = {Path(path).name for path, _ in prepared.files}
    assert names >= {"manifest.json", "skill-grasp.onnx", f"{task}.toml", "psm_classic.toml"}


def test_a_scene_file_is_where_things_are_and_stands_among_the_files(tmp_path: Path) -> None:
    path = scene_file(tmp_path)
    checklist, prepared = preflight(Sources(BUNDLE, scene=path))
    assert checklist.error is None
    assert named(checklist, "scene file").text == (
        "1 object, block1 to be moved; positions known within 0.50 mm (one sigma)"
    )
    assert named(checklist, "things").text == "block1, as in scene.toml"
    assert prepared is not None
    assert (str(path), data.sha256(path)) in prepared.files


@pytest.mark.invariant("S29")
def test_a_scene_far_from_training_is_refused_by_name_and_everything_is_looked_at(
    tmp_path: Path,
) -> None:
    checklist, _ = preflight(Sources(BUNDLE, scene=scene_file(tmp_path, "-0.027", "-0.127")))
    assert checklist.error is not None
    assert checklist.error.exit_code == 3
    scene, workspace = named(checklist, "scene"), named(checklist, "workspace")
    assert (scene.status, workspace.status) == ("fail", "fail")
    assert scene.margin is not None
    assert scene.margin < 0.0
    assert "mm, seen in training from" in scene.text
    assert "block1 lies 70.0 mm outside" in workspace.text
    plan = next(line for line in checklist.lines if line.name == "plan")
    assert plan.status == "warn"
    assert "does not do the task" in plan.text
    every = named(checklist, "every setpoint of the plan")
    assert every.status == "fail"
    assert "S29" in every.text


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("block1", "block9", "scene file"),
        ('cell = "bipegtransfer"', 'cell = "bipegboard"', "scene file"),
        ("schema = 1", "schema = 3", "scene file"),
    ],
)
def test_a_wrong_scene_file_is_a_line_of_its_own(
    tmp_path: Path, old: str, new: str, line: str
) -> None:
    checklist, prepared = preflight(Sources(BUNDLE, scene=scene_file(tmp_path, old, new)))
    assert checklist.error is not None
    assert checklist.error.exit_code == 3
    assert named(checklist, line).status == "fail"
    assert "scene.toml" in named(checklist, line).text
    assert prepared is not None


def test_a_thing_that_the_cell_does_not_have_is_refused(tmp_path: Path) -> None:
    path = scene_file(tmp_path)
    path.write_text(path.read_text().replace("block1", "block9"))
    checklist, _ = preflight(Sources(BUNDLE, scene=path))
    assert checklist.error is not None
    assert checklist.error.exit_code == 3
    told = named(checklist, "scene file").text
    assert "scene.toml: object: no object 'block9' in bipegtransfer; it has block0, block1" in told


def looked(sources: Sources) -> tuple[Checklist, Prepared | None]:
    checklist = Checklist()
    return checklist, look_at_files(checklist, sources)


def test_a_fresh_calibration_is_used_and_stands_among_the_files(tmp_path: Path) -> None:
    cell = prepare(BUNDLE).cell
    path = write_fresh(tmp_path / "cell.json", cell, 3 * DAY)
    checklist, prepared = looked(Sources(BUNDLE, calibration=path, date_s=time.time()))
    line = named(checklist, "calibration")
    assert (line.status, line.rule) == ("pass", "S27")
    assert line.text == "3.0 days old, residual 0.60 mm, by points"
    assert line.margin == pytest.approx(0.6, abs=1e-3)
    assert prepared is not None
    assert (str(path), data.sha256(path)) in prepared.files
    assert prepared.task.cell is prepared.cell
    np.testing.assert_array_equal(prepared.cell.arms[0].T_task_base, cell.arms[0].T_task_base)


@pytest.mark.invariant("S27")
@pytest.mark.parametrize(
    ("age", "words"), [(31 * DAY, "31.0 days old"), (-31 * DAY, "dated 31.0 days ahead")]
)
def test_an_old_calibration_is_refused(tmp_path: Path, age: float, words: str) -> None:
    path = write_fresh(tmp_path / "cell.json", prepare(BUNDLE).cell, age)
    with pytest.raises(CalibrationError, match=words) as caught:
        prepare(Sources(BUNDLE, calibration=path, date_s=time.time()))
    assert caught.value.exit_code == 3
    assert "calibrate the cell again" in str(caught.value)


@pytest.mark.invariant("S27")
def test_without_a_date_no_calibration_is_young(tmp_path: Path) -> None:
    path = write_fresh(tmp_path / "cell.json", prepare(BUNDLE).cell)
    with pytest.raises(CalibrationError, match=r"cell\.json"):
        prepare(Sources(BUNDLE, calibration=path))


@pytest.mark.invariant("S27")
def test_a_coarse_calibration_is_refused_and_the_arm_named(tmp_path: Path) -> None:
    made = calibration_of(prepare(BUNDLE).cell, created=datetime.datetime.now(datetime.UTC))
    arms = (made.arms[0], made.arms[1].model_copy(update={"residual_rms_m": 0.0021}))
    path = write_calibration(tmp_path / "c.json", made.model_copy(update={"arms": arms}))
    with pytest.raises(CalibrationError, match=r"residual of PSM2 is 2\.10 mm"):
        prepare(Sources(BUNDLE, calibration=path, date_s=time.time()))


@pytest.mark.invariant("S27")
def test_real_arms_need_a_calibration_that_is_theirs(tmp_path: Path) -> None:
    text = (ROOT / "robots/cells/bipegtransfer.toml").read_text()
    serials = iter(["29662", "30100"])
    lines = [
        line + (f'\nserial = "{next(serials)}"' if line.startswith("tool = ") else "")
        for line in text.splitlines()
    ]
    real = tmp_path / "lab.toml"
    real.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(CalibrationError, match="name their calibration file with --calibration"):
        prepare(Sources(BUNDLE, str(real)))
    theirs = prepare(BUNDLE).cell
    foreign = write_fresh(tmp_path / "foreign.json", theirs)
    with pytest.raises(CalibrationError, match=r"simulated.*the cell holds PSM1 .*29662"):
        prepare(Sources(BUNDLE, str(real), foreign))
    checklist, prepared = looked(Sources(BUNDLE, str(real)))
    assert [line.status for line in checklist.lines] == ["pass", "pass", "fail", "pass"]
    assert prepared is not None
    own = write_fresh(tmp_path / "own.json", prepared.cell)
    assert (
        prepare(Sources(BUNDLE, str(real), own, date_s=time.time())).cell.arms[0].entry.serial
        == "29662"
    )


def test_a_cell_that_is_looser_than_the_gate_fails_its_line(tmp_path: Path) -> None:
    text = (ROOT / "robots/cells/bipegtransfer.toml").read_text()
    loose = tmp_path / "loose.toml"
    loose.write_text(text.replace("tip_speed_m_s = 0.05 ", "tip_speed_m_s = 0.06 "))
    checklist, _ = preflight(Sources(BUNDLE, str(loose)))
    assert isinstance(checklist.error, DataFileError)
    assert "tip_speed_m_s" in named(checklist, "limits").text
    assert checklist.lines[-1].name == "limits", "no plan is made under limits that are refused"


def test_another_robot_than_trained_with_fails_its_line() -> None:
    checklist, prepared = preflight(Sources(BUNDLE, "bipegboard"))
    assert prepared is None
    assert [line.status for line in checklist.lines] == ["pass", "fail"]
    assert "was trained for cell 'bipegtransfer'" in checklist.lines[-1].text


def test_a_file_in_front_of_a_packaged_one_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "robots/cells"
    folder.mkdir(parents=True)
    (folder / "bipegtransfer.toml").write_text(
        (ROOT / "robots/cells/bipegtransfer.toml").read_text()
    )
    monkeypatch.setenv("VISKILL_DATA", str(tmp_path))
    checklist, prepared = looked(Sources(BUNDLE))
    assert named(checklist, "robot").status == "warn"
    assert "stands in front of the packaged" in named(checklist, "robot").text
    assert prepared is not None
    assert prepared.notes


def turned(yaw: float) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    return T


def test_a_measured_pose_may_be_two_sigmas_off_on_each_axis_of_its_covariance() -> None:
    scene = Scene(0.0, (ObjectPose("a", np.eye(4)), ObjectPose("b", turned(0.3))), "b", np.zeros(3))
    C = np.diag([4e-6, 0.0, 1e-6, 0.0, 0.0, 0.01])
    possible = list(possible_scenes(scene, {"b": C}))
    assert possible[0] is scene
    assert len(possible) == 1 + 6
    poses = [s.pose("b") for s in possible[1:]]
    offsets = [T[:3, 3] for T in poses]
    np.testing.assert_allclose(np.max(offsets, axis=0), [0.004, 0.0, 0.002], atol=1e-12)
    np.testing.assert_allclose(np.min(offsets, axis=0), [-0.004, 0.0, -0.002], atol=1e-12)
    yaws = sorted(float(np.arctan2(T[1, 0], T[0, 0])) for T in poses)
    np.testing.assert_allclose(yaws, [0.1, 0.3, 0.3, 0.3, 0.3, 0.5], atol=1e-9)
    assert all(s.pose("a") is scene.objects[0].T_task_object for s in possible)
    correlated = np.zeros((6, 6))
    correlated[:2, :2] = [[1e-6, 1e-6], [1e-6, 1e-6]]
    far = [s.pose("b")[:2, 3] for s in possible_scenes(scene, {"b": correlated})]
    np.testing.assert_allclose(np.max(far, axis=0), [0.002, 0.002], atol=1e-9)


def test_what_was_measured_stands_before_what_is_seen(tmp_path: Path) -> None:
    measured = read_scene(scene_file(tmp_path), "bipegtransfer").scene
    seen = Scene(
        2.0, (ObjectPose("block0", np.eye(4)), ObjectPose("block1", np.eye(4))), "", np.zeros(3)
    )
    merged = as_measured(seen, measured)
    assert [thing.name for thing in merged.objects] == ["block0", "block1"]
    np.testing.assert_allclose(merged.pose("block1")[:3, 3], [0.013, -0.027, 0.00725])
    np.testing.assert_array_equal(merged.pose("block0"), np.eye(4))
    assert (merged.active, merged.stamp_s) == ("block1", 2.0)
    np.testing.assert_allclose(merged.goal, measured.goal)
