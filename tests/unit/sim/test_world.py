import numpy as np
import pytest

from viskill_deploy.core.errors import ViskillError
from viskill_deploy.core.types import FloatArray, JointSetpoint, ObjectPose, Scene, Waypoint
from viskill_deploy.motion.resolve import resolve, task_poses
from viskill_deploy.motion.waypoints import downward_pose
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.world import World, WorldOptions

TASK = load_task("bipegtransfer")


def layout(seed: int = 0) -> Scene:
    return TASK.sample_layout(np.random.default_rng(seed), "reference")


def still(axes: FloatArray) -> list[JointSetpoint]:
    return [JointSetpoint(tuple(row[:6]), (0.0,) * 6, float(row[6]), 0.0) for row in axes.tolist()]


def sweep(world: World, speed_m_s: float, seconds: float) -> tuple[FloatArray, FloatArray]:
    """Setpoints of a straight tip motion of both arms along x, every control period."""
    period, cell = world.options.period_s, TASK.cell
    waypoints = []
    for i in range(round(seconds / period)):
        poses = []
        for arm in cell.arms:
            start = np.array(arm.entry.start_position_m)
            start[0] += speed_m_s * period * (i + 1)
            poses.append(downward_pose(start, arm.entry.start_yaw_rad))
        waypoints.append(Waypoint(tuple(poses), (0.0, 0.0), period))
    q = resolve(cell, waypoints, world.home.tolist())
    return q[1:], np.diff(q, axis=0) / period


@pytest.mark.parametrize("period_s", [0.001, 0.004, 0.01])
def test_the_tip_follows_45_mm_per_second_within_half_a_millimetre(period_s: float) -> None:
    world = World(TASK.cell, WorldOptions(period_s=period_s, joint_friction=True))
    world.reset(layout())
    positions, velocities = sweep(world, 0.045, 1.0)
    worst = 0.0
    for p, v in zip(positions, velocities, strict=True):
        world.run(p[None], v[None])
        for arm in range(2):
            wished = task_poses(TASK.cell, arm, p[arm][None, :6])[0][:3, 3]
            there = task_poses(TASK.cell, arm, np.array([world.measured(arm).jp]))[0][:3, 3]
            worst = max(worst, float(np.linalg.norm(wished - there)))
    assert worst < 0.5e-3
    assert world.time_s == pytest.approx(1.0)


def test_stepping_and_running_a_table_are_the_same() -> None:
    worlds = [World(TASK.cell) for _ in range(2)]
    positions, velocities = sweep(worlds[0], 0.03, 0.2)
    for world in worlds:
        world.reset(layout())
    worlds[0].run(positions, velocities)
    for p, v in zip(positions.tolist(), velocities.tolist(), strict=True):
        worlds[1].step(
            [
                JointSetpoint(tuple(a[:6]), tuple(b[:6]), a[6], b[6])
                for a, b in zip(p, v, strict=True)
            ]
        )
    assert np.array_equal(worlds[0].save(), worlds[1].save())


def test_blocks_stand_on_the_board_after_a_reset_and_arms_where_asked() -> None:
    world, scene = World(TASK.cell), layout()
    world.reset(scene)
    seen = world.scene()
    assert seen.active == scene.active
    assert np.array_equal(seen.goal, scene.goal)
    for asked, found in zip(scene.objects, seen.objects, strict=True):
        assert found.T_task_object[:2, 3] == pytest.approx(asked.T_task_object[:2, 3], abs=1e-4)
        assert found.T_task_object[2, 3] == pytest.approx(0.00725, abs=1e-4)
    for arm in range(2):
        assert world.measured(arm).jp == pytest.approx(world.home[arm, :6].tolist(), abs=1e-6)
    assert world.active_object().touched == (False, False)
    assert world.active_object().speed_m_s < 1e-3


def test_arms_can_start_from_given_joints() -> None:
    world = World(TASK.cell)
    axes = world.home + 0.02
    world.reset(layout(), axes)
    assert world.measured(1).jp == pytest.approx(axes[1, :6].tolist(), abs=1e-6)


def test_an_unknown_object_is_refused_with_the_names_that_exist() -> None:
    stray = Scene(0.0, (ObjectPose("ring0", np.eye(4)),), "ring0", np.zeros(3))
    with pytest.raises(ViskillError, match="block0"):
        World(TASK.cell).reset(stray)


def test_a_saved_state_comes_back_and_goes_on_the_same() -> None:
    world = World(TASK.cell)
    world.reset(layout())
    positions, velocities = sweep(world, 0.03, 0.4)
    world.run(positions[:40], velocities[:40])
    state = world.save()
    world.run(positions[40:], velocities[40:])
    end = world.measured(0).jp
    world.restore(state)
    assert np.array_equal(world.save(), state)
    world.run(positions[40:], velocities[40:])
    assert world.measured(0).jp == pytest.approx(end, abs=1e-12)


def test_transport_delay_holds_setpoints_back_by_whole_periods() -> None:
    direct, late = World(TASK.cell), World(TASK.cell, WorldOptions(delay_periods=5))
    positions, velocities = sweep(direct, 0.03, 0.2)
    for world in (direct, late):
        world.reset(layout())
    direct.run(positions[:30], velocities[:30])
    late.run(positions[:35], velocities[:35])
    assert late.measured(0).jp == pytest.approx(direct.measured(0).jp, abs=1e-6)


