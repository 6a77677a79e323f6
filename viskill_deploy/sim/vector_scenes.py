"""What is on the boards of many worlds side by side: `Scene` with a first axis of environments."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from viskill_deploy.core.errors import ViskillError
from viskill_deploy.core.types import FloatArray, ObjectPose, Scene


@dataclass(frozen=True, slots=True)
class Scenes:
    """Scenes of many worlds that hold the same things; reads as a `Scene` does.

    Attributes:
        stamp_s: when they were seen, (N,).
        names: of the things.
        poses: T_task_object of every thing, (N, things, 4, 4), m.
        active: the object to manipulate in each.
        goal: where it has to go, task frame, (N, 3) m.
    """

    stamp_s: FloatArray
    names: tuple[str, ...]
    poses: FloatArray
    active: tuple[str, ...]
    goal: FloatArray

    def pose(self, name: str | tuple[str, ...]) -> FloatArray:
        """Poses (N, 4, 4) of one object in all scenes, or of one object each."""
        if isinstance(name, str):
            return self.poses[:, self.names.index(name)]
        columns = [self.names.index(one) for one in name]
        chosen: FloatArray = self.poses[np.arange(len(columns)), columns]
        return chosen

    def row(self, index: int) -> Scene:
        """One of the scenes."""
        objects = zip(self.names, self.poses[index], strict=True)
        return Scene(
            float(self.stamp_s[index]),
            tuple(ObjectPose(name, pose) for name, pose in objects),
            self.active[index],
            self.goal[index],
        )


class ThingPoses:
    """Poses of things from generalised positions, many worlds at once.

    Args:
        model: the model of a cell.
        names: things of the model: bodies that hang in the world by one free or slide joint.

    Raises:
        ViskillError: a thing hangs by another kind of joint.
    """

    def __init__(self, model: mujoco.MjModel, names: tuple[str, ...]) -> None:
        self.names = names
        self._free: list[int] = []
        self._columns: list[npt.NDArray[np.intp]] = []
        self._slides: list[tuple[int, int, FloatArray, FloatArray]] = []
        for number, name in enumerate(names):
            body = model.body(name)
            joint = int(body.jntadr[0])
            start, kind = int(model.jnt_qposadr[joint]), model.jnt_type[joint]
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                self._free.append(number)
                self._columns.append(np.arange(start, start + 7))
            elif kind == mujoco.mjtJoint.mjJNT_SLIDE:
                home = matrices(np.concatenate([body.pos, body.quat]))
                axis = home[:3, :3] @ model.jnt_axis[joint]
                self._slides.append((number, start, home, axis))
            else:
                raise ViskillError(f"thing {name!r} has neither a free nor a slide joint; add one")

    def __call__(self, qpos: FloatArray) -> FloatArray:
        """T_task_object of every thing, (N, things, 4, 4), for positions (N, nq)."""
        poses = np.empty((len(qpos), len(self.names), 4, 4))
        if self._free:
            poses[:, self._free] = matrices(qpos[:, np.array(self._columns)])
        for number, column, home, axis in self._slides:
            poses[:, number] = home
            poses[:, number, :3, 3] += axis * qpos[:, column, None]
        return poses


def matrices(q: FloatArray) -> FloatArray:
    """Poses (..., 4, 4) from positions and unit quaternions x y z qw qx qy qz, (..., 7)."""
    w, x, y, z = (q[..., column] for column in range(3, 7))
    poses = np.zeros((*q.shape[:-1], 4, 4))
    poses[..., 0, 0] = w * w + x * x - y * y - z * z
    poses[..., 1, 1] = w * w - x * x + y * y - z * z
    poses[..., 2, 2] = w * w - x * x - y * y + z * z
    poses[..., 0, 1], poses[..., 1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    poses[..., 0, 2], poses[..., 2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    poses[..., 1, 2], poses[..., 2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    poses[..., :3, 3], poses[..., 3, 3] = q[..., :3], 1.0
    return poses
