"""Mistakes in the table of axes that no encoder shows: each is found before any run.

The drives are stepped; what they do to the arms is what the simulator's own joints say.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from silent_recorder import SilentRecorder
from typer.testing import CliRunner

from viskill_deploy.cli.can import app
from viskill_deploy.core import data
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import DriverError, SafetyStop, ViskillError
from viskill_deploy.drivers.can.config import Bus, CanFile, load_can
from viskill_deploy.drivers.can.driver import connect
from viskill_deploy.drivers.can.simulated import SteppedCan
from viskill_deploy.drivers.can.wiring_check import demand_checked, note_checked
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.small_motion import (
    AXES,
    Nudge,
    SimulatorsWitness,
    all_nudges,
    check_small_motions,
)
from viskill_deploy.runtime.small_motion_person import PersonsWitness
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")
FILE = load_can("bipegtransfer", CELL)
NUDGES = all_nudges(CELL)
LAYOUT = load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference")
OPTIONS = WorldOptions(period_s=0.01)


def checked(
    nudges: list[Nudge],
    wiring: CanFile | None = None,
    cell: CellDescription = CELL,
    really: CellDescription | None = None,
) -> list[Nudge]:
    """The nudges that went well, with drives or instruments that are not what the files say."""
    driver = SteppedCan(cell, FILE, OPTIONS, really=really, wiring=wiring)
    driver.connect()
    done: list[Nudge] = []
    line = Line(cell, driver.period_s, speed=0.5)
    with Session(cell, driver, line, SilentRecorder()) as session:
        driver.reset(LAYOUT)
        check_small_motions(session, SimulatorsWitness(driver.side.truth), nudges, done.append)
    return done


def of(*joints: str) -> list[Nudge]:
    """The nudges of these joints of PSM1."""
    return [nudge for nudge in NUDGES if nudge.arm == 0 and AXES[nudge.axis] in joints]


def rewired(axes: dict[str, dict[str, object]]) -> CanFile:
    """The file with some axes of PSM1 changed, by joint."""
    first: Bus = FILE.bus[0]
    changed = [axis.model_copy(update=axes.get(axis.joint, {})) for axis in first.axis]
    bus = first.model_copy(update={"axis": tuple(changed)})
    return FILE.model_copy(update={"bus": (bus, *FILE.bus[1:])})


def with_tool(folder: Path, tool: str) -> CellDescription:
    """The cell with Si arms that carry an instrument."""
    text = data.find("robots/cells/bipegtransfer.toml").read_text()
    text = text.replace("psm_classic", "psm_si").replace("large_needle_driver_400006", tool)
    path = folder / f"{tool}.toml"
    path.write_text(text)
    return load_cell(path)


def test_arms_that_are_wired_as_the_file_says_do_as_they_are_told() -> None:
    nudges = [*of(*AXES), *(n for n in NUDGES if n.arm == 1 and n.axis in {0, 3})]
    assert [(n.arm, n.axis) for n in checked(nudges)] == [(n.arm, n.axis) for n in nudges]


@pytest.mark.parametrize(
    ("joint", "named"),
    [
        ("yaw", r"PSM1 yaw: .*gate stepped in \(S11\)"),  # its mirror image is not in the workspace
        ("pitch", r"PSM1 pitch, told to go by \+0\.05 rad, went the other way: by -0\.05 rad"),
        ("insertion", "PSM1 insertion has no room .* passes a joint limit"),  # so it reads
        ("roll", "PSM1 roll, .* went the other way"),
        ("wrist_pitch", "PSM1 wrist_pitch, .* moved PSM1 wrist_pitch by -0.2 rad and"),
        ("wrist_yaw", "PSM1 wrist_yaw, .* moved PSM1 jaw"),
        ("jaw", "PSM1 jaw, .* moved PSM1 wrist_yaw"),
    ],
)
def test_a_wrong_sign_is_found_at_its_axis(joint: str, named: str) -> None:
    axis = FILE.bus[0].axis[AXES.index(joint)]
    with pytest.raises(ViskillError, match=named):
        checked(of(joint), rewired({joint: {"sign": -axis.sign}}))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("yaw", "pitch"),
        ("yaw", "roll"),
        ("roll", "wrist_pitch"),
        ("wrist_pitch", "wrist_yaw"),
        ("wrist_yaw", "jaw"),
    ],
)
def test_swapped_axes_are_found(one: str, other: str) -> None:
    nodes = {axis.joint: axis.node_id for axis in FILE.bus[0].axis}
    swapped = {one: {"node_id": nodes[other]}, other: {"node_id": nodes[one]}}
    with pytest.raises((DriverError, SafetyStop), match=f"PSM1 ({one}|{other})"):
        checked(of(one, other), rewired(swapped))


def test_a_wrong_number_of_counts_is_found() -> None:
    counts = FILE.bus[0].axis[0].scale
    with pytest.raises(DriverError, match=r"PSM1 yaw, .* not far enough: by \+0\.0333 rad"):
        checked(of("yaw"), rewired({"yaw": {"counts_per_rad": 1.5 * counts}}))


@pytest.mark.parametrize("is_geared", [True, False])
def test_the_wrong_one_of_two_variants_of_an_instrument_is_found(
    tmp_path: Path, is_geared: bool
) -> None:
    plain = with_tool(tmp_path, "large_needle_driver_420006")
    geared = with_tool(tmp_path, "large_needle_driver_420006_geared")
    cell, really = (plain, geared) if is_geared else (geared, plain)
    assert checked(of("roll", "jaw"), cell=cell, really=cell) == of("roll", "jaw")
    with pytest.raises(DriverError, match=r"PSM1 roll, .* went the other way"):
        checked(of("roll"), cell=cell, really=really)


def test_the_matrix_of_another_instrument_is_found(tmp_path: Path) -> None:
    cell = with_tool(tmp_path, "large_needle_driver_420006")
    really = with_tool(tmp_path, "prograsp_forceps_420093")
    matrices = [c.arms[0].arm.actuator_to_joint for c in (cell, really)]
    assert np.abs(matrices[0] - matrices[1]).max() > 0.2
    with pytest.raises(DriverError, match=r"PSM1 (roll|wrist_pitch|wrist_yaw|jaw), told"):
        checked(of("roll", "wrist_pitch", "wrist_yaw", "jaw"), cell=cell, really=really)


class Watcher:
    """A person who gives one answer after another; the first look finds none."""

    def __init__(self, *answers: str) -> None:
        self.answers, self.questions = list(answers), list[str]()
        self.is_looking = False

    def tell(self, note: str) -> None:
        raise AssertionError(note)

    def ask(self, question: str) -> None:
        self.questions.append(question)

    def answer(self) -> str | None:
        self.is_looking = not self.is_looking
        return None if self.is_looking else self.answers.pop(0)


def watched(watcher: Watcher, nudges: list[Nudge]) -> None:
    driver = SteppedCan(CELL, FILE, OPTIONS)
    driver.connect()
    line = Line(CELL, driver.period_s, speed=0.5)
    with Session(CELL, driver, line, SilentRecorder()) as session:
        driver.reset(LAYOUT)
        check_small_motions(session, PersonsWitness(watcher), nudges)


def test_a_person_is_told_what_there_is_to_see_and_only_a_yes_is_one() -> None:
    watcher = Watcher("y", "Yes ", "y", "yes")
    watched(watcher, of("yaw", "insertion", "roll", "jaw"))
    yaw, insertion, roll, jaw = watcher.questions
    assert yaw.startswith("PSM1 yaw: the end of its jaw moves")
    assert re.search(r"\d mm to -z of the task frame", insertion)  # deeper is down
    assert "turns clockwise by 11 degrees, seen along its shaft towards the tip" in roll
    assert "its jaw opens by 11 degrees" in jaw
    with pytest.raises(DriverError, match=r"PSM1 pitch, .* says who watched it"):
        watched(Watcher("what?"), of("roll", "pitch"))


def test_arms_are_not_connected_for_a_run_before_their_axes_were_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VISKILL_STATE", str(tmp_path))
    with pytest.raises(DriverError, match="run `viskill can check bipegtransfer`"):
        connect(CELL, FILE)
    note = note_checked(CELL, FILE, "today")
    demand_checked(CELL, FILE)
    other = rewired({"yaw": {"sign": -1}})
    si = with_tool(tmp_path, "large_needle_driver_420006")
    for cell, file in ((CELL, other), (si, FILE)):
        with pytest.raises(DriverError, match="have not been tried"):
            demand_checked(cell, file)
    note.write_text(note.read_text().replace("today", "never"))
    with pytest.raises(DriverError, match="have not been tried"):
        demand_checked(CELL, FILE)
    note_checked(CELL, other, "today").rename(note)
    with pytest.raises(DriverError, match="is not about CAN file"):
        demand_checked(CELL, FILE)


def test_the_command_tries_every_axis_of_simulated_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viskill_deploy.cli.can.all_nudges", lambda cell: of("pitch"))
    output = str(tmp_path / "run")
    done = CliRunner().invoke(app, ["check", "bipegtransfer", "--simulated", "--output", output])
    assert done.exit_code == 0, done.output
    assert "PSM1 pitch: as told (+0.05 rad)" in done.output
    assert "nothing is noted" in done.output
    assert (tmp_path / "run" / "recording").is_dir()
