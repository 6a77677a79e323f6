import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from viskill_deploy.core import data
from viskill_deploy.core.description import CellDescription, load_cell, load_robot
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.supervisor import Supervisor

CELL = load_cell("bipegtransfer")
JOINT_NUMBERS = [
    (index, key)
    for index, joint in enumerate(CELL.arms[0].arm.joints)
    for key in type(joint).model_fields
    if key.startswith(("lower_", "upper_", "max_"))
]
JAW_NUMBERS = [
    "lower_rad",
    "upper_rad",
    "max_velocity_rad_s",
    "max_acceleration_rad_s2",
    "max_jerk_rad_s3",
    "finger_length_m",
]
GATE_NUMBERS = list(type(CELL.arms[0].arm.gate).model_fields)
MOTION_NUMBERS = [
    "tip_speed_m_s",
    "tip_speed_ceiling_m_s",
    "floor_m",
    "consent_hold_s",
    "consent_stop_s",
]
NONSENSE = [math.nan, math.inf, -math.inf]


def with_arm(**changes) -> CellDescription:
    first = CELL.arms[0]
    return replace(CELL, arms=(replace(first, arm=replace(first.arm, **changes)), *CELL.arms[1:]))


def with_joint(index: int, key: str, value: float) -> CellDescription:
    joints = list(CELL.arms[0].arm.joints)
    joints[index] = joints[index].model_copy(update={key: value})
    return with_arm(joints=tuple(joints))


def with_table(table: str, key: str, value: float) -> CellDescription:
    if table == "motion":
        motion = CELL.file.motion.model_copy(update={key: value})
        return replace(CELL, file=CELL.file.model_copy(update={"motion": motion}))
    old = getattr(CELL.arms[0].arm, table)
    return with_arm(**{table: old.model_copy(update={key: value})})


def refused(cell: CellDescription, period_s: float = 0.004) -> str:
    with pytest.raises(DataFileError) as error:
        CellEnvelope.of(cell, period_s)
    assert "stricter" in str(error.value)
    return error.value.key


def test_the_shipped_thresholds_are_accepted_as_they_are():
    envelope = CellEnvelope.of(CELL, 0.004)
    arm = envelope.arms[0]
    assert arm.max_speed == (1.57, 1.57, 0.2, 18.8, 18.8, 18.8, 6.0)
    assert arm.max_acceleration == (7.85, 7.85, 1.0, 63.0, 63.0, 63.0, 63.0)
    assert arm.max_jerk == (157.0, 157.0, 20.0, 1260.0, 1260.0, 1260.0, 1260.0)
    assert arm.lower[:3] == (-1.588, -0.925025, 0.0)
    assert arm.upper[:3] == (1.588, 0.925025, 0.24)
    assert arm.margin == (0.01, 0.01, 0.001, 0.01, 0.01, 0.01)
    assert arm.first_command == (0.02, 0.02, 0.001, 0.02, 0.02, 0.02)
    assert arm.insertion_min == pytest.approx(0.0626)
    assert (arm.measured_slack, arm.feedback_period) == (0.0087, 0.01)
    assert arm.tracking == (0.05, 0.05, 0.003, 0.1, 0.1, 0.1)
    assert arm.tracking_time == 0.05
    assert (arm.slow_value, arm.least_value, arm.ik_residual) == (0.025, 0.015, 0.001)
    assert (envelope.tip_speed, envelope.tip_speed_ceiling) == (0.05, 0.25)
    assert (envelope.consent_hold, envelope.consent_stop) == (0.2, 2.0)


@pytest.mark.parametrize("tool", data.names("robots/tools"))
def test_every_shipped_instrument_is_accepted(tool):
    robot = "psm_si" if "_42" in tool else "psm_classic"
    arm = load_robot(robot, tool)
    first = CELL.arms[0]
    cell = replace(CELL, arms=(replace(first, arm=arm),))
    assert CellEnvelope.of(cell, 0.001).arms[0].tool == tool


