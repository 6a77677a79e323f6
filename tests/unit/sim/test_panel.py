"""The match board in the world: doors that stay where they are left, letters that lie still."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from viskill_deploy.core.types import FloatArray, JointSetpoint, ObjectPose, Scene, Waypoint
from viskill_deploy.motion.resolve import resolve
from viskill_deploy.motion.waypoints import downward_pose
from viskill_deploy.sim.letters import NAMES, SHAPES, grasp_point, plane_point
from viskill_deploy.sim.panel_model import column_y, row_x
from viskill_deploy.sim.scene import build_model
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.tasks.matchboardpanel import JAW_OPEN_RAD
from viskill_deploy.sim.world import World

TASK = load_task("matchboardpanel")
PANEL, LETTER = TASK.cell.file.panel, TASK.cell.file.letter
assert PANEL is not None
assert LETTER is not None
CLOSED_HANDLE = np.array([0.0, PANEL.handle_from_door_m[1], 0.0111])


def layout(seed: int = 0, distribution: str = "reference", **opened: float) -> Scene:
    """A layout whose doors are open by as much as is said of them, m."""
    scene = TASK.sample_layout(np.random.default_rng(seed), distribution)
    objects = []
    for thing in scene.objects:
        pose = thing.T_task_object.copy()
        pose[1, 3] += opened.get(thing.name, 0.0)
        objects.append(ObjectPose(thing.name, pose))
    return Scene(0.0, tuple(objects), scene.active, scene.goal)


def opening(world: World, row: int) -> float:
    return float(world.scene().pose(f"door{row}")[1, 3])


def axes_at(world: World, place: FloatArray, jaw: float = -0.35) -> FloatArray:
    """Axis positions with the tip at a place, pointing down, yaw 0."""
    waypoint = Waypoint((downward_pose(place, 0.0),), (jaw,), 0.2)
    return resolve(TASK.cell, [waypoint], world.home.tolist())[1]


def stay(world: World, axes: FloatArray, seconds: float) -> None:
    row = axes[0].tolist()
    for _ in range(round(seconds / world.options.period_s)):
        world.step([JointSetpoint(tuple(row[:6]), (0.0,) * 6, row[6], 0.0)])


def move(world: World, start: FloatArray, end: FloatArray, seconds: float) -> None:
    count = round(seconds / world.options.period_s)
    shares = np.arange(1, count + 1) / count
    waypoints = [
        Waypoint((downward_pose(start + share * (end - start), 0.0),), (-0.35,), 0.2)
        for share in shares
    ]
    q = resolve(TASK.cell, waypoints, axes_at(world, start).tolist())
    world.run(q[1:], np.diff(q, axis=0) / world.options.period_s)


def test_a_reset_closes_the_doors_and_lays_the_letter_on_the_table() -> None:
    world, scene = World(TASK.cell), layout()
    world.reset(scene)
    seen = world.scene()
    assert [opening(world, row) for row in range(3)] == pytest.approx([0.0] * 3, abs=1e-9)
    letter = seen.pose(scene.active)
    assert letter[:2, 3] == pytest.approx(scene.pose(scene.active)[:2, 3], abs=1e-4)
    assert letter[2, 3] == pytest.approx(LETTER.size_m[2] / 2, abs=1e-4)
    assert seen.goal.tolist() == scene.goal.tolist()
    thing = world.active_object()
    assert thing.touched == (False,)
    assert not thing.door_touched
    assert thing.speed_m_s < 1e-3


def test_a_scene_without_doors_finds_them_closed() -> None:
    world, scene = World(TASK.cell), layout()
    world.reset(layout(door1=0.04))
    world.reset(replace(scene, objects=scene.objects[:1]))
    assert opening(world, 1) == 0.0


def test_doors_start_where_the_scene_says_and_stay_there() -> None:
    world = World(TASK.cell)
    world.reset(layout(door0=0.0123, door2=0.075))
    stay(world, world.home, 2.0)
    openings = [opening(world, row) for row in range(3)]
    assert openings == pytest.approx([0.0123, 0.0, 0.075], abs=1e-6)


def test_a_door_stops_at_the_end_of_its_travel_wherever_a_scene_puts_it() -> None:
    world = World(TASK.cell)
    world.reset(layout(door0=0.5, door1=-0.5))
    assert opening(world, 0) == pytest.approx(PANEL.door_travel_m)
    assert opening(world, 1) == 0.0


@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_jaw_pushes_a_door_by_its_handle_and_it_stays_when_the_jaw_has_gone(row: int) -> None:
    world, scene = World(TASK.cell), layout()
    beside = CLOSED_HANDLE + np.array([row_x(PANEL)[row], -0.005, 0.0104])
    world.reset(scene, axes_at(world, beside))
    open_end, above = beside + np.array([0.0, 0.035, 0.0]), np.array([0.0, 0.0, 0.02])
    move(world, beside, open_end, 1.0)
    pushed = opening(world, row)
    assert pushed == pytest.approx(0.035 - 0.005 + 0.0022, abs=5e-4)
    move(world, open_end, open_end + above, 0.6)
    stay(world, axes_at(world, open_end + above), 1.0)
    # what dry friction lets go on when the push ends at full speed, and nothing after that
    assert opening(world, row) == pytest.approx(pushed, abs=1.5e-3)
    left = opening(world, row)
    stay(world, axes_at(world, open_end + above), 1.0)
    assert opening(world, row) == pytest.approx(left, abs=1e-7)
    others = {0, 1, 2} - {row}
    assert max(opening(world, other) for other in others) == 0.0


def test_less_than_its_friction_does_not_move_a_door() -> None:
    world = World(TASK.cell)
    world.reset(layout(door1=0.01))
    body = world.model.body("door1").id
    for force, moves in ((0.9 * PANEL.door_friction_n, False), (1.5 * PANEL.door_friction_n, True)):
        world.data.xfrc_applied[body, 1] = force
        before = opening(world, 1)
        stay(world, world.home, 0.2)
        gone = abs(opening(world, 1) - before)
        assert gone > 0.01 if moves else gone < 1e-4


def test_the_wrist_on_the_target_rows_door_is_told_and_on_another_one_is_not() -> None:
    world, scene = World(TASK.cell), layout()
    row = int(np.argmin(np.abs(row_x(PANEL) - scene.goal[0])))
    for at, told in ((row, True), ((row + 1) % 3, False)):
        # the jaw's end under the door's plane: only the simulation can be put there
        place = np.array([row_x(PANEL)[at], 0.0, PANEL.door_height_m + 0.003])
        world.reset(scene, axes_at(world, place))
        assert world.active_object().door_touched is told
        assert TASK.flags(world.active_object()) == (told,)


def test_rows_doors_and_plates_are_where_the_reference_has_them() -> None:
    assert row_x(PANEL).tolist() == column_y(PANEL).tolist() == [-0.025, 0.0, 0.025]
    model = build_model(TASK.cell)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for row in range(3):
        assert data.body(f"door{row}").xpos == pytest.approx([row_x(PANEL)[row], 0.0, 0.0086])
    assert data.geom("plate5").xpos[:2] == pytest.approx([0.0, 0.025])
    for plate in range(9):
        top = data.geom(f"plate{plate}").xpos[2] + model.geom(f"plate{plate}").size[2]
        assert top == pytest.approx(PANEL.plate_top_m)


def test_the_plate_of_the_goal_is_green_the_letter_red_and_doors_keep_their_look() -> None:
    world = World(TASK.cell)
    world.reset(layout(seed=3))
    green, door = (world.model.material(name).id for name in ("goal_plate", "door"))
    goal = world.scene().goal
    plates = [world.model.geom(f"plate{i}") for i in range(9)]
    marked = [plate for plate in plates if plate.matid[0] == green]
    assert len(marked) == 1
    assert marked[0].pos[:2] == pytest.approx(goal[:2])
    assert world.model.geom("letterC/stroke0").matid[0] == world.model.material("active_thing").id
    assert world.model.geom("letter0/stroke0").matid[0] == world.model.material("thing").id
    assert world.model.geom("door0/plate").matid[0] == door


@pytest.mark.parametrize("name", NAMES)
def test_a_letter_has_the_size_and_weight_of_its_file_and_lies_on_its_feet(name: str) -> None:
    world, scene = World(TASK.cell), layout()
    pose = scene.pose(scene.active)
    world.reset(Scene(0.0, (ObjectPose(name, pose),), name, scene.goal))
    model = world.model
    first = model.body(name).geomadr[0]
    strokes = [model.geom(first + i) for i in range(len(SHAPES[name[-1]].strokes))]
    reach = [np.max([np.abs(s.pos) + s.size for s in strokes], axis=0)]
    half = np.array(LETTER.size_m) / 2
    assert reach[0][2] == pytest.approx(half[2])
    assert (reach[0] <= half + 1e-9).all()
    assert float(model.body(name).mass[0]) == pytest.approx(LETTER.mass_kg)
    lies = world.active_object()
    assert lies.T_task_object[2, 2] > 0.9999
    assert lies.T_task_object[2, 3] == pytest.approx(half[2], abs=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_beside_every_grasp_point_there_is_room_for_an_open_jaw(name: str) -> None:
    finger, jaw = 0.0014, TASK.cell.arms[0].arm.jaw.finger_length_m
    spot, half_width = grasp_point(LETTER, name), 0.0009
    outer = jaw * np.sin(JAW_OPEN_RAD / 2) + finger
    for stroke in SHAPES[name[-1]].strokes:
        ends = (plane_point(LETTER, *stroke[:2]), plane_point(LETTER, *stroke[2:]))
        low = np.min(ends, axis=0) - LETTER.stroke_m / 2 - spot
        high = np.max(ends, axis=0) + LETTER.stroke_m / 2 - spot
        crosses = low[0] < half_width + 2e-4 and high[0] > -half_width - 2e-4  # along the stroke
        if crosses and not low[1] < 0.0 < high[1]:  # another stroke than the one that is taken
            assert min(abs(low[1]), abs(high[1])) > outer
