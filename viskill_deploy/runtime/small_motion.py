"""Every axis moved a little, one after another, while somebody who is not the robot looks on.

A wrong sign, two axes that are swapped, or the coupling of another instrument show in no encoder:
what is told and what is read are wrong in the same way. So each axis goes a little from where it
is, through line and gate, and a witness says what the arm really did.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from viskill_deploy.core import realtime
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError, MotionError, SafetyStop
from viskill_deploy.core.types import PSM_JOINTS, CellState, FloatArray
from viskill_deploy.drivers.base import ENABLED
from viskill_deploy.motion.plan import smooth
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.runtime.moves import axes_of, rest, run_motion
from viskill_deploy.runtime.planning import Plan
from viskill_deploy.runtime.session import Session

AXES = (*PSM_JOINTS, "jaw")

SIZES = (0.05, 0.05, 0.005, 0.2, 0.2, 0.2, 0.2)
"""How far each axis goes, rad; m for the insertion. A wrist's drive has a quarter of the counts of
an arm's in the sample file: taken for one another, neither swings the arm by over 3 degrees."""

SETTLE_S = 0.3

OFF = 0.2
"""Part of a nudge by which an axis may miss it, and any other may move: drives follow to within a
hundredth, and another instrument's wrist differs by more."""


@dataclass(frozen=True, slots=True)
class Nudge:
    """One axis of one arm, a little.

    Attributes:
        arm, axis: their indices; the jaw is axis 6.
        size: rad, or m; its sign is the joint's.
    """

    arm: int
    axis: int
    size: float

    @property
    def unit(self) -> str:
        """Of its size."""
        return "m" if self.axis == 2 else "rad"


class Witness(Protocol):
    """Who sees the arms by other means than their encoders."""

    def look(self) -> None:
        """The arms rest; a nudge is about to begin."""
        ...

    def judge(self, session: Session, nudge: Nudge) -> str:
        """What the arm did instead; "" when it did as it was told. It rests at the nudge's end."""
        ...


def all_nudges(cell: CellDescription) -> list[Nudge]:
    """Every axis of every arm."""
    return [
        Nudge(arm, axis, size) for arm in range(len(cell.arms)) for axis, size in enumerate(SIZES)
    ]


def check_small_motions(
    session: Session,
    witness: Witness,
    nudges: Sequence[Nudge],
    progress: Callable[[Nudge], None] = lambda nudge: None,
) -> None:
    """Moves each axis out and back; stops at the first that does not do as it is told.

    Args:
        session: a connected cell, at rest.
        witness: says what the arms really did.
        nudges: what to try; one that has no room is tried the other way.
        progress: told of every nudge that went well.

    Raises:
        DriverError: an arm did something else; names arm, axis and what it did. It is at rest.
        SafetyStop: the gate refuses to arm, or stepped in; or a nudge has no room either way.
    """
    # Planned before arms have power: with it they would count on us in every period.
    if not session.driver.capabilities.stepped:
        realtime.first_in_line()  # heartbeats do not wait for other programs
    ways = [_planned(session, nudge) for nudge in nudges]
    session.make_ready()
    session.begin()
    for nudge, out, back in ways:
        witness.look()
        _follow(session, out, nudge)
        seen = witness.judge(session, nudge)
        _follow(session, back, nudge)
        if seen:
            session.finish()
            raise DriverError(_sentence(session.cell, nudge, seen))
        progress(nudge)
    session.finish()


def name_of(cell: CellDescription, nudge: Nudge) -> str:
    """Such as "PSM1 yaw"."""
    return f"{cell.arms[nudge.arm].name} {AXES[nudge.axis]}"


def _sentence(cell: CellDescription, nudge: Nudge, seen: str) -> str:
    told = f"told to go by {nudge.size:+.3g} {nudge.unit}"
    return f"{name_of(cell, nudge)}, {told}, {seen}; put the table of axes right before any run"


