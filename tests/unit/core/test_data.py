"""Finding data files: order of the roots, shadows, and named refusals."""

from pathlib import Path

import pytest

from viskill_deploy.core import data
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.runtime.preflight import find_bundle


def test_every_packaged_robot_file_is_found() -> None:
    assert data.find("robots/psm_classic.toml").is_file()
    assert len(data.names("robots/tools")) == 51


def test_a_missing_file_names_the_roots_that_were_searched() -> None:
    with pytest.raises(DataFileError, match="searched") as caught:
        data.find("robots/none.toml")
    assert caught.value.exit_code == 3


def test_a_users_file_goes_first_and_is_known_to_shadow_the_packaged_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packaged = data.find("robots/psm_classic.toml")
    assert data.shadows(packaged) is None
    mine = tmp_path / "robots" / "psm_classic.toml"
    mine.parent.mkdir()
    mine.write_bytes(packaged.read_bytes())
    monkeypatch.setenv("VISKILL_DATA", str(tmp_path))
    assert data.find("robots/psm_classic.toml") == mine
    assert data.shadows(mine) == packaged
    assert data.shadows(tmp_path / "elsewhere.toml") is None
    assert data.shadows(Path("relative.toml")) is None


def test_a_bundle_may_be_named_without_its_folder() -> None:
    assert find_bundle(Path("bipegtransfer-viskill")).is_dir()
