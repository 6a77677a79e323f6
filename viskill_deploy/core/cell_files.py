"""The schema of the files in `robots/cells/`: where arms stand, and what is on the table."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from viskill_deploy.core.robot_files import NonNegative, Positive, Table, Vector3

Rotation = Literal["yaw", "pitch"]
"""The one angle of its tool that an arm's policies command (see `motion.waypoints`)."""

SIMULATED = "simulated"
"""Serial number of an arm that is none."""


class CellArmEntry(Table):
    """One arm of a cell. The start angle that it gives says which one its policies command.

    A cell of real arms names their serial numbers and is not armed without their calibration.
    An arm without a mechanical remote centre needs its port, and `start_joints_si` (rad and m, one
    a joint): near which joints, of all that there are, its start pose is looked for.
    """

    name: str
    robot: str
    tool: str
    serial: str = SIMULATED
    base_position_m: Vector3
    base_rpy_rad: Vector3
    workspace_lower_m: Vector3
    workspace_upper_m: Vector3
    start_position_m: Vector3
    start_yaw_rad: float | None = None
    start_pitch_rad: float | None = None
    port_in_base_m: Vector3 = (0.0, 0.0, 0.0)
    start_joints_si: tuple[float, ...] = ()

    @model_validator(mode="after")
    def _ordered(self) -> CellArmEntry:
        for low, high in zip(self.workspace_lower_m, self.workspace_upper_m, strict=True):
            if low >= high:
                raise ValueError("workspace_lower_m must be below workspace_upper_m on every axis")
        return self

    @model_validator(mode="after")
    def _turned(self) -> CellArmEntry:
        if (self.start_yaw_rad is None) == (self.start_pitch_rad is None):
            raise ValueError("give one of start_yaw_rad and start_pitch_rad, as the arm turns")
        return self

    @property
    def rotation(self) -> Rotation:
        """Which angle policies command."""
        return "yaw" if self.start_pitch_rad is None else "pitch"

    @property
    def start_angle_rad(self) -> float:
        """That angle in the start pose, rad."""
        return self.start_yaw_rad or self.start_pitch_rad or 0.0


Pair = Literal[
    "shaft_shaft",
    "shaft_wrist",
    "shaft_jaw",
    "wrist_wrist",
    "wrist_jaw",
    "jaw_jaw",
    "shaft_peg",
    "wrist_peg",
    "jaw_peg",
    "shaft_plate",
    "wrist_plate",
    "jaw_plate",
    "shaft_door",
    "wrist_door",
    "jaw_door",
    "shaft_keep_out",
    "wrist_keep_out",
    "jaw_keep_out",
]
"""Two parts of two instruments, or a part of one and a kind of thing that stands in the cell."""


class Clearance(Table):
    """How near two parts may come to each other, measured from surface to surface.

    Attributes:
        slow_m: distance below which they come nearer only slowly.
        stop_m: distance below which they do not come nearer.
        spare_m: of `shaft_wrist` alone: the end of the shaft that is not looked at, because two
            wrists that hold one thing stand beside each other there.
    """

    slow_m: Positive
    stop_m: Positive
    spare_m: NonNegative = 0.0

    @model_validator(mode="after")
    def _ordered(self) -> Clearance:
        if self.stop_m >= self.slow_m:
            raise ValueError(f"stop_m {self.stop_m} must be below slow_m {self.slow_m}")
        return self