def _planned(session: Session, nudge: Nudge) -> tuple[Nudge, Plan, Plan]:
    """A nudge that has room, and the checked ways out and back."""
    state = _with_power(session.read())
    held = axes_of(state)
    refusals = []
    for turned in (nudge, replace(nudge, size=-nudge.size)):
        goal = held.copy()
        goal[nudge.arm, nudge.axis] += turned.size
        try:
            out, back = _way(session.cell, held, goal), _way(session.cell, goal, held)
            session.check(out, state)
        except (MotionError, SafetyStop) as error:
            refusals.append(str(error))
            continue
        return turned, out, back
    name = name_of(session.cell, nudge)
    raise SafetyStop(
        f"{name} has no room for a small motion ({refusals[0]}); move it elsewhere, or put the "
        "table of axes right if it does not stand where this says"
    )


def _with_power(state: CellState) -> CellState:
    """The same arms once they are ready, for a rehearsal."""
    arms = [replace(arm, operating_state=ENABLED, is_homed=True) for arm in state.arms]
    return CellState(tuple(arms), replace(state.inputs, watchdog_stepped_in=False))


def _way(cell: CellDescription, start: FloatArray, goal: FloatArray) -> Plan:
    rows = np.array([start, goal])
    may_open = (True,) * len(cell.arms)  # before a run no jaw holds anything
    waypoints = [replace(waypoint_at(cell, row), may_open_jaw=may_open) for row in rows]
    return Plan(tuple(waypoints), smooth(cell, rows, cell.file.motion.step_s), {})


def _follow(session: Session, plan: Plan, nudge: Nudge) -> None:
    session.allow(plan.waypoints[-1])
    session.line.follow(plan.motion)
    if not (run_motion(session) and rest(session, SETTLE_S)):
        session.come_to_rest()
        why = f"{session.cause} {session.trouble}".strip()
        name = name_of(session.cell, nudge)
        raise SafetyStop(f"{name}: the gate stepped in ({why}); put that right and start again")


class SimulatorsWitness:
    """The simulator, which knows where its arms are.

    Args:
        truth: the cell as it is.
    """

    def __init__(self, truth: Callable[[], CellState]) -> None:
        self._truth, self._before = truth, np.zeros((0, 7))

    def look(self) -> None:
        """Remembers where the arms are."""
        self._before = _measured(self._truth())

    def judge(self, session: Session, nudge: Nudge) -> str:
        """What moved otherwise than it should."""
        moved = _measured(self._truth()) - self._before
        told = np.zeros_like(moved)
        told[nudge.arm, nudge.axis] = nudge.size
        # a metre at the insertion is worth as much as 10 rad of a joint
        parts = moved * np.array([1.0, 1.0, 10.0, 1.0, 1.0, 1.0, 1.0])
        size = abs(nudge.size) * (10.0 if nudge.axis == 2 else 1.0)
        off = np.abs(parts - told * (10.0 if nudge.axis == 2 else 1.0)) > OFF * size
        if not off.any():
            return ""
        return _seen(session.cell, moved, np.abs(parts) > OFF * size, nudge)


def _seen(cell: CellDescription, moved: FloatArray, has_moved: FloatArray, nudge: Nudge) -> str:
    """What moved, in words."""
    rows = [Nudge(int(a), int(b), float(moved[a, b])) for a, b in np.argwhere(has_moved)]
    if not rows:
        return "stayed where it was"
    if len(rows) == 1 and (rows[0].arm, rows[0].axis) == (nudge.arm, nudge.axis):
        is_mirrored = rows[0].size * nudge.size < 0.0
        how = "the other way" if is_mirrored else "too far or not far enough"
        return f"went {how}: by {rows[0].size:+.3g} {nudge.unit}"
    said = [f"{name_of(cell, row)} by {row.size:+.3g} {row.unit}" for row in rows]
    return "moved " + " and ".join(said)


def _measured(state: CellState) -> FloatArray:
    return np.array([(*arm.measured_jp, arm.jaw_measured_jp) for arm in state.arms])
