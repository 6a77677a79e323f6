"""The kinematic services of one simulated arm, which a transport may call in threads of its own."""

from __future__ import annotations

import threading

import numpy as np

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.crtk.arm_cartesian import Cartesian, matrix, pose_of
from viskill_deploy.drivers.crtk.messages import (
    ForwardKinematicsRequest,
    ForwardKinematicsResponse,
    InverseKinematicsRequest,
    InverseKinematicsResponse,
)
from viskill_deploy.drivers.crtk.transport import Transport


class KinematicsServices:
    """Answers kinematic questions about an arm; it need not be enabled.

    Args:
        arm: the arm.
    """

    def __init__(self, arm: CellArm) -> None:
        self._name, self._cartesian = arm.name, Cartesian(arm)
        self._lock = threading.Lock()

    def serve(self, transport: Transport) -> None:
        """Offers the services, where the transport has any."""
        if not transport.has_services:
            return
        request, response = ForwardKinematicsRequest, ForwardKinematicsResponse
        transport.serve(f"/{self._name}/forward_kinematics", request, response, self.forward)
        transport.serve(f"/{self._name}/local/forward_kinematics", request, response, self.local)
        transport.serve(
            f"/{self._name}/inverse_kinematics",
            InverseKinematicsRequest,
            InverseKinematicsResponse,
            self.inverse,
        )

    def forward(self, request: ForwardKinematicsRequest) -> ForwardKinematicsResponse:
        """Pose of the tip, or of a joint's frame on the way there, in the task frame."""
        return self._forward(request, self._cartesian.T_task_base)

    def local(self, request: ForwardKinematicsRequest) -> ForwardKinematicsResponse:
        """The same in the RCM frame."""
        return self._forward(request, np.eye(4))

    def _forward(
        self, request: ForwardKinematicsRequest, base: FloatArray
    ) -> ForwardKinematicsResponse:
        try:
            with self._lock:
                pose = base @ self._cartesian.frame(request.jp)
        except KinematicsError as error:
            return ForwardKinematicsResponse(message=str(error))
        return ForwardKinematicsResponse(pose_of(pose), True)

    def inverse(self, request: InverseKinematicsRequest) -> InverseKinematicsResponse:
        """Joints of a pose in the RCM frame; unlike dVRK's they are inside the limits."""
        try:
            with self._lock:
                q = self._cartesian.inverse(matrix(request.cp), request.jp or (0.0,) * 6)
        except KinematicsError as error:
            return InverseKinematicsResponse(message=str(error))
        return InverseKinematicsResponse(q, True)
