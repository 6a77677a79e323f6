"""What is looked at before a cell may be armed, second part: the scene, the start, the whole plan.

The plan is the policy's own, made in a simulator from where the arms and the things are now. A
closed-loop run will differ from it in millimetres; a policy that does not even rehearse inside the
limits is not let near an arm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pinocchio

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError, MotionError
from viskill_deploy.core.types import PSM_JOINTS, CellState, FloatArray, ObjectPose, Scene
from viskill_deploy.drivers import loopback
from viskill_deploy.drivers.base import ENABLED, Driver
from viskill_deploy.motion.links import CellLinks
from viskill_deploy.runtime.air import lifted, start_axes
from viskill_deploy.runtime.attempts import plan_for
from viskill_deploy.runtime.boundaries import Job, Stops
from viskill_deploy.runtime.checklist import Checklist, Found, Line
from viskill_deploy.runtime.planning import Plan
from viskill_deploy.runtime.preflight import PERIOD_S, Prepared, Sources, look_at_files
from viskill_deploy.safety.rules.s29_training_range import widened
from viskill_deploy.sim.world import WorldOptions

SIGMAS = 2.0
"""A measured pose is taken as anywhere within so many standard deviations."""

REST = (0.0,) * 6

LAYOUTS = 2**29
"""First number of the seeds of layouts: training never uses it."""


@dataclass(frozen=True, slots=True)
class Rehearsed:
    """How the plan of a run is made.

    Attributes:
        period_s: control period, s.
        speed: how fast the time base of line and gate runs, in (0, 1].
        ik_solver: QP solver of the IK.
        seed: of the scripted plan's random part.
        lift_m: how high above the board the plan is run; 0 on it.
        stops: where the arms rest for the operator.
    """

    period_s: float = PERIOD_S
    speed: float = 1.0
    ik_solver: str = "daqp"
    seed: int = 0
    lift_m: float = 0.0
    stops: Stops = "nowhere"


def preflight(sources: Sources, seed: int = 0) -> tuple[Checklist, Prepared | None]:
    """Looks at everything on a simulated cell; moves nothing but its simulation.

    Args:
        sources: the files of the run.
        seed: where no scene is given, a layout is drawn as for the first episode of a run with
            this seed.
    """
    checklist = Checklist()
    prepared = look_at_files(checklist, sources)
    goes_on = checklist.error is None or isinstance(checklist.error, CalibrationError)
    if prepared is None or not goes_on:
        return checklist, prepared
    driver = loopback.connect(prepared.cell, WorldOptions(PERIOD_S), seed)
    try:
        scene = checklist.look("things", "", partial(_put, driver, prepared, seed))
        if scene is not None:
            look_at_run(checklist, prepared, driver.state(), scene, Rehearsed())
    finally:
        driver.close()
    return checklist, prepared


def look_at_run(
    checklist: Checklist, prepared: Prepared, state: CellState, scene: Scene, how: Rehearsed
) -> None:
    """Adds the lines of a run that starts from a state and a scene.

    Args:
        checklist: gets the lines.
        prepared: the files of the run.
        state: the arms, enabled and homed.
        scene: the things as they are seen now.
        how: how the plan is made.
    """
    known = prepared.scene.covariance if prepared.scene else {}
    checklist.look("scene", "S29", partial(_scene, prepared, state, scene, known))
    checklist.look("workspace", "S11", partial(_workspace, prepared, state, scene))
    plan = checklist.look("plan", "", partial(_plan, prepared, state, scene, how))
    if plan is not None:
        judge = partial(_judged, prepared, plan, state, how)
        margins = checklist.look("every setpoint of the plan", "", judge)
        checklist.lines += _rules(margins or {})


def _put(driver: Driver, prepared: Prepared, seed: int) -> Found[Scene]:
    """Things where the scene file, or a drawn layout, has them, and arms that are ready."""
    measured = prepared.scene
    if measured is None:
        rng = np.random.default_rng([LAYOUTS, seed, 0])
        first = prepared.task.distributions[0]
        layout, where = prepared.task.sample_layout(rng, first), f"drawn ({first}, seed {seed})"
    else:
        layout, where = measured.scene, f"as in {measured.path.name}"
    driver.reset(layout)
    driver.enable()
    driver.home()
    driver.clock.sleep_until(driver.clock.now() + driver.period_s)
    seen, names = driver.scene() or layout, ", ".join(thing.name for thing in layout.objects)
    return Found(
        seen if measured is None else as_measured(seen, measured.scene), names + f", {where}"
    )


def as_measured(seen: Scene, measured: Scene) -> Scene:
    """What is seen, with those things that somebody has measured where they were measured."""
    known = {thing.name: thing for thing in measured.objects}
    objects = tuple(known.get(thing.name, thing) for thing in seen.objects)
    return replace(seen, objects=objects, active=measured.active, goal=measured.goal)


def _scene(
    prepared: Prepared, state: CellState, scene: Scene, known: Mapping[str, FloatArray]
) -> Found[None]:
    """Whether what the policy sees first is like what it saw in training."""
    manifest = prepared.bundle.manifest
    tips = _tips(prepared, state)
    jaws = [arm.jaw_measured_jp for arm in state.arms]
    ranges = widened(manifest.training_range.seen)
    worst, entry, value = -1.0, 0, 0.0
    for possible in possible_scenes(scene, known):
        observation = prepared.task.observe(tips, jaws, possible).tolist()
        parts = ranges.parts(tuple(observation))
        index = int(np.argmax(parts))
        if not parts[index] <= worst:
            worst, entry, value = parts[index], index, observation[index]
    name, scale, unit = _entry([(e.name, e.size) for e in manifest.observation], entry)
    low, high = (getattr(manifest.training_range, side)[entry] for side in ("lower", "upper"))
    text = (
        f"{name} is {scale * value:.1f} {unit}, seen in training from {scale * low:.1f} to "
        f"{scale * high:.1f}"
    )
    if not worst <= 1.0:
        error = MotionError(f"{text}; put things where the policy was trained, or train it there")
        return Found(None, str(error), 1.0 - worst, error=error)
    return Found(None, f"nearest to the edge: {text}", 1.0 - worst)


def possible_scenes(scene: Scene, known: Mapping[str, FloatArray]) -> Iterator[Scene]:
    """The scene, and one for every axis of every thing's covariance and side of it.

    Args:
        scene: as it was measured.
        known: covariance by name, position before rotation, (6, 6); things without one are where
            they are.
    """
    yield scene
    for index, thing in enumerate(scene.objects):
        if thing.name not in known:
            continue
        variances, axes = np.linalg.eigh(known[thing.name])
        for variance, axis in zip(variances, axes.T, strict=True):
            for side in (-SIGMAS, SIGMAS) if variance > 0.0 else ():
                offset = side * np.sqrt(variance) * axis
                T = thing.T_task_object.copy()
                T[:3, :3], T[:3, 3] = pinocchio.exp3(offset[3:]) @ T[:3, :3], T[:3, 3] + offset[:3]
                objects = list(scene.objects)
                objects[index] = ObjectPose(thing.name, T)
                yield replace(scene, objects=tuple(objects))


def _entry(layout: Sequence[tuple[str, int]], entry: int) -> tuple[str, float, str]:
    """One number of an observation: a name such as "object position y", scale and unit to show."""
    names = [
        (name, name.replace("_", " ") + (f" {'xyz'[axis]}" if size == 3 else ""))
        for name, size in layout
        for axis in range(size)
    ]
    key, words = names[entry]
    is_angle = key.endswith(("_euler", "_jaw"))
    return (words, math.degrees(1.0), "°") if is_angle else (words, 1e3, "mm")


def _workspace(prepared: Prepared, state: CellState, scene: Scene) -> Found[None]:
    """Whether arms stand inside their workspaces, thing and goal where an arm gets over them."""
    gaps: list[tuple[float, float, str]] = []
    for arm, T in zip(prepared.cell.arms, _tips(prepared, state), strict=True):
        low, high = np.array(arm.entry.workspace_lower_m), np.array(arm.entry.workspace_upper_m)
        gap = float(np.minimum(T[:3, 3] - low, high - T[:3, 3]).min())
        gaps.append((2.0 * gap / float((high - low).min()), gap, arm.name))
    for name, point in (
        (scene.active, scene.pose(scene.active)[:3, 3]),
        ("the goal", scene.goal),
    ):
        gaps.append((*max(_gap_over(prepared, point)), name))
    margin, gap, name = min(gaps)
    if not margin >= 0.0:
        error = MotionError(
            f"{name} lies {-1e3 * gap:.1f} mm outside every workspace that it has to be in; move "
            "it, or correct the scene or the cell"
        )
        return Found(None, str(error), margin, error=error)
    text = f"arms, {scene.active} and goal are inside; {name} by {1e3 * gap:.1f} mm"
    return Found(None, text, margin)


def _gap_over(prepared: Prepared, point: FloatArray) -> Iterator[tuple[float, float]]:
    """Distance of a point from each workspace's walls, seen from above: as a part, and in m."""
    for arm in prepared.cell.arms:
        low = np.array(arm.entry.workspace_lower_m[:2])
        high = np.array(arm.entry.workspace_upper_m[:2])
        gap = float(np.minimum(point[:2] - low, high - point[:2]).min())
        yield 2.0 * gap / float((high - low).min()), gap


