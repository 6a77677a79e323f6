"""Touched points: what is written down, what is refused, and that nothing is ever sent."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from measured_arm import TYPICAL

from viskill_deploy.calibrate.fit import fit_arm
from viskill_deploy.calibrate.landmarks import Landmark, board_landmarks, choose_landmarks
from viskill_deploy.calibrate.measurements import load
from viskill_deploy.calibrate.resting import Rested, rested
from viskill_deploy.calibrate.simulated_hand import HandOptions, SimulatedHand
from viskill_deploy.calibrate.touch_book import touched
from viskill_deploy.calibrate.touching import touch
from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError, DriverError, Interrupted
from viskill_deploy.core.types import ArmState, CellState
from viskill_deploy.drivers.crtk.inproc import Inproc
from viskill_deploy.drivers.crtk.listening import listening
from viskill_deploy.drivers.crtk.simulated import SteppedCrtk
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")
MARKS = [choose_landmarks(CELL, arm, board_landmarks(CELL), 9) for arm in range(2)]
TRUTH = (replace(TYPICAL, delay_s=0.0), ArmErrors(base_translation_m=(0.003, 0.0, -0.002)))
WORLD = WorldOptions(truth=TRUTH)
EXACT = HandOptions(noise_m=0.0)


class Said(SimulatedHand):
    """Says something else than "it is there" at some of the questions."""

    def __init__(self, answers: dict[int, str] | None = None) -> None:
        super().__init__(CELL, WORLD, EXACT)
        self.answers, self.asked = answers or {}, list[str]()

    def bring(self, arm: int, landmark: Landmark, words: str) -> str:
        self.asked.append(words)
        said = self.answers.get(len(self.asked), "")
        if said == "pull the plug":
            raise KeyboardInterrupt
        return said or super().bring(arm, landmark, words)


def test_points_that_are_touched_find_the_arm(tmp_path: Path) -> None:
    person = Said()
    touch(CELL, person, person, MARKS, tmp_path)
    m = load(tmp_path / "PSM2.csv")
    assert m.point_m == CELL.arms[1].arm.jaw.finger_length_m
    assert len(m) == 9
    fit = fit_arm(CELL.arms[1], m)
    np.testing.assert_allclose(fit.errors.base_translation_m, (0.003, 0.0, -0.002), atol=2e-5)
    assert fit.rms_m < 1e-6
    assert len(person.asked) == 18


def test_what_was_touched_before_the_plug_was_pulled_is_kept(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        person = Said({14: "pull the plug"})
        touch(CELL, person, person, MARKS, tmp_path)
    before = load(tmp_path / "PSM2.csv")
    assert len(before) == 4
    (tmp_path / "PSM2.new").write_text("half of a fi")  # the plug was pulled while it was written
    person = Said()
    touch(CELL, person, person, MARKS, tmp_path)
    assert len(person.asked) == 5
    assert touched(tmp_path / "PSM2.csv") == [mark.name for mark in MARKS[1]]
    np.testing.assert_array_equal(load(tmp_path / "PSM2.csv").joints[:4], before.joints)


def test_a_person_skips_stops_and_touches_again(tmp_path: Path) -> None:
    names = [mark.name for mark in MARKS[0]]
    person = Said({2: "s", 4: names[0], 5: "what?", 7: "q"})
    with pytest.raises(Interrupted, match=r"PSM1\.csv is kept"):
        touch(CELL, person, person, MARKS, tmp_path)
    assert touched(tmp_path / "PSM1.csv") == [names[2], names[0]]  # the first one, again, is last
    assert any("'what?' is none of these" in note for note in person.notes)


def test_a_slip_is_asked_about_and_touched_again(tmp_path: Path) -> None:
    class Slipping(Said):
        def bring(self, arm: int, landmark: Landmark, words: str) -> str:
            slips = len(self.asked) == 3
            self._options = replace(EXACT, slip_share=float(slips), slip_m=0.006)
            return super().bring(arm, landmark, words)

    person = Slipping()
    touch(CELL, person, person, MARKS, tmp_path)
    (question,) = [words for words in person.asked if "off what the others say" in words]
    assert MARKS[0][3].name in question
    assert fit_arm(CELL.arms[0], load(tmp_path / "PSM1.csv")).rms_m < 5e-4
    person = Slipping({10: "k"})  # they know better
    touch(CELL, person, person, MARKS, tmp_path / "kept")
    assert len(person.asked) == 19


def test_touches_of_another_cell_are_not_mixed_in(tmp_path: Path) -> None:
    person = Said({1: "q"})
    (tmp_path / "PSM1.csv").write_text("# touch: cell bipegboard\n")
    with pytest.raises(CalibrationError, match="name another folder"):
        touch(CELL, person, person, MARKS, tmp_path)


class Spoiled(SimulatedHand):
    """Readings are changed on their way."""

    change: Callable[[ArmState, int], ArmState] = staticmethod(lambda state, n: state)
    readings = 0

    def state(self) -> CellState:
        self.readings += 1
        state = super().state()
        return replace(state, arms=tuple(self.change(arm, self.readings) for arm in state.arms))


def moving(state: ArmState, n: int) -> ArmState:
    q = np.array(state.measured_jp)
    q[2] += 5e-5 * n
    return replace(state, measured_jp=tuple(q.tolist()))


def rolling(state: ArmState, n: int) -> ArmState:
    q = np.array(state.measured_jp)
    q[3] += 0.001 * n
    return replace(state, measured_jp=tuple(q.tolist()))


def changed(**what: Any) -> Callable[[ArmState, int], ArmState]:
    return lambda state, n: replace(state, **what)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (moving, r"PSM1 moves by 1\.. mm"),
        (rolling, "PSM1 moves"),
        (changed(valid=False), "does not know where it is"),
        (changed(measured_jp=(np.nan,) * 6), "does not know where it is"),
        (changed(jaw_measured_jp=0.4), "jaw is open by 0.40 rad"),
        (changed(tool="mega_needle_driver_400194"), "has mega_needle_driver_400194"),
        (changed(stamp_s=0.5), "s old"),
        (lambda state, n: replace(state, stamp_s=state.stamp_s - n % 5 * 0.01), "said only"),
    ],
)
def test_an_arm_that_does_not_rest_is_no_measurement(
    change: Callable[[ArmState, int], ArmState], words: str
) -> None:
    person = Spoiled(CELL, WorldOptions(joint_noise_rad=2e-4, joint_noise_m=2e-5))
    person.bring(0, MARKS[0][0], "")
    seen = rested(person, CELL.arms[0], 0)
    assert isinstance(seen, Rested)
    np.testing.assert_allclose(seen.joints, person.joints[0], atol=2e-4)
    person.change = change
    refused = rested(person, CELL.arms[0], 0)
    assert isinstance(refused, str)
    assert re.search(words, refused), refused


def test_arms_over_crtk_are_only_listened_to() -> None:
    robot = SteppedCrtk(CELL)
    robot.connect()  # somebody else's program, which has switched the arms on
    robot.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    lines = robot.exchange.lines
    spoken = {topic: len(line.mouths) for topic, line in lines.items()}
    driver = listening(CELL, Inproc(robot.exchange), robot.clock)
    assert "home it" in str(rested(driver, CELL.arms[1], 1))
    robot.enable()
    robot.home()
    seen = rested(driver, CELL.arms[1], 1)
    assert isinstance(seen, Rested), seen
    np.testing.assert_allclose(seen.joints, robot.world.measured(1).jp, atol=1e-4)
    for forbidden in (driver.hold, driver.disable):
        with pytest.raises(DriverError, match="only listened to"):
            forbidden()
    driver.close()
    assert {topic: len(line.mouths) for topic, line in lines.items()} == spoken
    assert robot.state().arms[1].operating_state == "ENABLED"
    robot.close()
