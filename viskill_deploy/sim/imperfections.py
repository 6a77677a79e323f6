"""What lies between a driver and a perfect world, all in one place.

A setpoint goes through lost messages, transport delay, lag and encoder offsets before an arm feels
it; a measurement comes back through encoder offsets, noise and lost messages.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import mujoco
import numpy as np

from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.cables import WRIST
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import ViskillError
from viskill_deploy.core.types import PSM_JOINTS, FloatArray

AXES = 7
PSM_SLIDES = tuple(name == "insertion" for name in PSM_JOINTS)

BRAKE = 1e6
"""Damping of a stuck joint, N m s/rad or N s/m: at full effort it moves by 4 um in a second."""


@dataclass(frozen=True, slots=True)
class WorldOptions:
    """How the world differs from a perfect one. All off by default.

    Offsets stay the same for a whole run; their sizes are drawn from the seed.

    Attributes:
        period_s: control period.
        joint_noise_rad: standard deviation of measured revolute joints and jaws.
        joint_noise_m: standard deviation of measured insertions.
        object_noise_m: standard deviation of measured object positions.
        delay_periods: control periods between a setpoint and its effect.
        joint_friction: whether the joints have the Coulomb friction of their files.
        lag_s: time constant with which the arms follow their setpoints.
        joint_offset_rad: standard deviation of the error of each revolute joint's zero.
        joint_offset_m: standard deviation of the error of each insertion's zero.
        base_error_m: standard deviation, an axis, of where an arm's base really stands.
        base_error_rad: standard deviation, an axis, of how it is really turned.
        drop_rate: part of the messages that are lost, each way.
        jitter_s: the control loop wakes late by up to this time (stepped loopback only).
        stuck: a joint that does not move, such as "PSM1/yaw"; "" for none.
        truth: what each arm really is beside its file, for calibration to find; () for as the
            files say.
        board_translation_m, board_rotation_rad: where the board really is in the task frame, in
            which arms are registered and things are seen.
        object_error_m: standard deviations, along the axes, of how far from its place a thing is
            seen; drawn whenever things are put down.
        object_error_rad: the same of a turn about the vertical.
    """

    period_s: float = 0.004
    joint_noise_rad: float = 0.0
    joint_noise_m: float = 0.0
    object_noise_m: float = 0.0
    delay_periods: int = 0
    joint_friction: bool = False
    lag_s: float = 0.0
    joint_offset_rad: float = 0.0
    joint_offset_m: float = 0.0
    base_error_m: float = 0.0
    base_error_rad: float = 0.0
    drop_rate: float = 0.0
    jitter_s: float = 0.0
    stuck: str = ""
    truth: tuple[ArmErrors, ...] = ()
    board_translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    board_rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    object_error_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    object_error_rad: float = 0.0

    def __post_init__(self) -> None:
        noises = (self.joint_noise_rad, self.joint_noise_m, self.object_noise_m)
        offsets = (self.joint_offset_rad, self.joint_offset_m)
        errors = (self.base_error_m, self.base_error_rad, self.object_error_rad)
        times = (self.lag_s, self.jitter_s, self.delay_periods)
        sizes = (*noises, *offsets, *errors, *self.object_error_m, *times)
        if not (0.0 < self.period_s <= 0.1 and all(size >= 0.0 for size in sizes)):
            raise ValueError(
                "period_s must be in (0, 0.1] s; noises, errors, times and delay_periods must not "
                "be negative"
            )
        if not 0.0 <= self.drop_rate < 1.0:
            raise ValueError("drop_rate must be in [0, 1)")

    @property
    def is_plain(self) -> bool:
        """Whether only period, delay and friction differ from the default."""
        plain = WorldOptions(self.period_s, 0, 0, 0, self.delay_periods, self.joint_friction)
        return self == plain


class Imperfections:
    """Everything of `WorldOptions` that acts while a world runs.

    Args:
        options: how large each imperfection is.
        arms: number of arms.
        seed: of noise, offsets and losses.
        slides: which joints of an arm are prismatic.
    """

    def __init__(
        self,
        options: WorldOptions,
        arms: int,
        seed: int,
        slides: tuple[bool, ...] = PSM_SLIDES,
    ) -> None:
        self.options, self._arms, self._axes = options, arms, len(slides) + 1
        self._slides = np.array([*slides, False])
        self._pending: deque[FloatArray] = deque()
        self._felt: FloatArray = np.zeros(arms * self._axes * 2)
        # Offsets and losses have dice of their own: turning one on leaves the noise as it was.
        offset = np.full((arms, self._axes), options.joint_offset_rad)
        offset[:, self._slides], offset[:, -1] = options.joint_offset_m, 0.0
        dice = np.random.default_rng([seed, 1])
        self._offset: FloatArray = offset * dice.normal(size=offset.shape)
        cables = [errors.cables for errors in options.truth or (ArmErrors(),) * arms]
        self._play: FloatArray = np.array([arm.backlash_rad for arm in cables])
        self._stretch: FloatArray = np.array([arm.coupling for arm in cables])
        self._is_displaced = any(x.any() for x in (self._offset, self._play, self._stretch))
        self._wrist: FloatArray = np.zeros((arms, 3))
        self._shift: FloatArray = np.zeros((arms, self._axes))
        self._part = 1.0 - np.exp(-options.period_s / options.lag_s) if options.lag_s else 1.0
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Restarts noise, losses and jitter; offsets stay."""
        self._noise = np.random.default_rng(seed)
        self._losses = np.random.default_rng([seed, 2])

    def start(self, controls: FloatArray) -> FloatArray:
        """The arms stand still under `controls` (2 axes an arm); what they feel of it."""
        self._pending = deque([controls] * self.options.delay_periods)
        self._wrist = _positions(controls, self._arms)[:, WRIST].copy()
        self._felt = self._displaced(controls)
        return self._felt

    def felt(self, controls: FloatArray) -> FloatArray:
        """What the arms feel in a period in which `controls` are sent."""
        self._pending.append(controls)
        arrived = self._displaced(self._pending.popleft())
        if self._part < 1.0:
            arrived = self._felt + self._part * (arrived - self._felt)
        self._felt = arrived
        return arrived

    def true_axes(self, axes: FloatArray) -> FloatArray:
        """Where the axes really are when their encoders say `axes` and the wrist is centred."""
        true = axes - self._offset
        true[:, WRIST] += _stretched(self._stretch, axes[:, WRIST])
        return true

    def measured(self, arm: int, axes: FloatArray) -> FloatArray:
        """What an arm's encoders say, given its true axes, (7,)."""
        options = self.options
        if self._is_displaced:
            axes = axes - self._shift[arm]
        if options.joint_noise_rad or options.joint_noise_m:
            scale = np.full(self._axes, options.joint_noise_rad)
            scale[self._slides] = options.joint_noise_m
            axes = axes + self._noise.normal(0.0, 1.0, self._axes) * scale
        return axes

    def seen_shift(self) -> FloatArray:
        """Error of one measured object position, (3,)."""
        return self._noise.normal(0.0, self.options.object_noise_m, 3)

    def loses(self) -> bool:
        """Whether the next message is lost."""
        rate = self.options.drop_rate
        return rate > 0.0 and bool(self._losses.random() < rate)

    def lateness_s(self) -> float:
        """How late the control loop wakes this time."""
        return (
            self.options.jitter_s * float(self._losses.random()) if self.options.jitter_s else 0.0
        )

    def _displaced(self, controls: FloatArray) -> FloatArray:
        """Offsets move every axis, cables the wrist: stretch turns with pose, play lags behind."""
        if not self._is_displaced:
            return controls
        positions = _positions(controls, self._arms)
        told = positions[:, WRIST]
        self._wrist = np.clip(self._wrist, told - self._play, told + self._play)
        self._shift = -self._offset
        self._shift[:, WRIST] += self._wrist - told + _stretched(self._stretch, told)
        moved = controls.copy()
        moved[0::2] += self._shift.ravel()
        return moved


