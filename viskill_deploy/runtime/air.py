"""In the air: a whole plan, lifted off the board, with nothing to touch and nothing to hold.

The gate, the line and the plan are given a cell whose board stands higher than the real one, by the
lift. So every rule that keeps an arm off the board or its pegs keeps it that much farther off the
real ones, and the plan itself stays, number by number, what it is on the ground.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.errors import MotionError, ViskillError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.plan import smooth
from viskill_deploy.motion.resolve import resolve
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.runtime.planning import Plan

HIGHEST_M = 0.1
"""No arm reaches its start pose from a board that is lifted by more."""


def lifted(cell: CellDescription, lift_m: float) -> CellDescription:
    """The cell as it is to arms over a board that stands `lift_m` higher along the task's z.

    Raises:
        MotionError: that is no height for a board.
    """
    if not 0.0 < lift_m <= HIGHEST_M:
        raise MotionError(f"a plan is lifted by up to {1e3 * HIGHEST_M:g} mm; ask for less")
    return replace(
        cell, arms=tuple(_lower(arm, lift_m) for arm in cell.arms), filed=cell.filed or cell
    )


def _lower(arm: CellArm, way_m: float) -> CellArm:
    T = arm.T_task_base.copy()
    T[2, 3] -= way_m
    T.flags.writeable = False
    return replace(arm, T_task_base=T)


def start_axes(cell: CellDescription, held: FloatArray) -> FloatArray:
    """Axis positions of the cell's start pose, jaws closed, (arms, 7).

    Args:
        cell: the arms in their places.
        held: axis positions from which roll turns follow on, (arms, 7).

    Raises:
        MotionError: it is out of reach.
    """
    axes: FloatArray = resolve(cell, [start_waypoint(cell)], held.tolist())[1]
    return axes


def over(plan: Plan, cell: CellDescription, held: FloatArray, rests: bool) -> Plan:
    """A plan that was made on the ground, for the arms of a lifted cell.

    Args:
        plan: from the start pose of the cell on the ground.
        cell: the lifted cell.
        held: axis positions of the setpoints that its arms hold, in its start pose, (arms, 7).
        rests: whether the arms rest at every waypoint.

    Raises:
        MotionError: the arms do not reach as high.
    """
    waypoints, inner = plan.waypoints, range(1, len(plan.waypoints) - 1)
    stops = [i for i in inner if rests or waypoints[i].skill != waypoints[i + 1].skill]
    try:
        q = resolve(cell, waypoints[1:], np.asarray(held).tolist())
        motion = smooth(cell, q, cell.file.motion.step_s, rests=stops)
    except ViskillError as error:
        raise MotionError(f"{error}; so high up the plan is not possible: lift it less") from error
    return replace(plan, motion=motion)
