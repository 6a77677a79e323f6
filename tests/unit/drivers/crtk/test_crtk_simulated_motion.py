"""How a simulated dVRK arm moves: servo, move, jaw, poses, and what it does not do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from crtk_rig import PERIOD_S, Rig

from viskill_deploy.drivers.crtk.arm_cartesian import matrix, pose_of
from viskill_deploy.drivers.crtk.messages import (
    Bool,
    Float,
    JointState,
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    WrenchStamped,
)
from viskill_deploy.kinematics.arm import Arm


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.make_ready()
    rig.client.forget()
    rig.run(0.02)
    return rig


def setpoint(rig: Rig) -> tuple[float, ...]:
    return rig.server.arms["PSM1"].arm.motion.setpoint.jp


def shifted(q: tuple[float, ...], joint: int, by: float) -> tuple[float, ...]:
    return (*q[:joint], q[joint] + by, *q[joint + 1 :])


def test_a_servo_goal_is_the_setpoint_at_once_and_the_arm_is_not_busy(rig: Rig) -> None:
    goal = shifted(setpoint(rig), 0, 0.02)
    rig.client.joints("servo_jp", *goal)
    rig.run(PERIOD_S)
    assert setpoint(rig) == goal
    rig.run(0.2)
    assert rig.measured()[:6] == pytest.approx(goal, abs=1e-4)
    assert not any(state.is_busy for state in rig.client.all("operating_state"))


def test_a_stream_that_stops_is_held_for_ever_and_its_velocity_forgotten(rig: Rig) -> None:
    goal = shifted(setpoint(rig), 2, 0.001)
    rig.client.joints("servo_jp", *goal, v=(0.0, 0.0, 0.05, 0.0, 0.0, 0.0))
    rig.run(0.016)
    motion = rig.server.arms["PSM1"].arm.motion
    assert motion.setpoint.jv[2] == 0.05
    rig.run(0.012)
    assert motion.setpoint.jv == (0.0,) * 6
    rig.run(3.0)
    assert motion.setpoint.jp == goal
    assert rig.measured()[:6] == pytest.approx(goal, abs=1e-4)


def test_velocities_that_are_left_out_stay_what_they_were(rig: Rig) -> None:
    q = setpoint(rig)
    motion = rig.server.arms["PSM1"].arm.motion
    rig.client.joints("servo_jp", *q, v=(0.1, 0.2, 0.01, 0.0, 0.0, 0.3))
    rig.client.joints("servo_jp", *q)
    rig.run(PERIOD_S)
    assert motion.setpoint.jv == (0.1, 0.2, 0.01, 0.0, 0.0, 0.3)
    rig.client.joints("servo_jp", *q, v=(0.0, 0.0))
    rig.run(PERIOD_S)
    assert motion.setpoint.jv == (0.0, 0.0, 0.01, 0.0, 0.0, 0.3)
    rig.client.empty("hold")
    rig.client.joints("move_jp", *q)
    rig.until_idle()
    rig.client.joints("servo_jp", *q)
    rig.run(PERIOD_S)
    assert motion.setpoint.jv == (0.0,) * 6


def test_goals_outside_the_limits_are_clipped_without_a_word(rig: Rig) -> None:
    arm = rig.cell.world.cell.arms[0].arm
    q = setpoint(rig)
    rig.client.joints("servo_jp", *q[:3], q[3], 99.0, q[5])
    rig.client.joints("jaw/servo_jp", -9.0)
    rig.server.poll(rig.clock.now())
    motion = rig.server.arms["PSM1"].arm.motion
    assert motion.setpoint.jp[4] == arm.limit(1)[4]
    assert motion.setpoint.jaw == arm.jaw.lower_rad
    assert rig.client.texts("warning") == rig.client.texts("error") == []


@pytest.mark.parametrize("verb", ["servo_jp", "servo_jr", "move_jp", "move_jr"])
def test_too_few_joints_are_refused_with_an_error_and_the_arm_lives_on(rig: Rig, verb: str) -> None:
    before = setpoint(rig)
    rig.client.joints(verb, 0.1, 0.1, 0.1)
    rig.client.joints(verb)
    rig.run(0.02)
    assert setpoint(rig) == before
    assert rig.client.texts("error") == [
        f"PSM1: {verb}: 3 positions for 6 joints",
        f"PSM1: {verb}: 0 positions for 6 joints",
    ]
    assert rig.client.summary == ("ENABLED", True, False)


def test_of_too_many_joints_the_first_six_count(rig: Rig) -> None:
    goal = shifted(setpoint(rig), 0, 0.01)
    rig.client.joints("servo_jp", *goal, 5.0, 5.0)
    rig.run(PERIOD_S)
    assert setpoint(rig) == goal


@pytest.mark.parametrize("count", [0, 2])
@pytest.mark.parametrize("verb", ["jaw/servo_jp", "jaw/move_jp"])
def test_a_jaw_takes_one_number(rig: Rig, verb: str, count: int) -> None:
    rig.client.joints(verb, *[0.3] * count)
    rig.run(0.02)
    assert rig.client.texts("error") == [f"PSM1: {verb}: {count} positions for 1 joints"]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("verb", ["servo_jp", "servo_jr", "move_jp", "move_jr"])
def test_what_is_no_number_is_refused_where_a_dvrk_would_take_it(
    rig: Rig, verb: str, bad: float
) -> None:
    before = setpoint(rig)
    rig.client.joints(verb, bad, *before[1:])
    if verb.startswith("servo"):
        rig.client.joints(verb, *before, v=(bad,))
    rig.client.joints("jaw/servo_jp", bad)
    rig.run(0.02)
    assert setpoint(rig) == before
    assert len(rig.client.texts("error")) == (3 if verb.startswith("servo") else 2)
    assert all(map(math.isfinite, rig.measured()))


def test_relative_servo_counts_from_the_setpoint(rig: Rig) -> None:
    before = setpoint(rig)
    for _ in range(3):
        rig.client.joints("servo_jr", 0.01, 0.0, 0.0, 0.0, 0.0, 0.0)
    rig.run(PERIOD_S)
    assert setpoint(rig) == pytest.approx(shifted(before, 0, 0.03))


def test_relative_moves_add_up_while_they_run(rig: Rig) -> None:
    before = setpoint(rig)
    rig.client.joints("move_jr", 0.05, 0.0, 0.0, 0.0, 0.0, 0.0)
    rig.run(0.05)
    rig.client.joints("move_jr", 0.05, 0.0, 0.0, 0.0, 0.0, 0.0)
    rig.until_idle()
    assert setpoint(rig) == pytest.approx(shifted(before, 0, 0.1))


@pytest.mark.parametrize("length", [0.0, 0.1])
def test_a_move_makes_busy_and_then_idle_however_short_it_is(rig: Rig, length: float) -> None:
    rig.client.joints("move_jp", *shifted(setpoint(rig), 0, length))
    rig.run(1.0)
    busy = [state.is_busy for state in rig.client.all("operating_state")]
    assert True in busy
    assert busy[-1] is False
    assert [m.data for m in rig.client.all("goal_reached")] == [True]


@pytest.mark.parametrize("verb", ["move_jp", "jaw/move_jp"])
def test_the_last_setpoint_is_published_before_the_word_that_all_is_done(
    rig: Rig, verb: str
) -> None:
    goal = shifted(setpoint(rig), 0, 0.037) if verb == "move_jp" else (0.2,)
    topic = "setpoint_js" if verb == "move_jp" else "jaw/setpoint_js"
    rig.client.joints(verb, *goal)
    rig.until_idle()
    rig.client.command("enable")
    order = [(key, word) for key, word in rig.client.heard if key in {topic, "operating_state"}]
    busy = max(i for i, (key, word) in enumerate(order) if key != topic and word.is_busy)
    idle = min(i for i, (key, _) in enumerate(order) if key != topic and i > busy)
    between = [word for key, word in order[busy:idle] if key == topic]
    assert between[-1].position == pytest.approx(goal, abs=1e-12)


def test_a_move_keeps_dvrks_speed_and_acceleration_and_the_ratio_slows_it(rig: Rig) -> None:
    motion = rig.server.arms["PSM1"].arm.motion
    durations = {}
    for ratio, sign in ((1.0, 1.0), (0.2, -1.0)):
        rig.client.send("trajectory_j/set_ratio", Float(ratio))
        rig.run(PERIOD_S)
        assert rig.client.last("trajectory_j/ratio").data == ratio
        rig.client.joints("move_jp", *shifted(setpoint(rig), 0, sign * 0.5))
        rig.run(PERIOD_S)
        speeds = [0.0]
        start = rig.clock.now()
        while motion.is_moving:
            speeds.append(abs(motion.v[0]))
            rig.run(PERIOD_S)
        durations[ratio] = rig.clock.now() - start
        steps = np.abs(np.diff(speeds)) / PERIOD_S
        assert max(speeds) <= ratio * 1.5708 + 1e-9
        assert steps.max() <= ratio * 1.5708 + 1e-6
    # half a radian from rest to rest: 2 sqrt(0.5 / 1.5708), and with the speed's limit 0.31416
    assert durations[1.0] == pytest.approx(1.128, abs=0.01)
    assert durations[0.2] == pytest.approx(0.5 / 0.31416 + 1.0, abs=0.01)


@pytest.mark.parametrize("ratio", [0.0, -1.0, 1.01, math.nan])
def test_a_ratio_that_is_none_is_refused(rig: Rig, ratio: float) -> None:
    rig.client.send("trajectory_j/set_ratio", Float(ratio))
    rig.run(PERIOD_S)
    assert rig.client.all("trajectory_j/ratio") == []
    assert rig.server.arms["PSM1"].arm.motion.ratio == 1.0
    assert len(rig.client.texts("warning")) == 1


def test_a_new_move_takes_the_place_of_the_one_before_without_a_jump(rig: Rig) -> None:
    before = setpoint(rig)
    motion = rig.server.arms["PSM1"].arm.motion
    rig.client.joints("move_jp", *shifted(before, 0, 0.5))
    rig.run(0.4)
    v = motion.v[0]
    rig.client.joints("move_jp", *before)
    rig.run(PERIOD_S)
    assert motion.v[0] == pytest.approx(v, abs=1.5708 * PERIOD_S + 1e-6)
    rig.until_idle()
    assert setpoint(rig) == pytest.approx(before)
    assert [m.data for m in rig.client.all("goal_reached")] == [True]


def test_a_servo_goal_ends_a_move_and_clears_busy(rig: Rig) -> None:
    rig.client.joints("move_jp", *shifted(setpoint(rig), 0, 0.5))
    rig.run(0.2)
    assert rig.client.state.is_busy
    goal = setpoint(rig)
    rig.client.joints("servo_jp", *goal)
    rig.run(PERIOD_S)
    assert not rig.client.state.is_busy
    assert rig.client.last("goal_reached").data is False
    rig.run(0.5)
    assert setpoint(rig) == goal


def test_arm_and_jaw_move_side_by_side_and_busy_covers_both(rig: Rig) -> None:
    goal = shifted(setpoint(rig), 0, 0.3)
    rig.client.joints("move_jp", *goal)
    rig.run(0.1)
    rig.client.joints("jaw/move_jp", 0.5)
    rig.run(0.01)
    rig.until_idle()
    assert setpoint(rig) == pytest.approx(goal)
    assert rig.server.arms["PSM1"].arm.motion.setpoint.jaw == pytest.approx(0.5)
    rig.client.forget()
    rig.client.joints("jaw/move_jp", -0.1)
    rig.run(PERIOD_S)
    assert rig.client.state.is_busy
    rig.client.joints("move_jp", *shifted(goal, 1, 0.02))
    rig.until_idle()
    assert rig.server.arms["PSM1"].arm.motion.setpoint.jaw == pytest.approx(-0.1)


def test_a_jaw_is_servoed_apart_from_the_arm(rig: Rig) -> None:
    before = setpoint(rig)
    rig.client.joints("jaw/servo_jp", 0.4, v=(1.0,))
    rig.run(0.3)
    assert setpoint(rig) == before
    assert rig.measured()[6] == pytest.approx(0.4, abs=0.01)
    assert rig.client.last("jaw/measured_js").name == ("jaw",)
    assert rig.client.last("jaw/setpoint_js").velocity == ()


def test_hold_stops_a_move_where_it_is(rig: Rig) -> None:
    rig.client.joints("move_jp", *shifted(setpoint(rig), 0, 0.5))
    rig.run(0.3)
    rig.client.empty("hold")
    rig.server.poll(rig.clock.now())
    held = setpoint(rig)
    assert not rig.client.state.is_busy
    rig.run(0.5)
    assert setpoint(rig) == held


def test_a_freed_arm_has_its_setpoint_where_it_is_until_it_is_told_otherwise(rig: Rig) -> None:
    q = setpoint(rig)
    rig.client.joints("servo_jp", *shifted(q, 0, 0.05))
    rig.run(0.008)
    rig.client.empty("free")
    rig.run(0.5)
    assert setpoint(rig) == pytest.approx(rig.measured()[:6], abs=1e-3)
    assert abs(setpoint(rig)[0] - q[0]) < 0.05
    rig.client.joints("servo_jp", *q)
    rig.run(0.3)
    assert rig.measured()[:6] == pytest.approx(q, abs=1e-3)


def test_poses_are_those_of_the_joints_in_the_remote_centre_and_in_the_task_frame(rig: Rig) -> None:
    arm = rig.cell.world.cell.arms[0]
    local = Arm(arm.arm).forward(rig.client.last("measured_js").position).homogeneous
    said = matrix(rig.client.last("local/measured_cp").pose)
    assert said == pytest.approx(local, abs=1e-9)
    assert matrix(rig.client.last("measured_cp").pose) == pytest.approx(
        arm.T_task_base @ local, abs=1e-9
    )
    assert rig.client.last("measured_cp").header.frame_id == "task"
    assert matrix(rig.client.last("setpoint_cp").pose) == pytest.approx(
        matrix(rig.client.last("measured_cp").pose), abs=1e-4
    )


def test_a_pose_can_be_servoed_to_and_moved_to(rig: Rig) -> None:
    T = matrix(rig.client.last("setpoint_cp").pose)
    for verb, dx in (("servo_cp", 0.001), ("move_cp", 0.01)):
        T[0, 3] += dx
        rig.client.pose(verb, pose_of(T))
        rig.run(0.008)
        rig.until_idle()
        rig.run(0.2)
        assert matrix(rig.client.last("measured_cp").pose) == pytest.approx(T, abs=2e-4)
    assert [m.data for m in rig.client.all("goal_reached")] == [True]


@pytest.mark.parametrize("verb", ["servo_cp", "move_cp"])
@pytest.mark.parametrize(
    "pose",
    [
        Pose(Point(0.5, 0.0, 0.0)),
        Pose(Point(math.nan, 0.0, 0.0)),
        Pose(Point(), Quaternion(0.0, 0.0, 0.0, 0.0)),
    ],
    ids=["out of reach", "not finite", "no rotation"],
)
def test_a_pose_without_joints_is_an_error_and_leaves_the_setpoint(
    rig: Rig, verb: str, pose: Pose
) -> None:
    before = setpoint(rig)
    rig.client.pose(verb, pose)
    rig.run(0.1)
    assert setpoint(rig) == before
    assert rig.client.summary == ("ENABLED", True, False)
    (error,) = rig.client.texts("error")
    assert error.startswith("PSM1: unable to solve inverse kinematics")


def test_a_wrist_in_the_cannula_takes_no_pose(rig: Rig) -> None:
    T = matrix(rig.client.last("setpoint_cp").pose)
    q = setpoint(rig)
    rig.client.joints("move_jp", *q[:2], 0.0156 + 0.0425, *q[3:])
    rig.until_idle()
    rig.run(0.3)
    before = setpoint(rig)
    for _ in range(10):
        rig.client.pose("servo_cp", pose_of(T))
    rig.run(0.02)
    assert setpoint(rig) == before
    assert rig.client.texts("warning") == [
        "PSM1: tool/endoscope needs to be inserted past the cannula to switch to cartesian space"
    ]


def test_a_pose_too_near_to_the_cannula_is_moved_along_the_shaft(rig: Rig) -> None:
    arm = rig.cell.world.cell.arms[0]
    q = (*setpoint(rig)[:2], 0.0156 + 0.0445, *setpoint(rig)[3:])
    T = arm.T_task_base @ Arm(arm.arm).forward(q).homogeneous
    rig.client.pose("move_cp", pose_of(T))
    rig.until_idle()
    assert setpoint(rig)[2] == pytest.approx(0.0156 + 0.045, abs=1e-9)
    assert setpoint(rig)[3:] == pytest.approx(q[3:], abs=1e-6)


def test_jacobians_turn_joint_speeds_into_the_tips_velocity(rig: Rig) -> None:
    rig.client.joints("move_jp", *[x + 0.05 for x in setpoint(rig)])
    rig.run(0.25)
    rig.client.forget()
    rig.run(0.02)
    js, cv = rig.client.last("measured_js"), rig.client.last("measured_cv")
    v = np.array([cv.twist.linear.x, cv.twist.linear.y, cv.twist.linear.z])
    w = np.array([cv.twist.angular.x, cv.twist.angular.y, cv.twist.angular.z])
    arm = rig.cell.world.cell.arms[0]
    base, T = arm.T_task_base[:3, :3], matrix(rig.client.last("local/measured_cp").pose)
    message = rig.client.last("body/jacobian")
    assert [(d.label, d.size, d.stride) for d in message.layout.dim] == [
        ("rows", 6, 1),
        ("cols", 6, 6),
    ]
    body = np.array(message.data).reshape(6, 6).T @ js.velocity
    assert base @ T[:3, :3] @ body[:3] == pytest.approx(v, abs=1e-9)
    assert base @ T[:3, :3] @ body[3:] == pytest.approx(w, abs=1e-9)
    spatial = np.array(rig.client.last("spatial/jacobian").data).reshape(6, 6).T @ js.velocity
    # the point of the tip moves with the spatial twist's field
    assert base @ (spatial[:3] + np.cross(spatial[3:], T[:3, 3])) == pytest.approx(v, abs=1e-9)
    assert base @ spatial[3:] == pytest.approx(w, abs=1e-9)
    # and the twist is what the poses do
    start = matrix(rig.client.last("measured_cp").pose)[:3, 3]
    rig.run(0.02)
    later = matrix(rig.client.last("measured_cp").pose)[:3, 3]
    assert (later - start) / 0.02 == pytest.approx(v, abs=0.1 * np.linalg.norm(v))


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("servo_jf", JointState(effort=(0.0,) * 6)),
        ("jaw/servo_jf", JointState(effort=(0.0,))),
        ("body/servo_cf", WrenchStamped()),
        ("spatial/servo_cf", WrenchStamped()),
    ],
)
def test_forces_are_not_simulated_and_it_says_so(rig: Rig, topic: str, message: object) -> None:
    rig.client.send(topic, message)
    rig.run(0.02)
    assert rig.client.texts("error") == [f"PSM1: {topic} is not simulated"]


@pytest.mark.parametrize("topic", ["use_gravity_compensation", "body/set_cf_orientation_absolute"])
def test_what_has_no_effect_on_a_classic_arm_is_taken_in_silence(rig: Rig, topic: str) -> None:
    rig.client.send(topic, Bool(True))
    rig.run(0.02)
    assert rig.client.texts("error") == rig.client.texts("warning") == []


def test_every_motion_is_refused_by_an_arm_that_is_not_ready(rig: Rig) -> None:
    rig.run(2.1)
    rig.client.command("pause")
    rig.run(0.02)
    before = setpoint(rig)
    for verb in ("servo_jp", "servo_jr", "move_jp", "move_jr"):
        rig.client.joints(verb, *[0.1] * 6)
    for verb in ("jaw/servo_jp", "jaw/move_jp"):
        rig.client.joints(verb, 0.1)
    for verb in ("servo_cp", "move_cp"):
        rig.client.send(verb, PoseStamped())
    for verb in ("hold", "free"):
        rig.client.empty(verb)
    rig.run(2.1)
    rig.client.joints("servo_jp", *[0.1] * 6)
    rig.run(0.02)
    assert setpoint(rig) == before
    assert rig.client.texts("warning") == [
        "PSM1: servo_jp, arm not ready (1 errors)",
        "PSM1: servo_jp, arm not ready (10 errors)",
    ]
    rig.client.command("resume")
    rig.client.joints("servo_jp", *shifted(before, 0, 0.01))
    rig.run(0.02)
    assert setpoint(rig) == shifted(before, 0, 0.01)
