"""One arm with its instrument at joint level, as MuJoCo bodies built from its DH rows.

Links have next to no mass: the arm's inertia is each joint's `armature` of its `[joint.dynamics]`
and its drive is a position + velocity servo with the joint's effort limit, so that an arm answers
its setpoints as its file says and gravity does not act (a Classic PSM carries counterweights).
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.robot_files import Instrument, Jaw, PrismaticJoint, RevoluteJoint
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.materials import CONTACT_SOLIMP, CONTACT_SOLREF, FRICTION, Touch

LINK_MASS_KG = 1e-6
"""Its weight bends no servo by a nanometre, so gravity need not be compensated link by link, which
took a twentieth of a physics step."""
LINK_RADIUS_M = 0.05
STRAIGHT_END_M = 0.015
"""The end of a straight instrument that things feel."""
FINGER_THICKNESS_M = 0.0014
FINGER_WIDTH_M = 0.0018

GRIP_TORQUE_NM = 0.01
"""Torque limit of each finger: about 1.2 N at the wall of a block. An instrument can give ten times
that; a peg-transfer block of 5 g needs no more, and more would dent the simulated contact."""
JAW_STIFFNESS_NM_PER_RAD = 0.15
JAW_ARMATURE_KG_M2 = 2e-5
JAW_DAMPING_NM_S_PER_RAD = 2.0 * math.sqrt(JAW_STIFFNESS_NM_PER_RAD * JAW_ARMATURE_KG_M2 / 2.0)
"""Critical damping of two fingers that move as one."""


def quaternion(rotation: FloatArray) -> FloatArray:
    """Unit quaternion (w, x, y, z) of a rotation matrix, (4,)."""
    result = np.zeros(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(rotation).ravel())
    return result


def rotation_x(angle: float) -> FloatArray:
    """Rotation about x, (3, 3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_z(angle: float) -> FloatArray:
    """Rotation about z, (3, 3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def add_arm(spec: mujoco.MjSpec, cell_arm: CellArm, friction: bool) -> None:
    """Adds an arm in its place: its joints, two coupled fingers, servos, the site `<arm>/tip`.

    Args:
        spec: the model that is being built.
        cell_arm: the arm; joints are named `<arm>/<joint>`, fingers `<arm>/jaw_left` and `_right`.
        friction: whether joints have the Coulomb friction of their file.

    Raises:
        DataFileError: a joint has no `[joint.dynamics]`.
    """
    name = cell_arm.name
    body = spec.worldbody.add_body(
        name=f"{name}/base",
        pos=cell_arm.T_task_base[:3, 3],
        quat=quaternion(cell_arm.T_task_base[:3, :3]),
    )
    body.add_geom(
        name=f"{name}/rcm",
        pos=cell_arm.entry.port_in_base_m,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[0.006, 0, 0],
        material="port",
        **Touch.NOTHING.bits,
    )
    for index, joint in enumerate(cell_arm.arm.joints):
        parent, body = body, _add_link(spec, body, name, joint, friction)
        if not cell_arm.arm.has_remote_centre:
            _add_tube(parent, f"{name}/link{index}", body.pos)
        _add_looks(body, name, index, cell_arm)
    _add_jaw(spec, body, name, cell_arm)


def _add_link(
    spec: mujoco.MjSpec,
    parent: mujoco.MjsBody,
    arm: str,
    joint: RevoluteJoint | PrismaticJoint,
    friction: bool,
) -> mujoco.MjsBody:
    """One row of the chain: Rx(alpha) Tx(a) Rz(theta) Tz(d), its joint about or along z."""
    revolute = isinstance(joint, RevoluteJoint)
    turn = joint.theta_rad + (joint.offset if revolute else 0.0)
    slide = joint.d_m + (0.0 if revolute else joint.offset)
    tilt, name = rotation_x(joint.alpha_rad), f"{arm}/{joint.name}"
    body = parent.add_body(
        name=name,
        pos=tilt @ np.array([joint.a_m, 0.0, slide]),
        quat=quaternion(tilt @ rotation_z(turn)),
        mass=LINK_MASS_KG,
        inertia=[1e-7, 1e-7, 1e-7],
        explicitinertial=True,
    )
    armature, stiffness, damping, friction_loss, effort = joint.servo
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE if revolute else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0, 0, 1],
        armature=armature,
        frictionloss=friction_loss if friction else 0.0,
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
    )
    _servo(spec, name, mujoco.mjtTrn.mjTRN_JOINT, stiffness, damping, effort)
    return body


def _add_tube(body: mujoco.MjsBody, name: str, end: FloatArray) -> None:
    """What is seen of a link of an arm of a lab's own: a tube from joint to joint."""
    if math.sqrt(end @ end) < LINK_RADIUS_M:
        return
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, 0, *end],
        size=[LINK_RADIUS_M, 0, 0],
        material="steel",
        **Touch.NOTHING.bits,
    )