def _plan(prepared: Prepared, state: CellState, scene: Scene, how: Rehearsed) -> Found[Plan]:
    """The policy's plan from here, as it would be streamed."""
    ground = prepared.cell if how.lift_m else None
    job = Job(prepared.bundle, prepared.task, ground=ground, stops=how.stops)
    cell, begin = _lifted(prepared, state, how)
    rng = np.random.default_rng([LAYOUTS, how.seed])
    plan = plan_for(cell, job, begin, scene, rng, must_succeed=False)
    text = f"{len(plan.waypoints) - 1} waypoints in {plan.motion.duration_s:.1f} s"
    if plan.succeeds:
        return Found(plan, f"{text}, does the task in the simulator")
    return Found(plan, f"{text}, does not do the task in the simulator", warns=True)


def _judged(
    prepared: Prepared, plan: Plan, state: CellState, how: Rehearsed
) -> Found[dict[str, float]]:
    cell, begin = _lifted(prepared, state, how)
    margins = plan.check(cell, how.period_s, begin, how.ik_solver, how.speed)
    tightest = min(margins.values())
    return Found(margins, f"passes all {len(margins)} rules of the gate", tightest)


def _lifted(
    prepared: Prepared, state: CellState, how: Rehearsed
) -> tuple[CellDescription, CellState]:
    """The cell that the plan is run in, and its arms where the plan begins."""
    if not how.lift_m:
        return prepared.cell, state
    cell = lifted(prepared.cell, how.lift_m)
    return cell, at_start(cell, state)


