"""BiPegBoard: PSM2 pulls a ring off a wall's peg, hands it to PSM1, which lays it over another peg.

Vectors are those of the ViSkill reference task in metres and in the task frame. EEF poses are those
of the last link (frame 6: y forward, z along the jaw's hinge), whose origin is the tip's. PSM1
works in pitch mode, PSM2 in yaw mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.cell_files import Board, Ring, Wall
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import ActiveObject, FloatArray, ObjectPose, Scene
from viskill_deploy.motion.waypoints import ActionSpec
from viskill_deploy.sim.tasks import bipegboard_script as script
from viskill_deploy.sim.tasks.base import Layout, SkillSpec
from viskill_deploy.sim.tasks.bipegtransfer import CONTACTS, GOAL, OBSERVATION

START_PEGS = (0, 1, 2)
WIDE_START_PEGS = (0, 1, 2, 3, 4)
"""The upper row but for the peg farthest on PSM1's side: a ring that is pulled off there would
meet PSM1 where it has to wait."""
GOAL_PEG = 1
ON_PEG = 0.5
"""Part of a peg's length at which its ring hangs."""
DROP_M = 0.001
"""A ring starts this far above the place where it hangs."""

JAW_OPEN_RAD = 0.7
PULL_M = 0.030
"""How far PSM2 pulls the ring along its peg: it is off after 13 mm."""
LIFT_M = 0.004
"""How far it lifts the ring before: about half of the play of the hole on the peg."""
MEET_M = 0.009
"""PSM1's y at the handover, and minus PSM2's."""
CLEAR_M = 0.022
"""PSM1 waits with its pivot at least this far, along y, from the centre of the hanging ring."""
CARRY_M = 0.020
"""How far along y PSM1 carries the ring away from PSM2 before the release skill starts."""
HANDOVER_NOISE_M = 0.008

SKILL_TOLERANCE_M = 0.005
PEG_TOLERANCE_M = 0.005
REST_TOLERANCE_M = 0.002
SPEED_TOLERANCE_M_S = 0.005

SKILLS = (
    SkillSpec("grasp", 30, (True, True), holds=(False, True)),
    SkillSpec("handover", 35, (False, True), holds=(True, False)),
    SkillSpec("release", 35, (True, True)),
)

