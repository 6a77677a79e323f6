import json
from pathlib import Path

import imageio.v3
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from viskill_deploy.train.curves import draw, rates_of, read_log, stage_seconds

LINES = [
    {"stage": "demos", "seconds": 4.0},
    {"stage": "grasp", "round": 0.0, "imitation": 0.3, "success": 0.1, "seconds": 2.0},
    {"stage": "grasp", "round": 1.0, "exploring": 0.4, "seconds": 9.0},  # lost, then done again
    {"stage": "grasp", "round": 1.0, "exploring": 0.5, "seconds": 3.0},
    {"stage": "grasp", "ends": 10, "seconds": 1.0},
    {"stage": "other", "round": 0.0, "exploring": 0.0, "seconds": 5.0},
]


def logged(folder: Path, torn: str = "") -> Path:
    text = "\n".join(map(json.dumps, LINES)) + f"\n{torn}"
    (folder / "log.jsonl").write_text(text, encoding="utf-8")
    return folder


def test_of_a_round_that_was_repeated_the_last_line_counts(tmp_path: Path) -> None:
    lines = read_log(logged(tmp_path))
    assert len(lines) == len(LINES) - 1
    assert stage_seconds(lines) == {"demos": 4.0, "grasp": 6.0, "other": 5.0}


def test_half_a_line_of_a_killed_process_does_not_count(tmp_path: Path) -> None:
    lines = read_log(logged(tmp_path, torn='{"stage": "grasp", "rou'))
    assert len(lines) == len(LINES) - 1


def test_a_folder_without_a_log_has_no_curves(tmp_path: Path) -> None:
    assert read_log(tmp_path) == []


def test_rates_stand_in_columns_with_gaps(tmp_path: Path) -> None:
    assert rates_of(read_log(logged(tmp_path)))["grasp"] == {
        "round": [0.0, 1.0],
        "exploring": [None, 0.5],
        "success": [0.1, None],
    }


def test_a_finished_stage_gets_its_tensorboard_file_and_the_picture(tmp_path: Path) -> None:
    for _ in range(2):  # the second time in place of the first
        draw(logged(tmp_path), ["grasp"])
    picture = imageio.v3.imread(tmp_path / "curves.png")[..., :3]
    dark = (picture < 128).any(axis=-1)
    assert dark[:, : picture.shape[1] // 3].sum() > 1000  # three panels wide, two in use
    assert not dark[:, picture.shape[1] * 9 // 10 :].any()
    (file,) = (tmp_path / "tensorboard" / "grasp").iterdir()
    events = EventAccumulator(str(file))
    events.Reload()
    assert {"exploring", "imitation", "success"} <= set(events.Tags()["scalars"])
    assert [(e.step, round(e.value, 3)) for e in events.Scalars("exploring")] == [(1, 0.5)]
    assert not (tmp_path / "tensorboard" / "other").exists()
