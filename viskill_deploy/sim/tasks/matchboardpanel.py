"""MatchBoardPanel: one PSM opens a sliding door, lays a letter into its cell and closes the door.

Vectors are those of the ViSkill reference task in metres and in the task frame. EEF poses are those
of the last link (frame 6: y forward, z along the jaw's hinge), whose origin is the tip's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.cell_files import Letter, Panel
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import ActiveObject, FloatArray, ObjectPose, Scene
from viskill_deploy.motion.waypoints import ActionSpec
from viskill_deploy.sim.letters import GRASP_YAW_RAD, NAMES, PREFIX, grasp_point
from viskill_deploy.sim.panel_model import COLUMNS, ROWS, column_y, door_name, row_x
from viskill_deploy.sim.tasks import matchboardpanel_script as script
from viskill_deploy.sim.tasks.base import Layout, SkillSpec
from viskill_deploy.sim.tasks.bipegtransfer import fixed_euler

REFERENCE_LETTER = PREFIX + "C"
LETTER_XY_M = (0.050, 0.055)
LETTER_SPREAD_M = (0.002, 0.004)
"""A letter lies up to this far beyond `LETTER_XY_M`."""
DROP_M = 0.0005
"""A letter starts this far above the table."""

JAW_OPEN_RAD = 0.7
"""As in the reference: no peg stands beside what the jaw takes hold of."""

RAISE_NOISE_M = 0.004
SLIDE_NOISE_M = 0.0005
OPENING_M = 0.075
"""A door is open when it has slid its own length."""

SKILL_TOLERANCE_M = 0.005
CLOSED_TOLERANCE_M = 0.005
REST_TOLERANCE_M = 0.001
SPEED_TOLERANCE_M_S = 0.005

SKILLS = (
    SkillSpec("pull", 45, (True,)),
    SkillSpec("grasp", 30, (True,), holds=(True,)),
    SkillSpec("release", 30, (True,)),
    SkillSpec("push", 45, (True,)),
)

OBSERVATION: Layout = (
    ("psm1_position", 3),
    ("psm1_euler", 3),
    ("psm1_jaw", 1),
    ("object_position", 3),
    ("object_from_psm1", 3),
    ("grasp1_position", 3),
    ("grasp1_euler", 3),
    ("door_position", 3),
    ("handle_position", 3),
    ("object_goal_position", 3),
    ("handle_goal_position", 3),
)
GOAL: Layout = (("first_position", 3), ("second_position", 3), ("contact", 1))


@dataclass(frozen=True)
class MatchBoardPanel:
    """The task in a cell that has a panel and letters."""

    cell: CellDescription
    panel: Panel
    letter: Letter
    name: str = "matchboardpanel"
    batched: bool = True
    skills: tuple[SkillSpec, ...] = SKILLS
    action: ActionSpec = field(default_factory=lambda: ActionSpec(jaw_open_rad=JAW_OPEN_RAD))
    observation_layout: Layout = OBSERVATION
    goal_layout: Layout = GOAL
    distributions: tuple[str, ...] = ("reference", "wide")

    @property
    def rest_height_m(self) -> float:
        """Height of the centre of a letter that lies in a cell."""
        return self.panel.plate_top_m + self.letter.size_m[2] / 2

    def sample_layout(self, rng: np.random.Generator, distribution: str) -> Scene:
        """A letter beside the board and a cell for it; all doors closed.

        In both distributions the cell is any of the nine and the letter lies up to 2 mm (x) and
        4 mm (y) off its place. `reference`: the letter is a C. `wide`: any of the nine characters.

        Raises:
            ValueError: another distribution.
        """
        if distribution not in self.distributions:
            raise ValueError(f"distribution {distribution!r} is unknown; use {self.distributions}")
        row, column = rng.integers(ROWS), rng.integers(COLUMNS)
        active = REFERENCE_LETTER if distribution == "reference" else str(rng.choice(NAMES))
        pose = np.eye(4)
        pose[:2, 3] = np.array(LETTER_XY_M) + rng.uniform(0.0, LETTER_SPREAD_M)
        pose[2, 3] = self.letter.size_m[2] / 2 + DROP_M
        objects = [ObjectPose(active, pose)]
        for number in range(ROWS):
            closed = np.eye(4)
            closed[:3, 3] = row_x(self.panel)[number], 0.0, self.panel.door_height_m
            objects.append(ObjectPose(door_name(number), closed))
        goal = [row_x(self.panel)[row], column_y(self.panel)[column], self.rest_height_m]
        return Scene(0.0, tuple(objects), active, np.array(goal))

    def observe(
        self, T_task_tip: Sequence[FloatArray], jaws: Sequence[float | FloatArray], scene: Scene
    ) -> FloatArray:
        """The observation, (..., 31), laid out as `OBSERVATION`.

        Args:
            T_task_tip: measured tip of the one arm, (..., 4, 4).
            jaws: measured opening of its jaw, (...) rad.
            scene: gives the letter's pose, the goal, and the pose of the door over it.
        """
        tip, letter = T_task_tip[0], scene.pose(scene.active)
        door = scene.pose(self._door_over(scene.goal))[..., :3, 3]
        place, turn = letter[..., :3, 3], letter[..., :3, :3]
        jaw_frame = tip[..., :3, :3] @ self.cell.arms[0].arm.tip_rotation.T
        grasp = (turn @ self._grasp_points(scene.active)[..., None])[..., 0]
        parts = [
            tip[..., :3, 3],
            fixed_euler(jaw_frame),
            np.asarray(jaws[0], dtype=np.float64)[..., None],
            place,
            place - tip[..., :3, 3],
            place + grasp,
            fixed_euler(turn @ _about_z(GRASP_YAW_RAD)),
            door,
            door + self.panel.handle_from_door_m,
            scene.goal,
            self._closed_handle(scene.goal),
        ]
        return np.concatenate(parts, axis=-1)

    def _rows(self, goal: FloatArray) -> npt.NDArray[np.intp]:
        """The rows in which goals (..., 3) lie, (...)."""
        rows: npt.NDArray[np.intp] = np.abs(goal[..., :1] - row_x(self.panel)).argmin(axis=-1)
        return rows

    def _door_over(self, goal: FloatArray) -> Any:
        """Name of the door over a goal (3,); a tuple of names for goals (N, 3)."""
        rows = self._rows(goal)
        return tuple(map(door_name, rows.tolist())) if rows.ndim else door_name(int(rows))

    def _closed_handle(self, goal: FloatArray) -> FloatArray:
        """The closed door's handle in the rows of goals (..., 3); (..., 3) m."""
        x, y, z = self.panel.handle_from_door_m
        handle = np.empty_like(goal)
        handle[..., 0] = row_x(self.panel)[self._rows(goal)] + x
        handle[..., 1], handle[..., 2] = y, self.panel.door_height_m + z
        return handle

    def _grasp_points(self, active: str | Sequence[str]) -> FloatArray:
        """Where a jaw takes the active letter, or each of them, in its frame; (..., 3) m."""
        if isinstance(active, str):
            return grasp_point(self.letter, active)
        return np.array([grasp_point(self.letter, name) for name in active])

    def subgoals(
        self, observation: FloatArray, scene: Scene, rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        """The scripted plan's subgoals, (7,) each, laid out as `GOAL`.

        Args:
            observation: the first of the episode, the letter at rest and the doors closed.
            scene: not needed; the observation holds the goal.
            rng: draws up to 4 mm of height, and up to 0.5 mm of the way that the door is opened.
        """
        seen = script.read(observation)
        up = np.array([0.0, 0.0, rng.uniform(0.0, RAISE_NOISE_M)])
        open_by = np.array([0.0, OPENING_M + rng.uniform(0.0, SLIDE_NOISE_M), 0.0])
        clear = np.array([0.0, 0.0, script.CLEAR_M])
        handle = seen.closed + open_by
        lift = np.array([0.0, 0.0, script.LIFT_M]) + up
        taken = seen.frame + np.array([0.0, 0.0, script.GRASP_M])
        let_go = taken + seen.goal - seen.letter + lift
        behind = np.array([0.0, script.CONTACT_M, 0.0])
        return {
            "pull": _goal(handle - behind + clear + up, handle),
            "grasp": _goal(taken + lift, seen.letter + lift),
            "release": _goal(let_go, seen.goal),
            "push": self.final_subgoal(observation, scene),
        }

    def scripted_action(
        self, skill: str, observation: FloatArray, subgoal: FloatArray
    ) -> FloatArray:
        """The scripted controller's actions, (..., 5)."""
        return script.act(skill, observation, subgoal, self.action)

    def complete_subgoal(
        self, skill: str, positions: FloatArray, observation: FloatArray, scene: Scene
    ) -> FloatArray:
        """Chosen positions (..., 6) and no touch of the door, (..., 7).

        A door has only one way to go: of the handle's place in `pull` y alone is chosen. In
        `release` the letter's place is the task's own goal.
        """
        del scene
        seen, chosen = script.read(observation), np.array(positions, dtype=np.float64)
        if skill == "pull":
            chosen[..., 3], chosen[..., 5] = seen.closed[..., 0], seen.closed[..., 2]
        if skill == "release":
            chosen[..., 3:6] = seen.goal
        return _goal(chosen[..., 0:3], chosen[..., 3:6])

    def final_subgoal(self, observation: FloatArray, scene: Scene) -> FloatArray:
        """The target row's door closed and the jaw above it and clear of its handle, (..., 7)."""
        del scene
        closed = script.read(observation).closed
        away = np.array([0.0, script.CONTACT_M, script.CLEAR_M])
        return _goal(closed + away, closed)

    def flags(self, thing: ActiveObject) -> tuple[bool, ...]:
        """Whether the wrist touches the target row's door now."""
        return (thing.door_touched,)

    def achieved(
        self, skill: str, observation: FloatArray, flags: Sequence[bool] | FloatArray
    ) -> FloatArray:
        """The jaw's place, that of handle or letter, and the wrist's touch, (..., 7)."""
        seen = script.read(observation)
        second = seen.handle if skill in ("pull", "push") else seen.letter
        return np.concatenate([seen.position, second, np.asarray(flags, np.float64)], axis=-1)

    def skill_success(
        self, skill: str, achieved: FloatArray, subgoal: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Whether a skill has reached its subgoal: within 5 mm as one vector, the door untouched.

        The jaw's place counts in every skill: a handle, a letter that is still in touch with the
        jaw is not yet where it will stay.
        """
        del skill
        error = (achieved - subgoal)[..., :6]
        near = np.sqrt((error**2).sum(axis=-1)) < SKILL_TOLERANCE_M
        reached: npt.NDArray[np.bool_] = near & (achieved[..., 6] == subgoal[..., 6])
        return reached

    def success(self, thing: ActiveObject, scene: Scene) -> bool:
        """Whether the letter lies in its cell, let go and at rest, and the door is closed."""
        door = scene.pose(self._door_over(scene.goal))
        return bool(
            self.is_in_cell(thing.T_task_object, scene.goal)
            and self.is_closed(door)
            and thing.speed_m_s < SPEED_TOLERANCE_M_S
            and not any(thing.touched)
        )

    def is_in_cell(self, T_task_letter: FloatArray, goal: FloatArray) -> npt.NDArray[np.bool_]:
        """Whether the whole of a letter (..., 4, 4) lies flat on the plate at a goal (..., 3)."""
        half = np.array(self.letter.size_m) / 2
        reach = np.abs(T_task_letter[..., :3, :3]) @ half
        off = np.abs(T_task_letter[..., :3, 3] - goal)
        inside = (off + reach)[..., :2].max(axis=-1) <= self.panel.pitch_m / 2
        flat = (off[..., 2] <= REST_TOLERANCE_M) & (reach[..., 2] <= half[2] + REST_TOLERANCE_M)
        return np.asarray(inside & flat)

    def is_closed(self, T_task_door: FloatArray) -> npt.NDArray[np.bool_]:
        """Whether a door (..., 4, 4) is closed."""
        return np.asarray(np.abs(T_task_door[..., 1, 3]) <= CLOSED_TOLERANCE_M)


def _goal(first: FloatArray, second: FloatArray) -> FloatArray:
    """A subgoal (..., 7): two places, and a door that the wrist does not touch."""
    return np.concatenate([first, second, np.zeros((*first.shape[:-1], 1))], axis=-1)


def _about_z(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def make(cell: CellDescription) -> MatchBoardPanel:
    """The task in `cell`.

    Raises:
        DataFileError: the cell does not have one arm, a panel and letters.
    """
    panel, letter = cell.file.panel, cell.file.letter
    if panel is None or letter is None or len(cell.arms) != 1:
        raise DataFileError(
            cell.files[0],
            "panel",
            "MatchBoardPanel needs one arm, a [panel] and a [letter]; add them",
        )
    return MatchBoardPanel(cell, panel, letter)
