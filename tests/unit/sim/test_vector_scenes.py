import mujoco
import numpy as np
import pytest

from viskill_deploy.core.errors import ViskillError
from viskill_deploy.core.types import Scene
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.vector_scenes import Scenes, ThingPoses
from viskill_deploy.sim.world import World

TASK = load_task("bipegtransfer")


def two_bodies(joint: mujoco.mjtJoint) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    for name, kind in (("free", mujoco.mjtJoint.mjJNT_FREE), ("other", joint)):
        body = spec.worldbody.add_body(
            name=name, pos=[0.1, 0.2, 0.3], quat=[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
        )
        body.add_joint(name=name, type=kind, axis=[1, 0, 0])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0])
    return spec.compile()


def test_poses_are_those_of_the_world_alone() -> None:
    world = World(TASK.cell)
    world.reset(TASK.sample_layout(np.random.default_rng(0), "wide"))
    poses = ThingPoses(world.model, world.things)(world.data.qpos[None].copy())
    for name, pose in zip(world.things, poses[0], strict=True):
        assert pose == pytest.approx(world.scene().pose(name), abs=1e-15)


def test_what_slides_has_the_pose_that_mujoco_says() -> None:
    model = two_bodies(mujoco.mjtJoint.mjJNT_SLIDE)
    data = mujoco.MjData(model)
    data.qpos[7] = 0.05
    mujoco.mj_forward(model, data)
    poses = ThingPoses(model, ("free", "other"))(data.qpos[None].copy())[0]
    for name, pose in zip(("free", "other"), poses, strict=True):
        assert pose[:3, 3] == pytest.approx(data.body(name).xpos, abs=1e-15)
        assert pose[:3, :3] == pytest.approx(data.body(name).xmat.reshape(3, 3), abs=1e-15)


def test_another_joint_is_refused() -> None:
    model = two_bodies(mujoco.mjtJoint.mjJNT_HINGE)
    with pytest.raises(ViskillError, match="other"):
        ThingPoses(model, ("free", "other"))


def test_scenes_read_as_one_scene_does_in_each_row() -> None:
    alone = [TASK.sample_layout(np.random.default_rng(seed), "wide") for seed in range(6)]
    names = ("block0", "block1", "block2", "block3")
    many = Scenes(
        np.zeros(6),
        names,
        np.array([[scene.pose(name) for name in names] for scene in alone]),
        tuple(scene.active for scene in alone),
        np.array([scene.goal for scene in alone]),
    )
    for index, scene in enumerate(alone):
        row: Scene = many.row(index)
        assert np.array_equal(many.pose(many.active)[index], scene.pose(scene.active))
        assert np.array_equal(many.pose("block1")[index], scene.pose("block1"))
        assert row.active == scene.active
        assert np.array_equal(row.pose("block3"), scene.pose("block3"))
        assert np.array_equal(row.goal, scene.goal)
