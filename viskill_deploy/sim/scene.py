"""The MuJoCo model of a cell, built from its files in `robots/`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from viskill_deploy.core.cell_files import Camera
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.arm_model import add_arm, quaternion
from viskill_deploy.sim.board_model import add_blocks, add_board
from viskill_deploy.sim.materials import add_materials
from viskill_deploy.sim.panel_model import add_letters, add_panel
from viskill_deploy.sim.ring_model import add_rings, add_wall

LONGEST_STEP_S = 0.004
"""Longer physics steps let a held block creep: placing falls from 1.00 to 0.96 at 5 ms."""

IMPRATIO = 10.0
RING_IMPRATIO = 100.0
"""How much harder friction is than pressure. A ring is held at two round points, which creep: in
six seconds it slips in PSM1's jaw by 1.5 mm at 10 and by 0.2 mm at 100."""


def build_model(
    cell: CellDescription,
    timestep_s: float = LONGEST_STEP_S,
    friction: bool = False,
    only: str | None = None,
) -> mujoco.MjModel:
    """The compiled model of a cell. World frame = task frame.

    Args:
        cell: arms, board and what lies on it.
        timestep_s: physics step, s.
        friction: whether arm joints have the Coulomb friction of their files.
        only: name of the one free thing to have; all of them by default.

    Raises:
        DataFileError: an arm's joint has no `[joint.dynamics]`.
    """
    spec = mujoco.MjSpec()
    spec.modelname = cell.name
    spec.compiler.degree = False
    _set_options(spec, timestep_s, RING_IMPRATIO if cell.file.ring else IMPRATIO)
    add_materials(spec)
    _add_looks(spec, cell.file.camera)
    if cell.file.board is not None:
        add_board(spec, cell.file.board)
    if cell.file.panel is not None:
        add_panel(spec, cell.file.panel)
    if cell.file.wall is not None:
        add_wall(spec, cell.file.wall)
    for arm in cell.arms:
        add_arm(spec, arm, friction)
    if cell.file.block is not None:
        add_blocks(spec, cell.file.block)
    if cell.file.letter is not None:
        add_letters(spec, cell.file.letter)
    if cell.file.ring is not None:
        add_rings(spec, cell.file.ring)
    if only is not None:
        _leave_out_others(spec, only)
    return spec.compile()


def _leave_out_others(spec: mujoco.MjSpec, only: str) -> None:
    """Takes the free things with other names out of a model under construction."""
    for body in list(spec.worldbody.bodies):
        free = any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints)
        if free and body.name != only:
            spec.delete(body)


def _set_options(spec: mujoco.MjSpec, timestep_s: float, impratio: float) -> None:
    option = spec.option
    option.timestep = timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = impratio
    # 1e-8, the default, moves a block by 2 um more or less in an episode and costs 4 % more time.
    option.tolerance = 1e-6
    # MuJoCo 4.0.0 factors the Newton Hessian wrongly with a sparse constraint Jacobian.
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # Things that nothing touches sleep: a step costs 20 us instead of 53.
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP


def _add_looks(spec: mujoco.MjSpec, cameras: Sequence[Camera]) -> None:
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
    for camera in cameras:
        spec.worldbody.add_camera(
            name=camera.name,
            pos=camera.position_m,
            quat=look_at(camera.position_m, camera.target_m),
            fovy=math.degrees(camera.vertical_field_of_view_rad),
        )


def look_at(eye: tuple[float, ...], target: tuple[float, ...]) -> FloatArray:
    """Quaternion of a camera at `eye` that looks at `target` with z up, (4,)."""
    back = np.array(eye) - np.array(target)
    back /= math.sqrt(back @ back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= math.sqrt(right @ right)
    return quaternion(np.column_stack([right, np.cross(back, right), back]))
