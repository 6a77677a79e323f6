"""The thresholds of one cell, frozen, in plain floats; refused when looser than the ceilings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viskill_deploy.core.description import ArmDescription, CellArm, CellDescription
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.robot_files import Instrument
from viskill_deploy.core.types import Joints, ObservationRange
from viskill_deploy.safety import ceilings
from viskill_deploy.safety.ceilings import check
from viskill_deploy.safety.clearances import Apart, clearances
from viskill_deploy.safety.geometry import Chain, Point

ROUNDING = 1e-9
"""Thresholds give this relative width, so that a value exactly at one passes in spite of rounding
(second differences of positions at 1 kHz carry 2e-10)."""

RATES = ("max_velocity", "max_acceleration", "max_jerk")


@dataclass(frozen=True, slots=True)
class ArmEnvelope:
    """What one arm may do. Its n axes are its joints, and the jaw as the last of them; rad, m, s.

    Attributes:
        lower, upper: hard limits, (n,).
        margin: distance that setpoints keep from them, (n - 1,).
        max_speed, max_acceleration, max_jerk: (n,).
        first_command: how far the first setpoint may be from the driver's, (n - 1,).
        insertion_min: insertion with the wrist just past the cannula; of an arm without a
            mechanical remote centre, least depth of the control point past the port.
        slow_value, least_value: singular values of the Jacobian that slow and that hold, m.
        tracking: how far a measured joint may be from its setpoint, (n - 1,), for `tracking_time`.
        wrist_offset: depth of the wrist past the remote centre at no insertion.
        wrist_length, jaw_length: from the wrist to the control point, from there to the jaw's end.
        port: registered port, task frame.
        port_warn, port_stop: distances of the shaft's axis from it.
        workspace_lower, workspace_upper: box of the control point, task frame.
        slides: which joints are prismatic, (n - 1,).
        levers: of an arm without a mechanical remote centre, the most that a joint moves any point
            behind it, m a rad or m a m, (n - 1,); () of a PSM.
    """

    name: str
    tool: str
    joint_names: tuple[str, ...]
    lower: Joints
    upper: Joints
    margin: Joints
    max_speed: Joints
    max_acceleration: Joints
    max_jerk: Joints
    measured_slack: float
    first_command: Joints
    insertion_min: float
    wrist_offset: float
    wrist_length: float
    jaw_length: float
    port: Point
    port_warn: float
    port_stop: float
    feedback_period: float
    tracking: Joints
    tracking_time: float
    slow_value: float
    least_value: float
    ik_residual: float
    workspace_lower: Point
    workspace_upper: Point
    chain: Chain
    slides: tuple[bool, ...]
    levers: Joints = ()

    @property
    def has_remote_centre(self) -> bool:
        """Whether a mechanism keeps the shaft in the port."""
        return not self.levers


@dataclass(frozen=True, slots=True)
class CellEnvelope:
    """What the whole cell may do.

    Attributes:
        period: control period, s.
        tip_speed: speed of a control point in a run, m/s.
        tip_speed_ceiling: speed at which the run ends, m/s.
        floor: lowest height of a jaw end, task frame, m.
        consent_hold, consent_stop: time without the operator's consent, s.
        training: what the policy has seen in training; None where no policy is asked.
        apart: every two things that stay apart.
    """

    arms: tuple[ArmEnvelope, ...]
    period: float
    tip_speed: float
    tip_speed_ceiling: float
    floor: float
    consent_hold: float
    consent_stop: float
    apart: tuple[Apart, ...]
    training: ObservationRange | None = None

    @classmethod
    def of(
        cls,
        cell: CellDescription,
        period_s: float,
        training: ObservationRange | None = None,
        speed: float = 1.0,
    ) -> CellEnvelope:
        """The thresholds of `cell`, each checked for sense and against its ceiling.

        Args:
            cell: the cell's description.
            period_s: control period, s.
            training: what the policy has seen in training.
            speed: part of every speed limit that is left, in (0, 1].

        Raises:
            DataFileError: a value is not finite, not positive, out of order or looser than the
                ceiling; names file, key, value and bound.
        """
        path, motion = cell.files[0], cell.file.motion
        low, high = ceilings.PERIOD_S
        check(path, "period_s", period_s, low, high)
        _positive(path, "speed", speed, 1.0)
        _positive(path, "motion.tip_speed_m_s", motion.tip_speed_m_s, ceilings.TIP_SPEED_M_S)
        check(
            path,
            "motion.tip_speed_ceiling_m_s",
            motion.tip_speed_ceiling_m_s,
            motion.tip_speed_m_s,
            ceilings.TIP_SPEED_CEILING_M_S,
        )
        check(path, "motion.floor_m", motion.floor_m, ceilings.MIN_FLOOR_M, 0.1)
        hold, stop = ceilings.CONSENT_S
        _positive(path, "motion.consent_hold_s", motion.consent_hold_s, hold)
        check(path, "motion.consent_stop_s", motion.consent_stop_s, motion.consent_hold_s, stop)
        if not cell.arms:
            raise DataFileError(path, "arm", "the cell has no arm; add one")
        return cls(
            arms=tuple(_arm(path, arm, speed) for arm in cell.arms),
            period=float(period_s),
            tip_speed=speed * float(motion.tip_speed_m_s),
            tip_speed_ceiling=float(motion.tip_speed_ceiling_m_s),
            floor=float(motion.floor_m),
            consent_hold=float(motion.consent_hold_s),
            consent_stop=float(motion.consent_stop_s),
            training=training,
            apart=clearances(cell),
        )


def _arm(cell_path: Path, cell_arm: CellArm, speed: float) -> ArmEnvelope:
    arm, entry = cell_arm.arm, cell_arm.entry
    _check_gate(arm)
    if arm.instrument is None:
        _check_joints(arm)
    else:
        _check_own(arm, arm.instrument)
    _check_workspace(cell_path, cell_arm)
    jaw, gate, chain, psm = arm.jaw, arm.gate, Chain.of(cell_arm), arm.has_remote_centre
    by_kind = [joint.type == "prismatic" for joint in arm.joints]
    return ArmEnvelope(
        name=cell_arm.name,
        tool=arm.tool,
        joint_names=tuple(joint.name for joint in arm.joints),
        lower=_floats(*arm.limit(0), jaw.lower_rad),
        upper=_floats(*arm.limit(1), jaw.upper_rad),
        margin=_floats(
            *(gate.position_margin_m if slides else gate.position_margin_rad for slides in by_kind)
        ),
        max_speed=_floats(*(speed * v for v in (*arm.limit(2), jaw.max_velocity_rad_s))),
        max_acceleration=_floats(*arm.limit(3), jaw.max_acceleration_rad_s2),
        max_jerk=_floats(*arm.limit(4), jaw.max_jerk_rad_s3),
        measured_slack=float(gate.measured_slack),
        first_command=_floats(
            *(gate.first_command_m if slides else gate.first_command_rad for slides in by_kind)
        ),
        insertion_min=float(arm.insertion_min_m if psm else gate.insertion_past_rcm_m),
        wrist_offset=float(arm.wrist_offset_m if psm else 0.0),
        wrist_length=float(arm.joints[5].a_m if psm else 0.0),
        jaw_length=float(jaw.finger_length_m),
        port=chain.in_task(entry.port_in_base_m),
        port_warn=float(gate.port_warn_m),
        port_stop=float(gate.port_stop_m),
        feedback_period=float(gate.feedback_period_s),
        tracking=_floats(
            *(gate.tracking_m if slides else gate.tracking_rad for slides in by_kind[:-3]),
            *(gate.tracking_m if slides else gate.tracking_wrist_rad for slides in by_kind[-3:]),
        ),
        tracking_time=float(gate.tracking_s),
        slow_value=float(gate.singular_value_slow_m),
        least_value=float(gate.singular_value_hold_m),
        ik_residual=float(gate.ik_residual_m),
        workspace_lower=entry.workspace_lower_m,
        workspace_upper=entry.workspace_upper_m,
        chain=chain,
        slides=tuple(by_kind),
        levers=() if psm else _levers(arm),
    )


def _levers(arm: ArmDescription) -> Joints:
    """The most that each joint moves any point behind it, m a rad or m a m."""
    levers: list[float] = []
    behind = math.dist(arm.tip_position, (0.0, 0.0, 0.0)) + arm.jaw.finger_length_m
    for joint in reversed(arm.joints):
        levers.append(1.0 if joint.type == "prismatic" else behind)
        slide = max(map(abs, joint.limits[:2])) if joint.type == "prismatic" else 0.0
        offset = abs(joint.offset) if joint.type == "prismatic" else 0.0
        behind += abs(joint.a_m) + abs(joint.d_m) + offset + slide
    return _floats(*reversed(levers))


def _check_own(arm: ArmDescription, instrument: Instrument) -> None:
    """An arm of a lab's own against ceilings that hold for all its joints alike, and its jaw."""
    path, gate = arm.files[0], arm.gate
    for joint in arm.joints:
        lower, upper, *rates = joint.limits
        slides = int(joint.type == "prismatic")
        most = ceilings.OWN_RANGE[slides]
        check(path, f"{joint.name}.lower", lower, -most, most)
        check(path, f"{joint.name}.upper", upper, -most, most)
        margin = gate.position_margin_m if slides else gate.position_margin_rad
        _positive(path, f"{joint.name} range less margins", upper - lower - 2.0 * margin, 2 * most)
        for key, rate, ceiling in zip(RATES, rates, ceilings.OWN_RATES, strict=True):
            _positive(path, f"{joint.name}.{key}", rate, ceiling[slides])
    _check_jaw(path, arm)
    first = (gate.first_command_rad, gate.first_command_m)
    tracking = (gate.tracking_rad, gate.tracking_m, gate.tracking_wrist_rad)
    for value, most in zip(first, ceilings.OWN_FIRST_COMMAND, strict=True):
        _positive(path, "gate.first_command", value, most)
    for value, most in zip(tracking, ceilings.OWN_TRACKING, strict=True):
        _positive(path, "gate.tracking", value, most)
    far = ceilings.OWN_TIP_M
    _positive(path, "instrument.shaft_length_m", instrument.shaft_length_m, far)
    for value in arm.tip_position:
        check(path, "instrument.tip_position_m", value, -far, far)


