"""Poses of one simulated arm: forward and inverse kinematics as CRTK's topics mean them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import FloatArray, Joints
from viskill_deploy.drivers.crtk.messages import Point, Pose, Quaternion
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.motion.trajectory import quaternions, rotations

CANNULA_M = 0.043
"""Nearer to the remote centre than this, a wrist takes no goal in Cartesian space."""

SHALLOWEST_M = 0.045
"""A goal nearer than this is moved along the shaft until it is no longer."""


class Cartesian:
    """Kinematics of an arm in its place. Not to be shared between threads.

    Args:
        arm: the arm; its base's pose in the task frame is what a dVRK calls its base frame.
    """

    def __init__(self, arm: CellArm) -> None:
        self._arm, self._wrist_m = Arm(arm.arm), arm.arm.wrist_offset_m
        self.T_task_base: FloatArray = arm.T_task_base

    def local(self, q: Sequence[float]) -> FloatArray:
        """Pose of the tip in the RCM frame, (4, 4)."""
        pose: FloatArray = self._arm.forward(q).homogeneous
        return pose

    def frame(self, q: Sequence[float]) -> FloatArray:
        """Frame of the last of the joints given, RCM frame, (4, 4); of the tip for all six.

        Raises:
            KinematicsError: more than six, or not finite.
        """
        count = len(q)
        if count > 5:
            return self.local(q)
        tip_of = (*q, *(0.0,) * (6 - count))
        pose: FloatArray = self._arm.joint_frame(tip_of, count).homogeneous
        return pose

    def is_past_cannula(self, q: Sequence[float]) -> bool:
        """Whether the wrist is far enough beyond the remote centre."""
        return q[2] + self._wrist_m >= CANNULA_M

    def inverse(self, local: FloatArray, seed: Sequence[float]) -> Joints:
        """Joints (6,) of a pose in the RCM frame.

        Raises:
            KinematicsError: there are none inside the limits.
        """
        return tuple(self._arm.inverse(local, seed).tolist())

    def goal(self, pose: Pose, seed: Sequence[float]) -> Joints:
        """Joints (6,) for a goal in the task frame, as dVRK bends it near the cannula.

        Raises:
            KinematicsError: there are none inside the limits, or the pose is none.
        """
        base = self.T_task_base
        local = np.eye(4)
        T = matrix(pose)
        local[:3, :3], local[:3, 3] = base[:3, :3].T @ T[:3, :3], T[:3, 3] - base[:3, 3]
        local[:3, 3] = base[:3, :3].T @ local[:3, 3]
        q = list(self.inverse(local, seed))
        q[2] = max(q[2], SHALLOWEST_M - self._wrist_m)
        return tuple(q)

    def twist(self, q: Sequence[float], v: Sequence[float]) -> FloatArray:
        """Velocity of the tip, task frame's axes: vx vy vz wx wy wz, (6,)."""
        R = self.T_task_base[:3, :3]
        local = self._arm.jacobian(q) @ np.asarray(v)
        twist: FloatArray = np.concatenate([R @ local[:3], R @ local[3:]])
        return twist

    def body_jacobian(self, q: Sequence[float]) -> FloatArray:
        """Of the tip in its own axes, (6, 6), rows v then w."""
        R = self.local(q)[:3, :3].T
        J = self._arm.jacobian(q)
        body: FloatArray = np.vstack([R @ J[:3], R @ J[3:]])
        return body

    def spatial_jacobian(self, q: Sequence[float]) -> FloatArray:
        """Of the point of the arm at the remote centre, RCM frame, (6, 6), rows v then w."""
        p, J = self.local(q)[:3, 3], self._arm.jacobian(q)
        spatial: FloatArray = np.vstack([J[:3] + np.cross(p, J[3:].T).T, J[3:]])
        return spatial


def matrix(pose: Pose) -> FloatArray:
    """A pose as a matrix, (4, 4).

    Raises:
        KinematicsError: numbers that are not finite, or a quaternion without length.
    """
    p, o = pose.position, pose.orientation
    q = np.array([o.x, o.y, o.z, o.w])
    length = float(np.linalg.norm(q))
    if not (np.isfinite([p.x, p.y, p.z, length]).all() and length > 1e-6):
        raise KinematicsError("this is no pose: send finite numbers and a unit quaternion")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotations(q[None])[0], (p.x, p.y, p.z)
    return T


def pose_of(T: FloatArray) -> Pose:
    """A matrix (4, 4) as a pose."""
    return Pose(Point(*T[:3, 3].tolist()), Quaternion(*quaternions(T[None, :3, :3])[0].tolist()))
