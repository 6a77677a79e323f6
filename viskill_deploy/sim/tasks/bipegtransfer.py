"""BiPegTransfer: PSM2 takes a block off its peg, hands it to PSM1, which puts it on another peg.

Vectors are those of the ViSkill reference task in metres and in the task frame. EEF poses are those
of the last link (frame 6: y forward, z along the jaw's hinge), whose origin is the tip's.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.cell_files import Block, Board
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import ActiveObject, FloatArray, ObjectPose, Scene
from viskill_deploy.motion.waypoints import ActionSpec
from viskill_deploy.sim.tasks import bipegtransfer_script as script
from viskill_deploy.sim.tasks.base import Layout, SkillSpec

ACTIVE_PEGS = (11, 6, 9, 10)
START_PEGS = (6, 7, 8, 9, 10, 11)
GOAL_PEGS = (0, 1, 2, 3, 4, 5)
REFERENCE_GOAL_PEG = 2
BLOCK_YAW_RAD = math.radians(30.0)
DROP_M = 0.001
"""A block starts this far above the board."""

HANDOVER_NOISE_M = 0.008
HANDOVER_SHARE = 0.3
"""Part of the way to the goal peg that PSM1 carries the block before the release skill starts."""

SKILL_TOLERANCE_M = 0.005
PEG_TOLERANCE_M = 0.005
REST_TOLERANCE_M = 0.003
SPEED_TOLERANCE_M_S = 0.005

SKILLS = (
    SkillSpec("grasp", 45, (True, True), holds=(False, True)),
    SkillSpec("handover", 35, (False, True), holds=(True, False)),
    SkillSpec("release", 20, (True, True)),
)

CONTACTS = {"grasp": (0.0, 1.0), "handover": (1.0, 0.0), "release": (0.0, 0.0)}
"""Which arms touch the block at the end of each skill."""

OBSERVATION: Layout = (
    ("psm1_position", 3),
    ("psm1_euler", 3),
    ("psm1_jaw", 1),
    ("psm2_position", 3),
    ("psm2_euler", 3),
    ("psm2_jaw", 1),
    ("object_position", 3),
    ("object_from_psm1", 3),
    ("object_from_psm2", 3),
    ("grasp1_position", 3),
    ("grasp1_euler", 3),
    ("grasp2_position", 3),
    ("grasp2_euler", 3),
)
GOAL: Layout = (("first_position", 3), ("second_position", 3), ("contact", 2))


def fixed_euler(R: FloatArray) -> FloatArray:
    """Fixed-axis x, y, z angles of rotations (..., 3, 3), (..., 3) rad."""
    opposite = (R[..., 2, 1], -R[..., 2, 0], R[..., 1, 0])
    adjacent = (R[..., 2, 2], np.hypot(R[..., 0, 0], R[..., 1, 0]), R[..., 0, 0])
    angles: FloatArray = np.arctan2(np.stack(opposite, axis=-1), np.stack(adjacent, axis=-1))
    return angles


@dataclass(frozen=True)
class BiPegTransfer:
    """The task in a cell that has a peg board and blocks."""

    cell: CellDescription
    board: Board
    block: Block
    name: str = "bipegtransfer"
    batched: bool = True
    skills: tuple[SkillSpec, ...] = SKILLS
    action: ActionSpec = field(default_factory=ActionSpec)
    observation_layout: Layout = OBSERVATION
    goal_layout: Layout = GOAL
    distributions: tuple[str, ...] = ("reference", "wide")

    @functools.cached_property
    def _grasp_frames(self) -> tuple[FloatArray, ...]:
        """Where a jaw takes hold of each side, in the block's frame, (4, 4) each."""
        places = zip(self.block.grasp_frame_xy_m, self.block.grasp_frame_yaw_rad, strict=True)
        return tuple(_upright(xy, 0.0, yaw) for xy, yaw in places)

    @property
    def rest_height_m(self) -> float:
        """Height of the centre of a block that stands on the board."""
        return self.block.height_m / 2

    def sample_layout(self, rng: np.random.Generator, distribution: str) -> Scene:
        """Blocks on pegs and a goal peg.

        `reference`: goal peg 2, blocks on pegs 11, 6, 9, 10. `wide`: any of the six goal pegs,
        blocks on any four of the six start pegs. In both the active block is any of the four and
        every block is turned by up to 30 degrees.

        Raises:
            ValueError: another distribution.
        """
        if distribution == "reference":
            pegs, goal = np.array(ACTIVE_PEGS), REFERENCE_GOAL_PEG
        elif distribution == "wide":
            pegs = rng.permutation(START_PEGS)[: len(ACTIVE_PEGS)]
            goal = int(rng.choice(GOAL_PEGS))
        else:
            raise ValueError(f"distribution {distribution!r} is unknown; use {self.distributions}")
        active = int(rng.integers(len(pegs)))
        yaws = rng.uniform(-BLOCK_YAW_RAD, BLOCK_YAW_RAD, len(pegs))
        height = self.rest_height_m + DROP_M
        objects = tuple(
            ObjectPose(f"block{i}", _upright(self.board.peg_xy_m[peg], height, yaw))
            for i, (peg, yaw) in enumerate(zip(pegs.tolist(), yaws.tolist(), strict=True))
        )
        goal_point = np.array([*self.board.peg_xy_m[goal], self.rest_height_m])
        return Scene(0.0, objects, f"block{active}", goal_point)

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
        thing = scene.pose(scene.active)
        place = thing[..., :3, 3]
        tips = [T[..., :3, 3] for T in T_task_tip]
        frames = [thing @ frame for frame in self._grasp_frames]
        eefs = [
            T[..., :3, :3] @ arm.arm.tip_rotation.T
            for arm, T in zip(self.cell.arms, T_task_tip, strict=True)
        ]
        turned = np.stack([*eefs, *(frame[..., :3, :3] for frame in frames)], axis=-3)
        euler = fixed_euler(turned)
        parts: list[FloatArray] = []
        for index, (tip, jaw) in enumerate(zip(tips, jaws, strict=True)):
            parts += [tip, euler[..., index, :], np.asarray(jaw)[..., None]]
        parts += [place, *(place - tip for tip in tips)]
        for index, frame in enumerate(frames):
            parts += [frame[..., :3, 3], euler[..., 2 + index, :]]
        return np.concatenate(parts, axis=-1)

    def subgoals(
        self, observation: FloatArray, scene: Scene, rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        """The scripted plan's subgoals, (8,) each, laid out as `GOAL`.

        Args:
            observation: the first of the episode, blocks at rest.
            scene: gives the goal.
            rng: draws the handover noise, up to 8 mm on each axis, the same for both arms.
        """
        noise = rng.uniform(0.0, HANDOVER_NOISE_M, 3)
        seen = script.read(observation)
        pegs = np.array(self.board.peg_xy_m)
        peg = pegs[np.argmin(((pegs - seen.thing[:2]) ** 2).sum(axis=1))]
        lift = np.array([0.0, -peg[1], script.TRAVEL_M])
        meet1, meet2 = (frame.position + lift + noise for frame in seen.frames)
        up = np.array([0.0, 0.0, script.STEP_BACK_M])
        over_goal = scene.goal[:2] + seen.frames[0].position[:2] - peg
        carried = meet1.copy()
        carried[:2] += HANDOVER_SHARE * (over_goal - meet1[:2])
        lifted = np.array([*seen.frames[1].position[:2], meet2[2]])
        return {
            "grasp": np.concatenate([meet1 + up, lifted, CONTACTS["grasp"]]),
            "handover": np.concatenate([meet2 + up, carried, CONTACTS["handover"]]),
            "release": np.concatenate([meet2 + up, scene.goal, CONTACTS["release"]]),
        }

    def scripted_action(
        self, skill: str, observation: FloatArray, subgoal: FloatArray
    ) -> FloatArray:
        """The scripted controller's actions, (..., 10)."""
        return script.act(skill, observation, subgoal, self.action)

    def complete_subgoal(
        self, skill: str, positions: FloatArray, observation: FloatArray, scene: Scene
    ) -> FloatArray:
        """Chosen positions (6,) with the contacts that the skill has to end with, (8,)."""
        del observation, scene
        return np.concatenate([positions, CONTACTS[skill]])

    def final_subgoal(self, observation: FloatArray, scene: Scene) -> FloatArray:
        """The block at the goal, PSM2 where it is, (8,)."""
        return np.concatenate([observation[7:10], scene.goal, CONTACTS["release"]])

    def flags(self, thing: ActiveObject) -> tuple[bool, ...]:
        """Per arm, whether it touches the block."""
        return thing.touched

    def achieved(
        self, skill: str, observation: FloatArray, flags: Sequence[bool] | FloatArray
    ) -> FloatArray:
        """Positions and contacts in the order of the skill's subgoal, (..., 8)."""
        psm1, psm2, thing = observation[..., 0:3], observation[..., 7:10], observation[..., 14:17]
        first, second = {
            "grasp": (psm1, psm2),
            "handover": (psm2, psm1),
            "release": (psm2, thing),
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
        """Whether the block stands on the goal peg.

        It does within 5 mm of the peg's axis, at most 3 mm above its rest height, slower than
        5 mm/s, touched by no arm.
        """
        place = thing.T_task_object[:3, 3]
        return bool(
            math.dist(place[:2], scene.goal[:2]) <= PEG_TOLERANCE_M
            and place[2] - self.rest_height_m <= REST_TOLERANCE_M
            and thing.speed_m_s < SPEED_TOLERANCE_M_S
            and not any(thing.touched)
        )


def _upright(xy: Sequence[float], z: float, yaw: float) -> FloatArray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array(
        [[c, -s, 0.0, xy[0]], [s, c, 0.0, xy[1]], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]]
    )


def make(cell: CellDescription) -> BiPegTransfer:
    """The task in `cell`.

    Raises:
        DataFileError: the cell lacks two arms, a peg board or blocks.
    """
    board, block = cell.file.board, cell.file.block
    if board is None or block is None or len(cell.arms) != 2:
        raise DataFileError(
            cell.files[0],
            "board",
            "BiPegTransfer needs two arms, a [board] and a [block]; add them",
        )
    return BiPegTransfer(cell, board, block)