def _check_jaw(path: Path, arm: ArmDescription) -> None:
    jaw, (low, high) = arm.jaw, ceilings.TOOL_RANGE[-1]
    check(path, "jaw.lower", jaw.lower_rad, low, high)
    check(path, "jaw.upper", jaw.upper_rad, low, high)
    rates = (jaw.max_velocity_rad_s, jaw.max_acceleration_rad_s2, jaw.max_jerk_rad_s3)
    most = (ceilings.MAX_SPEED, ceilings.MAX_ACCELERATION, ceilings.MAX_JERK)
    for key, rate, (*_, ceiling) in zip(RATES, rates, most, strict=True):
        _positive(path, f"jaw.{key}", rate, ceiling)


def _check_joints(arm: ArmDescription) -> None:
    """Joint limits against the ceilings of their place in the chain."""
    robot, tool = arm.files[0], arm.files[-1]
    is_si = math.isclose(arm.joints[2].offset, ceilings.SI_SHAFT_OFFSET_M, abs_tol=1e-6)
    ranges = (*(ceilings.SI_RANGE if is_si else ceilings.CLASSIC_RANGE), *ceilings.TOOL_RANGE)
    jaw = arm.jaw
    named = [(joint.name, joint.limits) for joint in arm.joints]
    named.append(
        (
            "jaw",
            (
                jaw.lower_rad,
                jaw.upper_rad,
                jaw.max_velocity_rad_s,
                jaw.max_acceleration_rad_s2,
                jaw.max_jerk_rad_s3,
            ),
        )
    )
    for index, (name, limits) in enumerate(named):
        path = robot if index < 3 else tool
        lower, upper, speed, acceleration, jerk = limits
        low, high = ranges[index]
        check(path, f"{name}.lower", lower, low, high)
        check(path, f"{name}.upper", upper, low, high)
        margin = arm.gate.position_margin_m if index == 2 else arm.gate.position_margin_rad
        _positive(path, f"{name} range less margins", upper - lower - 2.0 * margin, high - low)
        _positive(path, f"{name}.max_velocity", speed, ceilings.MAX_SPEED[index])
        _positive(path, f"{name}.max_acceleration", acceleration, ceilings.MAX_ACCELERATION[index])
        _positive(path, f"{name}.max_jerk", jerk, ceilings.MAX_JERK[index])


