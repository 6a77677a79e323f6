from pathlib import Path

import pytest

from viskill_deploy.core.errors import DataFileError
from viskill_deploy.train.results import Unit
from viskill_deploy.train.settings import read_settings
from viskill_deploy.train.sweep_file import merged, read_sweep

ROOT = Path(__file__).resolve().parents[3]

GOOD = """
output = "runs/here"
processes = 3
[measuring]
episodes = 10
[settings]
environments = 8
[settings.skill]
rounds = 5
updates = 7
[task_settings.bipegtransfer.skill]
rounds = 9
[[units]]
tasks = ["bipegtransfer"]
methods = ["gcbc", "viskill", "tstar"]
seeds = [0, 1]
[[units]]
tasks = ["bipegtransfer"]
methods = ["viskill"]
seeds = [0, 2]
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "sweep.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_tasks_methods_and_seeds_are_multiplied_and_who_learns_shared_skills_goes_first(
    tmp_path: Path,
) -> None:
    sweep = read_sweep(written(tmp_path, GOOD))
    names = [(unit.method, unit.seed) for unit in sweep.units]
    leaders = [("viskill", 0), ("viskill", 1), ("viskill", 2)]
    assert names == [*leaders, ("gcbc", 0), ("tstar", 0), ("gcbc", 1), ("tstar", 1)]


def test_a_task_may_have_settings_of_its_own(tmp_path: Path) -> None:
    sweep = read_sweep(written(tmp_path, GOOD))
    settings = sweep.settings["bipegtransfer"]
    assert (settings.environments, settings.skill.rounds, settings.skill.updates) == (8, 9, 7)
    assert (sweep.output, sweep.results, sweep.processes) == (Path("runs/here"), None, 3)
    assert (sweep.measuring.episodes, sweep.measuring.calibration_episodes) == (10, 300)


def test_merging_leaves_its_arguments_alone() -> None:
    common = {"a": {"b": 1, "c": 2}, "d": 3}
    assert merged(common, {"a": {"b": 5}, "e": 6}) == {"a": {"b": 5, "c": 2}, "d": 3, "e": 6}
    assert common == {"a": {"b": 1, "c": 2}, "d": 3}


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ('output = "runs/here"', "outputs = 1", "outputs"),
        ("processes = 3", "processes = 0", "processes"),
        ("episodes = 10", "episode = 10", "measuring.episode"),
        ("environments = 8", "environment = 8", "settings.environment"),
        ("updates = 7", "update = 7", "settings.skill.update"),
        ("rounds = 9", "turns = 9", "task_settings.bipegtransfer.skill.turns"),
        ("seeds = [0, 2]", "seeds = [-1]", "units.1.seeds"),
        ("seeds = [0, 2]", "seeds = []", "units.1.seeds"),
        ("seeds = [0, 2]", "seed = 1", "units.1.seed"),
        ('methods = ["viskill"]', 'methods = ["magic"]', "units.1.methods"),
        ('tasks = ["bipegtransfer"]', 'tasks = ["cooking"]', "units.0.tasks"),
        (
            "[task_settings.bipegtransfer.skill]",
            "[task_settings.bipegboard.skills]",
            "task_settings",
        ),
        ("environments = 8", 'distributions = ["narrow"]', "settings.distributions"),
        ("episodes = 10", "episodes = 0", "measuring"),
        ("updates = 7", "patience = 0", "settings of bipegtransfer"),
        ("[task_settings.bipegtransfer.skill]", "[task_settings.tea.skill]", "task_settings"),
        ("processes = 3", "processes = ", ""),
    ],
)
def test_what_a_sweep_may_not_say_is_refused_by_name(
    old: str, new: str, key: str, tmp_path: Path
) -> None:
    with pytest.raises(DataFileError) as refused:
        read_sweep(written(tmp_path, GOOD.replace(old, new)))
    assert refused.value.key.startswith(key)
    assert str(tmp_path) in str(refused.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataFileError, match="cannot be read"):
        read_sweep(tmp_path / "none.toml")


def test_the_shipped_sweep_has_the_papers_methods() -> None:
    sweep = read_sweep(ROOT / "sweeps" / "paper.toml")
    assert sweep.results == Path("docs/results")
    assert sweep.measuring.episodes >= 100
    assert len(sweep.units) == 3 * 5 + 3 * 3 * 3 + 5 * 3
    assert {unit.method for unit in sweep.units[:15]} == {"viskill"}
    assert Unit("bipegtransfer", "viskill_ldm", 2) in sweep.units


def test_the_published_numbers_of_dex_are_settings_of_a_run() -> None:
    settings = read_settings(ROOT / "sweeps" / "published_dex.toml")
    assert (settings.dex.guidance, settings.dex.closeness, settings.dex.tau) == (
        "neighbours",
        5.0,
        0.05,
    )
    assert settings.skill.corrections == 0
