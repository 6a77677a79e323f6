from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import synthetic_run as synthetic
from rich.console import Console

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import Boundary, GraspTest
from viskill_deploy.observe import figures, labels, plotting, starts, summary, tables
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.report import write_report
from viskill_deploy.observe.video import Video, render_video
from viskill_deploy.runtime.ledger import EpisodeResult

RESULT = {
    "task": "BiPegTransfer",
    "bundle": "policies/some",
    "mode": "closed-loop",
    "distribution": "wide",
    "episodes": 2,
    "success_rate": 0.5,
    "interventions": 3,
    "rcm_error_max_m": 0.0021,
    "joint_margin_min": 0.07,
    "tip_speed_max_m_s": 0.045,
    "setpoints": 12345,
    "realtime_factor": 6.25,
    "margins": {"S10": {"margin": 0.1, "arm": "PSM1"}, "S05": -0.01, "S99": 0.5},
    "episode_results": [
        {"episode": 0, "success": True, "skills": [
            {"name": "reach", "steps": 10, "success": True, "stretch_max": 1.0},
            {"name": "place", "steps": 7, "success": True, "stretch_max": 1.4},
        ]},
        {"episode": 1, "success": False, "skills": [
            {"name": "reach", "steps": 20, "success": False, "stretch_max": 1.1},
        ]},
    ],
    "files": [{"path": "robots/psm_classic.toml", "sha256": "ab" * 32}],
    "notes": ["<b>nominal</b> poses & no calibration"],
}  # fmt: skip


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "bag"
    synthetic.record(path, episodes=2, cycles=400, every=150)
    return path


@pytest.fixture(scope="module")
def page(bag, tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("report")
    (folder / "video.mp4").write_bytes(b"moving pictures")
    path = write_report(
        folder / "report.html", RESULT, load_cell("bipegtransfer"), bag, Video(folder / "video.mp4")
    )
    return path.read_text(encoding="utf-8")


def without_scripts(page: str) -> str:
    return re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)


def plots(page: str) -> dict:
    """The figures inside the page, parsed."""
    block = page[page.rindex("const plots = {") : page.rindex("for (const [id, figure]")]
    found = re.findall(r'^\s*"([\w-]+)": (\{.*\}),$', block, flags=re.MULTILINE)
    return {name: json.loads(text) for name, text in found}


def test_the_report_loads_nothing_from_anywhere(page):
    markup = without_scripts(page)
    sources = re.findall(r'(?:src|href|poster|action)\s*=\s*"([^"]*)"', markup)
    assert sources
    assert all(source.startswith("data:") for source in sources)
    assert "@import" not in markup
    assert "url(" not in markup
    assert "<script src" not in page
    assert page.count("Plotly.newPlot(id") == 1


def test_the_report_shows_figures_skills_margins_episodes_and_files(page):
    markup = without_scripts(page)
    for text in ("50%", "2.100 mm", "45.0 mm/s", "6.2×", "12,345", "over the limit", "10.0 %"):
        assert text in markup
    assert "15 (at most 20)" in markup
    assert "1 of 2" in markup
    assert "joint speed (S05)" in markup
    assert "ab" * 32 in markup
    assert "reach (20)" in markup
    assert "&lt;b&gt;nominal" in markup  # a note is text, never markup
    assert base64.b64encode(b"moving pictures").decode() in markup


def test_the_report_plots_the_first_episode_whole(page):
    found = plots(page)
    assert set(found) == {
        "paths", "verdicts", "joints-PSM1", "joints-PSM2", "tracking", "remote-centre",
    }  # fmt: skip
    assert len(found["joints-PSM1"]["data"]) == 7
    times = found["tracking"]["data"][0]["x"]
    assert (times[0], round(times[-1], 3)) == (0.0, 1.596)
    spoken = found["verdicts"]["data"][0]
    assert len(spoken["x"]) == 4
    assert set(spoken["y"]) == {"joint speed (S05)"}


def test_another_episode_can_be_plotted(bag, tmp_path):
    path = write_report(tmp_path / "r.html", RESULT, load_cell("bipegtransfer"), bag, episode=1)
    assert "episode 1, 1.6 s" in path.read_text(encoding="utf-8")


def test_a_run_without_video_says_why_and_goes_on(bag, tmp_path):
    video = render_video(bag, tmp_path / "v.mp4", backends=("nonsense",))
    assert video.path is None
    path = write_report(tmp_path / "r.html", RESULT, load_cell("bipegtransfer"), bag, video)
    text = path.read_text(encoding="utf-8")
    assert "apt-get install libosmesa6" in text
    assert "<video" not in text
    assert "Plotly.newPlot" in text