def _check_gate(arm: ArmDescription) -> None:
    """The arm's own thresholds of the gate; a margin is stricter when larger."""
    path, gate = arm.files[0], arm.gate
    margin_rad, margin_m = ceilings.MIN_POSITION_MARGIN
    first_rad, first_m = ceilings.FIRST_COMMAND
    check(path, "gate.position_margin_rad", gate.position_margin_rad, margin_rad, 0.1)
    check(path, "gate.position_margin_m", gate.position_margin_m, margin_m, 0.02)
    check(path, "gate.measured_slack", gate.measured_slack, 0.0, ceilings.MEASURED_SLACK)
    _positive(path, "gate.first_command_rad", gate.first_command_rad, first_rad)
    _positive(path, "gate.first_command_m", gate.first_command_m, first_m)
    check(
        path, "gate.insertion_past_rcm_m", gate.insertion_past_rcm_m, ceilings.MIN_PAST_RCM_M, 0.2
    )
    warn, stop = ceilings.PORT
    _positive(path, "gate.port_warn_m", gate.port_warn_m, warn)
    check(path, "gate.port_stop_m", gate.port_stop_m, gate.port_warn_m, stop)
    shape = arm.shape
    for key, radius, least in zip(
        ("shaft", "wrist", "jaw"),
        (shape.shaft_radius_m, shape.wrist_radius_m, shape.jaw_radius_m),
        ceilings.MIN_RADIUS_M,
        strict=True,
    ):
        check(arm.files[-1], f"shape.{key}_radius_m", radius, least, ceilings.MAX_RADIUS_M)
    if arm.has_remote_centre:
        beyond = arm.joints[2].limits[1] - arm.insertion_min_m
        _positive(path, "insertion range past the cannula", beyond, 1.0)
    slowest = ceilings.MAX_FEEDBACK_PERIOD_S
    _positive(path, "gate.feedback_period_s", gate.feedback_period_s, slowest)
    for key, ceiling in zip(("rad", "m", "wrist_rad"), ceilings.TRACKING, strict=True):
        _positive(path, f"gate.tracking_{key}", getattr(gate, f"tracking_{key}"), ceiling)
    _positive(path, "gate.tracking_s", gate.tracking_s, ceilings.TRACKING_S)
    (slow, hold), upper = ceilings.SINGULAR_VALUE_M, gate.singular_value_slow_m
    check(path, "gate.singular_value_slow_m", upper, slow, 0.2)
    check(path, "gate.singular_value_hold_m", gate.singular_value_hold_m, hold, upper)
    _positive(path, "gate.ik_residual_m", gate.ik_residual_m, ceilings.IK_RESIDUAL_M)
    _positive(arm.files[-1], "jaw.finger_length_m", arm.jaw.finger_length_m, ceilings.MAX_FINGER_M)


