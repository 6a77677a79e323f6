"""A 7-joint arm that holds a 0.4 m shaft, made of our own numbers: an arm that is no PSM."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from viskill_deploy.kinematics.limits import JointLimits

LINKS_M = (0.34, 0.0, 0.40, 0.0, 0.40, 0.0, 0.13)
"""Distance from the joint before, along the axis that joints 1, 3, 5 and 7 turn about."""

SHAFT_M = 0.4
LIMITS = JointLimits(
    lower=(-2.9, -2.0, -2.9, -2.0, -2.9, -2.0, -3.0),
    upper=(2.9, 2.0, 2.9, 2.0, 2.9, 2.0, 3.0),
    velocity=(1.5,) * 7,
    acceleration=(15.0,) * 7,
)
BENT = (0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0)


def chain7() -> pin.Model:
    """Axes z y z y z y z; frame "tool" at the end of the shaft, z along it."""
    model = pin.Model()
    parent = 0
    for i, length in enumerate(LINKS_M):
        joint = pin.JointModelRZ() if i % 2 == 0 else pin.JointModelRY()
        origin = pin.SE3(np.eye(3), np.array([0.0, 0.0, length]))
        parent = model.addJoint(parent, joint, origin, f"a{i + 1}")
    end = pin.SE3(np.eye(3), np.array([0.0, 0.0, SHAFT_M]))
    model.addFrame(pin.Frame("tool", parent, end, pin.OP_FRAME))
    return model


def tool_pose(model: pin.Model, q: tuple[float, ...]) -> pin.SE3:
    """Pose of the shaft's end."""
    data = model.createData()
    pin.forwardKinematics(model, data, np.array(q))
    return pin.SE3(pin.updateFramePlacement(model, data, model.getFrameId("tool")))
