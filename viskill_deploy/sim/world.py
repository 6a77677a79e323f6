"""The one world: policies are trained in it and the loopback driver steps it.

Time passes in control periods. In each of them every arm gets a setpoint, and physics runs in steps
of at most 4 ms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from viskill_deploy.core.arm_errors import with_errors
from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.types import ActiveObject, FloatArray, JointSetpoint, ObjectPose, Scene
from viskill_deploy.motion.resolve import resolve, start_seeds
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.sim.imperfections import (
    AXES,
    Drives,
    Imperfections,
    WorldOptions,
    displace_bases,
)
from viskill_deploy.sim.scene import LONGEST_STEP_S, build_model
from viskill_deploy.sim.seeing import Seeing, seen_from_board
from viskill_deploy.sim.things import Things, colour

__all__ = ["AXES", "ArmReading", "World", "WorldOptions", "controls"]

SETTLE_S = 0.25
"""Things are let fall for this long at a reset, as in the reference scene."""

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclass(frozen=True, slots=True)
class ArmReading:
    """Measured joints of one arm, (n,), and jaw opening with their speeds; rad, m, s."""

    jp: tuple[float, ...]
    jv: tuple[float, ...]
    jaw: float
    jaw_v: float


class _ArmIndex:
    """Where one arm's numbers lie in MuJoCo's vectors."""

    def __init__(self, model: mujoco.MjModel, arm: CellArm) -> None:
        joints = [f"{arm.name}/{joint.name}" for joint in arm.arm.joints]
        fingers = [f"{arm.name}/jaw_left", f"{arm.name}/jaw_right"]
        ids = [model.joint(name).id for name in (*joints, *fingers)]
        self.qpos: npt.NDArray[np.intp] = np.array([model.jnt_qposadr[i] for i in ids])
        self.qvel: npt.NDArray[np.intp] = np.array([model.jnt_dofadr[i] for i in ids])
        parts = ("wrist", "jaw_left", "jaw_right")
        self.geoms = {model.geom(f"{arm.name}/{part}").id for part in parts}
        self.wrist = model.geom(f"{arm.name}/wrist").id


class World:
    """The arms, the board and the things on it.

    Args:
        cell: the cell.
        options: period, noise, delay and what else is not perfect.
        seed: of noise, offsets and losses.
        only: name of the one free thing to have; all of them by default.

    Attributes:
        cell: the cell.
        options: as given.
        imperfections: what lies between the driver and this world.
        drives: the arms' drives, which can break.
        seeing: what is said of where tips and things are.
        substeps: physics steps in a control period.
        model, data: MuJoCo's, for rendering; leave writing to this class.
    """

    def __init__(
        self,
        cell: CellDescription,
        options: WorldOptions | None = None,
        seed: int = 0,
        only: str | None = None,
    ) -> None:
        self.cell, self.options = cell, options or WorldOptions()
        self.substeps: int = math.ceil(self.options.period_s / LONGEST_STEP_S - 1e-9)
        names = [arm.name for arm in cell.arms]
        truth = self.options.truth
        if len(truth) not in {0, len(names)}:
            raise ValueError(f"the truth is about {len(truth)} arms; this cell has {len(names)}")
        really = with_errors(cell, dict(zip(names, truth, strict=False)))
        really = seen_from_board(really, self.options)
        self.model = build_model(
            really, self.options.period_s / self.substeps, self.options.joint_friction, only
        )
        displace_bases(self.model, cell, self.options, seed)
        self.data = mujoco.MjData(self.model)
        self.imperfections = Imperfections(self.options, len(cell.arms), seed, _slides(cell))
        self.drives, self.seeing = Drives(self.model), Seeing(self.options, seed)
        if self.options.stuck:
            self.drives.stick(self.options.stuck)
        self._arms = [_ArmIndex(self.model, arm) for arm in cell.arms]
        self._things = Things(self.model)
        self._active, self._goal = "", np.zeros(3)
        home = resolve(cell, [start_waypoint(cell)], start_seeds(cell))
        self.home: FloatArray = home[1]
        """Axis positions (arms, axes) of the cell's start pose."""
        if not self.things:  # no scene will ever say that a run begins
            self.place(Scene(0.0, (), "", np.zeros(3)))

    @property
    def things(self) -> tuple[str, ...]:
        """Names of what the arms can move."""
        return self._things.names

    @property
    def settle_steps(self) -> int:
        """Physics steps for which things are let fall at a reset."""
        return math.ceil(SETTLE_S / float(self.model.opt.timestep))

    @property
    def arm_qpos(self) -> npt.NDArray[np.intp]:
        """Where each arm's joints and its two fingers lie in `qpos`, (arms, 8)."""
        return np.array([index.qpos for index in self._arms])

    @property
    def time_s(self) -> float:
        """Simulated time since the reset."""
        return float(self.data.time)

    def seed(self, seed: int) -> None:
        """Restarts noise, losses and jitter."""
        self.imperfections.seed(seed)

    def reset(
        self,
        scene: Scene,
        axes: npt.ArrayLike | None = None,
        setpoints: npt.ArrayLike | None = None,
    ) -> None:
        """Puts things and arms in place, lets the things fall and starts time at 0.

        Args:
            scene: poses of things; those that it does not name are put aside.
            axes: axis positions (arms, axes), jaw last; the cell's start pose by default.
            setpoints: what the arms are told to hold, (arms, axes); where they are by default. A
                jaw that squeezes something is told to close farther than it can.

        Raises:
            ViskillError: the scene names an object that this world does not have.
        """
        self.place(scene, axes, setpoints)
        colour(self.model, self._active, self._goal)
        mujoco.mj_step(self.model, self.data, nstep=self.settle_steps)
        self.data.time = 0.0

    def place(
        self,
        scene: Scene,
        axes: npt.ArrayLike | None = None,
        setpoints: npt.ArrayLike | None = None,
    ) -> None:
        """The first half of `reset`: everything in place and still, nothing fallen yet."""
        start = self.home if axes is None else np.asarray(axes, dtype=np.float64)
        told = start if setpoints is None else np.asarray(setpoints, dtype=np.float64)
        mujoco.mj_resetData(self.model, self.data)
        self._things.place(self.data, scene)
        self.seeing.put_down(self.things)
        true = self.imperfections.true_axes(start)
        for index, row in zip(self._arms, true, strict=True):
            self.data.qpos[index.qpos[:-2]] = row[:-1]
            self.data.qpos[index.qpos[-2:]] = max(row[-1], 0.0) / 2
        self.attend(scene.active, scene.goal)
        still = controls(told, np.zeros_like(told))
        self.data.ctrl[:] = self.imperfections.start(still)

    def attend(self, active: str, goal: FloatArray) -> None:
        """Says which thing counts, and where it has to go."""
        self._active, self._goal = active, np.array(goal)

    def knock(self, way: npt.ArrayLike) -> None:
        """Strikes the active thing out of whatever holds it: from there it falls.

        Args:
            way: how far and where it is struck, task frame, (3,) m.

        Raises:
            ViskillError: the active thing slides and cannot be struck out of anything.
        """
        self._things.knock(self.data, self._active, np.asarray(way, dtype=np.float64))
        mujoco.mj_forward(self.model, self.data)

    def step(self, setpoints: Sequence[JointSetpoint]) -> None:
        """Lets one control period pass under one setpoint an arm."""
        flat: list[float] = []  # a list is built faster than small arrays are stacked
        for s in setpoints:
            for position, velocity in zip((*s.jp, s.jaw), (*s.jv, s.jaw_v), strict=True):
                flat += (position, velocity)
        self._period(np.array(flat))

    def run(self, positions: FloatArray, velocities: FloatArray) -> None:
        """Lets a whole segment pass.

        Args:
            positions: axis positions after each period, (n, arms, axes).
            velocities: axis velocities after each period, (n, arms, axes).
        """
        for row in controls(positions, velocities):
            self._period(row)

    def _period(self, row: FloatArray) -> None:
        self.data.ctrl[:] = self.imperfections.felt(row)
        mujoco.mj_step(self.model, self.data, nstep=self.substeps)

    def measured(self, arm: int) -> ArmReading:
        """What the arm's sensors say, with noise where the options ask for it."""
        index = self._arms[arm]
        q, v = self.data.qpos[index.qpos], self.data.qvel[index.qvel].tolist()
        q[-2] += q[-1]
        axes = self.imperfections.measured(arm, q[:-1]).tolist()
        return ArmReading(tuple(axes[:-1]), tuple(v[:-2]), axes[-1], v[-2] + v[-1])

    def tips(self, beyond_m: float = 0.0) -> FloatArray:
        """Where the tips really are now, task frame, (arms, 3) m.

        Args:
            beyond_m: points this far beyond the jaw pivots, along the tips' z, instead.
        """
        mujoco.mj_kinematics(self.model, self.data)  # a step leaves poses of before it
        sites = [self.data.site(f"{arm.name}/tip") for arm in self.cell.arms]
        tips = [site.xpos + beyond_m * site.xmat.reshape(3, 3)[:, 2] for site in sites]
        return self.seeing.points(np.array(tips))

    def scene(self) -> Scene:
        """Where the things are, as a camera would tell, with noise and error where asked for."""
        objects = []
        for name in self._things.names:
            pose = self.seeing.thing(name, self._things.pose(self.data, name))
            if self.options.object_noise_m:
                pose[:3, 3] += self.imperfections.seen_shift()
            objects.append(ObjectPose(name, pose))
        return Scene(self.time_s, tuple(objects), self._active, self._goal)

    def active_object(self) -> ActiveObject:
        """The true state of the active object, in the board's own frame: its goal is there."""
        things, name = self._things, self._active
        partners = things.touching(self.data, name)
        touched = tuple(not index.geoms.isdisjoint(partners) for index in self._arms)
        pose, speed = things.pose(self.data, name), things.speed(self.data, name)
        return ActiveObject(pose, speed, touched, self._is_door_touched())

    def _is_door_touched(self) -> bool:
        """Whether a wrist touches the door over the goal."""
        door = self._things.door_over(self._goal)
        if not door:
            return False
        wrists = {index.wrist for index in self._arms}
        return not wrists.isdisjoint(self._things.touching(self.data, door))

    def save(self) -> FloatArray:
        """The physical state, for `restore`."""
        state: FloatArray = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, state, _STATE)
        return state

    def restore(self, state: FloatArray) -> None:
        """Goes back to a state of `save` of the same world and episode."""
        mujoco.mj_setState(self.model, self.data, state, _STATE)
        mujoco.mj_forward(self.model, self.data)


def _slides(cell: CellDescription) -> tuple[bool, ...]:
    """Which joints of an arm are prismatic, as in the first one."""
    return tuple(joint.type == "prismatic" for joint in cell.arms[0].arm.joints)


def controls(positions: FloatArray, velocities: FloatArray) -> FloatArray:
    """MuJoCo's control vector: position, velocity of every axis in turn, (..., 2 axes)."""
    pairs = np.stack([positions, velocities], axis=-1)
    return pairs.reshape(*positions.shape[:-2], -1)
