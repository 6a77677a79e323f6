"""Whatever is done to a bundle or a calibration, it is refused: exit code 3 and what to do."""

import itertools
import json
import pickle
import re
import shutil
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from calibrations import write_fresh

from viskill_deploy.bundle.format import MANIFEST, Manifest, write_manifest
from viskill_deploy.cli.main import main
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import BundleError, CalibrationError
from viskill_deploy.core.sealed import sealed
from viskill_deploy.runtime.preflight import Sources, prepare

pytestmark = [pytest.mark.invariant("S27"), pytest.mark.invariant("S28")]

SHIPPED = Path(__file__).resolve().parents[2] / "policies/bipegtransfer-viskill"
ADVICE = re.compile(r"(;|,) (fetch|export|remove|refuse|name|calibrate|put|rename) [^;]+$")

CLASSES = {
    "brace": rb"\{",
    "bracket": rb"\[",
    "quote": rb'"',
    "colon": rb":",
    "comma": rb",",
    "line end": rb"\n",
    "indent": rb"\n( )",
    "key": rb'"schem(a)"',
    "word": rb'"tas(k)"|"met(h)od": "points"',
    "digit": rb"0\.0*([1-9])",
    "last digit": rb"\.\d+(\d)[,\n]",
    "sign": rb"(-)\d",
    "point": rb"\d(\.)\d",
    "hash of a file": rb'"[0-9a-f]{30}([0-9a-f])[0-9a-f]{33}"',
    "own digest": rb'"digest": "([0-9a-f])',
    "last": rb"(\n)$",
}
"""A byte of every kind that a JSON file here is made of; its first group, or all of it."""

GRAPH_CLASSES = {
    "first": rb"^.",
    "name of an input": rb"goa(l)",
    "kind of a node": rb"MatM(u)l|Gem(m)",
    "name of an output": rb"actio(n)",
    "element type or size": rb"action\x12.{2,6}(\x01)",
}


def spot(content: bytes, pattern: bytes) -> int:
    found = re.search(pattern, content, re.DOTALL)
    assert found, pattern
    return next(found.start(i) for i in (*range(1, found.re.groups + 1), 0) if found.start(i) >= 0)


