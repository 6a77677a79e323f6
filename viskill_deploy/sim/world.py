"""The one world: policies are trained in it and the loopback driver steps it.

Time passes in control periods. In each of them every arm gets a setpoint, and physics runs in steps
of at most 4 ms.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.types import ActiveObject, FloatArray, JointSetpoint, ObjectPose, Scene
from viskill_deploy.motion.resolve import resolve
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.sim.scene import LONGEST_STEP_S, build_model
from viskill_deploy.sim.things import Things, colour

AXES = 7
SETTLE_S = 0.25
"""Things are let fall for this long at a reset, as in the reference scene."""

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


@dataclass(frozen=True, slots=True)
class WorldOptions:
    """How the world differs from a perfect one. All off by default.

    Attributes:
        period_s: control period.
        joint_noise_rad: standard deviation of measured revolute joints and jaws.
        joint_noise_m: standard deviation of measured insertions.
        object_noise_m: standard deviation of measured object positions.
        delay_periods: control periods between a setpoint and its effect.
        joint_friction: whether the joints have the Coulomb friction of their files.
    """

    period_s: float = 0.004
    joint_noise_rad: float = 0.0
    joint_noise_m: float = 0.0
    object_noise_m: float = 0.0
    delay_periods: int = 0
    joint_friction: bool = False

    def __post_init__(self) -> None:
        noises = (self.joint_noise_rad, self.joint_noise_m, self.object_noise_m)
        if not (0.0 < self.period_s <= 0.1 and min(noises) >= 0.0 and self.delay_periods >= 0):
            raise ValueError(
                "period_s must be in (0, 0.1] s, noises and delay_periods not negative"
            )


@dataclass(frozen=True, slots=True)
class ArmReading:
    """Measured joints of one arm: (6,) and jaw opening with their speeds; rad, m, s."""

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


class World:
    """The arms, the board and the things on it.

    Args:
        cell: the cell.
        options: period, noise, delay.
        seed: of the measurement noise.

    Attributes:
        cell: the cell.
        options: as given.
        model, data: MuJoCo's, for rendering; leave writing to this class.
    """

    def __init__(
        self, cell: CellDescription, options: WorldOptions | None = None, seed: int = 0
    ) -> None:
        self.cell, self.options = cell, options or WorldOptions()
        self._substeps = math.ceil(self.options.period_s / LONGEST_STEP_S - 1e-9)
        self.model = build_model(
            cell, self.options.period_s / self._substeps, self.options.joint_friction
        )
        self.data = mujoco.MjData(self.model)
        self._arms = [_ArmIndex(self.model, arm) for arm in cell.arms]
        self._things = Things(self.model)
        self._active, self._goal = "", np.zeros(3)
        self._rng = np.random.default_rng(seed)
        self._pending: deque[FloatArray] = deque()
        home = resolve(cell, [start_waypoint(cell)], [(0.0,) * AXES] * len(self._arms))
        self.home: FloatArray = home[1]
        """Axis positions (arms, 7) of the cell's start pose."""

    @property
    def time_s(self) -> float:
        """Simulated time since the reset."""
        return float(self.data.time)

    def seed(self, seed: int) -> None:
        """Restarts the measurement noise."""
        self._rng = np.random.default_rng(seed)

    def reset(self, scene: Scene, axes: npt.ArrayLike | None = None) -> None:
        """Puts things and arms in place, lets the things fall and starts time at 0.

        Args:
            scene: poses of things; those that it does not name are put aside.
            axes: axis positions (arms, 7), jaw last; the cell's start pose by default.

        Raises:
            ViskillError: the scene names an object that this world does not have.
        """
        start = self.home if axes is None else np.asarray(axes, dtype=np.float64)
        mujoco.mj_resetData(self.model, self.data)
        self._things.place(self.data, scene)
        for index, row in zip(self._arms, start, strict=True):
            self.data.qpos[index.qpos[:6]] = row[:6]
            self.data.qpos[index.qpos[6:]] = max(row[6], 0.0) / 2
        self._active, self._goal = scene.active, np.array(scene.goal)
        still = _controls(start, np.zeros_like(start))
        self._pending = deque([still] * self.options.delay_periods)
        self.data.ctrl[:] = still
        colour(self.model, self._active, self._goal)
        mujoco.mj_step(self.model, self.data, nstep=math.ceil(SETTLE_S / self.model.opt.timestep))
        self.data.time = 0.0

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
            positions: axis positions after each period, (n, arms, 7).
            velocities: axis velocities after each period, (n, arms, 7).
        """
        for row in _controls(positions, velocities):
            self._period(row)

    def _period(self, controls: FloatArray) -> None:
        self._pending.append(controls)
        self.data.ctrl[:] = self._pending.popleft()
        mujoco.mj_step(self.model, self.data, nstep=self._substeps)

    def measured(self, arm: int) -> ArmReading:
        """What the arm's sensors say, with noise where the options ask for it."""
        index = self._arms[arm]
        q, v = self.data.qpos[index.qpos], self.data.qvel[index.qvel]
        jp, jaw = q[:6].copy(), float(q[6] + q[7])
        if self.options.joint_noise_rad or self.options.joint_noise_m:
            scale = np.full(AXES, self.options.joint_noise_rad)
            scale[2] = self.options.joint_noise_m
            noise = self._rng.normal(0.0, 1.0, AXES) * scale
            jp, jaw = jp + noise[:6], jaw + float(noise[6])
        return ArmReading(tuple(jp.tolist()), tuple(v[:6].tolist()), jaw, float(v[6] + v[7]))

    def scene(self) -> Scene:
        """Where the things are, as a camera would tell, with noise where asked for."""
        objects = []
        for name in self._things.names:
            pose = self._things.pose(self.data, name)
            if self.options.object_noise_m:
                pose[:3, 3] += self._rng.normal(0.0, self.options.object_noise_m, 3)
            objects.append(ObjectPose(name, pose))
        return Scene(self.time_s, tuple(objects), self._active, self._goal)

    def active_object(self) -> ActiveObject:
        """The true state of the active object."""
        things, name = self._things, self._active
        partners = things.touching(self.data, name)
        touched = tuple(not index.geoms.isdisjoint(partners) for index in self._arms)
        return ActiveObject(things.pose(self.data, name), things.speed(self.data, name), touched)

    def save(self) -> FloatArray:
        """The physical state, for `restore`."""
        state: FloatArray = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, state, _STATE)
        return state

    def restore(self, state: FloatArray) -> None:
        """Goes back to a state of `save` of the same world and episode."""
        mujoco.mj_setState(self.model, self.data, state, _STATE)
        mujoco.mj_forward(self.model, self.data)


def _controls(positions: FloatArray, velocities: FloatArray) -> FloatArray:
    """MuJoCo's control vector: position, velocity of every axis in turn, (..., 2 axes)."""
    pairs = np.stack([positions, velocities], axis=-1)
    return pairs.reshape(*positions.shape[:-2], -1)
