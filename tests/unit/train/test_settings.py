"""What may be set about a run, and what its folder says."""

import json
from pathlib import Path

import pytest

from viskill_deploy.core.errors import DataFileError, TrainingError
from viskill_deploy.train import store
from viskill_deploy.train.results import Measuring
from viskill_deploy.train.run import Run
from viskill_deploy.train.settings import RunSettings, read_settings, settings_facts


def written(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [
        ("skill", "patience", "0"),
        ("skill", "passes", "0"),
        ("skill", "rounds", "-3"),
        ("skill", "learned_starts", "1.5"),
        ("dex", "batch", "0"),
        ("dex", "actor_rate", "nan"),
        ("demos", "episodes", "0"),
        ("chain", "hidden", "0"),
        ("amounts", "capacity", "-1"),
        ("amounts", "rounds", "4"),
    ],
)
def test_numbers_that_no_learning_could_have_are_refused_by_name(
    table: str, key: str, value: str, tmp_path: Path
) -> None:
    with pytest.raises(DataFileError, match=rf"{table}\.{key} has to be"):
        read_settings(written(tmp_path, f"[{table}]\n{key} = {value}\n"))


def test_what_may_be_turned_off_may_be_zero(tmp_path: Path) -> None:
    text = "[skill]\ncorrections = 0\npolish_steps = 0\nends = 0\n[dex]\ncritic_first = 0\n"
    assert read_settings(written(tmp_path, text)).skill.ends == 0


def test_measuring_asks_for_episodes() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Measuring(episodes=0)
    with pytest.raises(ValueError, match="not negative"):
        Measuring(calibration_episodes=-1)


def test_layouts_that_the_task_does_not_have_are_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    settings = RunSettings(distributions=("refrence",))
    with pytest.raises(TrainingError, match="the distributions reference, wide, no 'refrence'"):
        Run(tmp_path / "run", "bipegtransfer", 0, settings)
    assert not (tmp_path / "run").exists()


def test_settings_may_be_corrected_until_something_is_begun(tmp_path: Path) -> None:
    first = Run(tmp_path, "bipegtransfer", 0, RunSettings(environments=3))
    Run(tmp_path, "bipegtransfer", 0, RunSettings(environments=4))
    with pytest.raises(TrainingError, match="name an empty folder"):
        first.insist_own()
    (tmp_path / "demos.lock").touch()  # somebody records demonstrations
    with pytest.raises(TrainingError, match="name an empty folder"):
        Run(tmp_path, "bipegtransfer", 0, RunSettings(environments=5))
    assert Run.open(tmp_path).settings.environments == 4


def test_a_folder_of_runs_is_told_from_a_run(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="train first"):
        Run.open(tmp_path)
    run = tmp_path / "task" / "seed0"
    Run(run, "bipegtransfer", 0, RunSettings())
    (tmp_path / "task" / "settings.json").write_text("{}", encoding="utf-8")  # of an older sweep
    (run / "viskill").mkdir()
    (run / "viskill" / "unit-settings.json").write_text("{}", encoding="utf-8")
    for folder in (tmp_path, tmp_path / "task"):
        with pytest.raises(TrainingError, match=r"name one of \S*seed0$"):
            Run.open(folder)
    with pytest.raises(TrainingError, match="train first"):
        Run.open(run / "viskill")
    Run(run / "another", "bipegtransfer", 1, RunSettings())
    assert Run.open(run).seed == 0


@pytest.mark.parametrize("text", ["{", '{"task": "bipegtransfer"}', "[]"])
def test_a_damaged_settings_file_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "settings.json").write_text(text, encoding="utf-8")
    with pytest.raises(DataFileError, match=r"settings\.json"):
        Run.open(tmp_path)


def test_a_run_of_before_a_setting_was_there_opens(tmp_path: Path) -> None:
    facts = settings_facts(RunSettings())
    del facts["dex"]["neighbours"]
    text = json.dumps({"task": "bipegtransfer", "seed": 0, "settings": facts})
    (tmp_path / "settings.json").write_text(text, encoding="utf-8")
    store.save(tmp_path / "demos.npz", {})
    assert Run.open(tmp_path).settings == RunSettings()