def test_a_bare_result_makes_a_small_report(tmp_path):
    path = write_report(tmp_path / "r.html", {"task": "X"}, load_cell("bipegtransfer"))
    assert path.stat().st_size < 20_000
    assert "<script" not in path.read_text(encoding="utf-8")


def test_a_missing_recording_is_not_an_episode(bag):
    assert render_video(bag, bag.parent / "v.mp4", episode=9).note.startswith("no video: ")


def test_tracking_error_is_setpoint_less_measured(bag):
    data, cell = read_recording(bag, 0), load_cell("bipegtransfer")
    figure = figures.tracking_figure(data, cell)
    c = synthetic.cycle(cell, 0)
    error = np.abs(np.array(c.sent[0].jp) - c.state.arms[0].measured_jp) * 1e3
    assert figure["data"][0]["y"][0] == pytest.approx(np.delete(error, 2).max(), rel=1e-4)
    assert figure["data"][1]["y"][0] == pytest.approx(error[2], rel=1e-4)


def test_a_port_two_millimetres_off_shows_as_two_millimetres(bag):
    cell = load_cell("bipegtransfer")
    data = read_recording(bag, 0)
    assert max(figures.remote_centre_figure(data, cell)["data"][0]["y"]) < 1e-9
    first, second = cell.arms
    entry = first.entry.model_copy(update={"port_in_base_m": (0.0, 0.002, 0.0)})
    moved = replace(cell, arms=(replace(first, entry=entry), second))
    error = figures.remote_centre_figure(data, moved)["data"][0]["y"]
    assert 1.8 < max(error) <= 2.0  # the part across the shaft, mm


def test_thinning_keeps_every_peak():
    values = np.zeros(100_000)
    values[[123, 77_777]] = 5.0, -3.0
    x, y = plotting.thinned(np.arange(100_000.0), values, points=200)
    assert len(x) < 500
    assert (max(y), min(y)) == (5.0, -3.0)
    assert (x[0], x[-1]) == (0.0, 99_999.0)


def test_spans_name_each_stretch_of_a_skill(bag):
    named = plotting.spans(read_recording(bag, 0))
    assert [name for _, _, name in named] == ["reach", "lift", "handover"]
    assert named[0][:2] == pytest.approx((0.0, 0.6))


def test_every_rule_and_action_has_words():
    assert labels.rule_label("S05") == "joint speed (S05)"
    assert labels.rule_label("S99") == "S99"
    assert [labels.action_label(a) for a in (0, 3, 42)] == ["passed", "held", "42"]
    assert [labels.joint_label(j) for j in (-1, 4, 6)] == ["whole arm", "wrist pitch", "jaw"]
    assert labels.shown_joint(True, 0.12) == (120.0, "mm")


def test_margins_come_tightest_first_whatever_their_form():
    rows = summary.margin_rows(RESULT)
    assert [(row.rule, row.margin, row.where) for row in rows] == [
        ("S05", -0.01, ""), ("S10", 0.1, "PSM1"), ("S99", 0.5, ""),
    ]  # fmt: skip


def test_skills_of_one_episode_are_told_plainly():
    rows = summary.skill_rows(RESULT, episode=1)
    assert [(r.name, r.steps, r.result, r.stretch) for r in rows] == [
        ("reach", "20", "failed", "1.10×")
    ]


def test_without_a_terminal_the_tables_are_plain_lines():
    console = Console(file=io.StringIO(), width=40)
    tables.print_tables(RESULT, console)
    lines = console.file.getvalue().splitlines()
    assert lines[0] == "BiPegTransfer · closed-loop · wide, 2 episodes"
    assert "success: 50%" in lines
    assert "smallest margin to tip speed (S10): 10.0 % at PSM1" in lines
    assert "smallest margin to all other rules: 50.0 % or more" in lines
    assert "skill reach: 15 (at most 20) steps, 1 of 2, stretch 1.10×" in lines
    assert "\x1b" not in console.file.getvalue()


