"""Our own robot and tool files: every one is sound, and every fault is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from viskill_deploy import load_arm
from viskill_deploy.core import data
from viskill_deploy.core.errors import DataFileError

ROBOT = data.find("robots/psm_classic.toml").read_text(encoding="utf-8")
TOOL = data.find("robots/tools/large_needle_driver_400006.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new", "key", "reason"),
    [
        ("lower_rad = -1.588", "lower_rad = 1.6", "joint.0.revolute", "below upper_rad"),
        ("upper_rad = 1.588", "upper_rad = nan", "joint.0.revolute.upper_rad", "finite"),
        ("upper_rad = 1.588", "upper = 1.588", "joint.0.revolute.upper_rad", "unit in the key"),
        ("a_m = 0.0\n", "a_m = 0.0\nA_m = 0.0\n", "joint.0.revolute.A_m", "unknown key"),
        ("max_velocity_rad_s = 1.57", "max_velocity_rad_s = -1", "max_velocity_rad_s", "greater"),
        ("schema = 1", "schema = 2", "schema", "1"),
        ("schema = 1", "schema = ", "", "TOML"),
    ],
)
def test_a_wrong_robot_file_is_refused_with_file_key_and_reason(
    tmp_path: Path, old: str, new: str, key: str, reason: str
) -> None:
    assert old in ROBOT
    path = tmp_path / "psm.toml"
    path.write_text(ROBOT.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(DataFileError, match=reason) as refusal:
        load_arm(path)
    assert refusal.value.path == path
    assert refusal.value.key.endswith(key)


@pytest.mark.parametrize(
    ("old", "new", "key", "reason"),
    [
        ("grip_angle_rad = ", "grip_angle_rad = -9 #", "jaw", "jaw's limits"),
        ("tip_rotation = [[0.0,", "tip_rotation = [[1.0,", "", "proper rotation"),
        ("[-1.5632, 0.0, 0.0, 0.0],", "[0.0, 0.0, 0.0, 0.0],", "", "inverse"),
        ('generation = "Classic"', 'generation = "Xi"', "generation", "Classic"),
    ],
)
def test_a_wrong_tool_file_is_refused_with_file_key_and_reason(
    tmp_path: Path, old: str, new: str, key: str, reason: str
) -> None:
    assert old in TOOL
    path = tmp_path / "tool.toml"
    path.write_text(TOOL.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(DataFileError, match=reason) as refusal:
        load_arm("psm_classic", tool=path)
    assert refusal.value.path == path
    assert refusal.value.key.endswith(key)


def test_a_name_that_is_nowhere_is_refused_with_the_folders_searched() -> None:
    with pytest.raises(DataFileError, match="searched"):
        load_arm("psm_xi")
