"""The wall with its pegs and the rings on it as MuJoCo bodies.

A ring is sixteen capsules in a circle. On the board it lies on eight small spheres: eight contacts
instead of the thirty-two of sixteen capsules.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from viskill_deploy.core.cell_files import Ring, Wall
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.materials import CONTACT_SOLIMP, CONTACT_SOLREF, FRICTION, Touch

SEGMENTS = 16
ASIDE_M = (0.25, -0.15, 0.03)
ASIDE_STEP_M = 0.1
"""Where rings wait until a scene names them, and the distance between two of them."""


def add_wall(spec: mujoco.MjSpec, wall: Wall) -> None:
    """Adds the upright plate `wall` and its pegs `hook0`, `hook1`, ..."""
    bottom, front = -wall.thickness_m, wall.front_x_m
    spec.worldbody.add_geom(
        name="wall",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[front - wall.thickness_m / 2, 0, (wall.height_m + bottom) / 2],
        size=[wall.thickness_m / 2, wall.width_m / 2, (wall.height_m - bottom) / 2],
        material="wall",
        condim=3,
        friction=FRICTION,
        solref=CONTACT_SOLREF,
        **Touch.PLATE.bits,
    )
    for index, (y, z) in enumerate(wall.peg_yz_m):
        spec.worldbody.add_geom(
            name=f"hook{index}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[front, y, z, front + wall.peg_length_m - wall.peg_radius_m, y, z],
            size=[wall.peg_radius_m, 0, 0],
            material="peg",
            condim=3,
            friction=FRICTION,
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
            **Touch.PEG.bits,
        )


def add_rings(spec: mujoco.MjSpec, ring: Ring) -> None:
    """Adds the free rings `ring0`, `ring1`, ..., put aside until a scene names them."""
    for index in range(ring.count):
        x, y, z = ASIDE_M
        _add_ring(spec, f"ring{index}", ring, (x, y + ASIDE_STEP_M * index, z))


def _add_ring(
    spec: mujoco.MjSpec, name: str, ring: Ring, place: tuple[float, float, float]
) -> None:
    """One ring; its geoms are `<name>/arc0`, ... and `<name>/foot0`, ..."""
    body = spec.worldbody.add_body(name=name, pos=place)
    body.add_freejoint(name=name)
    for index in range(SEGMENTS):
        ends = [_on_circle(ring.radius_m, index + step) for step in (-0.5, 0.5)]
        body.add_geom(
            name=f"{name}/arc{index}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=np.concatenate(ends),
            size=[ring.tube_radius_m, 0, 0],
            mass=ring.mass_kg / SEGMENTS,
            material="thing",
            condim=4,
            friction=(ring.friction, *FRICTION[1:]),
            priority=1,
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
            **Touch.WALL.bits,
        )
    for index in range(0, SEGMENTS, 2):
        body.add_geom(
            name=f"{name}/foot{index}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=_on_circle(ring.radius_m, index + 0.5),
            size=[ring.tube_radius_m, 0, 0],
            mass=0.0,
            material="thing",
            condim=3,
            friction=(ring.friction, *FRICTION[1:]),
            priority=1,
            solref=CONTACT_SOLREF,
            **Touch.FOOT.bits,
        )


def _on_circle(radius_m: float, step: float) -> FloatArray:
    """A point of the ring's circle, counted in segments from its y axis, (3,) m."""
    angle = 2 * math.pi * step / SEGMENTS
    return radius_m * np.array([0.0, math.cos(angle), math.sin(angle)])
