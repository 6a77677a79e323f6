"""Where an arm with given errors has its point, and how that changes with each error."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.parameters import (
    BACKLASH,
    BASE_ROTATION,
    BASE_TRANSLATION,
    COUPLING,
    DELAY,
    NAMES,
    OFFSETS,
    POINT,
    TOOL_LENGTH,
)
from viskill_deploy.core.cables import WRIST
from viskill_deploy.core.description import CellArm
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.model import TIP_FRAME, build_model


class ErrorModel:
    """The forward model of a calibration, for one arm in its cell.

    Args:
        arm: nominal arm and place.
    """

    def __init__(self, arm: CellArm) -> None:
        self._model = build_model(arm.arm)
        self._data = self._model.createData()
        self._tip = self._model.getFrameId(TIP_FRAME)
        self._T = np.array(arm.T_task_base)

    def joints(self, vector: FloatArray, measured: Measurements) -> FloatArray:
        """The true joints behind reported ones, (n, 6): offsets, cables and delay."""
        q = measured.joints + vector[OFFSETS]
        q[:, 2] += vector[TOOL_LENGTH]
        coupling = vector[COUPLING].reshape(3, 3)
        q[:, WRIST] -= measured.turns * vector[BACKLASH]
        q[:, WRIST] += measured.joints[:, WRIST] @ coupling.T
        delay = vector[DELAY]
        q += 0.5 * delay**2 * measured.accelerations - delay * measured.speeds
        return np.asarray(q)

    def points(self, vector: FloatArray, measured: Measurements) -> FloatArray:
        """The measured point of every row, task frame, (n, 3) m."""
        return self._evaluate(vector, measured, with_jacobian=False)[0]

    def rotations(self, vector: FloatArray, measured: Measurements) -> FloatArray:
        """How the tip frame is turned in the task frame in every row, (n, 3, 3)."""
        R = self._T[:3, :3] @ pin.exp3(vector[BASE_ROTATION])
        return np.array([R @ self._placed(q).rotation for q in self.joints(vector, measured)])

    def linearised(
        self, vector: FloatArray, measured: Measurements
    ) -> tuple[FloatArray, FloatArray]:
        """Points (n, 3) and their derivatives by every parameter (n, 3, 27).

        The rotation of the base is a rotation vector; its columns hold to first order about the
        present one, which is what Gauss-Newton needs.
        """
        points, jacobian = self._evaluate(vector, measured, with_jacobian=True)
        return points, jacobian

    def _evaluate(
        self, vector: FloatArray, measured: Measurements, with_jacobian: bool
    ) -> tuple[FloatArray, FloatArray]:
        n = len(measured)
        points, jacobian = np.zeros((n, 3)), np.zeros((n if with_jacobian else 0, 3, len(NAMES)))
        turn = np.array(pin.exp3(vector[BASE_ROTATION]))
        R = self._T[:3, :3] @ turn
        origin = self._T[:3, 3] + vector[BASE_TRANSLATION]
        along = measured.point_m + vector[POINT]
        right = np.array(pin.Jexp3(vector[BASE_ROTATION])) if with_jacobian else np.eye(3)
        for i, q in enumerate(self.joints(vector, measured)):
            tip = self._placed(q)
            z = tip.rotation[:, 2]
            p = tip.translation + along * z
            points[i] = R @ p + origin
            if not with_jacobian:
                continue
            J6 = pin.computeFrameJacobian(
                self._model, self._data, q, self._tip, pin.LOCAL_WORLD_ALIGNED
            )
            J = R @ (J6[:3] + np.cross(J6[3:].T, along * z).T)
            block = jacobian[i]
            block[:, BASE_ROTATION] = -R @ pin.skew(p) @ right
            block[:, BASE_TRANSLATION] = np.eye(3)
            block[:, OFFSETS] = J
            block[:, TOOL_LENGTH] = J[:, 2]
            block[:, POINT] = R @ z
            block[:, BACKLASH] = -J[:, WRIST] * measured.turns[i]
            block[:, COUPLING] = np.einsum(
                "aj,k->ajk", J[:, WRIST], measured.joints[i, WRIST]
            ).reshape(3, 9)
            block[:, DELAY] = -J @ (measured.speeds[i] - vector[DELAY] * measured.accelerations[i])
        return points, jacobian

    def _placed(self, q: FloatArray) -> pin.SE3:
        """The tip frame in the arm's base frame."""
        pin.forwardKinematics(self._model, self._data, q)
        return pin.updateFramePlacement(self._model, self._data, self._tip)