@pytest.mark.invariant("S31")
@pytest.mark.parametrize(("index", "key"), JOINT_NUMBERS)
@pytest.mark.parametrize("factor", [1.05, 1000.0, -1.0, 0.0, *NONSENSE])
def test_no_joint_limit_gets_looser(index, key, factor):
    joint = CELL.arms[0].arm.joints[index]
    value = getattr(joint, key) * factor
    if key == "lower_m":
        value = -0.001 if math.isfinite(factor) else factor
    stricter = key.startswith(("lower", "upper")) and factor == 0.0
    if stricter or (index > 2 and factor == 1.05 and key.startswith(("lower", "upper"))):
        return  # zero is inside the range; the ceilings of instruments fit the widest of them
    assert refused(with_joint(index, key, value)).startswith(joint.name)


@pytest.mark.parametrize("key", JAW_NUMBERS)
@pytest.mark.parametrize("factor", [1000.0, -1.0, *NONSENSE])
def test_no_jaw_limit_gets_looser(key, factor):
    if key == "lower_rad" and factor < 0.0:
        factor = -3.0  # -1 makes a narrower range of this jaw, which is allowed
    value = getattr(CELL.arms[0].arm.jaw, key) * factor
    assert refused(with_table("jaw", key, value)).startswith("jaw")


@pytest.mark.invariant("S31")
@pytest.mark.parametrize("key", GATE_NUMBERS)
@pytest.mark.parametrize("factor", ["looser", "metres", -1.0, *NONSENSE])
def test_no_threshold_of_the_gate_gets_looser(key, factor):
    looser_is_less = key.startswith(("position_margin", "insertion", "singular_value"))
    if factor == "looser":
        factor = 0.95 if looser_is_less else 2.1
    elif factor == "metres":
        factor = 1000.0
    value = getattr(CELL.arms[0].arm.gate, key) * factor
    assert refused(with_table("gate", key, value)) == f"gate.{key}"


@pytest.mark.invariant("S31")
@pytest.mark.parametrize("key", MOTION_NUMBERS)
@pytest.mark.parametrize("value", [50.0, -0.05, *NONSENSE])
def test_no_speed_or_floor_of_the_cell_gets_looser(key, value):
    assert refused(with_table("motion", key, value)) == f"motion.{key}"


def test_the_ceiling_of_the_tip_speed_is_not_under_its_limit():
    assert refused(with_table("motion", "tip_speed_ceiling_m_s", 0.04)).endswith("ceiling_m_s")


def test_a_singularity_slows_an_arm_before_it_holds_it():
    gate = CELL.arms[0].arm.gate.model_copy(update={"singular_value_hold_m": 0.026})
    assert refused(with_arm(gate=gate)) == "gate.singular_value_hold_m"
    gate = gate.model_copy(update={"singular_value_slow_m": 0.026})
    assert CellEnvelope.of(with_arm(gate=gate), 0.004).arms[0].least_value == 0.026


def test_a_run_is_held_before_it_is_ended_for_want_of_consent():
    assert refused(with_table("motion", "consent_stop_s", 0.1)) == "motion.consent_stop_s"
    assert refused(with_table("motion", "consent_hold_s", 0.2001)) == "motion.consent_hold_s"
    assert refused(with_table("motion", "consent_stop_s", 2.001)) == "motion.consent_stop_s"


def test_stricter_values_are_accepted():
    assert CellEnvelope.of(with_joint(0, "max_velocity_rad_s", 0.5), 0.004)
    assert CellEnvelope.of(with_table("gate", "position_margin_rad", 0.05), 0.004)
    assert CellEnvelope.of(with_table("motion", "tip_speed_m_s", 0.01), 0.004)
    assert CellEnvelope.of(with_table("gate", "tracking_wrist_rad", 0.05), 0.004)
    assert CellEnvelope.of(with_table("motion", "consent_stop_s", 0.2), 0.004)


def test_a_classic_arm_does_not_get_the_range_of_an_si():
    assert refused(with_joint(0, "upper_rad", 2.9)) == "yaw.upper"


@pytest.mark.parametrize(("off", "is_si"), [(0.0, True), (9e-7, True), (1.02e-6, False)])
def test_a_shaft_is_that_of_an_si_within_a_micrometre(off, is_si):
    arm = load_robot("psm_si", next(n for n in data.names("robots/tools") if "_42" in n))
    shaft = arm.joints[2].model_copy(update={"offset_m": arm.joints[2].offset_m + off})
    changed = replace(arm, joints=(*arm.joints[:2], shaft, *arm.joints[3:]))
    cell = replace(CELL, arms=(replace(CELL.arms[0], arm=changed),))
    if is_si:
        assert CellEnvelope.of(cell, 0.004)
    else:
        assert refused(cell).endswith((".lower", ".upper"))