def at_start(cell: CellDescription, state: CellState) -> CellState:
    """The same arms in the cell's start pose, at rest, enabled and homed.

    Raises:
        MotionError: it is out of reach.
    """
    rows = start_axes(cell, np.zeros((len(cell.arms), 7))).tolist()
    return replace(
        state,
        arms=tuple(
            replace(
                arm,
                valid=True,
                operating_state=ENABLED,
                is_homed=True,
                is_busy=False,
                measured_jp=tuple(row[:6]),
                measured_jv=REST,
                setpoint_jp=tuple(row[:6]),
                jaw_measured_jp=max(row[6], 0.0),  # an empty jaw closes to its zero
                jaw_measured_jv=0.0,
                jaw_setpoint_jp=row[6],
                joint_names=PSM_JOINTS,
                tool=described.arm.tool,
            )
            for arm, described, row in zip(state.arms, cell.arms, rows, strict=True)
        ),
    )


def _rules(margins: Mapping[str, float]) -> Iterator[Line]:
    """A line a rule, tightest first; below zero is a warning, for the gate let it pass."""
    for rule, margin in sorted(margins.items(), key=lambda item: item[1]):
        yield Line("plan", rule, "pass" if margin >= 0.0 else "warn", margin, "")


def _tips(prepared: Prepared, state: CellState) -> list[FloatArray]:
    return CellLinks(prepared.cell).tips([arm.measured_jp for arm in state.arms])