FRAME_ROTATION = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Grasp frames have the ring's y axis as x. It stays level from the wall's peg to the standing one,
so that the frames' angles are continuous all the way; the ring's own would not be."""


def fixed_euler(R: FloatArray, yaw_centre: float = 0.0) -> FloatArray:
    """Fixed-axis x, y, z angles of rotations (..., 3, 3), as (..., 3), rad.

    Args:
        R: the rotations.
        yaw_centre: yaw is given within half a turn of it.
    """
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0]) - yaw_centre
    yaw = yaw_centre + np.remainder(yaw + math.pi, 2 * math.pi) - math.pi
    angles: FloatArray = np.stack([roll, pitch, yaw], axis=-1)
    return angles


@dataclass(frozen=True)
class BiPegBoard:
    """The task in a cell that has a board, a wall with pegs, and rings."""

    cell: CellDescription
    board: Board
    wall: Wall
    ring: Ring
    name: str = "bipegboard"
    batched: bool = True
    skills: tuple[SkillSpec, ...] = SKILLS
    action: ActionSpec = field(
        default_factory=lambda: ActionSpec(jaw_open_rad=JAW_OPEN_RAD, rotation=("pitch", "yaw"))
    )
    observation_layout: Layout = OBSERVATION
    goal_layout: Layout = GOAL
    distributions: tuple[str, ...] = ("reference", "wide")

    @property
    def rest_height_m(self) -> float:
        """Height of the centre of a ring that lies on the board."""
        return self.ring.tube_radius_m

    def sample_layout(self, rng: np.random.Generator, distribution: str) -> Scene:
        """Rings on pegs of the wall's upper row, and the goal peg.

        `reference`: rings on the three pegs on PSM2's side. `wide`: on any three of the five pegs
        from PSM2's side on. In both the active ring is any of the three.

        Raises:
            ValueError: another distribution.
        """
        if distribution == "reference":
            pegs = np.array(START_PEGS)
        elif distribution == "wide":
            pegs = rng.permutation(WIDE_START_PEGS)[: self.ring.count]
        else:
            raise ValueError(f"distribution {distribution!r} is unknown; use {self.distributions}")
        active = int(rng.integers(len(pegs)))
        x = self.wall.front_x_m + ON_PEG * self.wall.peg_length_m
        slack = self.ring.radius_m - self.ring.tube_radius_m - self.wall.peg_radius_m
        objects = []
        for index, peg in enumerate(pegs.tolist()):
            (y, z), pose = self.wall.peg_yz_m[peg], np.eye(4)
            pose[:3, 3] = x, y, z - slack + DROP_M
            objects.append(ObjectPose(f"ring{index}", pose))
        goal = np.array([*self.board.peg_xy_m[GOAL_PEG], self.rest_height_m])
        return Scene(0.0, tuple(objects), f"ring{active}", goal)

    def observe(
        self,
        T_task_tip: Sequence[FloatArray],
        jaws: Sequence[float | FloatArray],
        scene: Scene,
    ) -> FloatArray:
        """The observation, (..., 35), laid out as `OBSERVATION`.

        Args:
            T_task_tip: measured tip of PSM1 and PSM2, (..., 4, 4) each.
            jaws: measured opening of both jaws, (...) each, rad.
            scene: gives the active object's pose.
        """
        T_task_ring = scene.pose(scene.active)
        place, parts = T_task_ring[..., :3, 3], []
        for arm, T, jaw in zip(self.cell.arms, T_task_tip, jaws, strict=True):
            centre = -math.pi if arm.entry.rotation == "pitch" else 0.0
            angles = fixed_euler(T[..., :3, :3] @ arm.arm.tip_rotation.T, centre)
            parts += [T[..., :3, 3], angles, np.asarray(jaw)[..., None]]
        parts += [place, *(place - T[..., :3, 3] for T in T_task_tip)]
        angles = fixed_euler(T_task_ring[..., :3, :3] @ FRAME_ROTATION)
        for frame in self.ring.grasp_frame_m:
            parts += [place + T_task_ring[..., :3, :3] @ np.array(frame), angles]
        return np.concatenate(parts, axis=-1)

    def subgoals(
        self, observation: FloatArray, scene: Scene, rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        """The scripted plan's subgoals, (8,) each, laid out as `GOAL`.

        Args:
            observation: the first of the episode, rings at rest.
            scene: gives the goal.
            rng: draws the handover noise, up to 8 mm on each axis, the same for both arms.
        """
        noise = rng.uniform(0.0, HANDOVER_NOISE_M, 3)
        ring, frame1, frame2 = observation[14:17], observation[23:26], observation[29:32]
        meet1 = np.array([frame1[0] + PULL_M, MEET_M, frame1[2]]) + noise
        meet2 = np.array([frame2[0] + PULL_M, -MEET_M, frame2[2] + LIFT_M]) + noise
        pulled = np.array([meet2[0], frame2[1], frame2[2] + LIFT_M])
        wait = np.array([meet1[0], max(meet1[1], ring[1] + CLEAR_M), meet1[2]])
        carried = meet1 + np.array([0.0, CARRY_M, 0.0])
        return {
            "grasp": np.concatenate([wait, pulled, CONTACTS["grasp"]]),
            "handover": np.concatenate([meet2, carried, CONTACTS["handover"]]),
            "release": np.concatenate([meet2, scene.goal, CONTACTS["release"]]),
        }

    def scripted_action(
        self, skill: str, observation: FloatArray, subgoal: FloatArray
    ) -> FloatArray:
        """The scripted controller's action, (..., 10)."""
        return script.act(skill, observation, subgoal, self.action)

    def complete_subgoal(
        self, skill: str, positions: FloatArray, observation: FloatArray, scene: Scene
    ) -> FloatArray:
        """Chosen positions (6,) with the contacts that the skill has to end with, (8,)."""
        del observation, scene
        return np.concatenate([positions, CONTACTS[skill]])

    def final_subgoal(self, observation: FloatArray, scene: Scene) -> FloatArray:
        """The ring at the goal, PSM2 where it is, (8,)."""
        return np.concatenate([observation[7:10], scene.goal, CONTACTS["release"]])

    def flags(self, thing: ActiveObject) -> tuple[bool, ...]:
        """Per arm, whether it touches the ring."""
        return thing.touched

    def achieved(
        self, skill: str, observation: FloatArray, flags: Sequence[bool] | FloatArray
    ) -> FloatArray:
        """Positions and contacts in the order of the skill's subgoal, (..., 8)."""
        psm1, psm2 = observation[..., 0:3], observation[..., 7:10]
        first, second = {
            "grasp": (psm1, psm2),
            "handover": (psm2, psm1),
            "release": (psm2, observation[..., 14:17]),
        }[skill]
        return np.concatenate([first, second, np.asarray(flags, dtype=np.float64)], axis=-1)

    def skill_success(
        self, skill: str, achieved: FloatArray, subgoal: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Whether a skill has reached its subgoal.

        Positions have to be within 5 mm (as one vector) and contacts as the subgoal says. In the
        last skill only the object's position counts.
        """
        error = (achieved - subgoal)[..., 3 if skill == self.skills[-1].name else 0 : 6]
        near = np.sqrt((error**2).sum(axis=-1)) < SKILL_TOLERANCE_M
        same = (achieved[..., 6:] == subgoal[..., 6:]).all(axis=-1)
        reached: npt.NDArray[np.bool_] = near & same
        return reached

    def success(self, thing: ActiveObject, scene: Scene) -> bool:
        """Whether the ring lies around the goal peg, let go.

        It does with its centre within 5 mm of the peg's axis and at most 2 mm above its rest
        height, slower than 5 mm/s, touched by no arm.
        """
        place = thing.T_task_object[:3, 3]
        return bool(
            math.dist(place[:2], scene.goal[:2]) <= PEG_TOLERANCE_M
            and place[2] - self.rest_height_m <= REST_TOLERANCE_M
            and thing.speed_m_s < SPEED_TOLERANCE_M_S
            and not any(thing.touched)
        )


def make(cell: CellDescription) -> BiPegBoard:
    """The task in `cell`.

    Raises:
        DataFileError: the cell lacks a board, a wall, rings, or PSM1 in pitch and PSM2 in yaw mode.
    """
    file = cell.file
    modes = [arm.entry.rotation for arm in cell.arms]
    if file.board is None or file.wall is None or file.ring is None or modes != ["pitch", "yaw"]:
        raise DataFileError(
            cell.files[0],
            "board",
            "BiPegBoard needs a [board], a [wall] and a [ring], and two arms, the first with "
            "start_pitch_rad, the second with start_yaw_rad; add them",
        )
    return BiPegBoard(cell, file.board, file.wall, file.ring)
