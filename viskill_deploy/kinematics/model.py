"""Arm descriptions as Pinocchio models, and forward kinematics of many configurations at once.

Modified (Craig) Denavit-Hartenberg throughout: link i is Rx(alpha) Tx(a) Rz(theta) Tz(d).
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from viskill_deploy.core.description import ArmDescription
from viskill_deploy.core.robot_files import PrismaticJoint, RevoluteJoint
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.pose import checked_rows

TIP_FRAME = "tip"
"""Frame at the control point: origin on the wrist-yaw axis, z forward."""

SHAFT_FRAME = "shaft"
"""Frame on the instrument's shaft: origin on the wrist-pitch axis, z along the shaft. A straight
instrument's is that of its tip."""

ROLL = 3
"""Index of the joint that turns the shaft about itself."""


def link_origin(joint: RevoluteJoint | PrismaticJoint) -> FloatArray:
    """Pose of a joint's frame in the one before it, the joint at zero, (4, 4).

    Source: J. J. Craig, Introduction to Robotics, eq. 3.6.
    """
    slides = joint.type == "prismatic"
    theta = joint.theta_rad + (0.0 if slides else joint.offset)
    d = joint.d_m + (joint.offset if slides else 0.0)
    ca, sa = math.cos(joint.alpha_rad), math.sin(joint.alpha_rad)
    ct, st = math.cos(theta), math.sin(theta)
    return np.array(
        [
            [ct, -st, 0.0, joint.a_m],
            [st * ca, ct * ca, -sa, -sa * d],
            [st * sa, ct * sa, ca, ca * d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def build_model(arm: ArmDescription) -> pin.Model:
    """A Pinocchio model of the arm with the frames `tip` and `shaft`.

    Limits (position, velocity, effort) come from the description. It has no masses: gravity is
    the robot controller's business.
    """
    model = pin.Model()
    model.name = f"{arm.robot}+{arm.tool}"
    parent = 0
    for index, joint in enumerate(arm.joints):
        kind = pin.JointModelPZ() if joint.type == "prismatic" else pin.JointModelRZ()
        lower, upper, speed, _, _ = joint.limits
        effort = joint.servo[4] if joint.dynamics else math.inf
        parent = model.addJoint(
            parent,
            kind,
            pin.SE3(link_origin(joint)),
            joint.name,
            *(np.array([value]) for value in (effort, speed, lower, upper)),
        )
        if index == ROLL and arm.has_remote_centre:
            model.addFrame(pin.Frame(SHAFT_FRAME, parent, pin.SE3.Identity(), pin.OP_FRAME))
    tip = pin.SE3(arm.tip_rotation, np.array(arm.tip_position))
    model.addFrame(pin.Frame(TIP_FRAME, parent, tip, pin.OP_FRAME))
    if not arm.has_remote_centre:
        model.addFrame(pin.Frame(SHAFT_FRAME, parent, tip, pin.OP_FRAME))
    return model


def forward_batch(arm: ArmDescription, q: FloatArray) -> FloatArray:
    """Tip poses of many configurations.

    Args:
        arm: the arm.
        q: joint positions, (N, joints), rad and m.

    Returns:
        `T_base_tip` of each, (N, 4, 4), m.

    Raises:
        KinematicsError: another shape, or a number that is not finite.
    """
    pose = _chain(arm, checked_rows(q, len(arm.joints), "q"), len(arm.joints))
    result = pose.copy()
    result[:, :3, :3] = pose[:, :3, :3] @ arm.tip_rotation
    result[:, :3, 3] += pose[:, :3, :3] @ np.array(arm.tip_position)
    return result


def tip_positions(arm: ArmDescription, q: FloatArray) -> FloatArray:
    """Where the tip is, `forward_batch` without orientations and without checks: about 10x faster.

    Args:
        arm: the arm.
        q: joint positions, (..., joints), rad and m.

    Returns:
        Base frame, (..., 3), m.
    """
    tip = np.zeros((3, q[..., 0].size)) + np.array(arm.tip_position)[:, None]
    for index in range(len(arm.joints) - 1, -1, -1):
        joint, value = arm.joints[index], q[..., index].reshape(-1)
        if joint.type == "prismatic":
            tip[2] += value
        else:
            c, s = np.cos(value), np.sin(value)
            tip[0], tip[1] = c * tip[0] - s * tip[1], s * tip[0] + c * tip[1]
        T = link_origin(joint)
        tip = T[:3, :3] @ tip + T[:3, 3:]
    return np.moveaxis(tip.reshape(3, *q.shape[:-1]), 0, -1)


def port_distances(arm: ArmDescription, q: FloatArray, port: FloatArray) -> FloatArray:
    """Distance of the shaft's axis from a port for many configurations, (N,) m.

    Args:
        arm: the arm.
        q: joint positions, (N, joints), rad and m.
        port: base frame, (3,) m.
    """
    if arm.has_remote_centre:
        shaft = _chain(arm, checked_rows(q, len(arm.joints), "q"), ROLL + 1)
    else:
        shaft = forward_batch(arm, q)
    offset = np.asarray(port) - shaft[:, :3, 3]
    across = np.einsum("nij,ni->nj", shaft[:, :3, :2], offset)
    distances: FloatArray = np.hypot(across[:, 0], across[:, 1])
    return distances


def _chain(arm: ArmDescription, q: FloatArray, joints: int) -> FloatArray:
    """Pose of the frame of the last of the first `joints` joints, (N, 4, 4)."""
    pose = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for joint, value in zip(arm.joints[:joints], q.T, strict=False):
        motion = np.zeros((len(q), 4, 4))
        motion[:, 2, 2] = motion[:, 3, 3] = 1.0
        if joint.type == "prismatic":
            motion[:, 0, 0] = motion[:, 1, 1] = 1.0
            motion[:, 2, 3] = value
        else:
            motion[:, 0, 0] = motion[:, 1, 1] = np.cos(value)
            motion[:, 1, 0] = np.sin(value)
            motion[:, 0, 1] = -motion[:, 1, 0]
        pose = pose @ link_origin(joint) @ motion
    return pose
