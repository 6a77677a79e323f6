"""A trajectory that came from elsewhere: looked at for the usual mistakes, then made a plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import DataFileError, MotionError
from viskill_deploy.core.types import FloatArray, Waypoint
from viskill_deploy.motion.frames import FRAMES, Label
from viskill_deploy.motion.plan import smooth
from viskill_deploy.motion.resolve import densified_rows, resolve, waypoint_at
from viskill_deploy.motion.trajectory import Written, cell_sha256, read_plan, waypoints_of
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.runtime.planning import Plan

OUTSIDE_M = 0.001
"""A waypoint this far outside its arm's workspace is no rounding."""

SAME_M, SAME_RAD = 0.001, 0.05
"""Two poses within this are the same place: what stands still is known better."""

APART_M, APART_RAD = 0.003, 0.3
"""A file that starts at least this far from the arms starts somewhere else."""

INSERTION_TRAP_M = 0.0071
"""AMBF and the surgical robotics challenge have -0.4389 m where the dVRK has -0.4318."""


def open_plan(path: Path, cell_name: str = "") -> tuple[CellDescription, list[Waypoint]]:
    """The waypoints of a plan file, and the very cell that they were made for.

    Args:
        path: the plan file.
        cell_name: name or file of the cell; by default the plan's, in `robots/cells`.

    Raises:
        DataFileError: the plan, or a file of the cell, is wrong; or it is another cell.
        MotionError: a waypoint lies outside the workspace of its arm.
    """
    plan = read_plan(path)
    try:
        cell = load_cell(cell_name or plan.cell)
    except DataFileError as error:
        if cell_name:
            raise
        reason = f"{plan.cell!r} cannot be loaded ({error}); name the cell's file with --cell"
        raise DataFileError(path, "cell", reason) from error
    if plan.cell_sha256 != cell_sha256(cell):
        raise DataFileError(
            path,
            "cell",
            f"{plan.cell!r} when it was imported is not what {cell.files[0]} and its robot and "
            "tool files say now; name the right file with --cell, or import the trajectory again",
        )
    names = tuple(arm.name for arm in cell.arms)
    if plan.arms != names:
        raise DataFileError(path, "arms", f"is {plan.arms}, {cell.name} has {names}; import again")
    waypoints = plan.unpacked()
    look = look_at(cell, waypoints)
    if not look.is_inside:
        raise MotionError(
            f"{path}: a waypoint lies {1e3 * look.outside_m:.4g} mm outside the workspace of its "
            f"arm in {cell.name}; correct the trajectory and import it again"
        )
    return cell, waypoints


def plan_waypoints(
    cell: CellDescription,
    waypoints: Sequence[Waypoint],
    held: FloatArray,
    speed: float = 1.0,
    source: str = "the trajectory",
) -> Plan:
    """The plan from where the arms are held through all waypoints.

    Args:
        cell: the arms in their places.
        waypoints: task frame.
        held: axis positions of the setpoints that their driver holds, (arms, 7).
        speed: part of the planned tip speed to use.
        source: where the waypoints are from, for messages.

    Raises:
        MotionError: out of reach, or no motion inside the limits; names the source, and the
            waypoint as it is counted there.
    """
    here = waypoint_at(cell, held)
    step_s, may_open = waypoints[0].step_s, waypoints[0].may_open_jaw
    start = Waypoint(here.T_task_tip, here.jaw, step_s, "trajectory", may_open)
    try:
        dense, rows = densified_rows([start, *waypoints])
        names = [f"waypoint {row} of {len(waypoints)}" for row in rows[1:]]
        q = resolve(cell, dense[1:], held.tolist(), names)
    except MotionError as error:
        raise MotionError(f"{source}: {error}") from error
    try:
        return Plan(tuple(dense), smooth(cell, q, step_s, speed), {})
    except MotionError as error:
        added = len(dense) - 1 - len(waypoints)
        what = f"{source}, counted with the {added} waypoints that were added" if added else source
        raise MotionError(f"{what}: {error}") from error


@dataclass(frozen=True)
class Look:
    """How a reading of a file stands to its cell, the worst over all arms.

    Attributes:
        outside_m: how far a waypoint lies outside its arm's workspace.
        start_m: how far the first lies from where the arm starts.
        start_rad: how far it is turned from there.
    """

    outside_m: float
    start_m: float
    start_rad: float

    @property
    def is_inside(self) -> bool:
        """Whether every waypoint lies in its arm's workspace."""
        return self.outside_m <= OUTSIDE_M

    @property
    def starts_there(self) -> bool:
        """Whether the file starts where the arms do."""
        return self.start_m <= SAME_M and self.start_rad <= SAME_RAD