def test_measurement_noise_has_the_asked_size_and_follows_the_seed() -> None:
    options = WorldOptions(joint_noise_rad=1e-3, joint_noise_m=1e-4, object_noise_m=5e-4)
    world = World(TASK.cell, options, seed=3)
    world.reset(layout())
    first = [world.measured(0).jp for _ in range(400)]
    scatter = np.std(first, axis=0)
    assert scatter[[0, 1, 3, 4, 5]] == pytest.approx(1e-3, rel=0.2)
    assert scatter[2] == pytest.approx(1e-4, rel=0.2)
    name = layout().active
    places = [world.scene().pose(name)[:3, 3] for _ in range(400)]
    assert np.std(places, axis=0) == pytest.approx(5e-4, rel=0.2)
    world.seed(3)
    assert [world.measured(0).jp for _ in range(400)] == first


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="period_s"):
        WorldOptions(period_s=0.0)
    with pytest.raises(ValueError, match="delay"):
        WorldOptions(delay_periods=-1)


def test_an_empty_jaw_closes_to_zero_and_opens_as_told() -> None:
    world = World(TASK.cell)
    world.reset(layout())
    assert world.measured(0).jaw == pytest.approx(0.0, abs=0.01)
    axes = world.home.copy()
    axes[:, 6] = 0.6
    for _ in range(100):
        world.step(still(axes))
    assert world.measured(0).jaw == pytest.approx(0.6, abs=0.01)
    assert world.measured(0).jaw_v == pytest.approx(0.0, abs=0.01)


def test_a_jaw_lifts_a_block_by_friction_alone() -> None:
    world, scene = World(TASK.cell), layout()
    block = TASK.cell.file.block
    assert block is not None
    pose = scene.pose(scene.active)
    (x, y), yaw = block.grasp_frame_xy_m[1], block.grasp_frame_yaw_rad[1]
    place = pose @ np.array([x, y, 0.0, 1.0])
    turn = float(np.arctan2(pose[1, 0], pose[0, 0])) + yaw
    heights = [0.05, *[0.0205] * 3, *np.linspace(0.0205, 0.05, 200)]
    start = TASK.cell.arms[0].entry
    hold = downward_pose(start.start_position_m, start.start_yaw_rad)
    waypoints = [
        Waypoint((hold, downward_pose([place[0], place[1], z], turn)), (0.0, jaw), 1.0)
        for z, jaw in zip(heights, [0.6, 0.6, *[-0.349] * 202], strict=True)
    ]
    axes = resolve(TASK.cell, waypoints, world.home.tolist())[1:]
    world.reset(scene, axes[1])
    for row in axes[1:]:
        for _ in range(20 if row is axes[2] else 2):
            world.step(still(row))
    thing = world.active_object()
    assert thing.T_task_object[2, 3] > 0.03
    assert thing.touched == (False, True)
    assert world.model.neq == 2  # the jaws' couplings: nothing welds the block to the arm


def test_the_active_block_is_red_and_the_goal_peg_green() -> None:
    world, scene = World(TASK.cell), layout()
    world.reset(scene)
    red, blue = (world.model.material(name).id for name in ("active_thing", "thing"))
    assert world.model.geom(f"{scene.active}/wall0").matid[0] == red
    others = [thing.name for thing in scene.objects if thing.name != scene.active]
    assert all(world.model.geom(f"{name}/wall0").matid[0] == blue for name in others)
    assert world.model.geom("peg2").matid[0] == world.model.material("goal_peg").id


def test_a_thing_that_is_knocked_is_elsewhere_at_rest_and_falls() -> None:
    world = World(TASK.cell)
    world.reset(layout())
    before = {o.name: o.T_task_object for o in world.scene().objects}
    world.knock([0.01, 0.0, 0.04])
    thing = world.active_object()
    assert thing.T_task_object[:3, 3] - before[layout().active][:3, 3] == pytest.approx(
        [0.01, 0.0, 0.04]
    )
    assert thing.speed_m_s == 0.0
    for other in world.scene().objects:
        if other.name != layout().active:
            assert np.array_equal(other.T_task_object, before[other.name])
    for _ in range(10):
        world.step(still(world.home))
    assert world.active_object().T_task_object[2, 3] < thing.T_task_object[2, 3] - 0.005


def test_a_door_cannot_be_knocked_out_of_anything() -> None:
    panel = load_task("matchboardpanel")
    world = World(panel.cell)
    scene = panel.sample_layout(np.random.default_rng(0), "reference")
    world.reset(scene)
    world.attend("door0", scene.goal)
    with pytest.raises(ViskillError, match="'door0' is no free thing"):
        world.knock([0.0, 0.02, 0.0])


def test_a_jaw_that_starts_squeezing_keeps_what_is_in_it() -> None:
    """Arms told to stay where they are would let go: only a setpoint says how much they squeeze."""
    world = World(TASK.cell)
    world.reset(layout())
    axes, told = world.home.copy(), world.home.copy()
    axes[:, 6], told[:, 6] = 0.2, -0.349
    world.reset(layout(), axes)
    assert world.measured(0).jaw == pytest.approx(0.2, abs=0.01)
    world.reset(layout(), axes, told)
    assert world.measured(0).jaw == pytest.approx(0.0, abs=0.01)
