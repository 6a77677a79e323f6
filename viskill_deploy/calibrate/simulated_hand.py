"""A simulated person who takes simulated arms by hand, and brings their tips to points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from viskill_deploy.calibrate.error_model import ErrorModel
from viskill_deploy.calibrate.landmarks import Landmark, postures
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.parameters import OFFSETS, vector_of
from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.clock import Clock, SteppedClock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import ArmState, CellState, FloatArray, Inputs
from viskill_deploy.drivers.base import DISABLED
from viskill_deploy.sim.seeing import board_pose
from viskill_deploy.sim.world import WorldOptions

ROUNDS = 12
"""Newton steps on yaw, pitch and insertion; the residual is squared by each."""


@dataclass(frozen=True, slots=True)
class HandOptions:
    """How well a person touches.

    Attributes:
        noise_m: standard deviation of a coordinate: half of a peg's radius, in space.
        slip_share: part of the touches that are somewhere else.
        slip_m: standard deviation of a coordinate of those.
    """

    noise_m: float = 0.0003
    slip_share: float = 0.0
    slip_m: float = 0.005


class SimulatedHand:
    """The arms of a cell as they really are, and who moves them: it is `Arms` and `Hand`.

    Play of the wrist's cables is anywhere: who moves an arm by its instrument leaves it so.

    Args:
        cell: the arms as their files have them.
        world: what arms and board really are, and what encoders say; as the files say by default.
        options: how well it is done.
        things: where things are on the board, (4, 4) by name.
        seed: of noise and postures.

    Attributes:
        notes: what it was told.
    """

    def __init__(
        self,
        cell: CellDescription,
        world: WorldOptions | None = None,
        options: HandOptions | None = None,
        seed: int = 0,
        things: Mapping[str, FloatArray] | None = None,
    ) -> None:
        self.clock: Clock = SteppedClock()
        self.period_s, self.notes = 0.01, list[str]()
        self._cell, self._world = cell, world or WorldOptions()
        self._options, self._T_task_board = options or HandOptions(), board_pose(self._world)
        self._rng, self._things = np.random.default_rng([seed, 11]), things or {}
        errors = self._world.truth or (ArmErrors(),) * len(cell.arms)
        self._vectors = [vector_of(each) for each in errors]
        self._models = [ErrorModel(arm) for arm in cell.arms]
        self.joints: FloatArray = np.zeros((len(cell.arms), 6))

    def tell(self, note: str) -> None:
        """Remembers it."""
        self.notes.append(note)

    def bring(self, arm: int, landmark: Landmark, words: str) -> str:
        """Brings the end of an arm's jaw to a point of the board, as well as a person does.

        Raises:
            CalibrationError: the arm does not reach there.
        """
        del words
        options = self._options
        slips = self._rng.random() < options.slip_share
        spread = options.slip_m if slips else options.noise_m
        T = self._T_task_board @ self._things.get(landmark.thing, np.eye(4))
        place = T @ np.array([*landmark.position, 1.0])
        target = place[:3] + self._rng.normal(0.0, spread, 3)
        self.joints[arm] = self._at(arm, target)
        return ""

    def state(self) -> CellState:
        """What the encoders say now."""
        return CellState(
            tuple(self._state(index) for index in range(len(self._cell.arms))),
            Inputs(False, self.clock.now(), "simulated", False),
        )

    def _at(self, arm: int, target: FloatArray) -> FloatArray:
        """Joints with which the true end of the jaw is at a point."""
        seed = int(self._rng.integers(2**31))
        for q in self._rng.permutation(postures(self._cell, arm, target, seed)):
            play = self._rng.uniform(-1.0, 1.0, (1, 3))
            for _ in range(ROUNDS):
                row = self._row(arm, q, play)
                point, J = self._models[arm].linearised(self._vectors[arm], row)
                if np.linalg.norm(target - point[0]) < 1e-9:
                    return np.asarray(q)
                q[:3] += np.linalg.solve(J[0, :, OFFSETS][:, :3], target - point[0])
        raise CalibrationError(
            f"{self._cell.arms[arm].name} does not reach {np.round(target, 4).tolist()}; name "
            "another point"
        )

    def _row(self, arm: int, q: FloatArray, play: FloatArray) -> Measurements:
        finger_m = self._cell.arms[arm].arm.jaw.finger_length_m
        return Measurements(
            np.zeros(1), q[None], np.zeros((1, 6)), play, np.zeros((1, 3)), finger_m
        )

    def _state(self, index: int) -> ArmState:
        arm, world = self._cell.arms[index], self._world
        noise = self._rng.normal(0.0, 1.0, 6) * world.joint_noise_rad
        noise[2] = self._rng.normal(0.0, 1.0) * world.joint_noise_m
        q = tuple((self.joints[index] + noise).tolist())
        rest = (0.0,) * 6
        return ArmState(
            name=arm.name,
            stamp_s=self.clock.now(),
            valid=True,
            operating_state=DISABLED,
            is_homed=True,
            is_busy=False,
            measured_jp=q,
            measured_jv=rest,
            jaw_measured_jp=0.0,
            jaw_measured_jv=0.0,
            setpoint_jp=q,
            jaw_setpoint_jp=0.0,
            joint_names=arm.arm.joint_names,
            tool=arm.arm.tool,
        )