def _positions(controls: FloatArray, arms: int) -> FloatArray:
    """The positions in a control vector, (arms, axes)."""
    return controls[0::2].reshape(arms, -1)


def _stretched(stretch: FloatArray, wrist: FloatArray) -> FloatArray:
    """What the cables add to wrist angles (arms, 3)."""
    return np.asarray(np.einsum("aij,aj->ai", stretch, wrist))


def displace_bases(
    model: mujoco.MjModel, cell: CellDescription, options: WorldOptions, seed: int
) -> None:
    """Puts the arms' bases where they really stand, near where the cell's file says."""
    dice = np.random.default_rng([seed, 3])
    for arm in cell.arms:
        body = model.body(f"{arm.name}/base").id
        model.body_pos[body] += options.base_error_m * dice.normal(size=3)
        turn = options.base_error_rad * dice.normal(size=3)
        mujoco.mju_quatIntegrate(model.body_quat[body], turn, 1.0)


class Drives:
    """The arms' drives, which can break.

    Args:
        model: the model of a cell; its drives' numbers are written here alone.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._damping = model.dof_damping.copy()
        self._effort = model.actuator_forcerange.copy()

    def stick(self, joint: str) -> None:
        """A joint stops where it is and no longer moves.

        Args:
            joint: such as "PSM1/yaw".

        Raises:
            ViskillError: the cell has no such joint.
        """
        self._model.dof_damping[self._find(joint)[0]] = BRAKE

    def slip(self, joint: str) -> None:
        """A joint's cable slips: its drive no longer moves it, and friction stops it.

        Raises:
            ViskillError: the cell has no such joint.
        """
        dof, drive = self._find(joint)
        self._model.actuator_forcerange[drive] = 0.0
        self._model.dof_damping[dof] = abs(self._model.actuator_biasprm[drive, 2])

    def mend(self) -> None:
        """Every drive works again."""
        self._model.dof_damping[:] = self._damping
        self._model.actuator_forcerange[:] = self._effort

    def _find(self, joint: str) -> tuple[int, int]:
        model = self._model
        known = [model.actuator(i).name for i in range(len(self._effort))]
        if joint not in known or joint.endswith("/jaw"):
            names = ", ".join(name for name in known if not name.endswith("/jaw"))
            raise ViskillError(f"no joint {joint!r} in this cell; it has {names}")
        return int(model.joint(joint).dofadr[0]), known.index(joint)