class KeepOut(Table):
    """A box in the task frame that no part of any instrument enters."""

    name: str
    lower_m: Vector3
    upper_m: Vector3

    @model_validator(mode="after")
    def _ordered(self) -> KeepOut:
        if any(low >= high for low, high in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError("lower_m must be below upper_m on every axis")
        return self


class Distances(Table):
    """Each pair that there is in the cell stays apart, or is named as one that may touch."""

    apart: dict[Pair, Clearance]
    contact: tuple[Pair, ...]
    keep_out: tuple[KeepOut, ...] = ()


class Motion(Table):
    """Speed and safety values of the whole cell, all in the task frame."""

    step_s: Positive
    tip_speed_m_s: Positive
    tip_speed_ceiling_m_s: Positive
    consent_hold_s: Positive
    consent_stop_s: Positive
    floor_m: float


class Grasp(Table):
    """How a jaw that holds something is told from one that closed on nothing.

    Attributes:
        held_above_empty_rad: a closed jaw that stays open by more than this, counted from its
            empty angle, holds something. Half of what the thinnest thing does is a good value.
    """

    held_above_empty_rad: float = Field(gt=0.0, le=0.5)


class Board(Table):
    """The peg board: a slab whose top is z = 0 of the task frame, and its pegs."""

    size_m: Vector3
    peg_xy_m: tuple[tuple[float, float], ...]
    peg_radius_m: Positive
    peg_height_m: Positive


class Block(Table):
    """A triangular block with a hexagonal through-hole, as six walls around the axis."""

    count: int = Field(gt=0)
    height_m: Positive
    wall_inradius_m: Positive
    wall_thickness_m: Positive
    corner_radius_m: Positive
    mass_kg: Positive
    grasp_frame_xy_m: tuple[tuple[float, float], tuple[float, float]]
    grasp_frame_yaw_rad: tuple[float, float]


class Panel(Table):
    """Three by three plates on a table whose top is z = 0; a sliding door over each row of x.

    Attributes:
        pitch_m: side of a plate, and distance from one to the next.
        plate_top_m: height of the plates over the table.
        door_size_m: x, y, z.
        door_height_m: height of a door's centre over the table.
        door_travel_m: way of a door along +y, from closed to its stop.
        handle_from_door_m: from a door's centre to the point that counts as its handle.
        handle_height_m: height of the knob's centre over the door's centre.
    """

    pitch_m: Positive
    plate_top_m: Positive
    door_size_m: Vector3
    door_height_m: Positive
    door_travel_m: Positive
    door_mass_kg: Positive
    door_friction_n: Positive
    door_damping_n_s_per_m: NonNegative
    handle_from_door_m: Vector3
    handle_height_m: Positive
    handle_radius_m: Positive
    knob_radius_m: Positive


class Letter(Table):
    """Measures of the characters that lie beside a panel; `sim.letters` has their strokes."""

    size_m: Vector3
    stroke_m: Positive
    mass_kg: Positive


class Wall(Table):
    """An upright plate across the x axis, and the pegs that stand out of it along x."""

    front_x_m: float
    thickness_m: Positive
    width_m: Positive
    height_m: Positive
    peg_yz_m: tuple[tuple[float, float], ...]
    peg_radius_m: Positive
    peg_length_m: Positive


class Ring(Table):
    """A torus; its own axis is x, and z is up while it hangs.

    `radius_m` is that of the circle that the tube's centre runs on, `friction` that against all but
    the jaws. The two grasp frames are places of the jaw pivot, those of the first and second arm.
    """

    count: int = Field(gt=0)
    radius_m: Positive
    tube_radius_m: Positive
    mass_kg: Positive
    friction: Positive
    grasp_frame_m: tuple[Vector3, Vector3]


class SurrolWorld(Table):
    """The world of SurRoL, in which official policies live; its axes are parallel to the task's.

    Attributes:
        length_scale: its lengths over metres.
        task_origin_m: origin of the task frame in it, m before scaling.
    """

    length_scale: Positive
    task_origin_m: Vector3


class Camera(Table):
    """A view of the cell: a point to look from, a point to look at, both in the task frame."""

    name: str
    position_m: Vector3
    target_m: Vector3
    vertical_field_of_view_rad: Positive


class CellFile(Table):
    """`robots/cells/<task>.toml`: where the arms stand, and what is on the board."""

    schema_version: Literal[1] = Field(alias="schema")
    name: str
    arm: tuple[CellArmEntry, ...]
    motion: Motion
    grasp: Grasp
    distances: Distances
    surrol: SurrolWorld | None = None
    camera: tuple[Camera, ...] = ()
    board: Board | None = None
    block: Block | None = None
    panel: Panel | None = None
    letter: Letter | None = None
    wall: Wall | None = None
    ring: Ring | None = None
