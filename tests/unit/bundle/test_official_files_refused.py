"""Hostile, broken and mixed-up checkpoints are refused with a sentence before anything runs."""

import pickle
import re
import struct
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import official_files as files
import pytest

from viskill_deploy.bundle.official import pickle_data
from viskill_deploy.bundle.official.checkpoint import read_official
from viskill_deploy.bundle.official.layout import find_checkpoints
from viskill_deploy.bundle.official.pickle_data import PickleRefusedError, read_pickle
from viskill_deploy.bundle.official.torch_file import NAMES, read_torch_file
from viskill_deploy.cli.bring import official
from viskill_deploy.core.errors import BundleError, MissingExtraError
from viskill_deploy.sim.tasks.base import load_task

TASK = load_task("bipegtransfer")
SKILL = {"actor.trunk.mlp": (43, 10), "critic.q.mlp": (53, 1)}
NORMS = {"o_norm": (np.zeros(35), np.ones(35)), "g_norm": (np.zeros(8), np.ones(8))}


def chained(skills: tuple[str, ...] = files.SKILLS) -> dict[str, tuple[int, int]]:
    sizes = {f"sl_agent.{s}.actor.trunk.mlp": (43, 10) for s in skills}
    for skill in skills[:-1]:
        sizes[f"sc_agent.actor.actors.{skill}.trunk.mlp"] = (35, 12)
        sizes |= {f"sc_agent.critic.qs.{skill}.{q}.mlp": (41, 1) for q in ("q1", "q2")}
    return sizes


@pytest.fixture
def same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every skill gets the same weights, in its own checkpoint and in the chaining one."""
    original = files.random_weights

    def made(key: str, shape: tuple[int, ...]) -> np.ndarray:
        return original(re.sub(r"^sl_agent\.\w+\.", "", key), shape)

    monkeypatch.setattr(files, "random_weights", made)


def small(folder: Path, **changes: Any) -> Path:
    """A whole small set by torch and this numpy; keywords replace entries of the skills."""
    for skill in files.SKILLS:
        files.save_small(files.skill_path(folder, skill), SKILL, NORMS | changes)
    files.save_small(files.chaining_path(folder), chained(), {})
    return folder


def read(folder: Path) -> Any:
    found = find_checkpoints(folder)
    return read_official(found, load_task(found.task))


def with_pickle(path: Path, content: bytes) -> Path:
    return files.write_zip(path, {"data.pkl": content})


@pytest.mark.usefixtures("same")
def test_small_checkpoints_of_this_numpy_and_torch_are_read(tmp_path: Path) -> None:
    policy = read(small(tmp_path))
    assert set(policy.skills) == set(files.SKILLS)
    assert set(policy.chaining) == {"grasp", "handover"}
    wished = files.random_weights("actor.trunk.mlp.0.weight", (6, 43))
    assert np.array_equal(policy.skills["grasp"].actor[0][0], wished)
    assert policy.skills["grasp"].observation.clip == 5.0
    names = files.entries_of(files.skill_path(tmp_path, "grasp"))["data.pkl"]
    assert b"numpy._core.multiarray" in names, "numpy 2; the golden pickles are of numpy 1"


@pytest.mark.usefixtures("same")
def test_tensors_that_were_trained_on_a_gpu_are_read_without_one(tmp_path: Path) -> None:
    small(tmp_path)
    for path in tmp_path.rglob("*.pth"):
        entries = files.entries_of(path)
        text, tag = b"X\x03\x00\x00\x00cpu", b"X\x06\x00\x00\x00cuda:0"
        assert text in entries["data.pkl"]
        entries["data.pkl"] = entries["data.pkl"].replace(text, tag)
        files.write_zip(path, entries)
    assert set(read(tmp_path).skills) == set(files.SKILLS)


@pytest.mark.usefixtures("same")
def test_the_latest_episode_is_the_largest_number(tmp_path: Path) -> None:
    small(tmp_path)
    model = files.skill_path(tmp_path, "grasp").parent
    for name in ("weights_ep9.pth", "weights_ep100.pth", "weights_best.pth"):
        (model / name).write_bytes(b"")
    assert find_checkpoints(tmp_path).skills["grasp"].name == "weights_ep100.pth"


class Runs:
    """Pickles into a call of any function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self._call = (function, arguments)

    def __reduce__(self) -> Any:
        return self._call


