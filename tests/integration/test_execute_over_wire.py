"""A bundle is executed on arms that speak CRTK from a process of their own, against the clock."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import lab
import numpy as np
import pytest
from lab import AtPedal, Kept, Lab

from viskill_deploy.core.errors import Interrupted
from viskill_deploy.runtime.figures import Outcome
from viskill_deploy.sim.tasks.base import load_task

WIRES = [
    "dds",
    pytest.param("ros2", marks=pytest.mark.ros2),
    pytest.param("ros1", marks=pytest.mark.ros1),
]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.quiet,
    pytest.mark.timeout(1200),
    pytest.mark.parametrize("wire", WIRES),
]
TRIALS = 5
ATTEMPTS = 2
"""In 17 of 20 runs against the clock the task has to be done (`make wire`)."""

ALL = ["grasp", "handover", "release"]


def until_the_machine_is_in_time(arms: Lab, run: Callable[[], Outcome]) -> Outcome:
    """Once more where a machine that was too late has ended it; a HOLD for that is resumed."""
    for _ in range(TRIALS):
        arms.put_things_back()
        outcome = run()
        (result,) = outcome.figures["episode_results"]
        if not result["stopped_by"] or isinstance(outcome.failure, Interrupted):
            assert result["refused"] == ""
            return outcome
    pytest.fail(f"{TRIALS} runs were ended by the gate; make the machine less busy")


def whole_task(arms: Lab) -> bool:
    """Runs it, a person saying yes before every skill; whether the block is where it is to be."""
    until_the_machine_is_in_time(
        arms, lambda: arms.execute(AtPedal(arms), Kept(), looks=True, stops="skill")
    )
    arms.server.truth()  # looks anew
    return load_task(lab.CELL).success(arms.server.active_object(), arms.server.scene())


def skills(outcome: Outcome) -> list[str]:
    (result,) = outcome.figures["episode_results"]
    return [skill["name"] for skill in result["skills"]]


def test_a_run_is_held_when_the_pedal_is_let_go_resumed_and_ended_by_a_person(
    tmp_path: Path, wire: str
) -> None:
    with lab.opened(tmp_path, wire) as arms:
        kept = Kept()

        def grasp() -> Outcome:
            kept.events = {150: partial(arms.say, False)}
            person = AtPedal(arms, "next: handover")
            return arms.execute(person, kept, mode="closed-loop", stops="skill")

        run = until_the_machine_is_in_time(arms, grasp)
        assert isinstance(run.failure, Interrupted)
        assert "S22" in run.figures["episode_results"][0]["resumed"]
        assert set(skills(run)) == {"grasp"}
        way, heard = run.figures["on_the_way"], arms.server.heard()["heard"]
        assert 0.0 < way["echo_age_p50_ms"] < way["echo_age_p99_ms"]
        assert heard > 500
        last = kept.passed[-1]
        for arm, sent in zip(arms.server.truth().arms, last, strict=True):
            assert max(map(abs, arm.measured_jv)) < 1e-2
            assert arm.setpoint_jp == pytest.approx(sent.jp, abs=5e-3)


def test_all_stages_from_the_rehearsal_to_the_whole_task(tmp_path: Path, wire: str) -> None:
    with lab.opened(tmp_path, wire, "dvrk") as arms:
        rehearsal = until_the_machine_is_in_time(
            arms, lambda: arms.execute(AtPedal(arms), Kept(), looks=True, is_rehearsal=True)
        )
        assert skills(rehearsal) == ALL
        assert arms.server.heard()["heard"] == 0, "nothing was sent"

        kept, person = Kept(), AtPedal(arms)
        air = until_the_machine_is_in_time(
            arms, lambda: arms.execute(person, kept, lift_m=0.015, stops="waypoint")
        )
        assert skills(air) == ALL
        assert sum(question.startswith("next:") for question in person.asked) > 10
        assert np.isfinite([s.jp for row in kept.passed for s in row]).all()

        assert any(whole_task(arms) for _ in range(ATTEMPTS))