@pytest.mark.parametrize(
    ("table", "key", "value", "file"),
    [
        ("jaw", "upper_rad", 9.0, 2),
        ("jaw", "finger_length_m", 9.0, 2),
        ("shape", "jaw_radius_m", 9.0, 2),
        ("gate", "tracking_s", 9.0, 0),
    ],
)
def test_a_refusal_names_the_file_that_the_value_stands_in(table, key, value, file):
    cell = with_table(table, key, value)
    files = tuple(Path(name) for name in ("robot.toml", "between.toml", "tool.toml"))
    first = cell.arms[0]
    cell = replace(cell, arms=(replace(first, arm=replace(first.arm, files=files)),))
    with pytest.raises(DataFileError) as error:
        CellEnvelope.of(cell, 0.004)
    assert error.value.path == files[file]


@pytest.mark.parametrize("period", [0.0, -0.004, 0.0009, 0.011, *NONSENSE])
def test_a_period_outside_100_hz_to_1_khz_is_refused(period):
    assert refused(CELL, period) == "period_s"


def test_a_workspace_longer_than_an_insertion_is_refused():
    first = CELL.arms[0]
    entry = first.entry.model_copy(update={"workspace_upper_m": (5.0, 0.1, 0.1)})
    cell = replace(CELL, arms=(replace(first, entry=entry),))
    assert refused(cell) == "arm.PSM1.workspace"


def test_a_base_that_is_no_rigid_transform_is_refused():
    first = CELL.arms[0]
    mirrored, far = np.eye(4), np.eye(4)
    mirrored[0, 0] = 1.1
    far[0, 3] = 100.0
    with pytest.raises(DataFileError, match="rigid"):
        CellEnvelope.of(replace(CELL, arms=(replace(first, T_task_base=mirrored),)), 0.004)
    assert refused(replace(CELL, arms=(replace(first, T_task_base=far),))).endswith("position_m")


@pytest.mark.parametrize(("off", "is_rigid"), [(0.49e-9, True), (0.51e-9, False)])
def test_a_base_is_rigid_to_a_billionth(off, is_rigid):
    first, pose = CELL.arms[0], CELL.arms[0].T_task_base.copy()
    pose[:3, :3] = np.eye(3) * (1.0 + off)
    cell = replace(CELL, arms=(replace(first, T_task_base=pose),))
    if is_rigid:
        assert CellEnvelope.of(cell, 0.004)
    else:
        with pytest.raises(DataFileError, match="rigid"):
            CellEnvelope.of(cell, 0.004)


def test_a_base_without_its_last_row_is_refused():
    first = CELL.arms[0]
    cell = replace(CELL, arms=(replace(first, T_task_base=first.T_task_base[:3]),))
    with pytest.raises(DataFileError, match="rigid"):
        CellEnvelope.of(cell, 0.004)


def test_a_cell_without_arms_is_refused():
    with pytest.raises(DataFileError, match="no arm"):
        Supervisor(replace(CELL, arms=()), 0.004)


def test_an_insertion_range_that_ends_in_the_cannula_is_refused():
    assert refused(with_joint(2, "upper_m", 0.06)) == "insertion range past the cannula"


def test_a_part_of_full_speed_is_a_part_of_every_speed_limit_and_of_nothing_else() -> None:
    full, quarter = CellEnvelope.of(CELL, 0.004), CellEnvelope.of(CELL, 0.004, speed=0.25)
    assert quarter.tip_speed == 0.25 * full.tip_speed
    assert quarter.tip_speed_ceiling == full.tip_speed_ceiling
    for slow, fast in zip(quarter.arms, full.arms, strict=True):
        assert slow.max_speed == tuple(0.25 * speed for speed in fast.max_speed)
        assert replace(slow, max_speed=fast.max_speed) == fast


@pytest.mark.parametrize("speed", [0.0, -0.25, 1.0 + 1e-9, float("nan"), float("inf")])
def test_no_speed_above_full_speed_or_without_sense_is_taken(speed: float) -> None:
    with pytest.raises(DataFileError, match="speed"):
        CellEnvelope.of(CELL, 0.004, speed=speed)
