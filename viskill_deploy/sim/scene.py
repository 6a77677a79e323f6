"""The MuJoCo model of a cell, built from its files in `robots/`."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.arm_model import add_arm, quaternion
from viskill_deploy.sim.board_model import add_block, add_board
from viskill_deploy.sim.materials import add_materials

BLOCKS = 4
LONGEST_STEP_S = 0.004
"""Longer physics steps let a held block creep: placing falls from 1.00 to 0.96 at 5 ms."""

CAMERAS = {
    "overview": ((0.24, 0.10, 0.17), (-0.01, 0.0, 0.035), 38.0),
    "side": ((0.02, -0.26, 0.09), (-0.01, 0.0, 0.03), 40.0),
}
"""Position, point looked at (task frame, m), vertical field of view (deg)."""


def block_name(index: int) -> str:
    """Name of the block with this index."""
    return f"block{index}"


def build_model(
    cell: CellDescription, timestep_s: float = LONGEST_STEP_S, friction: bool = False
) -> mujoco.MjModel:
    """The compiled model of a cell. World frame = task frame.

    Args:
        cell: arms, board and blocks.
        timestep_s: physics step, s.
        friction: whether arm joints have the Coulomb friction of their files.

    Raises:
        DataFileError: an arm's joint has no `[joint.dynamics]`.
    """
    spec = mujoco.MjSpec()
    spec.modelname = cell.name
    spec.compiler.degree = False
    _set_options(spec, timestep_s)
    add_materials(spec)
    _add_looks(spec)
    if cell.file.board is not None:
        add_board(spec, cell.file.board)
    for arm in cell.arms:
        add_arm(spec, arm, friction)
    if cell.file.block is not None:
        for index in range(BLOCKS):
            add_block(spec, block_name(index), cell.file.block, 0.2 + 0.05 * index)
    return spec.compile()


def _set_options(spec: mujoco.MjSpec, timestep_s: float) -> None:
    option = spec.option
    option.timestep = timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    # MuJoCo 4.0.0 factors the Newton Hessian wrongly with a sparse constraint Jacobian.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # Blocks that nothing touches sleep: a step costs 20 us instead of 53.
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP


def _add_looks(spec: mujoco.MjSpec) -> None:
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 960
    spec.visual.map.znear = 0.01
    spec.visual.quality.shadowsize = 4096
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.68, 0.75],
        rgb2=[0.30, 0.35, 0.42],
        width=64,
        height=384,
    )
    spec.stat.center, spec.stat.extent = [0.0, 0.0, 0.05], 0.3
    spec.worldbody.add_light(
        pos=[0.25, 0.15, 0.5], dir=[-0.45, -0.25, -0.86], diffuse=[0.7, 0.7, 0.68], castshadow=True
    )
    spec.worldbody.add_light(
        pos=[-0.2, -0.3, 0.4], dir=[0.4, 0.5, -0.76], diffuse=[0.25, 0.26, 0.3], castshadow=False
    )
    for name, (eye, target, fovy) in CAMERAS.items():
        spec.worldbody.add_camera(name=name, pos=eye, quat=look_at(eye, target), fovy=fovy)


def colour(model: mujoco.MjModel, cell: CellDescription, active: str, goal: FloatArray) -> None:
    """Paints the active block red and the peg under the goal green.

    Args:
        model: a model of the cell.
        cell: the cell.
        active: name of the block to manipulate.
        goal: task frame, (3,) m.
    """
    for index in range(BLOCKS if cell.file.block else 0):
        body = model.body(block_name(index)).id
        first, count = model.body_geomadr[body], model.body_geomnum[body]
        look = "active_block" if block_name(index) == active else "block"
        model.geom_matid[first : first + count] = model.material(look).id
    board = cell.file.board
    for number, xy in enumerate(board.peg_xy_m if board else ()):
        look = "goal_peg" if math.dist(xy, goal[:2]) < 1e-3 else "peg"
        model.geom(f"peg{number}").matid = model.material(look).id


def look_at(eye: tuple[float, ...], target: tuple[float, ...]) -> FloatArray:
    """Quaternion of a camera at `eye` that looks at `target` with z up, (4,)."""
    back = np.array(eye) - np.array(target)
    back /= math.sqrt(back @ back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= math.sqrt(right @ right)
    return quaternion(np.column_stack([right, np.cross(back, right), back]))
