"""Paths in the body of a 7-joint arm with a straight shaft: our QP and pink's, in one run.

Usage: python benchmarks/port_paths.py [PATHS] [SEED]

Both solvers get the same targets, tick by tick, at 250 Hz: pairs of random places in the workspace
of the cell `bodytrainer`, with random turns, along the plan that `viskill dry-run` would follow.
pink has no constraint for a port. It is asked twice: with the orientation that the waypoints ask
for, as somebody would who does not think of the port; and with poses that were aimed through the
port beforehand, which is half of this project's solution handed to it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
import pink
import pinocchio as pin

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import Waypoint
from viskill_deploy.kinematics.ik import IkSolver
from viskill_deploy.kinematics.model import SHAFT_FRAME
from viskill_deploy.kinematics.port import PortConstraint
from viskill_deploy.kinematics.straight import DAMPING, StraightArm, placed_arm
from viskill_deploy.motion.plan import JointPlan
from viskill_deploy.motion.resolve import resolve, start_seeds
from viskill_deploy.motion.waypoints import downward_pose, start_waypoint
from viskill_deploy.runtime.trajectory import plan_waypoints

PERIOD_S = 0.004
CELL = load_cell("bodytrainer")
ENTRY = CELL.arms[0]
INSET_M = 0.012

Step = Callable[[np.ndarray, np.ndarray, pin.SE3, np.ndarray], np.ndarray]
"""Joints, their velocities, target and preferred velocities to the next joints."""


def plans(count: int, seed: int) -> list[JointPlan]:
    """Plans from the start pose through two random places each."""
    dice = np.random.default_rng(seed)
    low = np.add(ENTRY.entry.workspace_lower_m, INSET_M)
    high = np.subtract(ENTRY.entry.workspace_upper_m, INSET_M)
    found = []
    for _ in range(count):
        way = [start_waypoint(CELL)]
        for _ in range(2):
            pose = downward_pose(dice.uniform(low, high), dice.uniform(-0.5, 0.5))
            way.append(Waypoint((pose,), (0.0,), 0.2))
        held = resolve(CELL, way[:1], start_seeds(CELL))[1]
        found.append(plan_waypoints(CELL, way, held).motion)
    return found


def ours(arm: StraightArm) -> Step:
    """The QP of the line, with the port as a constraint."""
    port = PortConstraint(arm.port, SHAFT_FRAME, np.array([0.0, 0.0, 1.0]))
    solver = IkSolver.for_arm(arm, port=port, damping=DAMPING)

    def step(q: np.ndarray, v: np.ndarray, goal: pin.SE3, wish: np.ndarray) -> np.ndarray:
        return np.array(solver.step(q, v, arm.aimed(goal), PERIOD_S, v_preferred=wish).q)

    return step


def pinks(arm: StraightArm, is_aimed: bool) -> Step:
    """Pink's solve_ik with one frame task."""
    task = pink.FrameTask("tip", position_cost=1.0, orientation_cost=0.05)
    configuration = pink.Configuration(arm.model, arm.model.createData(), pin.neutral(arm.model))

    def step(q: np.ndarray, v: np.ndarray, goal: pin.SE3, wish: np.ndarray) -> np.ndarray:
        configuration.update(q)
        task.set_target(arm.aimed(goal) if is_aimed else goal)
        speed = pink.solve_ik(configuration, [task], PERIOD_S, solver="daqp", safety_break=False)
        return q + np.array(speed) * PERIOD_S

    return step


def follow(arm: StraightArm, step: Step, motions: list[JointPlan], upright: bool) -> str:
    """Worst distance from the port and of the tip from its target, and the time of a tick."""
    off_port = off_path = 0.0
    times = []
    level = downward_pose((0.0, 0.0, 0.0), 0.0)[:3, :3]
    for motion in motions:
        q, v = np.array(motion.at(0.0)[0].p[:-1]), np.zeros(7)
        for tick in range(1, int(motion.duration_s / PERIOD_S) + 1):
            reference = np.array(motion.at(tick * PERIOD_S)[0].p[:-1])
            goal = arm.forward(reference)
            if upright:
                goal = pin.SE3(ENTRY.T_task_base[:3, :3].T @ level, goal.translation)
            before = time.perf_counter()
            after = step(q, v, goal, (reference - q) / PERIOD_S)
            times.append(time.perf_counter() - before)
            q, v = after, (after - q) / PERIOD_S
            off_port = max(off_port, arm.rcm_error(q, arm.port))
            place = arm.forward(q).translation
            off_path = max(off_path, float(np.linalg.norm(place - goal.translation)))
    us = 1e6 * np.percentile(times, (50, 99))
    return (
        f"port {1e3 * off_port:9.4f} mm   tip {1e3 * off_path:9.4f} mm   "
        f"tick {us[0]:6.0f} us (p99 {us[1]:.0f})"
    )


def main(count: int = 50, seed: int = 1) -> None:
    """Prints a line a solver."""
    arm = placed_arm(ENTRY)
    assert isinstance(arm, StraightArm)
    motions = plans(count, seed)
    ticks = sum(int(m.duration_s / PERIOD_S) for m in motions)
    print(f"{count} paths, {ticks} ticks")
    print(f"this project, port constraint     {follow(arm, ours(arm), motions, False)}")
    print(f"pink, aimed poses handed to it    {follow(arm, pinks(arm, True), motions, False)}")
    print(f"pink, orientation kept as asked   {follow(arm, pinks(arm, False), motions, True)}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
