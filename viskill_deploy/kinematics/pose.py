"""Poses as callers give them, checked: a Pinocchio SE3 or a 4x4 array.

Pinocchio's log6 of something that is no rotation returns zero in silence, and NaN travels through
it unseen: every pose from outside passes here first.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from viskill_deploy.core.errors import IkError, KinematicsError
from viskill_deploy.core.types import FloatArray, Joints

Pose: TypeAlias = pin.SE3 | npt.ArrayLike
"""A pose as a Pinocchio SE3 or as a 4x4 array, m."""

ORTHONORMAL_TOLERANCE = 1e-6
"""How far R^T R of a pose may be from identity: float32 policies reach 1e-7."""

SKEW_TOLERANCE = ORTHONORMAL_TOLERANCE**2
LAST_ROW = [0.0, 0.0, 0.0, 1.0]

Rows: TypeAlias = tuple[Joints, Joints, Joints]


def split(pose: Pose) -> tuple[Rows, Joints]:
    """Rows of the rotation and origin of a pose, as plain floats.

    Raises:
        KinematicsError: another shape, not finite ("not-finite"), or no rigid transform.
    """
    matrix = pose.homogeneous if isinstance(pose, pin.SE3) else np.asarray(pose, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise KinematicsError(f"the pose has shape {matrix.shape}; give an SE3 or a 4x4 array")
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = matrix.tolist()
    # Unit first rows, at right angles, and the third their cross product: this refuses mirrors too.
    # x - x is 0 for a number and NaN for infinity and NaN, which no comparison lets through.
    skew = (
        (a * a + b * b + c * c - 1.0) ** 2
        + (d * d + e * e + f * f - 1.0) ** 2
        + (a * d + b * e + c * f) ** 2
        + (b * f - c * e - g) ** 2
        + (c * d - a * f - h) ** 2
        + (a * e - b * d - i) ** 2
        + (x - x)
        + (y - y)
        + (z - z)
    )
    if not (skew <= SKEW_TOLERANCE and last == LAST_ROW):
        raise _refusal(matrix)
    return ((a, b, c), (d, e, f), (g, h, i)), (x, y, z)


def _refusal(matrix: FloatArray) -> KinematicsError:
    """Why a 4x4 array is no pose."""
    if not np.isfinite(matrix).all():
        return IkError("not-finite", "the pose holds a number that is not finite; check its source")
    return KinematicsError(
        "the pose is no rigid transform; give a proper rotation over a last row of 0 0 0 1"
    )


def as_se3(pose: Pose) -> pin.SE3:
    """The pose as an SE3. Raises as `split`."""
    split(pose)
    return pose if isinstance(pose, pin.SE3) else pin.SE3(np.asarray(pose, dtype=np.float64))


def checked_rows(values: Any, width: int, name: str) -> FloatArray:
    """`values` as a float64 array (N, width) of finite numbers.

    Raises:
        KinematicsError: another shape, or a number that is not finite.
    """
    rows = np.asarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != width:
        raise KinematicsError(f"{name} has shape {rows.shape}; give an array of shape (N, {width})")
    if not np.isfinite(rows).all():
        raise IkError("not-finite", f"{name} holds a number that is not finite; check its source")
    return rows


def checked_poses(values: Any, name: str) -> FloatArray:
    """`values` as a float64 array (N, 4, 4) of rigid poses.

    Raises:
        KinematicsError: another shape, a number that is not finite, or no rigid transform; names
            the first at fault.
    """
    poses = np.asarray(values, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise KinematicsError(f"{name} has shape {poses.shape}; give an array of shape (N, 4, 4)")
    if not np.isfinite(poses).all():
        raise IkError("not-finite", f"{name} holds a number that is not finite; check its source")
    R = poses[:, :3, :3]
    off = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2)) > ORTHONORMAL_TOLERANCE
    off |= (np.linalg.det(R) < 0) | (np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1) > 1e-9)
    if off.any():
        raise KinematicsError(
            f"{name}[{int(off.argmax())}] is no rigid pose; give proper rotations over a last row "
            "of 0 0 0 1"
        )
    return poses
