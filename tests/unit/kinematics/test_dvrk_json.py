"""The dVRK's own files, and paths instead of names."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from viskill_deploy import load_arm
from viskill_deploy.core import data
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.kinematics.dvrk_json import strip_comments

NAMED = load_arm("psm_classic", tool="large_needle_driver_400006")


def row(name: str, kind: str, numbers: tuple[float, ...]) -> dict[str, Any]:
    """One joint: alpha, A, D, offset, qmin, qmax, ftmax."""
    keys = ("alpha", "A", "D", "offset", "qmin", "qmax", "ftmax")
    values = dict(zip(keys, numbers, strict=True))
    return {"name": name, "type": kind, "mode": "active", "theta": 0.0, **values}


def arm_content() -> dict[str, Any]:
    """The arm file of a Classic PSM."""
    joints = [
        row("outer_yaw", "revolute", (1.5708, 0, 0, 1.5708, -1.588, 1.588, 3.316101)),
        row("outer_pitch", "revolute", (-1.5708, 0, 0, -1.5708, -0.925025, 0.925025, 3.316101)),
        row("outer_insertion", "prismatic", (1.5708, 0, 0, -0.4318, 0.0, 0.24, 9.877926)),
    ]
    return {"DH": {"convention": "modified", "joints": joints}}


def tool_content(offset_key: str = "tooltip_offset") -> dict[str, Any]:
    """The instrument file of a large needle driver."""
    joints = [
        row("roll", "revolute", (0, 0, 0.4162, 0, -4.53786, 4.53786, 0.33)),
        row("wrist_pitch", "revolute", (-1.5708, 0, 0, -1.5708, -1.39626, 1.39626, 0.25)),
        row("wrist_yaw", "revolute", (-1.5708, 0.0091, 0, -1.5708, -1.39626, 1.39626, 0.2)),
    ]
    coupling = [
        [-1.5632, 0, 0, 0],
        [0, 1.0186, 0, 0],
        [0, -0.8306, 0.6089, 0.6089],
        [0, 0, -1.2177, 1.2177],
    ]
    return {
        "DH": {"convention": "modified", "joints": joints},
        "jaw": {"qmin": -0.698132, "qmax": 1.39626, "ftmax": 0.16},
        offset_key: [[0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]],
        "coupling": {"ActuatorToJointPosition": coupling},
        "tool-engage-position": {"lower": [-4.5, -0.2, -0.2, 0.0], "upper": [4.5, 0.2, 0.2, 0.0]},
    }


def write(path: Path, content: dict[str, Any]) -> Path:
    """A file as the dVRK writes them: with comments."""
    text = "/* -*- Mode: Javascript -*- */\n// see the user guide\n" + json.dumps(content, indent=1)
    path.write_text(text.replace('"ftmax":', '// "N m", or N /*\n"ftmax":'), encoding="utf-8")
    return path


@pytest.mark.parametrize("key", ["tooltip_offset", "tooltip-offset"])
def test_the_dvrks_files_make_the_same_arm_as_ours(tmp_path: Path, key: str) -> None:
    arm_file = write(tmp_path / "PSM.json", arm_content())
    tool_file = write(tmp_path / "LND.json", tool_content(key))
    arm = load_arm(arm_file, tool=str(tool_file))
    q = np.random.default_rng(0).uniform(NAMED.lower, NAMED.upper, (50, 6))
    np.testing.assert_allclose(arm.forward_batch(q), NAMED.forward_batch(q), rtol=0, atol=1e-12)
    for which in range(5):
        assert arm.description.limit(which) == NAMED.description.limit(which)
    assert arm.description.joints == NAMED.description.joints
    np.testing.assert_array_equal(
        arm.description.actuator_to_joint, NAMED.description.actuator_to_joint
    )
    assert arm.description.jaw.lower_rad == -0.698132
    assert arm.description.jaw.grip_angle_rad == -0.698132
    assert arm.description.files == (arm_file, tool_file)
    assert (arm.description.robot, arm.description.tool) == ("psm", "lnd")


def test_a_json_tool_fits_a_named_arm_and_a_toml_path_is_taken(tmp_path: Path) -> None:
    tool_file = write(tmp_path / "LND.json", tool_content())
    assert load_arm("psm_classic", tool=tool_file).description.robot == "psm_classic"
    path = data.find("robots/psm_classic.toml")
    tool = data.find("robots/tools/large_needle_driver_400006.toml")
    np.testing.assert_array_equal(load_arm(path, tool=tool).lower, NAMED.lower)


def test_an_si_arm_is_known_by_its_insertion_and_gets_si_numbers(tmp_path: Path) -> None:
    content = arm_content()
    inertia = {"mass": 0.1, "cx": 0.0, "Ixx": 1e-4, "x1": 1.0, "z3": 1.0}
    content["DH"]["joints"][2].update(offset=-0.4826, **inertia)
    arm = load_arm(write(tmp_path / "PSM-Si.json", content), tool="large_needle_driver_420006")
    assert arm.description.joints[2].offset == -0.4826
    with pytest.raises(DataFileError, match="does not fit"):
        load_arm(tmp_path / "PSM-Si.json", tool="large_needle_driver_400006")


def test_a_limit_written_as_1_5708_stays_as_written(tmp_path: Path) -> None:
    content = tool_content()
    content["DH"]["joints"][2].update(qmin=-1.5708, qmax=1.5708)
    arm = load_arm("psm_classic", tool=write(tmp_path / "MBF.json", content))
    assert arm.upper[5] == 1.5708
    assert arm.description.joints[5].offset == -math.pi / 2


def test_comments_go_and_what_stands_in_strings_stays() -> None:
    text = '{"a": "http://x /* y */", /* b */ "c": 1 // "d": 2\n}'
    assert json.loads(strip_comments(text)) == {"a": "http://x /* y */", "c": 1}


Change = tuple[str, Any]


@pytest.mark.parametrize(
    ("change", "key", "reason"),
    [
        (lambda c: c["DH"]["joints"][1].update(qmin=2.0), "DH.joints.1.qmin", "below qmax"),
        (lambda c: c["DH"]["joints"][1].update(qmax=math.nan), "DH.joints.1.qmax", "finite"),
        (lambda c: c["DH"]["joints"][1].update(speed=1.0), "DH.joints.1.speed", "unknown key"),
        (lambda c: c["DH"]["joints"][1].pop("ftmax"), "DH.joints.1.ftmax", "missing"),
        (lambda c: c["DH"].update(convention="standard"), "DH.convention", "modified"),
        (lambda c: c["DH"]["joints"].pop(), "DH.joints", "three joints"),
        (lambda c: c["DH"]["joints"][2].update(offset=-0.2), "DH.joints.2.offset", "generation"),
        (lambda c: c["DH"]["joints"][1].update(type="prismatic"), "DH.joints.1.type", "revolute"),
        (lambda c: c.update(extra=1), "extra", "unknown key"),
    ],
)
def test_an_arm_file_is_refused_with_file_key_and_reason(
    tmp_path: Path, change: Any, key: str, reason: str
) -> None:
    content = arm_content()
    change(content)
    path = write(tmp_path / "PSM.json", content)
    with pytest.raises(DataFileError, match=reason) as refusal:
        load_arm(path)
    assert (refusal.value.path, refusal.value.key) == (path, key)


@pytest.mark.parametrize(
    ("change", "key", "reason"),
    [
        (lambda c: c["tooltip_offset"][2].__setitem__(3, 0.01), "tooltip_offset", "pure rotation"),
        (lambda c: c["DH"]["joints"].pop(), "DH.joints", "snake"),
        (lambda c: c.pop("jaw"), "jaw", "missing"),
        (lambda c: c["jaw"].update(qmin=2.0), "jaw", "below"),
        (lambda c: c["tooltip_offset"][0].__setitem__(1, 1), "", "proper rotation"),
    ],
)
def test_an_instrument_file_is_refused_with_file_key_and_reason(
    tmp_path: Path, change: Any, key: str, reason: str
) -> None:
    content = tool_content()
    change(content)
    path = write(tmp_path / "LND.json", content)
    with pytest.raises(DataFileError, match=reason) as refusal:
        load_arm("psm_classic", tool=path)
    assert (refusal.value.path, refusal.value.key) == (path, key)


@pytest.mark.parametrize(
    ("text", "reason"), [("{", "cannot be read"), ("[1]", "no JSON object"), (None, "not found")]
)
def test_what_is_no_json_file_is_refused(tmp_path: Path, text: str | None, reason: str) -> None:
    path = tmp_path / "PSM.json"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(DataFileError, match=reason) as refusal:
        load_arm(path)
    assert refusal.value.path == path
