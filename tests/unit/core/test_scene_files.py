"""A scene file says where things are and how well, or is refused with its key."""

from pathlib import Path

import numpy as np
import pytest

from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.scene_files import SeenScene, read_scene

WHOLE = """
schema = 1
cell = "bipegtransfer"
active = "block1"
goal_m = [0.01, 0.043, 0.00725]

[[object]]
name = "block0"
position_m = [-0.0215, -0.00708, 0.00725]
sigma_position_m = [0.0005, 0.0005, 0.0002]
sigma_rotation_rad = [0.01, 0.01, 0.03]

[[object]]
name = "block1"
position_m = [-0.033, -0.027, 0.00725]
rotation_rpy_rad = [0.0, 0.0, 1.5707963267948966]
covariance = [
  [4e-8, 1e-8, 0, 0, 0, 0],
  [1e-8, 4e-8, 0, 0, 0, 0],
  [0, 0, 1e-8, 0, 0, 0],
  [0, 0, 0, 1e-4, 0, 0],
  [0, 0, 0, 0, 1e-4, 0],
  [0, 0, 0, 0, 0, 9e-4],
]
"""


def read(tmp_path: Path, text: str, cell: str = "bipegtransfer") -> SeenScene:
    path = tmp_path / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return read_scene(path, cell)


def test_a_scene_is_read_with_poses_goal_and_covariances(tmp_path: Path) -> None:
    seen = read(tmp_path, WHOLE)
    assert (seen.scene.active, [o.name for o in seen.scene.objects]) == (
        "block1",
        ["block0", "block1"],
    )
    np.testing.assert_allclose(seen.scene.goal, [0.01, 0.043, 0.00725])
    turned = [[0, -1, 0, -0.033], [1, 0, 0, -0.027], [0, 0, 1, 0.00725], [0, 0, 0, 1]]
    np.testing.assert_allclose(seen.scene.pose("block1"), turned, atol=1e-12)
    np.testing.assert_allclose(
        np.diag(seen.covariance["block0"]), [25e-8, 25e-8, 4e-8, 1e-4, 1e-4, 9e-4]
    )
    assert seen.covariance["block1"][0, 1] == 1e-8
    assert seen.path == tmp_path / "scene.toml"


def drop(line: str) -> tuple[str, str]:
    return (line, "")


BAD = {
    "schema": (("schema = 1", "schema = 2"), "schema"),
    "cell": (('cell = "bipegtransfer"', 'cell = "elsewhere"'), "cell: is 'elsewhere'"),
    "active": (('active = "block1"', 'active = "block7"'), "active is 'block7'"),
    "no goal": (drop("goal_m = [0.01, 0.043, 0.00725]"), "goal_m: missing"),
    "goal in mm": (("[0.01, 0.043, 0.00725]", "[10, 43, 7.25]"), "goal_m: .*in m"),
    "object in mm": (("[-0.033, -0.027, 0.00725]", "[-33, -27, 7.25]"), "position_m: .*in m"),
    "unknown key": (("rotation_rpy_rad", "rotation_rpy"), "unknown key"),
    "two of a name": (('name = "block0"', 'name = "block1"'), "share a name"),
    "nan": (("position_m = [-0.033", "position_m = [nan"), "position_m"),
    "no sigma": (drop("sigma_rotation_rad = [0.01, 0.01, 0.03]"), "object.0: give covariance"),
    "both": (
        ("covariance = [", "sigma_position_m = [0, 0, 0]\ncovariance = ["),
        "object.1: give covariance",
    ),
    "negative sigma": (("[0.0005, 0.0005, 0.0002]", "[-0.0005, 0, 0]"), "sigma_position_m"),
    "not symmetric": (("[4e-8, 1e-8, 0", "[4e-8, 2e-8, 0"), "not symmetric"),
    "negative": (("[0, 0, 1e-8,", "[0, 0, -1e-8,"), "negative eigenvalue"),
    "short": (("[0, 0, 1e-8, 0, 0, 0],", ""), "covariance"),
    "no toml": (("schema = 1", "schema ="), "cannot be read as TOML"),
}


@pytest.mark.parametrize(("change", "named"), BAD.values(), ids=BAD.keys())
def test_one_that_makes_no_sense_is_refused_and_the_key_named(
    tmp_path: Path, change: tuple[str, str], named: str
) -> None:
    assert change[0] in WHOLE
    with pytest.raises(DataFileError, match=named) as caught:
        read(tmp_path, WHOLE.replace(change[0], change[1], 1))
    assert caught.value.exit_code == 3
    assert "scene.toml" in str(caught.value)


def test_no_object_and_no_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataFileError, match="object"):
        read(tmp_path, WHOLE.split("[[object]]", maxsplit=1)[0] + "object = []\n")
    with pytest.raises(DataFileError, match="cannot be read"):
        read_scene(tmp_path / "none.toml", "bipegtransfer")


def test_a_thing_whose_place_is_known_exactly_is_fine(tmp_path: Path) -> None:
    text = WHOLE.replace("[0.0005, 0.0005, 0.0002]", "[0, 0, 0]").replace(
        "[0.01, 0.01, 0.03]", "[0, 0, 0]"
    )
    assert not read(tmp_path, text).covariance["block0"].any()
