"""The exporter in the documentation writes a bundle that loads."""

import re
from pathlib import Path

import pytest

from viskill_deploy.bundle.format import load_bundle

ROOT = Path(__file__).resolve().parents[3]


def test_the_exporter_in_the_docs_writes_a_bundle_that_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (ROOT / "docs" / "bundle.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    (tmp_path / "policies").symlink_to(ROOT / "policies")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "docs/bundle.md", "exec"), {"__name__": "docs"})
    bundle = load_bundle(tmp_path / "mine")
    assert set(bundle.chaining) == {"grasp", "handover"}
    assert bundle.manifest.subgoals == "chaining"
