"""Against the clock the policy is asked before a step ends, and the arms never wait for it."""

from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest
from chaining import SHIPPED

from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.runtime import session as session_module
from viskill_deploy.runtime import thinking
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.episodes import LEAD_S, from_start_pose
from viskill_deploy.runtime.line import Coming, Line
from viskill_deploy.runtime.preflight import prepare
from viskill_deploy.runtime.session import Session

pytestmark = pytest.mark.no_cover


class Notebook:
    """A recorder that keeps when each step of a skill began, and nothing else."""

    alive = True

    def __init__(self) -> None:
        self.began: list[tuple[str, int, float]] = []

    def cycle(self, *args: object) -> None:
        pass

    def scene(self, *args: object) -> None:
        pass

    def mark(
        self, now: float, episode: int, skill: str, step: int, note: str = "", **what: object
    ) -> None:
        if skill and "boundary" not in what:
            self.began.append((skill, step, now))


def asked(question, delay_s: float = 0.0) -> Future:
    """The answer of a thread that is done at once, so that the run is the same every time."""
    answer: Future = Future()
    answer.set_result(question())
    return answer


def test_every_step_of_a_skill_but_its_first_is_planned_while_the_arms_go_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(thinking, "_asked", asked)
    nothing = SimpleNamespace(
        **dict.fromkeys(("settle", "prepare", "pause", "release"), lambda **_: None)
    )
    monkeypatch.setattr(session_module, "realtime", nothing)
    prepared = prepare(SHIPPED)
    driver, notebook = LoopbackDriver(prepared.cell), Notebook()
    driver.connect()
    driver.reset(prepared.task.sample_layout(np.random.default_rng(3), "reference"))
    line = Line(prepared.cell, driver.period_s)
    training = prepared.bundle.manifest.training_range.seen
    session = Session(prepared.cell, driver, line, notebook, training)
    driver.capabilities = type(driver.capabilities)(True, False, True, True)
    ahead, now = list[float](), list[float]()
    plan = Coming.plan

    def noted(coming: Coming, *args):
        (now if line.arrived else ahead).append(line.remaining_s)
        return plan(coming, *args)

    monkeypatch.setattr(Coming, "plan", noted)
    with session:
        job = Job(prepared.bundle, prepared.task)
        result = from_start_pose(session, "closed-loop", job, np.random.default_rng(0), 0)
    assert result.success
    assert session.overruns == 0
    steps = [skill.steps for skill in result.skills]
    assert len(ahead) == sum(steps) - len(steps)
    assert max(ahead) <= LEAD_S + 1e-9
    assert len(now) >= len(steps)  # and what brings the arms to rest between the skills
    times = {(skill, step): at for skill, step, at in notebook.began}
    gaps = [at - times[skill, step - 1] for (skill, step), at in times.items() if step]
    stretched = max(skill.stretch_max for skill in result.skills)
    assert min(gaps) == pytest.approx(0.2)
    assert max(gaps) <= 0.2 * stretched + driver.period_s
