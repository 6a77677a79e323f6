"""The peg board and its blocks as MuJoCo bodies.

The board is a plane, a peg a capsule, a block six wall boxes around a hexagonal hole that stands on
six small spheres: nine contact rows at rest instead of the 48 of a box on a box.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from viskill_deploy.core.cell_files import Block, Board
from viskill_deploy.sim.materials import CONTACT_SOLIMP, CONTACT_SOLREF, FRICTION, Touch

TABLE_HALF_M = (0.30, 0.30, 0.02)
SIDES = 6
ASIDE_X_M, ASIDE_Y_M = 0.25, 0.1
"""Distance from the board at which blocks wait, and between two of them."""


def add_board(spec: mujoco.MjSpec, board: Board) -> None:
    """Adds the board (its top is z = 0), its pegs `peg0`, `peg1`, ... and the table below."""
    world = spec.worldbody
    x, y, thickness = board.size_m
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.5, 0.5, 0.01],
        rgba=[0, 0, 0, 0],
        condim=3,
        friction=FRICTION,
        solref=CONTACT_SOLREF,
        **Touch.BOARD.bits,
    )
    world.add_geom(
        name="board",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0, 0, -thickness / 2],
        size=[x / 2, y / 2, thickness / 2],
        material="board",
        **Touch.NOTHING.bits,
    )
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0, 0, -thickness - TABLE_HALF_M[2]],
        size=TABLE_HALF_M,
        material="table",
        **Touch.NOTHING.bits,
    )
    for index, (px, py) in enumerate(board.peg_xy_m):
        world.add_geom(
            name=f"peg{index}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[px, py, 0, px, py, board.peg_height_m - board.peg_radius_m],
            size=[board.peg_radius_m, 0, 0],
            material="peg",
            condim=3,
            friction=FRICTION,
            solref=CONTACT_SOLREF,
            solimp=CONTACT_SOLIMP,
            **Touch.PEG.bits,
        )


def add_blocks(spec: mujoco.MjSpec, block: Block) -> None:
    """Adds the free blocks `block0`, `block1`, ..., put aside until a scene names them."""
    for index in range(block.count):
        _add_block(spec, f"block{index}", block, (ASIDE_X_M, ASIDE_Y_M * index - 0.15, 0.01))


def _add_block(spec: mujoco.MjSpec, name: str, block: Block, place: Sequence[float]) -> None:
    """One block, its axis upright; its geoms are `<name>/wall0`, ..."""
    body = spec.worldbody.add_body(name=name, pos=place)
    body.add_freejoint(name=name)
    for side in range(SIDES):
        _add_wall(body, name, side, block)
    for corner in range(0, SIDES, 2):
        _add_corner(spec, body, name, corner, block)


def _add_wall(body: mujoco.MjsBody, name: str, side: int, block: Block) -> None:
    angle = 2 * math.pi * side / SIDES
    normal = np.array([math.cos(angle), math.sin(angle), 0.0])
    length = 2 * block.wall_inradius_m * math.tan(math.pi / SIDES)
    body.add_geom(
        name=f"{name}/wall{side}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=block.wall_inradius_m * normal,
        quat=[math.cos(angle / 2), 0, 0, math.sin(angle / 2)],
        size=[block.wall_thickness_m / 2, length / 2, block.height_m / 2],
        mass=block.mass_kg / SIDES,
        material="thing",
        condim=4,
        friction=FRICTION,
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
        **Touch.WALL.bits,
    )
    foot = block.wall_thickness_m / 2
    edge = angle + math.pi / SIDES
    reach = block.wall_inradius_m / math.cos(math.pi / SIDES)
    body.add_geom(
        name=f"{name}/foot{side}",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=[reach * math.cos(edge), reach * math.sin(edge), foot - block.height_m / 2],
        size=[foot, 0, 0],
        mass=0.0,
        material="thing",
        condim=3,
        friction=FRICTION,
        solref=CONTACT_SOLREF,
        **Touch.FOOT.bits,
    )


def _add_corner(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, side: int, block: Block
) -> None:
    """The pointed part that makes the block look triangular; nothing touches it."""
    mesh = f"{name}/corner{side}"
    outer = block.wall_inradius_m + block.wall_thickness_m / 2
    half = outer * math.tan(math.pi / SIDES)
    tip = (block.corner_radius_m, half / 4)
    outline = [(outer, -half), (outer, half), tip, (tip[0], -tip[1])]
    points = [(x, y, z) for x, y in outline for z in (-block.height_m / 2, block.height_m / 2)]
    spec.add_mesh(name=mesh, uservert=np.array(points).ravel())
    angle = 2 * math.pi * side / SIDES
    body.add_geom(
        name=mesh,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=mesh,
        quat=[math.cos(angle / 2), 0, 0, math.sin(angle / 2)],
        mass=0.0,
        material="thing",
        **Touch.NOTHING.bits,
    )