def test_on_a_terminal_the_tables_are_boxes():
    console = Console(file=io.StringIO(), width=100, force_terminal=True)
    tables.print_tables(RESULT, console)
    text = console.file.getvalue()
    assert "Smallest margins" in text
    assert "all other rules: 50.0 % or more" in text
    assert "Skills" in text


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_counts_to_the_end(terminal):
    console = Console(file=io.StringIO(), width=100, force_terminal=terminal)
    with tables.progress(20, console) as advance:
        for index in range(20):
            advance(index // 2)
    text = console.file.getvalue()
    assert ("20/20" if terminal else "episode 20 of 20, 9 succeeded") in text
    assert terminal or len(text.splitlines()) == 10


def test_a_skill_that_nobody_can_judge_is_neither_done_nor_failed():
    skills = [{"name": "reach", "steps": 3, "success": None, "stretch_max": None}]
    (row,) = summary.skill_rows({"episode_results": [{"episode": 0, "skills": skills}]})
    assert (row.result, row.stretch, row.good) == ("–", "–", True)


@pytest.mark.parametrize(
    ("episode", "words"),
    [
        ({"success": True, "stopped_by": ""}, "success"),
        ({"success": False}, "failed"),
        ({"success": False, "stopped_by": "S10"}, "stopped by tip speed (S10)"),
    ],
)
def test_an_episode_says_how_it_ended(episode, words):
    assert summary.outcome(episode) == words


def test_an_episode_that_never_moved_is_a_note_not_an_error(bag, tmp_path):
    path = write_report(tmp_path / "r.html", RESULT, load_cell("bipegtransfer"), bag, episode=8)
    text = path.read_text(encoding="utf-8")
    assert "no plots: " in text
    assert "no episode 8; ask for one of [0, 1]" in text
    assert "50%" in text


CHAINED = RESULT | {
    "episodes": 2,
    "value_threshold": 0.5,
    "subgoal_layout": [
        {"name": "first_position", "size": 3},
        {"name": "second_position", "size": 3},
        {"name": "contact", "size": 2},
    ],
    "episode_results": [
        {"episode": 0, "success": True, "skills": [
            {"name": "reach", "steps": 10, "success": True, "stretch_max": 1.0,
             "subgoal": [0.0123, -0.04, 0.05, 0.01, 0.02, 0.03, 1.0, 0.0],
             "subgoal_source": "chaining", "value": 0.42},
            {"name": "place", "steps": 7, "success": True, "stretch_max": 1.4,
             "subgoal": [0.0, 0.0, 0.05, 0.01, 0.02, 0.03, 0.0, 0.0],
             "subgoal_source": "task", "value": None},
        ]},
        {"episode": 1, "success": False, "stopped_by": "S16", "reason": "it is <lost>", "skills": [
            {"name": "reach", "steps": 10, "success": True, "stretch_max": 1.0,
             "subgoal": [0.0] * 8, "subgoal_source": "chaining", "value": 0.71},
        ]},
    ],
}  # fmt: skip


def test_the_report_tells_every_subgoal_and_value_of_the_shown_episode(tmp_path):
    path = write_report(tmp_path / "r.html", CHAINED, load_cell("bipegtransfer"))
    text = path.read_text(encoding="utf-8")
    section = text[text.index("<h2>Subgoals</h2>") :]
    for told in ("12.3, -40.0, 50.0 mm", "Second position", "1, 0", "0.42", "chaining", "task"):
        assert told in section
    assert '<td class="n low">0.42</td>' in section
    assert "A value below 0.50 counts as low" in section
    assert "0.71" not in section
    assert "it is &lt;lost&gt;" in section


def test_why_the_shown_episode_ended_early_stands_in_the_notes(tmp_path):
    path = write_report(tmp_path / "r.html", CHAINED, load_cell("bipegtransfer"), episode=1)
    notes = path.read_text(encoding="utf-8")
    notes = notes[notes.index("<h2>Notes</h2>") : notes.index("<h2>This run</h2>")]
    assert "episode 1: it is &lt;lost&gt;" in notes


REFUSED = "the plan is refused at 1.20 s: S10 on PSM1, and S05"
NAMED = "the plan is refused at 1.20 s: tip speed (S10) on PSM1, and joint speed (S05)"


def test_people_read_rules_by_their_names_wherever_a_text_has_an_id(tmp_path):
    assert labels.with_labels(REFUSED) == labels.with_labels(NAMED) == NAMED
    assert list(starts.remarks(EpisodeResult(3, refused=REFUSED))) == [f"episode 3: {NAMED}"]
    result = json.loads(json.dumps(CHAINED))
    for episode in result["episode_results"]:
        episode |= {"reason": "", "refused": REFUSED}
    path = write_report(tmp_path / "r.html", result, load_cell("bipegtransfer"), episode=1)
    page = path.read_text(encoding="utf-8")
    assert page.count(NAMED) >= 2, "in the notes and in the table of episodes"
    assert REFUSED not in page


def test_a_result_without_subgoals_has_no_such_section(page):
    assert "<h2>Subgoals</h2>" not in page


def test_values_are_told_from_lowest_to_highest_and_low_ones_counted():
    reach, place = summary.skill_rows(CHAINED)
    assert (reach.source, reach.value, reach.values_low) == ("chaining", "0.42–0.71", 1)
    assert (place.source, place.value, place.values_low) == ("task", "–", 0)
    assert summary.skill_rows(CHAINED, episode=1)[0].value == "0.71"


def test_the_plain_lines_tell_source_and_value():
    lines = list(tables.plain_lines(CHAINED))
    assert (
        "skill reach: 10 steps, 2 of 2, subgoal chaining, value 0.42–0.71, 1 below the threshold, "
        "stretch 1.00×" in lines
    )
    assert "skill place: 7 steps, done, subgoal task, stretch 1.40×" in lines
    console = Console(file=io.StringIO(), width=100, force_terminal=True)
    tables.print_tables(CHAINED, console)
    assert "0.42–0.71" in console.file.getvalue()


def test_subgoals_without_a_layout_are_plain_numbers():
    (row, _) = starts.start_rows({k: v for k, v in CHAINED.items() if k != "subgoal_layout"}, 0)
    assert row.parts == (("subgoal", "0.0123, -0.04, 0.05, 0.01, 0.02, 0.03, 1, 0"),)


@pytest.mark.parametrize(
    ("failed", "episodes", "told"),
    [(0, 200, "100.0%"), (1, 100, "99%"), (1, 101, "99.0%"), (1, 1000, "99.9%"), (1, 1, "0%")],
)
def test_no_rounding_hides_a_failure(failed, episodes, told):
    result = {"success_rate": 1.0 - failed / episodes, "episodes": episodes}
    (success,) = (fact for fact in summary.facts(result) if fact.name == "Success")
    assert success.text == told


def boundary(course="go on", value=None, threshold=0.5, angle=0.16, closed=True) -> Boundary:
    grasps = (GraspTest("PSM2", angle, -0.001, 0.07, closed),)
    return Boundary("reach", "place", grasps, value, threshold, course, "reach")


HOLDS, LOST = "PSM2 holds (jaw 0.160 rad", "PSM2 lost its hold (jaw 0.010 rad, empty -0.001 rad)"


@pytest.mark.parametrize(
    ("seen", "told"),
    [
        (boundary("safe pose", 0.49), "value 0.49 is below 0.50; the arms go to their start pose"),
        (boundary("retry", angle=0.01), f"{LOST}; reach is tried again"),
        (boundary("retry", 0.1, angle=0.01), f"{LOST}, value 0.10 is below 0.50; reach is tried"),
        (boundary("retry", angle=0.5, closed=False), "PSM2 is open (jaw 0.500 rad"),
        (boundary("retry", float("nan")), "value nan is below 0.50"),
        (boundary(value=0.5), ""),
        (boundary(value=0.1, threshold=None), ""),
        (boundary(), ""),
    ],
)
def test_a_person_hears_why_the_runtime_did_not_go_on(seen, told):
    remarks = list(starts.remarks(EpisodeResult(3, boundaries=[seen])))
    assert len(remarks) == bool(told)
    assert all(r.startswith("episode 3: before place: ") and told in r for r in remarks)


def test_a_person_hears_that_the_thing_was_off_the_plan(tmp_path):
    words = "before place: the thing is 3.9 mm off the plan; planned anew"
    assert list(starts.remarks(EpisodeResult(3, off_plan=[words]))) == [f"episode 3: {words}"]
    episode = dict(RESULT["episode_results"][0], off_plan=[words])
    result = RESULT | {"episode_results": [episode]}
    path = write_report(tmp_path / "report.html", result, load_cell("bipegtransfer"))
    assert words in path.read_text()


def test_a_report_tells_what_was_decided_between_the_skills(tmp_path):
    stopped = dict(RESULT["episode_results"][0], stopped_by="", success=False)
    stopped["boundaries"] = [asdict(boundary("safe pose", 0.49)), asdict(boundary(value=0.9))]
    result = RESULT | {"episode_results": [stopped]}
    path = write_report(tmp_path / "report.html", result, load_cell("bipegtransfer"))
    html = path.read_text(encoding="utf-8")
    assert "Between the skills" in html
    assert HOLDS in html
    assert "0.49, below 0.50" in html
    assert "before place: value 0.49 is below 0.50" in html
    assert summary.outcome(stopped) == "failed"
    stopped["boundaries"] = stopped["boundaries"][:1]
    assert summary.outcome(stopped) == "stopped before place, arms in their start pose"


@pytest.mark.parametrize("key", ["reason", "refused"])
def test_a_person_hears_why_an_episode_ended(key):
    assert list(starts.remarks(EpisodeResult(3, **{key: "lost"}))) == ["episode 3: lost"]