def names_of(module: str, name: str, argument: bytes) -> bytes:
    """A protocol 2 pickle that calls `module.name(argument)`, written by hand."""
    text = b"X" + struct.pack("<I", len(argument)) + argument
    return b"\x80\x02c" + f"{module}\n{name}\n".encode() + text + b"\x85R."


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "system"),
        ("posix", "system"),
        ("builtins", "eval"),
        ("__builtin__", "eval"),
        ("builtins", "getattr"),
        ("numpy", "load"),
        ("torch", "load"),
        ("viskill.components.normalizer", "Other"),
        ("collections", "OrderedDict.fromkeys"),
    ],
)
def test_a_name_that_no_checkpoint_needs_is_refused_and_not_run(
    tmp_path: Path, module: str, name: str
) -> None:
    canary = tmp_path / "canary"
    argument = f"open({str(canary)!r}, 'w')" if name == "eval" else f"touch {canary}"
    path = with_pickle(tmp_path / "bad.pth", names_of(module, name, argument.encode()))
    with pytest.raises(BundleError, match=re.escape(f"{module}.{name}")) as caught:
        read_torch_file(path)
    assert "nothing of it was run" in str(caught.value)
    assert caught.value.exit_code == 3
    assert not canary.exists()


@pytest.mark.parametrize("protocol", [0, 1, 3, 4, 5])
def test_other_protocols_with_a_call_in_them_are_refused(tmp_path: Path, protocol: int) -> None:
    canary = tmp_path / "canary"
    content = pickle.dumps(Runs(exec, f"open({str(canary)!r}, 'w')"), protocol)
    with pytest.raises(BundleError):
        read_torch_file(with_pickle(tmp_path / "bad.pth", content))
    assert not canary.exists()


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x02}X\x01\x00\x00\x00aK\x01s}R.",  # a table is called
        b"\x80\x02K\x01)R.",  # a number is called
        b"\x80\x02cnumpy\nndarray\n(K\x01tR.",  # an array made directly
        b"\x80\x02ctorch\nFloatStorage\n)R.",  # a storage without an archive
        b"\x80\x02K\x01}b.",  # a state for a number
        b"\x80\x02K\x01K\x02K\x03s.",  # an entry into a number
        b"\x80\x02}K\x01K\x02s.",  # an entry without a name
        b"\x80\x02K\x01K\x02a.",  # appended to a number
        b"\x80\x02(K\x01.",  # an open group
        b"\x80\x02h\x07.",  # nothing was put aside
        b"\x80\x02(\x85.",  # a tuple of a mark
        b"\x80\x02t.",  # no group
        b"\x80\x02.",  # nothing left
        b"\x80\x02K\x01",  # no end
        b"\x80\x02\x8e\xff\xff\xff\xff\x02\x00\x00\x00.",  # bytes of 12 GB
        b"\x80\x02X\xff\xff\xff\x7fa.",  # a text of 2 GB
        b"\x80\x02\x8a\xff\x01.",  # a number that is cut off
        b"\x80\x02K\x01r\xff\xff\xff\xff(.",  # an open group after a far-away memo
        b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00aX\x03\x00\x00\x00rot\x86R.",  # another code
        b"\x80\x02cnumpy\ndtype\nX\x01\x00\x00\x00O\x85R.",  # an array of objects
        b"\x80\x02cnumpy\ndtype\nX\x02\x00\x00\x00f4\x85RK\x03X\x01\x00\x00\x00>\x86b.",  # order
        b"\x80\x02cviskill.components.normalizer\nNormalizer\n)\x81K\x01b.",  # no attributes
        b"\x80\x02cnumpy.core.multiarray\nscalar\nK\x01K\x02\x86R.",  # a number of no type
        b"\xff\x00garbage",
        b"",
    ],
)
def test_a_broken_pickle_gives_one_sentence(content: bytes) -> None:
    with pytest.raises(PickleRefusedError, match="pickle"):
        read_pickle(content, NAMES, lambda pid: None)


def test_what_a_pickle_may_hold_is_read() -> None:
    value = {"a": [1, 2.5, "text", None, True], "b": (1, (2, 3), ()), "c": 2**70, "d": [3]}
    assert read_pickle(pickle.dumps(value, 2), NAMES, lambda pid: None) == value


def test_an_endless_pickle_is_cut_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickle_data, "MAX_INSTRUCTIONS", 100)
    with pytest.raises(PickleRefusedError, match="longer"):
        read_pickle(b"\x80\x02" + b"K\x01" * 101 + b".", NAMES, lambda pid: None)
    monkeypatch.setattr(pickle_data, "MAX_BYTES", 10)
    with pytest.raises(PickleRefusedError, match="bytes"):
        read_pickle(b"\x80\x02" + b"K\x01" * 10 + b".", NAMES, lambda pid: None)