def _servo(
    spec: mujoco.MjSpec,
    target: str,
    transmission: mujoco.mjtTrn,
    stiffness: float,
    damping: float,
    effort: float,
) -> None:
    """A drive with two inputs: position and velocity setpoint."""
    drive = spec.add_actuator(name=target, target=target, trntype=transmission)
    drive.set_to_pid(kp=stiffness, kv=damping)
    drive.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    drive.forcerange = [-effort, effort]


def _add_looks(body: mujoco.MjsBody, name: str, index: int, cell_arm: CellArm) -> None:
    """What is seen of the shaft and the wrist; the wrist also pushes blocks."""
    shape = cell_arm.arm.shape
    if not cell_arm.arm.has_remote_centre:
        return
    if index == 3:
        length = cell_arm.arm.joints[3].d_m
        body.add_geom(
            name=f"{name}/shaft",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, -length, 0, 0, -shape.shaft_radius_m],
            size=[shape.shaft_radius_m, 0, 0],
            material="shaft",
            **Touch.NOTHING.bits,
        )
    if index == 4:
        body.add_geom(
            name=f"{name}/wrist",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, cell_arm.arm.joints[5].a_m, 0, 0],
            size=[shape.wrist_radius_m, 0, 0],
            material="steel",
            solref=CONTACT_SOLREF,
            **Touch.WRIST.bits,
        )


def _add_jaw(spec: mujoco.MjSpec, wrist: mujoco.MjsBody, name: str, cell_arm: CellArm) -> None:
    tip = wrist.add_body(
        name=f"{name}/tip",
        pos=cell_arm.arm.tip_position,
        quat=quaternion(cell_arm.arm.tip_rotation),
        mass=LINK_MASS_KG,
        inertia=[1e-8, 1e-8, 1e-8],
        explicitinertial=True,
    )
    if cell_arm.arm.instrument is not None:
        _add_straight(tip, name, cell_arm.arm.instrument)
    tip.add_site(name=f"{name}/tip", size=[0.0005, 0.0005, 0.0005], group=4)
    jaw = cell_arm.arm.jaw
    for side, sign in (("left", 1.0), ("right", -1.0)):
        _add_finger(tip, f"{name}/jaw_{side}", sign, jaw)
    spec.add_exclude(bodyname1=f"{name}/jaw_left", bodyname2=f"{name}/jaw_right")
    spec.add_equality(
        name=f"{name}/jaw",
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=f"{name}/jaw_left",
        name2=f"{name}/jaw_right",
        data=[0.0, 1.0, *[0.0] * 10],
        solref=CONTACT_SOLREF,
    )
    opening = spec.add_tendon(name=f"{name}/jaw")
    opening.wrap_joint(f"{name}/jaw_left", 1.0)
    opening.wrap_joint(f"{name}/jaw_right", 1.0)
    _servo(
        spec,
        f"{name}/jaw",
        mujoco.mjtTrn.mjTRN_TENDON,
        JAW_STIFFNESS_NM_PER_RAD,
        JAW_DAMPING_NM_S_PER_RAD,
        min(GRIP_TORQUE_NM, jaw.effort_nm),
    )


def _add_straight(tip: mujoco.MjsBody, name: str, instrument: Instrument) -> None:
    """The tube of a straight instrument; its last stretch pushes things as a wrist does."""
    shape, length = instrument.shape, instrument.shaft_length_m
    for part, ends, radius, touch in (
        ("shaft", (-length, -STRAIGHT_END_M), shape.shaft_radius_m, Touch.NOTHING),
        ("wrist", (-STRAIGHT_END_M, -shape.wrist_radius_m), shape.wrist_radius_m, Touch.WRIST),
    ):
        tip.add_geom(
            name=f"{name}/{part}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, ends[0], 0, 0, ends[1]],
            size=[radius, 0, 0],
            material="shaft",
            solref=CONTACT_SOLREF,
            **touch.bits,
        )


def _add_finger(tip: mujoco.MjsBody, name: str, sign: float, jaw: Jaw) -> None:
    finger = tip.add_body(
        name=name,
        mass=LINK_MASS_KG,
        ipos=[0, 0, jaw.finger_length_m / 2],
        inertia=[1e-8, 1e-8, 1e-8],
        explicitinertial=True,
    )
    finger.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[-sign, 0, 0],
        armature=JAW_ARMATURE_KG_M2,
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=[0.0, max(jaw.upper_rad, 0.1) / 2],
        solref_limit=CONTACT_SOLREF,
    )
    half = [FINGER_WIDTH_M / 2, FINGER_THICKNESS_M / 2, jaw.finger_length_m / 2]
    finger.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0, sign * half[1], half[2]],
        size=half,
        material="steel",
        condim=4,
        friction=FRICTION,
        priority=2,  # whatever a jaw holds, its own friction decides
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
        **Touch.FINGER.bits,
    )
