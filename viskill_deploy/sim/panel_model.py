"""The match board with its sliding doors, and the letters, as MuJoCo bodies.

A door is a body on a slide joint of its own name whose dry friction holds it where it is left; only
what pushes it, such as a jaw at its handle, moves it. A letter is a few boxes that jaws touch, on
spheres as high as itself that stand on the table or on a plate: it has two good faces.
"""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from viskill_deploy.core.cell_files import Letter, Panel
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.letters import NAMES, plane_point, shape_of
from viskill_deploy.sim.materials import CONTACT_SOLIMP, CONTACT_SOLREF, FRICTION, Touch

TABLE_HALF_M = (0.30, 0.30, 0.02)
ROWS = COLUMNS = 3
RAIL_M = 0.0005
RAIL_SOLREF, RAIL_SOLIMP = (0.008, 1.0), (0.999, 0.999, 0.001, 0.5, 2.0)
"""How a door's dry friction answers. MuJoCo's own values let 90 % of the force that would break it
loose creep it along at 16 mm/s."""
STROKE_SOLREF, STROKE_SOLIMP = (0.012, 1.0), (0.998, 0.998, 0.0005, 0.5, 2.0)
"""How the strokes of a letter answer a jaw. A contact gives way the more the lighter what it holds
is: with the blocks' values a grip of 1.2 N dents a letter of 1 g by 0.2 mm a side and squeezes it
out of the jaw within 12 s, and as quick a contact that gives way less rattles. With these a letter
slips by 0.3 mm and tilts by a degree from grasp to release."""
ASIDE_X_M, ASIDE_Y_M = 0.27, 0.025
"""Where letters wait that a scene does not name, and distance between two of them."""


def row_x(panel: Panel) -> FloatArray:
    """Middle of each row, (3,) m along x."""
    return panel.pitch_m * (np.arange(ROWS, dtype=np.float64) - (ROWS - 1) / 2)


def column_y(panel: Panel) -> FloatArray:
    """Middle of each column, (3,) m along y."""
    return panel.pitch_m * (np.arange(COLUMNS, dtype=np.float64) - (COLUMNS - 1) / 2)


def door_name(row: int) -> str:
    """Name of the door over a row."""
    return f"door{row}"


def add_panel(spec: mujoco.MjSpec, panel: Panel) -> None:
    """Adds the table (its top is z = 0), the plates and the doors `door0`, `door1`, `door2`."""
    world = spec.worldbody
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
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0, 0, -TABLE_HALF_M[2] - 1e-4],
        size=TABLE_HALF_M,
        material="table",
        **Touch.NOTHING.bits,
    )
    for number, (x, y) in enumerate(itertools.product(row_x(panel), column_y(panel))):
        _add_plate(world, f"plate{number}", panel, (x, y))
    for row, x in enumerate(row_x(panel)):
        _add_door(world, door_name(row), panel, x)
    for number in range(ROWS + 1):
        _add_rail(world, f"rail{number}", panel, panel.pitch_m * (number - ROWS / 2))


def _add_plate(world: mujoco.MjsBody, name: str, panel: Panel, place: tuple[float, float]) -> None:
    half = panel.plate_top_m / 2
    world.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[*place, half],
        size=[panel.pitch_m / 2 - 2e-4, panel.pitch_m / 2 - 2e-4, half],
        material="plate",
        condim=3,
        friction=FRICTION,
        solref=CONTACT_SOLREF,
        **Touch.BOARD.bits,
    )


def _add_rail(world: mujoco.MjsBody, name: str, panel: Panel, x: float) -> None:
    """What a door runs in; only seen."""
    length = panel.door_size_m[1] + panel.door_travel_m
    top = panel.door_height_m + panel.door_size_m[2] / 2
    world.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[x, panel.door_travel_m / 2, top / 2],
        size=[RAIL_M / 2, length / 2, top / 2],
        material="rail",
        **Touch.NOTHING.bits,
    )


def _add_door(world: mujoco.MjsBody, name: str, panel: Panel, x: float) -> None:
    body = world.add_body(name=name, pos=[x, 0, panel.door_height_m])
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0, 1, 0],
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=[0.0, panel.door_travel_m],
        frictionloss=panel.door_friction_n,
        damping=panel.door_damping_n_s_per_m,
        solref_friction=RAIL_SOLREF,
        solimp_friction=RAIL_SOLIMP,
        solref_limit=CONTACT_SOLREF,
    )
    surface = {
        "condim": 3,
        "friction": FRICTION,
        "solref": CONTACT_SOLREF,
        "solimp": CONTACT_SOLIMP,
        **Touch.DOOR.bits,
    }
    body.add_geom(
        name=f"{name}/plate",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[side / 2 for side in panel.door_size_m],
        mass=panel.door_mass_kg,
        material="door",
        **surface,
    )
    handle = np.array([*panel.handle_from_door_m[:2], 0.0])
    knob = handle + np.array([0.0, 0.0, panel.handle_height_m])
    body.add_geom(
        name=f"{name}/handle",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*handle, *knob],
        size=[panel.handle_radius_m, 0, 0],
        mass=0.0,
        material="steel",
        **surface,
    )
    body.add_geom(
        name=f"{name}/knob",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        pos=knob,
        size=[panel.knob_radius_m, 0, 0],
        mass=0.0,
        material="steel",
        **surface,
    )


def add_letters(spec: mujoco.MjSpec, letter: Letter) -> None:
    """Adds a free body for every character, put aside until a scene names it."""
    for index, name in enumerate(NAMES):
        y = ASIDE_Y_M * (index - (len(NAMES) - 1) / 2)
        body = spec.worldbody.add_body(name=name, pos=[ASIDE_X_M, y, letter.size_m[2] / 2])
        body.add_freejoint(name=name)
        _add_strokes(body, name, letter)
        _add_feet(body, name, letter)


def _add_strokes(body: mujoco.MjsBody, name: str, letter: Letter) -> None:
    strokes = shape_of(name).strokes
    ends = [(plane_point(letter, a, b), plane_point(letter, c, d)) for a, b, c, d in strokes]
    lengths = [float(np.abs(end - start).sum()) for start, end in ends]
    for number, ((start, end), length) in enumerate(zip(ends, lengths, strict=True)):
        half = np.abs(end - start) / 2 + letter.stroke_m / 2
        half[2] = letter.size_m[2] / 2
        body.add_geom(
            name=f"{name}/stroke{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(start + end) / 2,
            size=half,
            mass=letter.mass_kg * length / sum(lengths),
            material="thing",
            condim=4,
            friction=FRICTION,
            solref=STROKE_SOLREF,
            solimp=STROKE_SOLIMP,
            priority=1,
            **Touch.WALL.bits,
        )


def _add_feet(body: mujoco.MjsBody, name: str, letter: Letter) -> None:
    """Spheres inside the letter's outline, which nobody sees."""
    radius = letter.size_m[2] / 2
    reach = np.array(letter.size_m) / 2 - radius
    for number, (u, v) in enumerate(shape_of(name).feet):
        body.add_geom(
            name=f"{name}/foot{number}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=np.clip(plane_point(letter, u, v), -reach, reach),
            size=[radius, 0, 0],
            mass=0.0,
            group=4,
            material="thing",
            condim=3,
            friction=FRICTION,
            solref=CONTACT_SOLREF,
            **Touch.FOOT.bits,
        )
