"""Motions that no policy asks for: to rest, to the start pose. All pass line and gate.

Each returns whether the gate let it pass; where it did not, the arms are under the gate's stop.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import CellState, FloatArray, Waypoint
from viskill_deploy.motion.resolve import densified, waypoint_at
from viskill_deploy.motion.waypoints import WORKSPACE_INSET_M, start_waypoint
from viskill_deploy.runtime.planning import Plan
from viskill_deploy.runtime.session import Session


def axes_of(state: CellState) -> FloatArray:
    """Axis positions of the setpoints that the driver holds, (arms, 7), jaw last."""
    return np.array([(*arm.setpoint_jp, arm.jaw_setpoint_jp) for arm in state.arms])


def run_motion(session: Session, lead_s: float = 0.0) -> bool:
    """Cycles until the motion is over, or will be in `lead_s`."""
    while True:
        if not session.cycle():
            return False
        if session.line.arrived or session.line.remaining_s <= lead_s:
            return True


def arrive(session: Session) -> bool:
    """Cycles until a motion is over that may be so already."""
    return session.line.arrived or run_motion(session)


def halt(session: Session) -> bool:
    """Brings the arms to rest from where they are, as fast as the plans' limits allow.

    No jaw may open meanwhile, and what the policy saw last is no longer what the arms act on.
    """
    session.allow(None)
    session.line.halt()
    return run_motion(session)


def rest(session: Session, seconds: float) -> bool:
    """Stays where the arms are, at rest, for some time."""
    return all(session.cycle() for _ in range(round(seconds / session.driver.period_s)))


def go_through(session: Session, waypoints: list[Waypoint]) -> bool:
    """Follows waypoints from the first, at which the arms rest, to the last, and rests there."""
    way = densified(waypoints)[1:]
    for waypoint in way:
        session.go_to(waypoint, last=waypoint is way[-1])
        if not run_motion(session):
            return False
    return True


def close_jaws(session: Session) -> bool:
    """Closes every jaw where the arms are."""
    here = waypoint_at(session.cell, axes_of(session.read()))
    grips = tuple(arm.arm.jaw.grip_angle_rad for arm in session.cell.arms)
    return go_through(session, [here, replace(here, jaw=grips)])


def go_to_start_pose(session: Session, held: tuple[bool, ...]) -> bool:
    """Takes arms at rest to their start pose.

    Args:
        session: the arms.
        held: per arm, whether its jaw holds something. Such a jaw stays as it is; the others close
            at the end, where nothing is near.
    """
    here = waypoint_at(session.cell, axes_of(session.read()))
    return go_through(session, way_to_start(session.cell, here, held))


def way_to_start(
    cell: CellDescription, here: Waypoint, held: tuple[bool, ...] = ()
) -> list[Waypoint]:
    """The way to the start pose: straight up first, then across; jaws that hold nothing close."""
    start, held = start_waypoint(cell), held or (False,) * len(cell.arms)
    raised = []
    for pose, goal, arm in zip(here.T_task_tip, start.T_task_tip, cell.arms, strict=True):
        up = np.array(pose)
        top = arm.entry.workspace_upper_m[2] - WORKSPACE_INSET_M
        up[2, 3] = max(up[2, 3], min(goal[2, 3], top))
        raised.append(up)
    jaws = tuple(
        now if holds else end for now, end, holds in zip(here.jaw, start.jaw, held, strict=True)
    )
    above = replace(here, T_task_tip=tuple(raised))
    across = replace(start, jaw=here.jaw)
    return [here, above, across, replace(start, jaw=jaws)]


def stream(session: Session, plan: Plan) -> bool:
    """Streams a whole plan that starts where the arms are."""
    session.line.follow(plan.motion)
    while not session.line.arrived:
        ahead = plan.index_at(session.line.phase + session.driver.period_s)
        session.allow(plan.waypoints[ahead])
        if not session.cycle():
            return False
    return True
