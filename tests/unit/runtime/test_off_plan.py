"""Plan mode where the thing is not where the plan has it: what is left is planned anew."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from knocking import knocked, lifted
from operators import Person

from viskill_deploy.bundle.format import load_bundle
from viskill_deploy.core.errors import DriverError, MotionError, SafetyStop
from viskill_deploy.observe.starts import remarks
from viskill_deploy.runtime.attempts import Attempts
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks import load_task

ROOT = Path(__file__).resolve().parents[3]
BLOCK, RING, LETTER = (load_task(n) for n in ("bipegtransfer", "bipegboard", "matchboardpanel"))


def job(task=BLOCK, retries=0, **more) -> Job:
    return Job(load_bundle(ROOT / "policies" / f"{task.name}-viskill"), task, retries, **more)


def layout(task=BLOCK, seed=0):
    return task.sample_layout(np.random.default_rng(seed), "reference")


def slipping():
    """The block moves in PSM1's jaw once PSM1 alone holds it."""
    is_held = lifted(0, 0.02)
    return lambda driver: np.array([-0.0025, 0.0, 0.0]) if is_held(driver) else None


def going_on(job, when=slipping):
    return knocked(job, layout(job.task), when(), True)


def never():
    return lambda driver: None


pytestmark = pytest.mark.no_cover


def test_what_is_left_is_planned_anew_for_a_block_that_slipped_in_its_jaw():
    person = Person()
    result, notes, session = going_on(job(operator=person))
    (told,) = result.off_plan
    assert told.startswith("before release: the thing is 3.")
    assert told.endswith(" mm off the plan; planned anew")
    assert told in person.told
    assert list(remarks(result)) == [f"episode 0: {told}"]
    assert [(b.before, b.course) for b in notes.boundaries] == [
        (skill, "go on") for skill in ("grasp", "handover", "release")
    ]
    assert result.success
    assert (result.stopped_by, result.retries) == ("", 0)
    assert session.ledger.interventions == 0


@pytest.mark.parametrize("task", [BLOCK, RING, LETTER], ids=lambda task: task.name)
def test_nothing_is_planned_anew_where_nothing_slips(task):
    result, _, _ = going_on(job(task), never)
    assert result.success
    assert result.off_plan == []


def test_the_old_plan_goes_on_where_no_new_one_does_the_task(monkeypatch):
    made, first = [], Attempts.plan

    def once_only(*args, **more):
        made.append(args)
        if len(made) > 1:
            raise MotionError("no way")
        return first(*args, **more)

    monkeypatch.setattr(Attempts, "plan", once_only)
    result, _, _ = going_on(job())
    (told,) = result.off_plan
    assert told.endswith("; not planned anew (no way), the old plan goes on")
    assert result.skills[-1].start.skill == "release"
    assert result.skills[-1].steps > 1


def test_a_thing_that_is_back_once_it_rests_is_planned_for_already(monkeypatch):
    honest, looks = Session.seen, []

    def swinging(session):
        scene = honest(session)
        looks.append(scene)
        if len(looks) != 2:
            return scene
        moved = [
            replace(o, T_task_object=o.T_task_object + np.eye(4, 4, 3) * 0.01)
            for o in scene.objects
        ]
        return replace(scene, objects=tuple(moved))

    monkeypatch.setattr(Session, "seen", swinging)
    result, _, _ = going_on(job(), never)
    assert len(looks) == 3, "handover; release, twice"
    assert result.off_plan == []
    assert result.success


def test_without_a_new_consent_nothing_goes_on_and_the_reason_is_kept(monkeypatch):
    begun, first = [], Session.begin

    def once_only(session):
        begun.append(session)
        if len(begun) > 1:
            raise SafetyStop("nobody agreed")
        first(session)

    monkeypatch.setattr(Session, "begin", once_only)
    result, _, session = going_on(job(retreats=True))
    assert result.reason == "not gone on with: nobody agreed"
    assert (result.stopped_by, result.success) == ("", False)
    assert result.skills[-1].start.skill == "handover"
    assert session.ledger.interventions == 0
    assert not session.is_armed


def test_a_tracker_that_falls_silent_at_the_second_look_does_so_too(monkeypatch):
    honest, looks = Session.seen, []

    def silent_then(session):
        looks.append(session)
        if len(looks) == 3:
            raise DriverError("block was not seen for 3 s")
        return honest(session)

    monkeypatch.setattr(Session, "seen", silent_then)
    result, _, _ = going_on(job())
    assert (result.stopped_by, result.off_plan) == ("S16", [])
    assert result.reason == "block was not seen for 3 s"


def test_a_tracker_that_falls_silent_brings_the_arms_to_rest(monkeypatch):
    def silent(session):
        raise DriverError("block was not seen for 3 s")

    monkeypatch.setattr(Session, "seen", silent)
    result, _, _ = going_on(job(), never)
    assert result.stopped_by == "S16"
    assert result.reason == "block was not seen for 3 s"
