"""The things of a cell that arms can move, whatever they are: found in the model by their joint.

A thing is a body that hangs in the world by one joint of its own name: a free joint, or a slide
joint (a door). Nothing here knows what a block or a ring is.
"""

from __future__ import annotations

from typing import Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from viskill_deploy.core.errors import ViskillError
from viskill_deploy.core.types import FloatArray, Scene


class _Thing(Protocol):
    """Where one thing's numbers lie in MuJoCo's vectors, and what they mean."""

    def pose(self, data: mujoco.MjData) -> FloatArray: ...

    def place(self, data: mujoco.MjData, T_task_thing: FloatArray) -> None: ...

    def speed(self, data: mujoco.MjData) -> float: ...


class _Free:
    """A thing that may lie anywhere."""

    def __init__(self, model: mujoco.MjModel, joint: int) -> None:
        self._qpos, self._qvel = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])

    def pose(self, data: mujoco.MjData) -> FloatArray:
        q = data.qpos[self._qpos : self._qpos + 7]
        return _pose(q[:3], q[3:])

    def place(self, data: mujoco.MjData, T_task_thing: FloatArray) -> None:
        start = self._qpos
        data.qpos[start : start + 3] = T_task_thing[:3, 3]
        rotation = np.ascontiguousarray(T_task_thing[:3, :3]).ravel()
        mujoco.mju_mat2Quat(data.qpos[start + 3 : start + 7], rotation)

    def speed(self, data: mujoco.MjData) -> float:
        return float(np.linalg.norm(data.qvel[self._qvel : self._qvel + 3]))

    def knock(self, data: mujoco.MjData, way: FloatArray) -> None:
        data.qpos[self._qpos : self._qpos + 3] += way
        data.qvel[self._qvel : self._qvel + 6] = 0.0


class Sliding:
    """A thing that slides along a line, as a door does.

    Args:
        model: the model of a cell.
        joint: its joint.

    Attributes:
        column: where its travel stands among the generalised positions.
        axis: direction of its travel, task frame, (3,).
    """

    def __init__(self, model: mujoco.MjModel, joint: int) -> None:
        body = model.jnt_bodyid[joint]
        self.column, self._qvel = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self._home = _pose(model.body_pos[body], model.body_quat[body])
        self.axis: FloatArray = self._home[:3, :3] @ model.jnt_axis[joint]
        self._range = model.jnt_range[joint].copy()

    def pose(self, data: mujoco.MjData) -> FloatArray:
        """Its pose in the task frame, (4, 4)."""
        pose = self._home.copy()
        pose[:3, 3] += self.axis * data.qpos[self.column]
        return pose

    def place(self, data: mujoco.MjData, T_task_thing: FloatArray) -> None:
        """Slides it to where a pose says; what the pose says across its line does not count."""
        data.qpos[self.column] = self.travel(T_task_thing[:3, 3])

    def speed(self, data: mujoco.MjData) -> float:
        """Its speed, m/s."""
        return abs(float(data.qvel[self._qvel]))

    def travel(self, positions: npt.ArrayLike) -> FloatArray:
        """How far it has slid when its origin is at positions (..., 3), within its range; (...)."""
        way = (np.asarray(positions) - self._home[:3, 3]) @ self.axis
        within: FloatArray = np.clip(way, *self._range)
        return within

    def aside(self, place: FloatArray) -> float:
        """Distance from a place (3,) to the line that it slides along, seen from above, m."""
        way = (place - self._home[:3, 3])[:2]
        return float(abs(way @ np.array([-self.axis[1], self.axis[0]])))


def sliding(model: mujoco.MjModel) -> dict[str, Sliding]:
    """Everything in a model that slides, by name."""
    slides = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE)
    return {
        model.joint(joint).name: Sliding(model, int(joint))
        for joint in slides
        if model.body_parentid[model.jnt_bodyid[joint]] == 0
    }


class Things:
    """Where the things of a model are, by name.

    Args:
        model: the model of a cell.

    Attributes:
        names: of the things, in the order of the model.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        self._free = {model.body(model.jnt_bodyid[j]).name: _Free(model, int(j)) for j in free}
        self._sliding = sliding(model)
        self._things: dict[str, _Thing] = {**self._free, **self._sliding}
        self.names = tuple(self._things)
        self._geoms = {name: _geoms(model, name) for name in self.names}

    def pose(self, data: mujoco.MjData, name: str) -> FloatArray:
        """Pose of a thing in the task frame, (4, 4)."""
        return self._known(name).pose(data)

    def speed(self, data: mujoco.MjData, name: str) -> float:
        """Speed of a thing's origin, m/s."""
        return self._known(name).speed(data)

    def door_over(self, place: FloatArray) -> str:
        """Name of the sliding thing whose line passes nearest to a place (3,); "" without any."""
        lines = self._sliding
        return min(lines, key=lambda name: lines[name].aside(place), default="")

    def touching(self, data: mujoco.MjData, name: str) -> set[int]:
        """Ids of the geoms that touch a thing."""
        self._known(name)
        first, end = self._geoms[name]
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
            self._known(thing.name).place(data, thing.T_task_object)

    def knock(self, data: mujoco.MjData, name: str, way: FloatArray) -> None:
        """Moves a free thing by `way` (3,), at rest.

        Raises:
            ViskillError: no free thing has that name.
        """
        if name not in self._free:
            known = ", ".join(self._free) or "none"
            raise ViskillError(
                f"{name!r} is no free thing and stays where it is; free are: {known}"
            )
        self._free[name].knock(data, way)

    def colour(self, model: mujoco.MjModel, active: str) -> None:
        """Paints the active thing red and the other free ones blue."""
        for name in self._free:
            look = "active_thing" if name == active else "thing"
            model.geom_matid[slice(*self._geoms[name])] = model.material(look).id

    def _known(self, name: str) -> _Thing:
        if name not in self._things:
            known = ", ".join(self.names) or "none"
            raise ViskillError(f"no object {name!r} in this world; it has: {known}")
        return self._things[name]


def _pose(position: FloatArray, quaternion: FloatArray) -> FloatArray:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    a, b, c, d, e, f, g, h, i = rotation.tolist()
    x, y, z = position.tolist()
    return np.array([[a, b, c, x], [d, e, f, y], [g, h, i, z], [0.0, 0.0, 0.0, 1.0]])


def colour(model: mujoco.MjModel, active: str, goal: npt.ArrayLike) -> None:
    """Paints the active thing red, and the upright peg or the plate at the goal green.

    Args:
        model: a model of a cell; pegs are geoms called `peg0`, `peg1`, ..., plates `plate0`, ...
        active: name of the thing to manipulate.
        goal: task frame, (3,) m.
    """
    Things(model).colour(model, active)
    for index in range(model.ngeom):
        kind = model.geom(index).name.rstrip("0123456789")
        if kind in ("peg", "plate"):
            away = model.geom_pos[index][:2] - np.asarray(goal)[:2]
            look = f"goal_{kind}" if np.hypot(*away) < 1e-3 else kind
            model.geom_matid[index] = model.material(look).id


def _geoms(model: mujoco.MjModel, name: str) -> tuple[int, int]:
    """First geom of a thing, and the one after its last."""
    body = model.body(name).id
    first = int(model.body_geomadr[body])
    return first, first + int(model.body_geomnum[body])
