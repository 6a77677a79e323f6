"""JSON files that carry their own digest: a changed byte anywhere in them is found.

The digest is the SHA-256 of all other entries in one fixed form. A file is written in another fixed
form, and read only in that: a space, a digit that rounds to the same number or an entry that stands
twice would leave the digest as it is.

A digest finds accidents and changes of a single file. It does not say who wrote the file.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, NoReturn

DIGEST = "digest"


def digest(content: dict[str, Any]) -> str:
    """Hex SHA-256 of a file's content without its `digest` entry."""
    body = {key: value for key, value in content.items() if key != DIGEST}
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def sealed(content: dict[str, Any]) -> str:
    """The text of a file with this content and its digest, which replaces any that is there."""
    return _text({**content, DIGEST: digest(content)})


def read_sealed(path: Path, largest_bytes: int) -> dict[str, Any]:
    """The content of a file that was written with `sealed`, digest included.

    Raises:
        ValueError: it is a link, too large, no JSON, or was changed; says which.
        OSError: it cannot be read.
    """
    if path.is_symlink():
        raise ValueError("is a link; put the file itself there")
    if path.stat().st_size > largest_bytes:
        raise ValueError(f"is larger than {largest_bytes // 1024} KiB, far too large for its kind")
    try:
        text = path.read_bytes().decode()
        content = json.loads(text, parse_constant=_no_constant)
        is_whole = isinstance(content, dict) and content.get(DIGEST) == digest(content)
        if is_whole and text == _text(content):
            return dict(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"is not readable ({error})") from error
    raise ValueError("was changed after it was written")


def _text(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number for a file")
