"""What the jaws tell by how far they close: whether they hold something, or have lost it.

A jaw that is told to close squeezes. With something between its fingers it stays open by the
thing's thickness; with nothing it closes to its empty angle, which is measured before the run,
since a real jaw's zero is off by more than a thing is thick.
"""

from __future__ import annotations

from statistics import fmean

from viskill_deploy.core.errors import SafetyStop
from viskill_deploy.core.types import ArmState, GraspTest
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.moves import close_jaws
from viskill_deploy.runtime.session import Session

SETTLE_S = 0.25
"""A jaw that lost its hold is closed after 0.1 s; one that is measured gets this long."""

MEASURED_S = 0.1
"""The empty angle is the mean over this time: noise counts for a fifth at 250 Hz."""

CLOSED_RAD = 1e-3
"""A jaw that is told to close to within this of its grip angle is closed."""

CLOSING_RAD_S = 0.5
"""A closed jaw that closes faster than this is on its way: what it holds is not known yet. A grip
that creeps while its arm moves stays under 0.2 rad/s; one that lost its hold makes 1.5 and more."""


def measure_empty_jaws(session: Session, result: EpisodeResult) -> bool:
    """Measures, once in a run, how far every jaw is open when it closes on nothing.

    The arms are ready and not armed. Jaws that are not closed are closed first, through line and
    gate.

    Returns:
        False when the gate stepped in meanwhile; `result` says for what.

    Raises:
        SafetyStop: a jaw does not close, or the gate refuses to arm; nothing else was moved.
        DriverError: the driver failed.
    """
    if session.empty_jaw_rad:
        return True
    (state,) = session.stand(1)
    grips = [arm.arm.jaw.grip_angle_rad for arm in session.cell.arms]
    told = [arm.jaw_setpoint_jp for arm in state.arms]
    if not all(abs(t - grip) <= CLOSED_RAD for t, grip in zip(told, grips, strict=True)):
        session.begin()
        if not close_jaws(session):
            session.come_to_rest(result)
            return False
        session.finish()
    period = session.driver.period_s
    states = session.stand(round((SETTLE_S + MEASURED_S) / period))
    states = states[-max(1, round(MEASURED_S / period)) :]
    arms = range(len(session.cell.arms))
    angles = tuple(fmean(state.arms[arm].jaw_measured_jp for state in states) for arm in arms)
    limit = session.cell.file.grasp.held_above_empty_rad
    for arm, angle in zip(session.cell.arms, angles, strict=True):
        if not abs(angle) <= limit:
            raise SafetyStop(
                f"{arm.name}'s jaw closes to {angle:.3f} rad and has to come within {limit:.3f} "
                "of 0; take out what it holds, or correct the jaw's zero"
            )
    session.empty_jaw_rad = angles
    return True


def grasp_test(session: Session, index: int, arm: ArmState) -> GraspTest:
    """What a jaw tells now."""
    empty, limit = session.empty_jaw_rad[index], session.cell.file.grasp.held_above_empty_rad
    is_closed = arm.jaw_setpoint_jp <= empty + limit
    return GraspTest(arm.name, arm.jaw_measured_jp, empty, limit, is_closed)


def is_undecided(arm: ArmState, test: GraspTest) -> bool:
    """Whether a jaw that seems to hold something is closing still."""
    return test.holds and not arm.jaw_measured_jv > -CLOSING_RAD_S
