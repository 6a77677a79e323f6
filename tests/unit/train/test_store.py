from pathlib import Path

import numpy as np
import pytest

from viskill_deploy.core.errors import TrainingError
from viskill_deploy.train import store


def test_a_tree_comes_back_as_it_was(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    tree = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3),
        "deep": {"list": [np.ones(2), {"x": 1, "y": None}], "text": "ok", "n": float("nan")},
        "rng": rng.bit_generator.state,
    }
    store.save(tmp_path / "new" / "t.npz", tree)
    back = store.load(tmp_path / "new" / "t.npz")
    assert back["a"].dtype == np.float32
    assert (back["a"] == tree["a"]).all()
    assert (back["deep"]["list"][0] == 1).all()
    assert back["deep"]["list"][1] == {"x": 1, "y": None}
    other = np.random.default_rng(0)
    other.bit_generator.state = back["rng"]
    assert other.random() == rng.random()


def test_writing_leaves_the_old_file_whole_until_the_new_one_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "t.npz"
    store.save(path, {"n": 1})

    def fails(*_: object, **__: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", fails)
    with pytest.raises(OSError, match="disk full"):
        store.save(path, {"n": 2})
    assert store.load(path) == {"n": 1}


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 cut"])
def test_a_damaged_file_is_refused_with_what_to_do(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "t.npz"
    path.write_bytes(content)
    with pytest.raises(TrainingError, match="delete it and train again"):
        store.load(path)


def test_a_pickle_inside_is_not_executed(tmp_path: Path) -> None:
    path = tmp_path / "t.npz"
    np.savez(path, __tree__=np.array({"a": 1}, dtype=object))
    with pytest.raises(TrainingError):
        store.load(path)