def look_at(cell: CellDescription, waypoints: Sequence[Waypoint]) -> Look:
    """How waypoints stand to the workspaces and the start of their cell."""
    outside, away, turned = 0.0, 0.0, 0.0
    home = start_waypoint(cell)
    for index, arm in enumerate(cell.arms):
        poses = np.array([w.T_task_tip[index] for w in waypoints])
        low, high = (
            np.array(x) for x in (arm.entry.workspace_lower_m, arm.entry.workspace_upper_m)
        )
        excess = np.maximum(low - poses[:, :3, 3], poses[:, :3, 3] - high)
        outside = max(outside, float(excess.max()))
        start = home.T_task_tip[index]
        away = max(away, float(np.linalg.norm(poses[0, :3, 3] - start[:3, 3])))
        cosine = (np.trace(poses[0, :3, :3].T @ start[:3, :3]) - 1.0) / 2.0
        turned = max(turned, math.acos(min(max(cosine, -1.0), 1.0)))
    return Look(outside, away, turned)


def checked_waypoints(
    cell: CellDescription, written: Written, label: Label, step_s: float | None, source: str
) -> list[Waypoint]:
    """The waypoints of a file, if what it says of its numbers can be true.

    Refused are waypoints outside the workspace of their arm, and a file that starts beside the
    arms by just what one of the usual mistakes makes: a file that shall start there begins with
    the pose where the arms are.

    Raises:
        MotionError: as said, with a hint at what the numbers may mean; and as `waypoints_of`.
    """
    waypoints = waypoints_of(cell, written, label, step_s, source)
    look = look_at(cell, waypoints)
    readings = _other_readings(cell, written, label, step_s, source)
    fitting = [name for name, other in readings if other.is_inside and other.starts_there]
    if not look.is_inside:
        fitting = fitting or [name for name, other in readings if other.is_inside]
        raise MotionError(
            f"{source}: read as {label}, a waypoint lies {1e3 * look.outside_m:.1f} mm outside the "
            f"workspace of its arm in {cell.name}; {_hint(fitting)}"
        )
    if (look.start_m >= APART_M or look.start_rad >= APART_RAD) and fitting:
        raise MotionError(
            f"{source}: read as {label}, it starts {1e3 * look.start_m:.1f} mm and "
            f"{math.degrees(look.start_rad):.0f} degrees from where the arms of {cell.name} are; "
            f"{_hint(fitting)}, or begin the file where the arms are"
        )
    return waypoints


def _hint(fitting: Sequence[str]) -> str:
    if not fitting:
        return "no usual mistake explains it: compare a pose with `viskill convert`"
    return f"likely it is {' or '.join(fitting)}"


def _other_readings(
    cell: CellDescription, written: Written, label: Label, step_s: float | None, source: str
) -> list[tuple[str, Look]]:
    """Every usual mistake, and how the file looks without it."""
    other = "jaw-end" if label.control_point == "jaw-pivot" else "jaw-pivot"
    finger_mm = 1e3 * cell.arms[0].arm.jaw.finger_length_m
    named = [(f"about the {other} ({finger_mm:.1f} mm)", label.but(control_point=other))]
    named += [(f"in frame {frame}", label.but(frame=frame)) for frame in FRAMES]
    scales = {"not scaled": 1.0, "scaled by 5": 5.0}
    named += [(name, label.but(length_scale=scale)) for name, scale in scales.items()]
    readings = []
    for name, reading in named:
        if reading != label:
            try:
                waypoints = waypoints_of(cell, written, reading, step_s, source)
            except DataFileError:  # a cell that does not say where SurRoL's world is
                continue
            readings.append((name, look_at(cell, waypoints)))
    own = waypoints_of(cell, written, label, step_s, source)
    for name, sign in (("less", 1.0), ("more", -1.0)):
        text = f"from a model whose insertion is 7.1 mm {name}"
        readings.append((text, look_at(cell, _moved(cell, own, sign * INSERTION_TRAP_M))))
    return readings


def _moved(cell: CellDescription, waypoints: Sequence[Waypoint], way_m: float) -> list[Waypoint]:
    """Every tip moved along the line from its remote centre."""

    def moved(index: int, T: FloatArray) -> FloatArray:
        result = T.copy()
        away = T[:3, 3] - cell.arms[index].T_task_base[:3, 3]
        result[:3, 3] += way_m * away / max(float(np.linalg.norm(away)), 1e-9)
        return result

    return [
        Waypoint(tuple(moved(i, T) for i, T in enumerate(w.T_task_tip)), w.jaw, w.step_s)
        for w in waypoints
    ]
