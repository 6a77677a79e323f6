"""A sealed file is read as it was written, or not at all."""

import json
import random
from pathlib import Path

import pytest

from viskill_deploy.core.sealed import digest, read_sealed, sealed

pytestmark = pytest.mark.invariant("S28")

CONTENT = {"name": "ä name", "numbers": [0.5235987755982988, -7e-05, 3], "nested": {"yes": True}}


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_what_was_sealed_is_read_back_with_its_digest(tmp_path: Path) -> None:
    path = write(tmp_path / "file.json", sealed(CONTENT | {"digest": "an old one"}))
    assert read_sealed(path, 4096) == CONTENT | {"digest": digest(CONTENT)}


def test_every_flip_of_every_bit_is_found(tmp_path: Path) -> None:
    whole = sealed(CONTENT).encode()
    path = tmp_path / "file.json"
    for index in range(len(whole)):
        for bit in range(8):
            changed = bytearray(whole)
            changed[index] ^= 1 << bit
            path.write_bytes(bytes(changed))
            with pytest.raises(ValueError, match=r"changed|readable"):
                read_sealed(path, 4096)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (",\n", ", \n"),
        ("\n", "\r\n"),
        ("0.5235987755982988", "0.52359877559829880"),
        ("-7e-05", "-7E-05"),
        ('"nested"', '"name": "ä name", "nested"'),
        ("\\u00e4", "ä"),
        ("}\n", "}"),
        ("}\n", "}\n\n"),
    ],
)
def test_another_text_of_the_same_content_is_found(tmp_path: Path, old: str, new: str) -> None:
    text = sealed(CONTENT)
    assert old in text
    changed = text.replace(old, new)
    assert json.loads(changed) == json.loads(text)
    path = tmp_path / "file.json"
    path.write_bytes(changed.encode())
    with pytest.raises(ValueError, match="changed"):
        read_sealed(path, 4096)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "readable"),
        ("null", "changed"),
        ("[]\n", "changed"),
        ("{}\n", "changed"),
        ('{"digest": 5}', "changed"),
        ('{"a": NaN}', "NaN is no number"),
        ('{"a": 1e999}', "readable"),
        ("[" * 100_000, "readable"),
        ('"\\ud800"', "changed"),
    ],
)
def test_what_was_never_sealed_is_refused(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        read_sealed(write(tmp_path / "file.json", text), 2**20)


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    whole = sealed(CONTENT).encode()
    path = tmp_path / "file.json"
    for length in random.Random(0).sample(range(len(whole)), 40):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"changed|readable"):
            read_sealed(path, 4096)


def test_a_link_a_large_file_and_none_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "file.json", sealed(CONTENT))
    (tmp_path / "link.json").symlink_to(path)
    with pytest.raises(ValueError, match="link"):
        read_sealed(tmp_path / "link.json", 4096)
    with pytest.raises(ValueError, match="larger than 0 KiB"):
        read_sealed(path, path.stat().st_size - 1)
    assert read_sealed(path, path.stat().st_size)
    with pytest.raises(OSError, match="No such file"):
        read_sealed(tmp_path / "none.json", 4096)