def _check_workspace(path: Path, cell_arm: CellArm) -> None:
    entry = cell_arm.entry
    for low, high in zip(entry.workspace_lower_m, entry.workspace_upper_m, strict=True):
        key = f"arm.{cell_arm.name}.workspace"
        _positive(path, key, high - low, ceilings.MAX_WORKSPACE_SIDE_M)
        check(path, key, low, -ceilings.MAX_WORKSPACE_SIDE_M, ceilings.MAX_WORKSPACE_SIDE_M)
    for value in entry.port_in_base_m:
        is_psm = cell_arm.arm.has_remote_centre
        offset = ceilings.MAX_PORT_OFFSET_M if is_psm else ceilings.OWN_PORT_M
        check(path, f"arm.{cell_arm.name}.port_in_base_m", value, -offset, offset)
    T = cell_arm.T_task_base
    R = T[:3, :3]
    if T.shape != (4, 4) or not np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=1e-9):
        raise DataFileError(
            path, f"arm.{cell_arm.name}", "its base pose is no rigid transform; correct it"
        )
    for value in T[:3, 3]:
        check(path, f"arm.{cell_arm.name}.base_position_m", float(value), -2.0, 2.0)


def _positive(path: Path, key: str, value: float, ceiling: float) -> None:
    """Refuses zero, a negative number, NaN and whatever is above the ceiling."""
    check(path, key, value, math.ulp(0.0), ceiling)


def _floats(*values: float) -> Joints:
    return tuple(map(float, values))
