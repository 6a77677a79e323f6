"""The PSM's inverse kinematics in closed form: exact, microseconds, no iteration.

Holds for every arm whose six rows have the PSM's pattern (see `PsmGeometry`). The wrist-yaw axis z6
passes at the distance a6 from the wrist-pitch axis, which meets the shaft, which meets the remote
centre; so z6 and the tip's origin p give, in turn, the wrist-pitch axis z5 = z6 x p, the link x5,
the wrist, the shaft u, and from there every joint. Two signs (of z5 and of u) and the mirrored yaw
and pitch make eight branches. Inside the joint limits of the dVRK's tools at most one survives: the
principal one, on which cos(wrist pitch) and cos(wrist yaw) are positive, except at the very edge of
tools whose wrist yaw reaches 90 degrees. What stays free is whole turns of roll.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import atan2, hypot, pi, sqrt

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import ArmDescription
from viskill_deploy.core.errors import KinematicsError, NoSolutionError
from viskill_deploy.core.types import FloatArray, Joints
from viskill_deploy.kinematics.model import ROLL
from viskill_deploy.kinematics.pose import checked_poses, checked_rows

TURN = 2 * pi
LIMIT_TOLERANCE = 1e-10
"""Rounding of a pose made at a limit may put the joint this far outside; it is put on the limit."""

DEGENERATE_M = 1e-9
"""Closer to the remote centre than this, tip or wrist leave yaw and pitch undetermined."""

BRANCHES = tuple((a, b, c) for a in (1.0, -1.0) for b in (1.0, -1.0) for c in (False, True))
"""Sign of z5, sign of u, yaw and pitch mirrored; the principal branch first."""

_NAN = (math.nan,) * 6


@dataclass(frozen=True)
class PsmGeometry:
    """The numbers of an arm that the closed form needs.

    Attributes:
        names: of the joints.
        lower: joint limits, rad and m.
        upper: joint limits, rad and m.
        shift: what a row's theta + offset has beyond the PSM's pattern, rad (0 for the insertion).
        shaft_m: insertion at which the wrist would be one wrist-offset past the remote centre, m:
            distance RCM to wrist = q3 + shaft_m.
        a6_m: distance between wrist-pitch and wrist-yaw axes, m.
        tip_rotation: rotation from frame 6 to the tip, (3, 3).
    """

    names: tuple[str, ...]
    lower: Joints
    upper: Joints
    shift: Joints
    shaft_m: float
    a6_m: float
    tip_rotation: FloatArray

    @classmethod
    def of(cls, arm: ArmDescription) -> PsmGeometry:
        """The geometry of a description.

        Raises:
            KinematicsError: the arm's rows do not have the PSM's pattern; names the first row.
        """
        quarter = pi / 2
        alphas = (quarter, -quarter, quarter, 0.0, -quarter, -quarter)
        zeros = (quarter, -quarter, 0.0, 0.0, -quarter, -quarter)
        shift = [0.0] * 6
        for i, (joint, alpha, zero) in enumerate(zip(arm.joints, alphas, zeros, strict=True)):
            stray_d = 0.0 if i in {2, ROLL} else joint.d_m
            stray_a = 0.0 if i == 5 else joint.a_m
            if max(abs(joint.alpha_rad - alpha), abs(stray_a), abs(stray_d)) > 1e-12:
                raise KinematicsError(
                    f"{arm.robot} with {arm.tool}: row {joint.name} is not a PSM's (alpha "
                    f"{alpha:.4f}, a and d 0); use IkSolver for this arm"
                )
            shift[i] = joint.theta_rad + (0.0 if i == 2 else joint.offset) - zero
        # The insertion's own theta turns about the shaft, as roll does.
        shift[ROLL], shift[2] = shift[ROLL] + shift[2], 0.0
        insertion, roll = arm.joints[2], arm.joints[ROLL]
        return cls(
            names=tuple(joint.name for joint in arm.joints),
            lower=arm.limit(0),
            upper=arm.limit(1),
            shift=tuple(shift),
            shaft_m=insertion.d_m + insertion.offset + roll.d_m,
            a6_m=arm.joints[5].a_m,
            tip_rotation=arm.tip_rotation,
        )


def branch_solution(
    geometry: PsmGeometry,
    x: Joints,
    z: Joints,
    p: Joints,
    branch: tuple[float, float, bool] = BRANCHES[0],
) -> Joints:
    """The joints of one branch, limits not looked at, roll within half a turn of zero.

    Args:
        geometry: of the arm.
        x: x axis of frame 6 in the base frame, (3,).
        z: z axis of frame 6 in the base frame, (3,).
        p: origin of the tip in the base frame, (3,) m.
        branch: one of `BRANCHES`.

    Returns:
        Six joints, or six NaN where yaw and pitch are undetermined.
    """
    sign5, sign_u, mirrored = branch
    (xx, xy, xz), (zx, zy, zz), (px, py, pz) = x, z, p
    # Wrist-pitch axis: perpendicular to the wrist-yaw axis and to the line from the remote centre.
    nx, ny, nz = zy * pz - zz * py, zz * px - zx * pz, zx * py - zy * px
    length = sqrt(nx * nx + ny * ny + nz * nz)
    if length < DEGENERATE_M:
        return _NAN
    if (nx * xx + ny * xy + nz * xz) * sign5 < 0.0:
        length = -length
    wx, wy, wz = nx / length, ny / length, nz / length
    lx, ly, lz = zy * wz - zz * wy, zz * wx - zx * wz, zx * wy - zy * wx
    a = geometry.a6_m
    ox, oy, oz = px - a * lx, py - a * ly, pz - a * lz
    depth = sqrt(ox * ox + oy * oy + oz * oz)
    if depth < DEGENERATE_M:
        return _NAN
    if (ox * lx + oy * ly + oz * lz) * sign_u < 0.0:
        depth = -depth
    ux, uy, uz = ox / depth, oy / depth, oz / depth
    s1c2, c1c2 = ux, -uz
    c2 = hypot(s1c2, c1c2)
    if mirrored:
        s1c2, c1c2, c2 = -s1c2, -c1c2, -c2
    q1, q2 = atan2(s1c2, c1c2), atan2(-uy, c2)
    s1, c1, s2 = math.sin(q1), math.cos(q1), -uy
    q4 = atan2(s1 * s2 * wx + c2 * wy - c1 * s2 * wz, -c1 * wx - s1 * wz)
    q5 = atan2(-(ux * zx + uy * zy + uz * zz), ux * lx + uy * ly + uz * lz)
    q6 = atan2(xx * lx + xy * ly + xz * lz, xx * wx + xy * wy + xz * wz)
    f = geometry.shift
    return (
        q1 - f[0],
        q2 - f[1],
        depth - geometry.shaft_m,
        q4 - f[3],
        q5 - f[4],
        q6 - f[5],
    )


def nearest_turn(angle: float, seed: float, lower: float, upper: float) -> float:
    """`angle` plus the whole turns that bring it nearest to `seed` inside the limits.

    Where no turn lies inside, the one that is least outside.
    """
    angle += TURN * round((seed - angle) / TURN)
    if angle > upper + LIMIT_TOLERANCE:
        lowered = angle - TURN * math.ceil((angle - upper - LIMIT_TOLERANCE) / TURN)
        return lowered if lower - lowered < angle - upper else angle
    if angle < lower - LIMIT_TOLERANCE:
        raised = angle + TURN * math.ceil((lower - angle - LIMIT_TOLERANCE) / TURN)
        return raised if raised - upper < lower - angle else angle
    return angle


def inverse(geometry: PsmGeometry, x: Joints, z: Joints, p: Joints, seed_roll: float) -> Joints:
    """The joints that bring the tip to a pose, inside the limits.

    Args:
        geometry: of the arm.
        x: x axis of frame 6 in the base frame, (3,).
        z: z axis of frame 6 in the base frame, (3,).
        p: origin of the tip in the base frame, (3,) m.
        seed_roll: the roll turn nearest to this is taken, rad.

    Raises:
        NoSolutionError: no branch lies inside the limits; names the joint of the principal branch
            that is furthest outside, relative to its range.
    """
    first: Joints = _NAN
    for branch in BRANCHES:
        q = branch_solution(geometry, x, z, p, branch)
        if q is _NAN:
            continue
        roll = nearest_turn(q[3], seed_roll, geometry.lower[3], geometry.upper[3])
        q = (q[0], q[1], q[2], roll, q[4], q[5])
        inside = _on_limits(geometry, q)
        if inside is not None:
            return inside
        if branch is BRANCHES[0]:
            first = q
    raise no_solution(geometry, first)


def _on_limits(geometry: PsmGeometry, q: Joints) -> Joints | None:
    """`q` if it lies inside the limits, put onto them where it is out by rounding; else None."""
    rounded = False
    for value, low, high in zip(q, geometry.lower, geometry.upper, strict=True):
        if low <= value <= high:
            continue
        if not low - LIMIT_TOLERANCE <= value <= high + LIMIT_TOLERANCE:
            return None
        rounded = True
    if not rounded:
        return q
    limits = zip(q, geometry.lower, geometry.upper, strict=True)
    return tuple(min(max(value, low), high) for value, low, high in limits)


def no_solution(geometry: PsmGeometry, q: Joints) -> NoSolutionError:
    """The refusal of a pose whose principal branch is `q`."""
    if not math.isfinite(sum(q)):
        return NoSolutionError(
            -1,
            "",
            math.nan,
            math.nan,
            "tip or wrist lies on the remote centre, where yaw and pitch are undetermined; "
            "insert further first",
        )
    limits = list(zip(q, geometry.lower, geometry.upper, strict=True))
    excess = [max(low - value, value - high) for value, low, high in limits]
    part = [e / (high - low) for e, (_, low, high) in zip(excess, limits, strict=True)]
    joint = max(range(6), key=part.__getitem__)
    value, low, high = limits[joint]
    name, unit = geometry.names[joint], "m" if joint == 2 else "rad"
    return NoSolutionError(
        joint,
        name,
        value,
        excess[joint],
        f"the pose needs {name} = {value:.6g} {unit}, {excess[joint]:.3g} {unit} outside "
        f"[{low:.6g}, {high:.6g}]; choose a pose within reach",
    )


def inverse_batch(
    arm: ArmDescription, T_base_tip: FloatArray, seed: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """The closed form for many poses at once, each on its own.

    Args:
        arm: the arm.
        T_base_tip: tip poses in the base frame, (N, 4, 4), m.
        seed: configurations whose roll turn is to be kept, (N, 6) or (6,) for all.

    Returns:
        Joints (N, 6) and whether each row lies inside the limits (N,). A row outside holds the
        principal branch, or NaN where the pose is degenerate.

    Raises:
        KinematicsError: wrong shapes, numbers that are not finite, improper rotations.
    """
    geometry = PsmGeometry.of(arm)
    poses = checked_poses(T_base_tip, "T_base_tip")
    seeds = checked_rows(np.broadcast_to(seed, (len(poses), 6)), 6, "seed")
    q = _principal_batch(geometry, poses)
    lower, upper = np.array(geometry.lower), np.array(geometry.upper)
    q[:, ROLL] = _nearest_turns(q[:, ROLL], seeds[:, ROLL], lower[ROLL], upper[ROLL])
    outside = (q < lower - LIMIT_TOLERANCE) | (q > upper + LIMIT_TOLERANCE) | np.isnan(q)
    ok: npt.NDArray[np.bool_] = ~np.asarray(outside.any(axis=1))
    q[ok] = np.clip(q[ok], lower, upper)
    # Another branch inside the limits is a matter of edges: rare enough to go one by one.
    R6 = poses[:, :3, :3] @ geometry.tip_rotation.T
    for i in np.flatnonzero(~ok):
        x, z, p = (tuple(v.tolist()) for v in (R6[i, :, 0], R6[i, :, 2], poses[i, :3, 3]))
        try:
            q[i], ok[i] = inverse(geometry, x, z, p, float(seeds[i, ROLL])), True
        except NoSolutionError:
            continue
    return q, ok


def _principal_batch(geometry: PsmGeometry, poses: FloatArray) -> FloatArray:
    """`branch_solution` of the principal branch for poses (N, 4, 4): joints (N, 6)."""
    R6 = poses[:, :3, :3] @ geometry.tip_rotation.T
    x, z, p = R6[:, :, 0], R6[:, :, 2], poses[:, :3, 3]
    n = np.cross(z, p)
    length = np.linalg.norm(n, axis=1)
    length = np.where(length < DEGENERATE_M, np.nan, length)
    z5 = n / np.where((n * x).sum(axis=1) < 0, -length, length)[:, None]
    x5 = np.cross(z, z5)
    o5 = p - geometry.a6_m * x5
    depth = np.linalg.norm(o5, axis=1)
    depth = np.where(depth < DEGENERATE_M, np.nan, depth)
    depth = np.where((o5 * x5).sum(axis=1) < 0, -depth, depth)
    u = o5 / depth[:, None]
    q1, c2, s2 = np.arctan2(u[:, 0], -u[:, 2]), np.hypot(u[:, 0], u[:, 2]), -u[:, 1]
    s1, c1 = np.sin(q1), np.cos(q1)
    x3_z5 = -s1 * s2 * z5[:, 0] - c2 * z5[:, 1] + c1 * s2 * z5[:, 2]
    y3_z5 = -c1 * z5[:, 0] - s1 * z5[:, 2]
    columns = (
        q1,
        np.arctan2(s2, c2),
        depth - geometry.shaft_m,
        np.arctan2(-x3_z5, y3_z5),
        np.arctan2(-(u * z).sum(axis=1), (u * x5).sum(axis=1)),
        np.arctan2((x * x5).sum(axis=1), (x * z5).sum(axis=1)),
    )
    joints: FloatArray = np.stack(columns, axis=1) - np.array(geometry.shift)
    return joints


def _nearest_turns(angle: FloatArray, seed: FloatArray, lower: float, upper: float) -> FloatArray:
    """`nearest_turn` for arrays (N,); NaN stays NaN."""
    angle = angle + TURN * np.round((seed - angle) / TURN)
    high, low = angle - upper - LIMIT_TOLERANCE, lower - angle - LIMIT_TOLERANCE
    lowered = angle - TURN * np.ceil(np.maximum(high, 0.0) / TURN)
    raised = angle + TURN * np.ceil(np.maximum(low, 0.0) / TURN)
    turned = np.where((high > 0) & (lower - lowered < angle - upper), lowered, angle)
    turned = np.where((low > 0) & (raised - upper < lower - angle), raised, turned)
    result: FloatArray = turned
    return result