def tensor(size: tuple[int, ...], stride: tuple[int, ...], offset: int = 0) -> Any:
    return NAMES["torch._utils._rebuild_tensor_v2"](
        np.arange(6, dtype=np.float32), offset, size, stride, False, {}
    )


def test_a_tensor_is_the_view_of_its_storage_that_it_says() -> None:
    assert np.array_equal(tensor((2, 3), (3, 1)), [[0, 1, 2], [3, 4, 5]])
    assert np.array_equal(tensor((3, 2), (1, 3)), [[0, 3], [1, 4], [2, 5]])
    assert np.array_equal(tensor((2,), (2,), 1), [1, 3])
    assert tensor((), (), 5) == 5.0


@pytest.mark.parametrize(
    ("size", "stride", "offset"),
    [
        ((7,), (1,), 0),
        ((6,), (1,), 1),
        ((2**30,), (0,), 0),
        ((2, 3), (1,), 0),
        ((-1,), (1,), 0),
        ((0,), (1,), 0),
        ((2,), (-1,), 3),
        ((2.0,), (1,), 0),
        ((2**40,), (1,), 0),
    ],
)
def test_a_tensor_that_reaches_outside_its_storage_is_refused(
    size: tuple[int, ...], stride: tuple[int, ...], offset: int
) -> None:
    with pytest.raises(ValueError, match="tensor"):
        tensor(size, stride, offset)


