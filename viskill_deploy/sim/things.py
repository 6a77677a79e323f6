"""The things of a cell that arms can move, whatever they are: found in the model by their joint.

A thing is a body that hangs in the world by a free joint of its own name. Nothing here knows what
a block or a ring is.
"""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from viskill_deploy.core.errors import ViskillError
from viskill_deploy.core.types import FloatArray, Scene


class Things:
    """Where the things of a model are, by name.

    Args:
        model: the model of a cell.

    Attributes:
        names: of the things, in the order of the model.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        bodies = {model.body(model.jnt_bodyid[joint]).name: joint for joint in free}
        self.names = tuple(bodies)
        self._qpos = {name: int(model.jnt_qposadr[joint]) for name, joint in bodies.items()}
        self._qvel = {name: int(model.jnt_dofadr[joint]) for name, joint in bodies.items()}
        self._geoms = {name: _geoms(model, name) for name in self.names}

    def pose(self, data: mujoco.MjData, name: str) -> FloatArray:
        """Pose of a thing in the task frame, (4, 4)."""
        start = self._qpos[self._known(name)]
        q = data.qpos[start : start + 7]
        rotation, pose = np.empty(9), np.eye(4)
        mujoco.mju_quat2Mat(rotation, q[3:])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), q[:3]
        return pose

    def speed(self, data: mujoco.MjData, name: str) -> float:
        """Speed of a thing's origin, m/s."""
        start = self._qvel[self._known(name)]
        return float(np.linalg.norm(data.qvel[start : start + 3]))

    def touching(self, data: mujoco.MjData, name: str) -> set[int]:
        """Ids of the geoms that touch a thing."""
        first, end = self._geoms[self._known(name)]
        partners = set()
        for a, b in data.contact.geom.tolist():
            if first <= a < end:
                partners.add(b)
            elif first <= b < end:
                partners.add(a)
        return partners

    def place(self, data: mujoco.MjData, scene: Scene) -> None:
        """Puts the things of a scene in place; the others stay where they are.

        Raises:
            ViskillError: the scene names a thing that the model does not have.
        """
        for thing in scene.objects:
            start = self._qpos[self._known(thing.name)]
            data.qpos[start : start + 3] = thing.T_task_object[:3, 3]
            rotation = np.ascontiguousarray(thing.T_task_object[:3, :3]).ravel()
            mujoco.mju_mat2Quat(data.qpos[start + 3 : start + 7], rotation)

    def colour(self, model: mujoco.MjModel, active: str) -> None:
        """Paints the active thing red and the others blue."""
        for name in self.names:
            look = "active_thing" if name == active else "thing"
            model.geom_matid[slice(*self._geoms[name])] = model.material(look).id

    def _known(self, name: str) -> str:
        if name not in self._qpos:
            known = ", ".join(self.names) or "none"
            raise ViskillError(f"no object {name!r} in this world; it has: {known}")
        return name


def colour(model: mujoco.MjModel, active: str, goal: npt.ArrayLike) -> None:
    """Paints the active thing red and the upright peg under the goal green.

    Args:
        model: a model of a cell; pegs are geoms called `peg0`, `peg1`, ...
        active: name of the thing to manipulate.
        goal: task frame, (3,) m.
    """
    Things(model).colour(model, active)
    for index in range(model.ngeom):
        if model.geom(index).name.startswith("peg"):
            away = model.geom_pos[index][:2] - np.asarray(goal)[:2]
            look = "goal_peg" if np.hypot(*away) < 1e-3 else "peg"
            model.geom_matid[index] = model.material(look).id


def _geoms(model: mujoco.MjModel, name: str) -> tuple[int, int]:
    """First geom of a thing, and the one after its last."""
    body = model.body(name).id
    first = int(model.body_geomadr[body])
    return first, first + int(model.body_geomnum[body])