def flip(path: Path, index: int, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[index] ^= 1 << bit
    path.write_bytes(bytes(content))


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return shutil.copytree(SHIPPED, tmp_path / "bundle")


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    return write_fresh(tmp_path / "cell.json", load_cell("bipegtransfer"))


def refused(sources: Sources | Path) -> str:
    with pytest.raises((BundleError, CalibrationError)) as caught:
        prepare(sources)
    assert caught.value.exit_code == 3
    assert ADVICE.search(str(caught.value)), str(caught.value)
    return str(caught.value)


def told(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: object
) -> str:
    """What `viskill` with these words says on its way to exit code 3."""
    monkeypatch.setattr(sys, "argv", ["viskill", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 3
    out = capsys.readouterr()
    return out.out + out.err


@pytest.mark.parametrize("bit", [0, 1, 3, 5])
@pytest.mark.parametrize("kind", CLASSES)
def test_every_kind_of_byte_of_a_manifest(bundle: Path, kind: str, bit: int) -> None:
    path = bundle / MANIFEST
    flip(path, spot(path.read_bytes(), CLASSES[kind]), bit)
    assert MANIFEST in refused(bundle)


@pytest.mark.parametrize("bit", [0, 1, 3, 5])
@pytest.mark.parametrize("kind", CLASSES)
def test_every_kind_of_byte_of_a_calibration(calibration: Path, kind: str, bit: int) -> None:
    flip(calibration, spot(calibration.read_bytes(), CLASSES[kind]), bit)
    assert "cell.json" in refused(Sources(SHIPPED, date_s=time.time(), calibration=calibration))


@pytest.mark.parametrize("bit", [0, 7])
@pytest.mark.parametrize("kind", [*GRAPH_CLASSES, "weight", "last"])
@pytest.mark.parametrize("name", ["skill-grasp.onnx", "skill-release.onnx"])
def test_every_kind_of_byte_of_weights(bundle: Path, name: str, kind: str, bit: int) -> None:
    path = bundle / name
    content = path.read_bytes()
    where = {"weight": len(content) // 2, "last": len(content) - 1}
    flip(path, where.get(kind) or spot(content, GRAPH_CLASSES.get(kind, b"^")), bit)
    assert f"{name}: was changed" in refused(bundle)


@pytest.mark.parametrize("name", sorted(path.name for path in SHIPPED.iterdir()))
@pytest.mark.parametrize("part", [0.0, 0.5, 1.0])
def test_a_truncated_or_longer_file(bundle: Path, name: str, part: float) -> None:
    path = bundle / name
    content = path.read_bytes()
    path.write_bytes(content + b"\n" if part == 1.0 else content[: int(part * len(content))])
    assert name in refused(bundle)


@pytest.mark.parametrize("part", [0.0, 0.5, 0.999])
def test_a_truncated_calibration(calibration: Path, part: float) -> None:
    content = calibration.read_bytes()
    calibration.write_bytes(content[: int(part * len(content))])
    refused(Sources(SHIPPED, date_s=time.time(), calibration=calibration))


GRAPHS = sorted(path.name for path in SHIPPED.glob("*.onnx"))


@pytest.mark.parametrize(("one", "other"), list(itertools.pairwise(GRAPHS)))
def test_swapped_files(bundle: Path, one: str, other: str) -> None:
    spare = bundle.parent / "spare"
    (bundle / one).rename(spare)
    (bundle / other).rename(bundle / one)
    spare.rename(bundle / other)
    assert "was changed after export" in refused(bundle)


def test_the_manifest_of_another_bundle(bundle: Path) -> None:
    other = SHIPPED.parent / "bipegboard-viskill" / MANIFEST
    (bundle / MANIFEST).write_bytes(other.read_bytes())
    assert "was changed after export" in refused(bundle)


def resealed(path: Path, edit: Callable[[dict], object]) -> None:
    """Changes a file and gives it a digest that fits, as somebody with bad intentions would."""
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(sealed(content))


@pytest.mark.parametrize(
    "name", ["../outside.onnx", "/etc/passwd", "a/../skill-grasp.onnx", "..", "a\\..\\b.onnx", ""]
)
def test_a_path_out_of_the_folder(bundle: Path, name: str) -> None:
    (bundle.parent / "outside.onnx").write_bytes(b"")
    resealed(bundle / MANIFEST, lambda m: m["files"].update({name: "0" * 64}))
    refused(bundle)
    resealed(bundle / MANIFEST, lambda m: m["skills"][0].__setitem__("file", name))
    refused(bundle)


@pytest.mark.parametrize("name", [MANIFEST, "skill-grasp.onnx", "MODEL_CARD.md"])
def test_a_link(bundle: Path, name: str) -> None:
    moved = bundle.parent / "moved"
    (bundle / name).rename(moved)
    (bundle / name).symlink_to(moved)
    refused(bundle)


def test_a_calibration_that_is_a_link(calibration: Path) -> None:
    link = calibration.with_name("link.json")
    link.symlink_to(calibration)
    assert "is a link" in refused(Sources(SHIPPED, date_s=time.time(), calibration=link))


class Touch:
    """Leaves a trace where it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[..., object], tuple[Path]]:
        return Path.touch, (self.trace,)


@pytest.mark.parametrize("name", ["weights.pkl", "weights.onnx", "skill-grasp.onnx", "NOTES.md.pt"])
@pytest.mark.parametrize("is_listed", [False, True])
def test_a_pickle_inside(bundle: Path, name: str, is_listed: bool) -> None:
    trace = bundle.parent / "trace"
    (bundle / name).write_bytes(pickle.dumps(Touch(trace)))
    if is_listed:
        content = json.loads((bundle / MANIFEST).read_text())
        write_manifest(bundle, Manifest.model_validate(content))
    assert name in refused(bundle)
    assert not trace.exists()
    pickle.loads((bundle / name).read_bytes())
    assert trace.exists(), "the pickle would have done it"


def test_a_pickle_for_a_manifest_or_a_calibration(bundle: Path, tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    for path in (bundle / MANIFEST, tmp_path / "cell.json"):
        path.write_bytes(pickle.dumps(Touch(trace)))
    refused(bundle)
    refused(Sources(SHIPPED, date_s=time.time(), calibration=tmp_path / "cell.json"))
    assert not trace.exists()


@pytest.fixture
def bomb(tmp_path: Path) -> Path:
    """A zip of 100 kB that grows a thousand times."""
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("manifest.json", bytes(100_000_000))
    return path


def test_a_zip_bomb(bundle: Path, bomb: Path) -> None:
    assert "is no folder" in refused(bomb)
    refused(Sources(SHIPPED, date_s=time.time(), calibration=bomb))
    for name in ("extra.zip", "skill-grasp.onnx", MANIFEST):
        shutil.copy(bomb, bundle / name)
        if name != MANIFEST:
            resealed(bundle / MANIFEST, lambda m: None)
        refused(bundle)
        (bundle / "extra.zip").unlink(missing_ok=True)


def test_a_manifest_that_nests_without_end(bundle: Path) -> None:
    (bundle / MANIFEST).write_text("[" * 500_000)
    refused(bundle)


def test_a_manifest_of_gigabytes(bundle: Path) -> None:
    with (bundle / MANIFEST).open("r+b") as manifest:
        manifest.truncate(4 * 2**30)  # sparse: takes no room
    assert "larger than" in refused(bundle)
    with (bundle / "MODEL_CARD.md").open("r+b") as card:
        card.truncate(4 * 2**30)
    shutil.copy(SHIPPED / MANIFEST, bundle / MANIFEST)
    assert "MODEL_CARD.md: is larger" in refused(bundle)


@pytest.mark.parametrize("command", ["check", "dry-run", "inspect"])
def test_the_command_line_says_so_and_exits_with_3(
    bundle: Path,
    command: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flip(bundle / "skill-grasp.onnx", 2000, 0)
    said = told(capsys, monkeypatch, command, bundle)
    assert "was changed after export (SHA-256); fetch the bundle again" in said


def test_check_says_what_is_wrong_with_a_calibration(
    calibration: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    flip(calibration, 100, 0)
    said = told(capsys, monkeypatch, "check", SHIPPED, "--calibration", calibration, "--json")
    (line,) = said.splitlines()[:1]
    told_lines = {entry["name"]: entry for entry in json.loads(line)["lines"]}
    assert told_lines["calibration"]["status"] == "fail"
    assert "calibrate the cell again" in told_lines["calibration"]["text"]
    assert told_lines["every setpoint of the plan"]["status"] == "pass"
