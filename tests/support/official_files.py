"""Official checkpoints for tests: real pickles with made-up weights, and small ones by torch."""

from __future__ import annotations

import sys
import types
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.bundle.official.pickle_data import read_pickle
from viskill_deploy.bundle.official.torch_file import NAMES

GOLDEN = Path(__file__).resolve().parents[1] / "golden" / "official"
SKILLS = ("grasp", "handover", "release")
Made = Callable[[str, tuple[int, ...]], np.ndarray]


def skill_path(folder: Path, skill: str, task: str = "BiPegTransfer", seed: int = 1) -> Path:
    """Where the official code puts a skill's checkpoint."""
    parts = f"skill_learning/{task}-v0/SL_DEX/d200/s{seed}/{skill}/model/weights_ep10.pth"
    return folder / parts


def chaining_path(folder: Path, task: str = "BiPegTransfer", seed: int = 1) -> Path:
    """Where it puts a chaining checkpoint."""
    parts = f"viskill/{task}-v0/SC_SAC_SIL_SL_DEX/d200/rs1/s{seed}/model/weights_ep20.pth"
    return folder / parts


def key_of(name: str, skill: str) -> str:
    """The same key for the same weights in a skill's checkpoint and in a chaining one."""
    if skill != "chaining":
        return f"{skill}.{name}"
    return name.removeprefix("sc_agent.").removeprefix("sl_agent.")


def random_weights(key: str, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers that depend on the key alone, about as large as fresh networks have them."""
    rng = np.random.default_rng(zlib.crc32(key.encode()))
    return rng.uniform(-1.0, 1.0, shape).astype(np.float32) / np.float32(np.sqrt(shape[-1]))


def whole(folder: Path, make: Made = random_weights) -> dict[str, np.ndarray]:
    """A whole set of checkpoints around the real pickles; returns the weights by their keys."""
    weights: dict[str, np.ndarray] = {}
    for skill in (*SKILLS, "chaining"):
        path = chaining_path(folder) if skill == "chaining" else skill_path(folder, skill)
        content = (GOLDEN / f"{skill}.pkl").read_bytes()
        weights |= fill(path, content, lambda name, s=skill: key_of(name, s), make)
    return weights


def fill(
    path: Path, content: bytes, key: Callable[[str], str], make: Made
) -> dict[str, np.ndarray]:
    """Writes a torch zip file around a pickle with weights of our own."""
    sizes: dict[str, int] = {}

    def storage(pid: Any) -> np.ndarray:
        sizes[pid[2]] = pid[4]
        return np.full(pid[4], float(pid[2]), dtype=np.float32)  # every number tells its storage

    state = read_pickle(content, NAMES, storage)["state_dict"]
    weights, numbers = {}, {}
    for name, tensor in state.items():
        weights[key(name)] = make(key(name), tensor.shape)
        numbers[str(int(tensor.flat[0]))] = weights[key(name)]
    entries = {f"data/{k}": numbers[k].tobytes() for k in sizes}
    write_zip(path, {"data.pkl": content, "byteorder": b"little", **entries})
    return weights


def write_zip(path: Path, entries: Mapping[str, bytes], root: str = "weights") -> Path:
    """A zip of stored entries below a root folder, as torch writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in entries.items():
            archive.writestr(f"{root}/{name}", content)
    return path


def entries_of(path: Path) -> dict[str, bytes]:
    """What `write_zip` was given."""
    with zipfile.ZipFile(path) as archive:
        return {n.split("/", 1)[1]: archive.read(n) for n in archive.namelist()}


def save_small(path: Path, sizes: Mapping[str, tuple[int, int]], extra: Mapping[str, Any]) -> Path:
    """A checkpoint of small networks, by torch itself and with this numpy.

    Args:
        path: of the file.
        sizes: inputs and outputs of every network, by the prefix of its names.
        extra: further entries; a pair of arrays becomes a Normalizer with that mean and std.
    """
    import torch  # noqa: PLC0415 - slow to import

    state = OrderedDict()
    for prefix, (inputs, outputs) in sizes.items():
        for layer, (n, m) in enumerate([(inputs, 6), (6, 6), (6, 6), (6, outputs)]):
            for part, shape in (("weight", (m, n)), ("bias", (m,))):
                name = f"{prefix}.{2 * layer}.{part}"
                state[name] = torch.from_numpy(random_weights(name, shape))
    state._metadata = OrderedDict(version=1)  # what a module's own state_dict carries along
    path.parent.mkdir(parents=True, exist_ok=True)
    with _official_class() as kind:
        content = {key: _entry(kind, value) for key, value in extra.items()}
        torch.save({"episode": 1, "state_dict": state, "score": np.float64(0.5), **content}, path)
    return path


def _entry(kind: type, value: Any) -> Any:
    if not isinstance(value, tuple):
        return value
    record = kind()
    mean, std = (np.asarray(x, dtype=np.float32) for x in value)
    record.__dict__ = {"size": len(mean), "eps": 1e-2, "default_clip_range": 5}
    record.__dict__ |= {"mean": mean, "std": std, "total_count": np.ones(1, np.float32)}
    return record


class _official_class:  # noqa: N801 - used like a function
    """Lends the class name that official pickles hold for as long as one is being written."""

    name = "viskill.components.normalizer"

    def __enter__(self) -> type:
        kind = type("Normalizer", (), {"__module__": self.name})
        module = types.ModuleType(self.name)
        module.Normalizer = kind
        parents = ("viskill", "viskill.components")
        sys.modules |= {name: types.ModuleType(name) for name in parents} | {self.name: module}
        return kind

    def __exit__(self, *_: object) -> None:
        for name in ("viskill", "viskill.components", self.name):
            del sys.modules[name]


def network(x: np.ndarray, weights: Mapping[str, np.ndarray], prefix: str) -> np.ndarray:
    """Linear layers with ReLU between them, in double precision: the tests' own forward pass."""
    for layer in range(4):
        matrix, bias = (weights[f"{prefix}.{2 * layer}.{p}"] for p in ("weight", "bias"))
        x = (np.maximum(x, 0.0) if layer else x) @ matrix.T.astype(float) + bias
    return x
