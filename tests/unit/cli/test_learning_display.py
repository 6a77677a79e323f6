import io
from pathlib import Path

from rich.console import Console

from viskill_deploy.cli.learning_display import StageBars, SweepBars
from viskill_deploy.train.results import Unit
from viskill_deploy.train.sweep import Outcome

UNIT = Unit("bipegtransfer", "viskill", 0)


def console(terminal: bool) -> tuple[Console, io.StringIO]:
    text = io.StringIO()
    return Console(file=text, force_terminal=terminal, width=120, color_system=None), text


def test_a_stage_has_a_bar_with_its_rates_and_is_full_when_it_is_over() -> None:
    shown, text = console(terminal=True)
    with StageBars(shown) as bars:
        bars.watch({"stage": "demos", "done": True})
        bars.watch({"stage": "grasp", "round": 1.0, "rounds": 8, "exploring": 0.25})
        bars.say("stage grasp, round 1")
        middle = text.getvalue()
        bars.watch({"stage": "grasp", "done": True})  # learned before all rounds were needed
    assert "stage grasp, round 1" in middle
    assert "8/8" in text.getvalue()
    assert "exploring 0.25" in text.getvalue()


def test_what_is_no_terminal_gets_lines_alone() -> None:
    shown, text = console(terminal=False)
    with StageBars(shown) as bars:
        bars.watch({"stage": "grasp", "round": 0.0, "rounds": 8})
        bars.say("[bold] is no markup here")
    assert text.getvalue() == "[bold] is no markup here\n"


def test_a_sweep_shows_what_runs_and_says_what_is_over() -> None:
    shown, text = console(terminal=True)
    with SweepBars(shown, 2) as bars:
        bars.started(UNIT, 1)
        bars.says(UNIT, "stage grasp [3]")
        bars.started(UNIT, 2)
        bars.over(Outcome(UNIT, "finished", 2, 61.0, Path("log")))
        bars.over(Outcome(Unit("bipegtransfer", "dex", 0), "skipped", 0, 0.0, Path("log")))
    said = text.getvalue()
    assert "bipegtransfer-viskill-seed0: died, started once more" in said
    assert "bipegtransfer-viskill-seed0: finished after 61 s" in said
    assert "bipegtransfer-dex-seed0: skipped" in said
    assert "2/2" in said
