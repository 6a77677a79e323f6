"""What happens where one skill ends and the next one begins.

Two questions are asked there: do the jaws hold what they should, and is success likely enough? If
not, the runtime does not go on. It tries again from the latest skill that can begin with what the
jaws hold now, as often as it was told to; then it takes the arms to their start pose, and stops.
Plan mode asks a third one, whether the thing is where the plan has it (`attempts.renewed`).
A jaw that loses its hold in the middle of a skill ends the skill at once: a policy that runs after
a thing that has fallen does what it never did in training.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from viskill_deploy.bundle.format import Bundle
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import Boundary, GraspTest, SkillStart
from viskill_deploy.runtime.jaws import SETTLE_S, grasp_test, is_undecided
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.moves import go_to_start_pose, halt, rest
from viskill_deploy.runtime.operator import Operator
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import SkillSpec, Task

Stops = Literal["nowhere", "skill", "waypoint"]
"""Before every skill, or before every waypoint, the arms rest until the operator goes on."""


@dataclass(frozen=True, slots=True)
class Job:
    """What an episode runs: a bundle on its task.

    Attributes:
        retries: how often a skill may be tried again where a grasp was lost or the value is low;
            after that, the arms go to their start pose.
        ground: the cell on whose board the plan is made, where it is run in the air above it.
        has_things: whether there is something to hold and to look at; if not, nobody asks the jaws
            or the value, and every skill follows the one before.
        stops: where the operator is asked to go on.
        operator: who may resume after a HOLD, and goes on at the stops; None for nobody.
        retreats: whether the arms go back to their start pose at the end.
    """

    bundle: Bundle
    task: Task
    retries: int = 1
    ground: CellDescription | None = None
    has_things: bool = True
    stops: Stops = "nowhere"
    operator: Operator | None = None
    retreats: bool = False

    @property
    def threshold(self) -> float | None:
        """Value below which the runtime does not go on; None where the bundle tells no value."""
        value = self.bundle.manifest.value
        return None if value is None else value.threshold


def holds_of(skills: Sequence[SkillSpec], index: int, arms: int) -> tuple[bool, ...]:
    """Which jaws hold something when a skill has ended; none before the first (index -1)."""
    return (skills[index].holds if index >= 0 else ()) or (False,) * arms


def way_back(skills: Sequence[SkillSpec], ended: int, held: Sequence[bool]) -> str:
    """The latest skill, not after the one that has ended, which can begin as the jaws are now.

    A skill can when the jaws hold all that it begins with, and nothing but that and what it is to
    take itself: a jaw that holds something for a later skill would be opened by an earlier one.

    Args:
        skills: the task's.
        ended: index of the skill that has ended, -1 for none.
        held: per arm, whether its jaw holds something.

    Returns:
        Its name; "" when there is none.
    """
    for index in range(ended, -1, -1):
        begins, ends = (holds_of(skills, i, len(held)) for i in (index - 1, index))
        fits = [h or not b for h, b in zip(held, begins, strict=True)]
        fits += [not h or b or e for h, b, e in zip(held, begins, ends, strict=True)]
        if all(fits):
            return skills[index].name
    return ""


def held_now(session: Session) -> tuple[bool, ...]:
    """Per arm, whether its jaw holds something; none does where its empty angle is not known."""
    arms = session.read().arms
    if not session.empty_jaw_rad:
        return (False,) * len(arms)
    return tuple(grasp_test(session, index, arm).holds for index, arm in enumerate(arms))


class Boundaries:
    """Asks before every skill of one attempt, and looks after the grips within. Tells the record.

    Args:
        session: the arms.
        job: what is run.
        result: the episode so far.
    """

    def __init__(self, session: Session, job: Job, result: EpisodeResult) -> None:
        self._session, self._job, self._result = session, job, result
        self._skills = job.task.skills
        self._names = [skill.name for skill in self._skills]
        self._has = [False] * len(session.cell.arms)

    def before(self, start: SkillStart) -> Boundary | None:
        """Both questions, where a skill is about to start.

        The arms are brought to rest where a jaw does not tell at once.

        Args:
            start: what the skill is to do, and its value.

        Returns:
            What is decided; None when the gate stepped in, as `result` says then.
        """
        index = self._names.index(start.skill)
        if not self._job.has_things:
            after = self._names[index - 1] if index else ""
            return Boundary(after, start.skill, (), None, None, "go on", start.skill)
        needed = holds_of(self._skills, index - 1, len(self._has))
        tests = self._tests()
        if any(map(operator.and_, needed, self._undecided(tests))):
            if not self._settled():
                return None
            tests = self._tests()
        grasps = tuple(itertools.compress(tests, needed))
        after = self._names[index - 1] if index else ""
        threshold = self._job.threshold
        seen = Boundary(after, start.skill, grasps, start.value, threshold, "go on", start.skill)
        if seen.lost or seen.is_value_low:
            seen = self._turned_back(seen, index - 1)
        return self._told(seen)

    def within(self, skill: str, may_halt: bool) -> Boundary | None:
        """What is decided when a jaw has lost what it held; to be asked after every policy step.

        A jaw that closes on nothing has lost nothing: a policy may try again by itself.

        Args:
            skill: the skill that is running.
            may_halt: the arms may be brought to rest where a jaw does not tell at once.

        Returns:
            None while nothing is lost, and when the gate stepped in, as `result` says then.
        """
        if not self._job.has_things:
            return None
        tests = self._tests()
        if may_halt and any(map(operator.and_, self._has, self._undecided(tests))):
            if not self._settled():
                return None
            tests = self._tests()
        fallen = [test.is_closed and not test.holds for test in tests]
        lost = tuple(itertools.compress(tests, map(operator.and_, self._has, fallen)))
        self._has = [
            test.holds and (had or not is_open)
            for test, had, is_open in zip(tests, self._has, self._undecided(tests), strict=True)
        ]
        if not lost:
            return None
        seen = Boundary(skill, skill, lost, None, None, "go on", skill)
        return self._told(self._turned_back(seen, self._names.index(skill)))

    def _turned_back(self, seen: Boundary, ended: int) -> Boundary:
        """The same where the runtime does not go on: with what it does instead."""
        back = way_back(self._skills, ended, held_now(self._session))
        if not back or self._result.retries >= self._job.retries:
            return replace(seen, course="safe pose", skill="")
        return replace(seen, course="retry", skill=back)

    def _told(self, seen: Boundary) -> Boundary:
        """The same, in result and record."""
        self._result.boundaries.append(seen)
        now, episode = self._session.driver.clock.now(), self._result.episode
        self._session.recorder.mark(now, episode, seen.skill, 0, boundary=seen)
        return seen

    def _tests(self) -> list[GraspTest]:
        """What every jaw tells now."""
        arms = self._session.read().arms
        return [grasp_test(self._session, index, arm) for index, arm in enumerate(arms)]

    def _undecided(self, tests: Sequence[GraspTest]) -> list[bool]:
        """Per arm, whether its jaw seems to hold something and is closing still."""
        arms = self._session.read().arms
        return [is_undecided(arm, test) for arm, test in zip(arms, tests, strict=True)]

    def _settled(self) -> bool:
        """Rests until every jaw tells; False when the gate stepped in, as the result says then."""
        if halt(self._session) and rest(self._session, SETTLE_S):
            return True
        self._session.come_to_rest(self._result)
        return False


def leave(session: Session, boundary: Boundary) -> bool:
    """After a boundary at which the runtime does not go on: puts the arms where it goes on from.

    That is the start pose, or, for a retry with something in a jaw, the place where they are.

    Returns:
        False when the gate stepped in.
    """
    if not halt(session):
        return False
    held = held_now(session)
    if boundary.course == "retry" and any(held):
        return True
    return go_to_start_pose(session, held)
