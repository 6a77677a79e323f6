"""A report calls a probability likely, and a return what it is."""

from pathlib import Path

import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.observe.report import write_report

SKILL = {"name": "reach", "steps": 1, "subgoal": [0.0], "subgoal_source": "chaining", "value": 3.2}
BOUNDARY = {
    "after": "", "before": "reach", "skill": "reach", "course": "go on", "grasps": (),
    "value": 3.2, "threshold": None,
}  # fmt: skip
EPISODE = {"episode": 0, "success": True, "skills": [SKILL], "boundaries": [BOUNDARY]}


@pytest.mark.parametrize("meaning", ["probability", "return"])
def test_the_report_says_what_a_value_means(tmp_path: Path, meaning: str) -> None:
    result = {"episode_results": [EPISODE], "value_threshold": None, "value_meaning": meaning}
    page = write_report(tmp_path / "r.html", result, load_cell("bipegtransfer")).read_text()
    assert page.count("3.20") == 3, "of the skill, of its start and of the boundary before it"
    assert page.count("how likely success looked") == (2 if meaning == "probability" else 0)
    assert page.count("no probability") == (2 if meaning == "return" else 0)
