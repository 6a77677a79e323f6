"""Between two skills: what the jaws tell, what is decided, and where the arms go then."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from knocking import KnockingDriver, Notes, knocked, lifted
from scripted import scripted
from untrained import write_untrained

from viskill_deploy.bundle.format import load_bundle
from viskill_deploy.core.errors import SafetyStop
from viskill_deploy.core.types import CellState, FloatArray, SkillStart
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.runtime.boundaries import Boundaries, Job, way_back
from viskill_deploy.runtime.jaws import CLOSING_RAD_S, grasp_test, is_undecided, measure_empty_jaws
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.moves import axes_of, go_through, go_to_start_pose, run_motion
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks import load_task

ROOT = Path(__file__).resolve().parents[3]
BLOCK, RING, LETTER = (load_task(n) for n in ("bipegtransfer", "bipegboard", "matchboardpanel"))
ASIDE = np.array([0.02, -0.015, 0.0])


def layout(task, seed=0):
    return task.sample_layout(np.random.default_rng(seed), "reference")


def trained(task, retries=1):
    return Job(load_bundle(ROOT / "policies" / f"{task.name}-viskill"), task, retries)


def of_script(task, folder: Path, retries: int) -> Job:
    return Job(scripted(write_untrained(folder / "scripted", task), task), task, retries)


def once(is_time, way: FloatArray):
    return lambda driver: way if is_time(driver) else None


@pytest.mark.parametrize("task", [BLOCK, RING, LETTER], ids=lambda task: task.name)
def test_every_task_says_what_its_jaws_hold(task):
    arms = len(task.cell.arms)
    assert all(len(skill.holds) in (0, arms) for skill in task.skills)
    assert any(any(skill.holds) for skill in task.skills)
    assert not any(task.skills[-1].holds), "a task ends with everything let go"


NONE, FIRST, SECOND, BOTH = (False, False), (True, False), (False, True), (True, True)


@pytest.mark.parametrize(
    ("task", "ended", "held", "skill"),
    [
        (BLOCK, 0, NONE, "grasp"),
        (BLOCK, 0, SECOND, "grasp"),
        (BLOCK, 0, FIRST, ""),
        (BLOCK, 1, NONE, "grasp"),
        (BLOCK, 1, SECOND, "handover"),
        (BLOCK, 1, BOTH, "handover"),
        (BLOCK, 1, FIRST, ""),
        (BLOCK, -1, NONE, ""),
        (LETTER, 0, (False,), "pull"),
        (LETTER, 1, (False,), "grasp"),
        (LETTER, 1, (True,), "grasp"),
        (LETTER, 2, (True,), "release"),
    ],
)
def test_the_way_back_leads_to_the_latest_skill_that_can_begin(task, ended, held, skill):
    assert way_back(task.skills, ended, held) == skill


def test_a_block_that_is_lost_is_noticed_and_the_arms_go_to_their_start_pose():
    when = once(lifted(1, 0.02), ASIDE)
    result, notes, session = knocked(trained(BLOCK, retries=0), layout(BLOCK), when)
    assert [(b.after, b.before, b.course) for b in notes.boundaries] == [
        ("", "grasp", "go on"),
        ("grasp", "grasp", "safe pose"),
    ]
    (grasp,) = notes.boundaries[1].grasps
    assert grasp.arm == "PSM2"
    assert not grasp.holds
    assert not result.success
    assert (result.stopped_by, result.retries) == ("", 0)
    assert session.ledger.interventions == 0
    np.testing.assert_allclose(notes.sent[-1], notes.sent[0], atol=1e-3)


def test_a_block_that_falls_back_on_its_peg_is_taken_again():
    scene = layout(BLOCK)
    start = scene.pose(scene.active)[:3, 3]

    def back(driver: KnockingDriver) -> FloatArray | None:
        if not is_up(driver):
            return None
        return (
            start + np.array([0.0, 0.0, 0.003]) - driver.world.active_object().T_task_object[:3, 3]
        )

    is_up = lifted(1, 0.02)
    result, notes, _ = knocked(trained(BLOCK), scene, back)
    assert [(b.before, b.course) for b in notes.boundaries] == [
        ("grasp", "go on"),
        ("grasp", "retry"),
        *((skill, "go on") for skill in ("grasp", "handover", "release")),
    ]
    assert result.success
    assert (result.stopped_by, result.retries) == ("", 1)


@pytest.mark.no_cover
def test_in_plan_mode_a_block_lost_in_the_handover_is_noticed_before_the_release():
    notes, cycles = Notes(), []

    def late(driver: KnockingDriver) -> FloatArray | None:
        if len(notes.boundaries) == 2:
            cycles.append(driver.clock.now())
        return ASIDE if len(cycles) > 250 else None

    result, _, session = knocked(trained(BLOCK, 0), layout(BLOCK), late, True, notes)
    assert [b.course for b in notes.boundaries][-1] == "safe pose"
    assert notes.boundaries[-1].before == "handover"
    assert notes.boundaries[-1].lost
    assert not result.success
    assert session.ledger.interventions == 0
    np.testing.assert_allclose(notes.sent[-1], notes.sent[0], atol=1e-3)


@pytest.mark.no_cover
def test_a_letter_that_is_lost_out_of_reach_is_not_tried_again_and_the_reason_is_told(tmp_path):
    when = once(lifted(0, 0.01), np.array([0.05, 0.0, 0.0]))
    result, notes, session = knocked(of_script(LETTER, tmp_path, 1), layout(LETTER), when)
    assert [(b.before, b.course) for b in notes.boundaries] == [
        ("pull", "go on"),
        ("grasp", "go on"),
        ("grasp", "retry"),
    ]
    assert [len(b.grasps) for b in notes.boundaries] == [0, 0, 1]
    assert session.ledger.interventions == 0
    assert not result.success
    assert result.reason.startswith("not tried again: ")
    assert result.retries == 0
    np.testing.assert_allclose(notes.sent[-1], notes.sent[0], atol=1e-3)


def test_a_ring_that_is_lost_on_its_way_is_noticed_before_the_next_skill():
    when = once(lifted(1, 0.002), np.array([0.02, 0.0, 0.0]))
    result, notes, session = knocked(trained(RING, retries=0), layout(RING), when)
    assert notes.boundaries[-1].course == "safe pose"
    assert [grasp.arm for grasp in notes.boundaries[-1].lost] == ["PSM2"]
    assert session.ledger.interventions == 0
    assert not result.success


@pytest.fixture
def standing():
    driver, notes = KnockingDriver(BLOCK.cell), Notes()
    driver.connect()
    driver.reset(layout(BLOCK))
    with Session(BLOCK.cell, driver, Line(BLOCK.cell, driver.period_s), notes) as session:
        session.make_ready()
        yield session, driver, notes


def test_the_empty_angle_is_measured_without_a_motion_where_the_jaws_are_closed(standing):
    session, _, notes = standing
    assert measure_empty_jaws(session, EpisodeResult(0))
    assert session.empty_jaw_rad == pytest.approx((0.0, 0.0), abs=0.01)
    assert notes.sent == []


def opened(session: Session) -> None:
    session.begin()
    here = waypoint_at(session.cell, axes_of(session.read()))
    session.go_to(replace(here, jaw=(0.4, 0.5), may_open_jaw=(True, True)), last=True)
    assert run_motion(session)
    session.finish()


def test_open_jaws_are_closed_through_line_and_gate_before_they_are_measured(standing):
    session, _, notes = standing
    opened(session)
    sent = len(notes.sent)
    assert measure_empty_jaws(session, EpisodeResult(0))
    assert session.empty_jaw_rad == pytest.approx((0.0, 0.0), abs=0.01)
    assert len(notes.sent) > sent
    assert notes.sent[-1][6] == pytest.approx(-0.349, abs=1e-3)


def test_a_gate_that_steps_in_while_jaws_are_closed_counts(standing):
    session, driver, notes = standing
    opened(session)
    sent = len(notes.sent)
    driver.when = lambda _: driver.say(estop=True) if len(notes.sent) > sent + 5 else None
    result = EpisodeResult(0)
    assert not measure_empty_jaws(session, result)
    assert result.stopped_by == "S23"
    assert session.empty_jaw_rad == ()


@pytest.mark.parametrize("angle", [0.071, -0.071, math.nan])
def test_a_jaw_that_does_not_close_to_about_zero_is_refused_by_name(standing, angle):
    session, driver, _ = standing
    honest = driver.state

    def squeezing() -> CellState:
        state = honest()
        return replace(state, arms=(replace(state.arms[0], jaw_measured_jp=angle), state.arms[1]))

    driver.state = squeezing
    with pytest.raises(SafetyStop, match=r"PSM1's jaw closes to .* take out what it holds"):
        measure_empty_jaws(session, EpisodeResult(0))


def test_a_jaw_that_closes_still_gets_time_until_it_tells(standing):
    session, driver, _ = standing
    assert measure_empty_jaws(session, EpisodeResult(0))
    session.begin()
    driver.world.data.qpos[driver.world.arm_qpos[1, 6:]] = 0.09  # as if the block had just gone
    while session.read().arms[1].jaw_measured_jv > -CLOSING_RAD_S:
        assert session.cycle()
    arm = session.read().arms[1]
    test = grasp_test(session, 1, arm)
    assert test.holds, "by its angle alone"
    assert is_undecided(arm, test)
    assert not is_undecided(replace(arm, jaw_measured_jv=-0.2), test)
    assert is_undecided(replace(arm, jaw_measured_jv=math.nan), test)
    start = SkillStart("handover", np.zeros(8), "scripted")
    seen = Boundaries(session, trained(BLOCK), EpisodeResult(0)).before(start)
    assert seen is not None
    assert seen.lost
    assert session.read().arms[1].jaw_measured_jv == pytest.approx(0.0, abs=0.01)
    session.finish()


def test_arms_go_up_before_they_go_across_and_a_jaw_that_holds_stays_as_it_is(standing):
    session, _, notes = standing
    session.begin()
    here = waypoint_at(session.cell, axes_of(session.read()))
    low = [np.array(pose) for pose in here.T_task_tip]
    for pose in low:
        pose[:3, 3] += (0.015, 0.0, -0.015)
    below = replace(here, T_task_tip=tuple(low), jaw=(-0.2, -0.2), may_open_jaw=(True, True))
    assert go_through(session, [here, below])
    sent = len(notes.sent)
    assert go_to_start_pose(session, (True, False))
    way = np.array([pose[:3, 3] for pose in session.tips(session.read())])
    np.testing.assert_allclose(way, [T[:3, 3] for T in here.T_task_tip], atol=5e-4)
    assert (notes.sent[-1][6], notes.sent[-1][13]) == pytest.approx((-0.2, -0.349066), abs=1e-6)
    arm = Arm(BLOCK.cell.arms[0].arm)
    back = BLOCK.cell.arms[0].T_task_base
    path = np.array([(back @ arm.forward(row[:6]).homogeneous)[:3, 3] for row in notes.sent[sent:]])
    aside = np.abs(path[:, 0] - low[0][0, 3]) > 0.002
    assert path[aside][:, 2].min() > here.T_task_tip[0][2, 3] - 0.001
    session.finish()