def zipped(path: Path, *infos: tuple[str, bytes, int]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content, kind in infos:
            archive.writestr(name, content, kind)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "../../etc/passwd",
        "a/../data.pkl",
        "/a/data.pkl",
        "a\\..\\b",
        "C:/a/b",
        "data.pkl",
        "b/data/0",
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_archive_that_reaches_outside_its_folder_is_refused(tmp_path: Path, name: str) -> None:
    good = ("a/data.pkl", b"\x80\x02}.", zipfile.ZIP_STORED)
    path = zipped(tmp_path / "bad.pth", good, (name, b"x", zipfile.ZIP_STORED))
    with pytest.raises(BundleError, match="outside its folder"):
        read_torch_file(path)


def test_a_zip_bomb_and_a_claim_of_ten_gigabytes_are_refused(tmp_path: Path) -> None:
    bomb = zipped(tmp_path / "bomb.pth", ("a/data.pkl", bytes(10**7), zipfile.ZIP_DEFLATED))
    with pytest.raises(BundleError, match="more than the file holds"):
        read_torch_file(bomb)
    claim = zipped(tmp_path / "claim.pth", ("a/data.pkl", b"\x80\x02}.", zipfile.ZIP_STORED))
    content = bytearray(claim.read_bytes())
    at = content.index(b"PK\x01\x02")
    extra = struct.pack("<HHQQ", 1, 16, 10 * 2**30, 10 * 2**30)  # zip64: both sizes, 10 GiB
    content[at + 20 : at + 28] = b"\xff" * 8
    content[at + 30 : at + 32] = struct.pack("<H", len(extra))
    end = content.index(b"PK\x05\x06")
    content[end + 12 : end + 16] = struct.pack("<I", end - at + len(extra))
    content[end:end] = extra
    claim.write_bytes(bytes(content))
    with zipfile.ZipFile(claim) as archive:
        assert archive.infolist()[0].file_size == 10 * 2**30, "the claim is a claim"
    with pytest.raises(BundleError, match="10737418240 bytes"):
        read_torch_file(claim)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_other_wrong_archives_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, stored = b"\x80\x02}.", zipfile.ZIP_STORED
    cases = {
        "two entries": [("a/data.pkl", good, stored)] * 2,
        "no data.pkl": [("a/other", good, stored)],
        "not little-endian": [("a/data.pkl", good, stored), ("a/byteorder", b"big", stored)],
        "no table": [("a/data.pkl", b"\x80\x02K\x01.", stored)],
    }
    for match, infos in cases.items():
        with pytest.raises(BundleError, match=match):
            read_torch_file(zipped(tmp_path / "bad.pth", *infos))
    fine = zipped(tmp_path / "fine.pth", ("a/data.pkl", good, stored))
    assert read_torch_file(fine) == {}
    monkeypatch.setattr("viskill_deploy.bundle.official.torch_file.MAX_ENTRIES", 0)
    with pytest.raises(BundleError, match="entries"):
        read_torch_file(fine)
    monkeypatch.setattr("viskill_deploy.bundle.official.torch_file.MAX_FILE_BYTES", 10)
    with pytest.raises(BundleError, match="larger"):
        read_torch_file(fine)
    with pytest.raises(BundleError, match="No such file"):
        read_torch_file(tmp_path / "nothing.pth")


def test_a_file_of_the_old_format_is_refused(tmp_path: Path) -> None:
    import torch  # noqa: PLC0415 - slow to import

    path = tmp_path / "old.pth"
    torch.save({"state_dict": {}}, path, _use_new_zipfile_serialization=False)
    with pytest.raises(BundleError, match="zip format"):
        read_torch_file(path)


@pytest.mark.usefixtures("same")
def test_a_checkpoint_cut_short_or_with_a_flipped_byte_gives_one_sentence(tmp_path: Path) -> None:
    path = files.save_small(tmp_path / "a.pth", SKILL, NORMS)
    content, rng = path.read_bytes(), np.random.default_rng(0)
    for share in (0.0, 0.1, 0.5, 0.9, 0.999):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(BundleError, match="get the checkpoint again"):
            read_torch_file(path)
    for at in rng.integers(0, len(content), 200).tolist():
        changed = bytearray(content)
        changed[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(changed))
        try:
            assert isinstance(read_torch_file(path), dict)  # a byte that nothing depends on
        except BundleError as error:
            assert error.path == path


@pytest.mark.filterwarnings("ignore:invalid escape")
def test_every_byte_of_a_real_pickle_may_be_changed_without_harm() -> None:
    content = (files.GOLDEN / "grasp.pkl").read_bytes()
    rng = np.random.default_rng(1)
    for at in rng.integers(0, len(content), 200).tolist():
        changed = bytearray(content)
        changed[at] = int(rng.integers(256))
        try:
            read_pickle(bytes(changed), NAMES, lambda pid: np.zeros(pid[4] % 2**20, np.float32))
        except PickleRefusedError as error:
            assert "pickle" in str(error)


def rewritten(path: Path, sizes: dict[str, tuple[int, int]], extra: dict[str, Any]) -> Path:
    path.unlink()
    return files.save_small(path, sizes, extra)


@pytest.mark.usefixtures("same")
def test_checkpoints_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    def refused(match: str) -> None:
        with pytest.raises(BundleError, match=match) as caught:
            read(folder)
        assert caught.value.exit_code == 3

    for match, change in {
        "lacks a checkpoint for handover": lambda f: files.skill_path(f, "handover").unlink(),
        "normalizers of their inputs": lambda f: [
            files.skill_path(f, s).unlink() for s in files.SKILLS
        ],
        "holds no .*weights_ep": lambda f: [p.unlink() for p in f.rglob("*.pth")],
        "lacks state_dict, o_norm": lambda f: files.save_small(
            files.skill_path(f, "grasp"), SKILL, {}
        ),
        "another task or another kind": lambda f: files.save_small(
            files.skill_path(f, "grasp"), SKILL | {"actor.trunk.mlp": (38, 5)}, NORMS
        ),
        "takes 12 numbers": lambda f: files.save_small(
            files.skill_path(f, "grasp"), SKILL | {"actor.trunk.mlp": (12, 10)}, NORMS
        ),
        "o_norm is no normalizer of 35": lambda f: files.save_small(
            files.skill_path(f, "grasp"), SKILL, NORMS | {"o_norm": (np.zeros(31), np.ones(31))}
        ),
        "scale nothing": lambda f: files.save_small(
            files.skill_path(f, "grasp"), SKILL, NORMS | {"g_norm": (np.zeros(8), np.zeros(8))}
        ),
        "trained over another 'grasp'": lambda f: spoil(files.skill_path(f, "grasp"), 1.0),
        "no linear layer": lambda f: spoil(files.skill_path(f, "grasp"), float("nan")),
        "knows no skill 'grasp'": lambda f: files.save_small(files.chaining_path(f), SKILL, NORMS),
        "holds no state_dict": lambda f: with_pickle(files.chaining_path(f), b"\x80\x02}."),
        "no sc_agent.actor.actors.grasp": lambda f: files.save_small(
            files.chaining_path(f),
            {k: v for k, v in chained().items() if "actor.actors.grasp" not in k},
            {},
        ),
    }.items():
        folder = small(tmp_path / re.sub(r"\W", "", match))
        change(folder)
        refused(match)


def spoil(path: Path, number: float) -> None:
    """Puts a number into the first weight of a checkpoint."""
    entries = files.entries_of(path)
    entries["data/0"] = struct.pack("<f", number) + entries["data/0"][4:]
    files.write_zip(path, entries)


@pytest.mark.usefixtures("same")
def test_layers_that_do_not_fit_or_are_of_another_kind_are_refused(tmp_path: Path) -> None:
    folder = small(tmp_path)
    path = files.skill_path(folder, "grasp")
    entries = files.entries_of(path)
    entries["data.pkl"] = entries["data.pkl"].replace(b"actor.trunk.mlp.2.", b"actor.trunk.mlp.3.")
    files.write_zip(path, entries)
    with pytest.raises(BundleError, match="as the official code builds it"):
        read(folder)
    entries["data.pkl"] = entries["data.pkl"].replace(b"actor.trunk.mlp.3.", b"actor.trunk.mlp.8.")
    entries["data.pkl"] = entries["data.pkl"].replace(b"actor.trunk.mlp.0.", b"actor.trunk.mlp.2.")
    entries["data.pkl"] = entries["data.pkl"].replace(b"actor.trunk.mlp.8.", b"actor.trunk.mlp.0.")
    files.write_zip(path, entries)
    with pytest.raises(BundleError, match="do not fit each other"):
        read(folder)


@pytest.mark.usefixtures("same")
def test_a_missing_or_short_tensor_is_named(tmp_path: Path) -> None:
    path = files.save_small(tmp_path / "a.pth", SKILL, NORMS)
    entries = files.entries_of(path)
    files.write_zip(path, {k: v for k, v in entries.items() if k != "data/3"})
    with pytest.raises(BundleError, match="tensor 3 are missing"):
        read_torch_file(path)
    files.write_zip(path, entries | {"data/3": entries["data/3"][:-4]})
    with pytest.raises(BundleError, match="tensor 3 are missing or cut off"):
        read_torch_file(path)
    entries["data.pkl"] = entries["data.pkl"].replace(b"storage", b"stowage")
    files.write_zip(path, entries)
    with pytest.raises(BundleError, match="32-bit floats"):
        read_torch_file(path)


@pytest.mark.usefixtures("same")
def test_several_tasks_or_seeds_have_to_be_chosen_from(tmp_path: Path) -> None:
    small(tmp_path)
    for seed in (2, 3):
        for skill in files.SKILLS:
            files.save_small(files.skill_path(tmp_path, skill, seed=seed), SKILL, NORMS)
        files.save_small(files.chaining_path(tmp_path, seed=seed), chained(), {})
    with pytest.raises(BundleError, match="--skill-seed"):
        find_checkpoints(tmp_path)
    with pytest.raises(BundleError, match="--chaining-seed"):
        find_checkpoints(tmp_path, skill_seed=2)
    with pytest.raises(BundleError, match=r"s3.*--skill-seed"):
        find_checkpoints(tmp_path, skill_seed=9)
    found = find_checkpoints(tmp_path, skill_seed=2, chaining_seed=3)
    assert found.skills["grasp"].parents[2].name == "s2"
    assert found.chaining is not None
    assert found.chaining.parents[1].name == "s3"
    alone = find_checkpoints(files.skill_path(tmp_path, "grasp", seed=2).parents[2])
    assert alone.chaining is None
    files.save_small(files.skill_path(tmp_path, "push", "MatchBoard"), SKILL, NORMS)
    with pytest.raises(BundleError, match="--task"):
        find_checkpoints(tmp_path)
    assert find_checkpoints(tmp_path, "MatchBoard").task == "matchboardpanel"
    assert find_checkpoints(tmp_path, "bipegtransfer", 1, 1).task == "bipegtransfer"
    with pytest.raises(BundleError, match="no bipegboard"):
        find_checkpoints(tmp_path, "BiPegBoard")


def test_a_folder_that_is_none_or_of_no_known_task_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="is no folder"):
        find_checkpoints(tmp_path / "nothing")
    other = files.skill_path(tmp_path, "reach", "NeedleReach")
    other.parent.mkdir(parents=True)
    other.touch()
    with pytest.raises(BundleError, match="BiPegTransfer-v0"):
        find_checkpoints(tmp_path)


def test_the_command_says_which_extra_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(sys.modules):
        if name.startswith(("viskill_deploy.bundle.official", "viskill_deploy.bundle.graph_w")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingExtraError, match=r"pip install -e .\.\[import\]"):
        official(tmp_path, tmp_path / "out")
