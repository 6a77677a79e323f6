"""The remote-centre constraint: a shaft that has to pass through a registered port."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import FloatArray, frozen_array


@dataclass(frozen=True)
class PortConstraint:
    """A shaft, the port that it has to pass through, and how strictly.

    On a PSM whose port is its own remote centre this constrains nothing: the mechanism does it, and
    both rows are zero. It does work on arms without a mechanical remote centre, and as a soft row
    where the registered port is off the mechanical one.

    Attributes:
        position: the port in the model's base frame, (3,) m.
        frame: name of a frame of the model whose origin lies on the shaft's axis.
        axis: direction of the shaft in that frame, (3,), of any length.
        mode: "soft" weighs the distance in the objective; "band" makes it a hard limit.
        weight: of the soft mode, 1/m (the task's rows weigh 1/lever_m for metres, 1 for radians).
        tolerance_m: half width of the band on each of the two axes across the shaft, m.
        return_rate: part of the way to the band's edge that one step may go. The rows are linear:
            the motion's curvature can carry the shaft over the edge by about (w dt)^2 times half
            the lever in one step, and the next step brings it back.
    """

    position: FloatArray
    frame: str
    axis: FloatArray
    mode: Literal["soft", "band"] = "soft"
    weight: float = 500.0
    tolerance_m: float = 1e-4
    return_rate: float = 0.5

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "position", frozen_array(self.position, (3,), "port"))
            object.__setattr__(self, "axis", frozen_array(self.axis, (3,), "shaft axis"))
        except ValueError as error:
            raise KinematicsError(f"{error}; give three finite numbers") from error
        if np.linalg.norm(self.axis) < 1e-9:
            raise KinematicsError("the shaft's axis has no length; give a direction")
        numbers = (self.weight, self.tolerance_m, self.return_rate)
        if not all(math.isfinite(x) and x > 0 for x in numbers) or self.return_rate > 1:
            raise KinematicsError(
                "weight, tolerance_m and return_rate must be positive and finite, return_rate at "
                "most 1; correct them"
            )

    def across(self) -> FloatArray:
        """Two unit vectors across the shaft and each other, in the shaft's frame, (2, 3)."""
        direction = self.axis / np.linalg.norm(self.axis)
        other = np.eye(3)[int(np.abs(direction).argmin())]
        first = np.cross(direction, other)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(direction, first)])


class PortRows:
    """Evaluates a port constraint on a model whose joint Jacobians are up to date."""

    def __init__(self, model: pin.Model, port: PortConstraint) -> None:
        if not model.existFrame(port.frame):
            raise KinematicsError(f"the model has no frame {port.frame!r}; name one on the shaft")
        self._model, self._port = model, port
        self._frame = model.getFrameId(port.frame)
        self._across = port.across()

    def evaluate(self, data: Any) -> tuple[FloatArray, FloatArray]:
        """Offset of the port from the shaft, and its rate per joint velocity.

        With p the port in the shaft's frame, which moves with v and w: dp/dt = -v - w x p.

        Args:
            data: Pinocchio's data after `computeJointJacobians`.

        Returns:
            Offsets along the two axes across the shaft, (2,) m, and their Jacobian, (2, n).
        """
        shaft = pin.updateFramePlacement(self._model, data, self._frame)
        p = shaft.actInv(self._port.position)
        J = pin.getFrameJacobian(self._model, data, self._frame, pin.LOCAL)
        rate = self._across @ (pin.skew(p) @ J[3:] - J[:3])
        return self._across @ p, rate

    def band(self, offset: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """Bounds on the offset's rate, m/s, that keep it in the band or bring it back."""
        gain = self._port.return_rate / dt
        return -gain * (self._port.tolerance_m + offset), gain * (self._port.tolerance_m - offset)
