"""Points of an arm with known errors, made without the code under test's Jacobian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.cables import Cables
from viskill_deploy.core.description import CellArm, load_cell
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.model import forward_batch


def cell_arm(index: int = 0) -> CellArm:
    return load_cell("bipegtransfer").arms[index]


def rotation(vector: FloatArray) -> FloatArray:
    """Rodrigues' formula, (3, 3)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle else vector
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def true_points(arm: CellArm, errors: ArmErrors, m: Measurements) -> FloatArray:
    """Where the point is, by the definitions in `ArmErrors`, (n, 3)."""
    d = errors.delay_s
    q = m.joints + np.array(errors.joint_offset) - d * m.speeds + d * d / 2 * m.accelerations
    q[:, 2] += errors.tool_length_m
    q[:, 3:] += m.joints[:, 3:] @ np.array(errors.cables.coupling).T
    q[:, 3:] -= m.turns * np.array(errors.cables.backlash_rad)
    T = forward_batch(arm.arm, q)
    local = T[:, :3, 3] + (m.point_m + errors.point_m) * T[:, :3, 2]
    R = arm.T_task_base[:3, :3] @ rotation(np.array(errors.base_rotation_rad))
    return np.asarray(local @ R.T + arm.T_task_base[:3, 3] + np.array(errors.base_translation_m))


def poses(n: int, rng: np.random.Generator, moving: float = 0.2) -> Measurements:
    """Joints spread over the workspace, a part of them on the move; points still zero."""
    low = np.array([-0.5, -0.4, 0.08, -1.5, -0.9, -0.9])
    high = np.array([0.5, 0.4, 0.2, 1.5, 0.9, 0.9])
    speeds = rng.normal(0.0, [0.3, 0.3, 0.03, 0.5, 0.5, 0.5], (n, 6))
    speeds[rng.random(n) >= moving] = 0.0
    accelerations = np.where(speeds, rng.normal(0.0, [1.0, 1.0, 0.1, 2.0, 2.0, 2.0], (n, 6)), 0.0)
    return Measurements(
        np.arange(float(n)),
        rng.uniform(low, high, (n, 6)),
        speeds,
        rng.choice([-1.0, 1.0], (n, 3)),
        np.zeros((n, 3)),
        accelerations=accelerations,
    )


def with_points(m: Measurements, points: FloatArray) -> Measurements:
    return replace(m, points=points)


def measured(
    arm: CellArm, errors: ArmErrors, n: int, seed: int, noise_m: float = 2e-4, wrong: float = 0.0
) -> tuple[Measurements, np.ndarray]:
    """Noisy points, some of them wrong by centimetres; and which those are."""
    rng = np.random.default_rng(seed)
    m = poses(n, rng)
    points = true_points(arm, errors, m) + rng.normal(0.0, noise_m, (n, 3))
    is_wrong = rng.random(n) < wrong
    points[is_wrong] += rng.normal(0.0, 0.02, (int(is_wrong.sum()), 3))
    return with_points(m, points), is_wrong


TYPICAL = ArmErrors(
    base_rotation_rad=(0.012, -0.017, 0.02),
    base_translation_m=(0.004, -0.006, 0.003),
    joint_offset=(0.0, 0.008, -0.0065, 0.02, -0.025, 0.0),
    cables=Cables((0.01, 0.015, 0.0), ((0.01, 0.0, 0.0), (0.0, 0.03, -0.02), (0.0, 0.0, 0.0))),
    delay_s=0.018,
)
"""As an arm that was set up by hand, without what the jaw pivot cannot show."""
