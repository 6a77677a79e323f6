from dataclasses import replace
from pathlib import Path

import pytest
from result_files import result, without_success

from viskill_deploy.core.errors import DataFileError, TrainingError
from viskill_deploy.train.reproduce import order, read_results, reproduce, spread
from viskill_deploy.train.results import Measuring, Result, write_result

GOLDEN = Path(__file__).resolve().parents[2] / "golden" / "reproduction.md"

MADE = [
    *(result("bipegtransfer", "viskill", k, s) for k, s in enumerate((0.98, 0.96, 1.0))),
    *(result("bipegtransfer", "tstar", k, s) for k, s in enumerate((0.91, 0.87))),
    *(result("bipegtransfer", "viskill_sr", k, 0.99) for k in range(2)),
    *(result("bipegtransfer", "viskill_dm", k, 0.7) for k in range(2)),
    result("bipegtransfer", "self_imitation", 0, 0.9),
    without_success(result("bipegtransfer", "dex", 0, 0.0)),
    result("bipegboard", "viskill", 0, 0.95, length=55.5, subtasks=2.9),
]


def written(folder: Path, made: list[Result]) -> Path:
    for one in made:
        write_result(folder / f"{one.unit.name}.json", one)
    return folder


def test_the_page_is_built_from_result_files_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "results", MADE)
    page, figure = reproduce(Path("results"), Path("out/reproduction.md"))
    text = page.read_text(encoding="utf-8")
    assert text == GOLDEN.read_text(encoding="utf-8")
    assert "The simulator is ours" in text
    assert figure.name == "reproduction-value.svg"


def test_the_same_results_give_the_same_bytes(tmp_path: Path) -> None:
    folder = written(tmp_path / "results", MADE)
    first = [path.read_bytes() for path in reproduce(folder, tmp_path / "a.md")]
    again = [path.read_bytes() for path in reproduce(folder, tmp_path / "a.md")]
    assert first == again
    assert first[1].startswith(b"<?xml")


def test_means_stand_with_their_sample_deviation() -> None:
    assert spread([90.0, 94.0]) == "92.00 ± 2.83"
    assert spread([90.0]) == "90.00"
    assert spread([None, 60.0, 62.0]) == "61.00 ± 1.41"
    assert spread([None]) == "-"


def test_whether_the_order_of_the_paper_holds_is_told_of_every_task(tmp_path: Path) -> None:
    transfer, board, panel, *wide = order(read_results(written(tmp_path, MADE)))
    assert transfer.startswith("**BiPegTransfer**: of 10 pairs")
    assert "Cannot be told apart: ViSkill from T-STAR, ViSkill-SR;" in transfer
    assert "cannot be said" in board
    assert panel.endswith("Not run: ViSkill, T-STAR, GCBC, DEX.")
    assert [line.split(":")[0] for line in wide] == [
        f"**{task}**, wide layouts" for task in ("BiPegTransfer", "BiPegBoard", "MatchBoardPanel")
    ]


def test_settings_that_are_not_the_defaults_and_their_sweep_are_told(tmp_path: Path) -> None:
    made = result("bipegtransfer", "dex", 0, 0.1)
    settings = {**made.settings, "environments": 16}
    settings["skill"] = {**settings["skill"], "corrections": 0}
    folder = written(tmp_path / "few", [replace(made, settings=settings)])
    page, _ = reproduce(folder, tmp_path / "few.md")
    assert "viskill sweep" not in page.read_text(encoding="utf-8")
    page, _ = reproduce(folder, tmp_path / "few.md", Path("sweeps/few.toml"))
    text = page.read_text(encoding="utf-8")
    assert "- BiPegTransfer: `environments = 16`, `skill.corrections = 0`\n" in text
    assert "`viskill sweep sweeps/few.toml` writes" in text
    assert "-o " in text and "--sweep sweeps/few.toml" in text


def test_results_of_other_settings_do_not_go_into_one_table(tmp_path: Path) -> None:
    one = result("bipegtransfer", "gcbc", 0, 0.1)
    other = replace(result("bipegtransfer", "dex", 0, 0.1), measuring=Measuring(episodes=50))
    with pytest.raises(TrainingError, match="otherwise than"):
        read_results(written(tmp_path, [one, other]))


def test_without_any_calibration_the_figure_says_so(tmp_path: Path) -> None:
    folder = written(tmp_path / "results", [result("bipegtransfer", "gcbc", 0, 0.1)])
    page, figure = reproduce(folder, tmp_path / "page.md")
    assert figure.is_file()
    assert "| 147 | not run | not run |" in page.read_text(encoding="utf-8")


def test_a_folder_without_results_and_a_second_result_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="no result files"):
        read_results(tmp_path)
    one = result("bipegtransfer", "gcbc", 0, 0.1)
    for name in "ab":
        write_result(tmp_path / f"{name}.json", one)
    with pytest.raises(TrainingError, match="second result"):
        read_results(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"schema": 1', '"schema": 9', "schema"),
        ('"success_rate"', '"rate"', "scores.reference"),
        ('"calibration": null', '"calibration": null, "extra": 1', "extra"),
        ("{", "[", "JSON"),
    ],
)
def test_a_wrong_result_file_is_refused_by_name(
    old: str, new: str, says: str, tmp_path: Path
) -> None:
    written(tmp_path, [result("bipegtransfer", "gcbc", 0, 0.1)])
    (path,) = tmp_path.iterdir()
    path.write_text(path.read_text("utf-8").replace(old, new), encoding="utf-8")
    with pytest.raises(DataFileError, match=says):
        read_results(tmp_path)
