"""On a hidden robot the board is elsewhere, and things are seen where they are not."""

from dataclasses import replace

import numpy as np

from viskill_deploy.core.arm_errors import rotation
from viskill_deploy.core.description import load_cell
from viskill_deploy.motion.resolve import task_poses
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import World, WorldOptions

CELL = load_cell("bipegtransfer")
TASK = load_task("bipegtransfer")
LAYOUT = TASK.sample_layout(np.random.default_rng(1), "reference")
SHIFT, TURN = (0.003, -0.002, 0.001), (0.0, 0.0, 0.02)
MOVED = WorldOptions(board_translation_m=SHIFT, board_rotation_rad=TURN)


def _reset(options: WorldOptions, seed: int = 0) -> World:
    world = World(CELL, options, seed)
    world.reset(LAYOUT)
    return world


def test_a_board_that_is_elsewhere_has_its_things_with_it_and_the_arms_where_they_were() -> None:
    plain, moved = _reset(WorldOptions()), _reset(MOVED)
    R = rotation(TURN)
    for told, seen in zip(plain.scene().objects, moved.scene().objects, strict=True):
        there = R @ told.T_task_object[:3, 3] + SHIFT
        np.testing.assert_allclose(seen.T_task_object[:3, 3], there, atol=2e-5)
        np.testing.assert_allclose(
            seen.T_task_object[:3, :3], R @ told.T_task_object[:3, :3], atol=1e-3
        )
    np.testing.assert_allclose(moved.tips(), plain.tips(), atol=1e-5)
    told = [task_poses(CELL, arm, moved.home[arm : arm + 1, :6])[0, :3, 3] for arm in range(2)]
    np.testing.assert_allclose(moved.tips(), told, atol=1e-4)
    np.testing.assert_array_equal(moved.scene().goal, plain.scene().goal)


def test_what_lies_at_its_goal_on_a_moved_board_is_judged_to_be_there() -> None:
    goal = LAYOUT.goal
    name = LAYOUT.active
    objects = []
    for thing in LAYOUT.objects:
        pose = thing.T_task_object.copy()
        if thing.name == name:
            pose[:3, 3] = goal
        objects.append(replace(thing, T_task_object=pose))
    world = World(CELL, MOVED)
    world.reset(replace(LAYOUT, objects=tuple(objects)))
    seen = next(o for o in world.scene().objects if o.name == name)
    assert np.linalg.norm(seen.T_task_object[:3, 3] - goal) > 0.002
    np.testing.assert_allclose(world.active_object().T_task_object[:3, 3], goal, atol=5e-4)


def test_things_are_seen_wrongly_by_a_draw_that_stays_until_they_are_put_down_again() -> None:
    options = WorldOptions(object_error_m=(0.001, 0.001, 0.0), object_error_rad=0.1)
    world, plain = _reset(options, 4), _reset(WorldOptions())
    name = LAYOUT.active

    def off() -> np.ndarray:
        return world.scene().pose(name)[:3, 3] - plain.scene().pose(name)[:3, 3]

    first = world.seeing.error(name)
    np.testing.assert_allclose(off(), first[:3], atol=1e-9)
    np.testing.assert_array_equal(off(), off())
    true, seen = plain.scene().pose(name)[:3, :3], world.scene().pose(name)[:3, :3]
    np.testing.assert_allclose(seen, rotation((0.0, 0.0, float(first[3]))) @ true, atol=1e-9)
    np.testing.assert_allclose(
        world.active_object().T_task_object, plain.active_object().T_task_object, atol=1e-12
    )
    world.reset(LAYOUT)
    assert not np.array_equal(world.seeing.error(name), first)
    assert first[2] == 0.0
    np.testing.assert_array_equal(_reset(options, 4).seeing.error(name), first)
