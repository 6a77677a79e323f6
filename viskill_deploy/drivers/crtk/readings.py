"""What a simulated arm publishes all the time, as messages of one moment."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from viskill_deploy.core.types import PSM_JOINTS, ArmState, FloatArray, Joints
from viskill_deploy.drivers.crtk.arm_cartesian import pose_of
from viskill_deploy.drivers.crtk.messages import (
    Float64MultiArray,
    Header,
    JointState,
    MultiArrayDimension,
    MultiArrayLayout,
    PoseStamped,
    Time,
    Twist,
    TwistStamped,
    Vector3,
    WrenchStamped,
)
from viskill_deploy.drivers.crtk.simulated_arm import SimulatedArm

ACTUATORS = ("yaw", "pitch", "insertion", "disc_1", "disc_2", "disc_3", "disc_4")
"""Names of an arm without an instrument; dVRK's differ from system to system."""

NO_EFFORT = (0.0,) * 6


class Reading:
    """One moment of an arm. Poses are computed only when somebody asks.

    Args:
        arm: the arm.
        state: its joints as measured.
        stamp: of that measurement.
    """

    def __init__(self, arm: SimulatedArm, state: ArmState, stamp: Time) -> None:
        self._arm, self._state, self._stamp = arm, state, stamp
        self._held = arm.motion.setpoint

    def message(self, topic: str) -> Any:
        """The message for a periodic topic; stamp 0 where there is no valid data."""
        match topic:
            case "measured_js":
                return self._measured_js()
            case "setpoint_js":
                return self._js(PSM_JOINTS, self._held.jp, self._held.jv)
            case "jaw/measured_js":
                state = self._state
                return self._js(("jaw",), (state.jaw_measured_jp,), (state.jaw_measured_jv,))
            case "jaw/setpoint_js":
                return self._js(("jaw",), (self._held.jaw,), ())
        return self._cartesian(topic)

    def is_valid(self, topic: str) -> bool:
        """Whether a topic's message means anything; without an instrument poses do not."""
        return self._stamp != Time() and (bool(self._arm.tool) or topic.endswith("_js"))

    def _cartesian(self, topic: str) -> Any:
        cartesian, q, base = self._arm.cartesian, self._state.measured_jp, f"{self._arm.name}_base"
        match topic:
            case "measured_cp":
                message: Any = self._cp(cartesian.T_task_base @ self._measured, "task")
            case "local/measured_cp":
                message = self._cp(self._measured, base)
            case "setpoint_cp":
                message = self._cp(cartesian.T_task_base @ self._setpoint, "task")
            case "local/setpoint_cp":
                message = self._cp(self._setpoint, base)
            case "measured_cv":
                v = cartesian.twist(q, self._state.measured_jv).tolist()
                twist = Twist(Vector3(*v[:3]), Vector3(*v[3:]))
                message = TwistStamped(self._header("task"), twist)
            case "body/jacobian":
                message = _matrix(cartesian.body_jacobian(q))
            case "spatial/jacobian":
                message = _matrix(cartesian.spatial_jacobian(q))
            case _:  # the simulation feels no forces
                message = WrenchStamped(self._header(base))
        return message

    @cached_property
    def _measured(self) -> FloatArray:
        return self._arm.cartesian.local(self._state.measured_jp)

    @cached_property
    def _setpoint(self) -> FloatArray:
        return self._arm.cartesian.local(self._held.jp)

    def _header(self, frame: str = "") -> Header:
        is_known = bool(self._arm.tool) or not frame
        return Header(self._stamp if is_known else Time(), frame)

    def _js(self, names: tuple[str, ...], q: Joints, v: Joints) -> JointState:
        return JointState(self._header(), names, q, v, NO_EFFORT[: len(names)])

    def _cp(self, T: FloatArray, frame: str) -> PoseStamped:
        return PoseStamped(self._header(frame), pose_of(T))

    def _measured_js(self) -> JointState:
        state = self._state
        if self._arm.tool:
            return self._js(PSM_JOINTS, state.measured_jp, state.measured_jv)
        q = self._arm.actuators((*state.measured_jp, state.jaw_measured_jp))
        v = self._arm.actuators((*state.measured_jv, state.jaw_measured_jv))
        return JointState(self._header(), ACTUATORS, q, v, (0.0,) * 7)


def _matrix(J: FloatArray) -> Float64MultiArray:
    rows, columns = J.shape
    dims = (MultiArrayDimension("rows", rows, 1), MultiArrayDimension("cols", columns, rows))
    return Float64MultiArray(MultiArrayLayout(dims), tuple(J.ravel(order="F").tolist()))
