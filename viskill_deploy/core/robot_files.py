"""The schema of arms and instruments in `robots/`, and the reader of every file there.

Every number carries its unit in its key. Unknown keys, missing units, min > max and NaN are refused
with file, key and reason. Chain convention: modified (Craig) Denavit-Hartenberg, link transform
Rx(alpha) Tx(a) Rz(theta) Tz(d); a revolute joint adds offset + q to theta, a prismatic one to d.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from viskill_deploy.core.errors import DataFileError

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Vector3 = tuple[float, float, float]


class Table(BaseModel):
    """A table of a data file: frozen, no unknown key, no NaN or infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)


class RevoluteDynamics(Table):
    """How the simulated joint answers its servo: reflected inertia, servo gains, friction."""

    armature_kg_m2: Positive
    stiffness_nm_per_rad: Positive
    damping_nm_s_per_rad: Positive
    friction_nm: NonNegative
    effort_nm: Positive


class PrismaticDynamics(Table):
    """The same for a sliding joint."""

    armature_kg: Positive
    stiffness_n_per_m: Positive
    damping_n_s_per_m: Positive
    friction_n: NonNegative
    effort_n: Positive


D = TypeVar("D")


def _given(dynamics: D | None, joint: str) -> D:
    if dynamics is None:
        raise DataFileError("", joint, "has no [joint.dynamics]; the simulator needs one")
    return dynamics


class RevoluteJoint(Table):
    """One revolute row of the chain with its limits."""

    name: str
    type: Literal["revolute"]
    alpha_rad: float
    a_m: float
    theta_rad: float
    d_m: float
    offset_rad: float
    lower_rad: float
    upper_rad: float
    max_velocity_rad_s: Positive
    max_acceleration_rad_s2: Positive
    max_jerk_rad_s3: Positive
    dynamics: RevoluteDynamics | None = None

    @model_validator(mode="after")
    def _ordered(self) -> RevoluteJoint:
        if self.lower_rad >= self.upper_rad:
            raise ValueError(f"lower_rad {self.lower_rad} must be below upper_rad {self.upper_rad}")
        return self

    @property
    def limits(self) -> tuple[float, float, float, float, float]:
        """Lower, upper, max velocity, max acceleration, max jerk in rad and s."""
        return (
            self.lower_rad,
            self.upper_rad,
            self.max_velocity_rad_s,
            self.max_acceleration_rad_s2,
            self.max_jerk_rad_s3,
        )

    @property
    def servo(self) -> tuple[float, float, float, float, float]:
        """Armature, stiffness, damping, friction, effort limit of the simulated joint, SI."""
        d = _given(self.dynamics, self.name)
        return (
            d.armature_kg_m2,
            d.stiffness_nm_per_rad,
            d.damping_nm_s_per_rad,
            d.friction_nm,
            d.effort_nm,
        )

    @property
    def offset(self) -> float:
        """Zero offset, rad."""
        return self.offset_rad


class PrismaticJoint(Table):
    """One prismatic row of the chain with its limits."""

    name: str
    type: Literal["prismatic"]
    alpha_rad: float
    a_m: float
    theta_rad: float
    d_m: float
    offset_m: float
    lower_m: float
    upper_m: float
    max_velocity_m_s: Positive
    max_acceleration_m_s2: Positive
    max_jerk_m_s3: Positive
    dynamics: PrismaticDynamics | None = None

    @model_validator(mode="after")
    def _ordered(self) -> PrismaticJoint:
        if self.lower_m >= self.upper_m:
            raise ValueError(f"lower_m {self.lower_m} must be below upper_m {self.upper_m}")
        return self

    @property
    def limits(self) -> tuple[float, float, float, float, float]:
        """Lower, upper, max velocity, max acceleration, max jerk in m and s."""
        return (
            self.lower_m,
            self.upper_m,
            self.max_velocity_m_s,
            self.max_acceleration_m_s2,
            self.max_jerk_m_s3,
        )

    @property
    def servo(self) -> tuple[float, float, float, float, float]:
        """Armature, stiffness, damping, friction, effort limit of the simulated joint, SI."""
        d = _given(self.dynamics, self.name)
        return (
            d.armature_kg,
            d.stiffness_n_per_m,
            d.damping_n_s_per_m,
            d.friction_n,
            d.effort_n,
        )

    @property
    def offset(self) -> float:
        """Zero offset, m."""
        return self.offset_m


Joint = Annotated[RevoluteJoint | PrismaticJoint, Field(discriminator="type")]


class Jaw(Table):
    """The instrument's jaw. Closed is `grip_angle_rad`: negative squeezes."""

    lower_rad: float
    upper_rad: float
    grip_angle_rad: float
    finger_length_m: Positive
    effort_nm: NonNegative
    max_velocity_rad_s: Positive
    max_acceleration_rad_s2: Positive
    max_jerk_rad_s3: Positive

    @model_validator(mode="after")
    def _ordered(self) -> Jaw:
        if self.lower_rad >= self.upper_rad:
            raise ValueError(f"lower_rad {self.lower_rad} must be below upper_rad {self.upper_rad}")
        if not self.lower_rad <= self.grip_angle_rad <= self.upper_rad:
            raise ValueError(
                f"grip_angle_rad {self.grip_angle_rad} must lie in the jaw's limits "
                f"[{self.lower_rad}, {self.upper_rad}]"
            )
        return self


def _proper(rows: tuple[Vector3, ...]) -> tuple[Vector3, ...]:
    R = np.array(rows)
    if abs(R @ R.T - np.eye(3)).max() > 1e-9 or np.linalg.det(R) < 0:
        raise ValueError("tip_rotation must be a proper rotation matrix")
    return rows


class Shape(Table):
    """How thick an instrument is. A file need not say it: these are the 8 mm instruments.

    Attributes:
        shaft_radius_m: of the tube; with its rounded end it reaches to the wrist's first axis.
        wrist_radius_m: of the link from there to the jaw's pivot.
        jaw_radius_m: of the closed jaw.
    """

    shaft_radius_m: Positive = 0.0042
    wrist_radius_m: Positive = 0.0025
    jaw_radius_m: Positive = 0.0017


class GateThresholds(Table):
    """Thresholds of the gate that belong to the arm; `safety` holds the ceilings above them."""

    position_margin_rad: NonNegative
    position_margin_m: NonNegative
    measured_slack: NonNegative
    first_command_rad: Positive
    first_command_m: Positive
    insertion_past_rcm_m: Positive
    port_warn_m: Positive
    port_stop_m: Positive
    feedback_period_s: Positive
    tracking_rad: Positive
    tracking_m: Positive
    tracking_wrist_rad: Positive
    tracking_s: Positive
    singular_value_slow_m: Positive
    singular_value_hold_m: Positive
    ik_residual_m: Positive


class Instrument(Table):
    """A straight instrument on the flange of an arm that has no remote centre by mechanism.

    Attributes:
        shaft_length_m: of the tube, from where it may touch a port to the jaw's pivot.
        tip_position_m: the jaw's pivot in the last joint's frame.
        tip_rotation: from the last joint's frame to the tip, whose z runs along the shaft.
    """

    name: str
    shaft_length_m: Positive
    tip_position_m: Vector3
    tip_rotation: tuple[Vector3, Vector3, Vector3]
    jaw: Jaw
    shape: Shape = Shape()

    @field_validator("tip_rotation")
    @classmethod
    def _proper_rotation(cls, rows: tuple[Vector3, ...]) -> tuple[Vector3, ...]:
        return _proper(rows)


class RobotFile(Table):
    """`robots/<name>.toml`: the part of an arm that stays when the instrument changes.

    An arm of a lab's own (`generation = "own"`) has no remote centre by mechanism: software keeps
    its instrument in the port. Its file holds the instrument too.
    """

    schema_version: Literal[1] = Field(alias="schema")
    name: str
    generation: Literal["Classic", "Si", "own"]
    joint: tuple[Joint, ...]
    gate: GateThresholds
    instrument: Instrument | None = None

    @model_validator(mode="after")
    def _whole(self) -> RobotFile:
        if (self.instrument is not None) != (self.generation == "own"):
            raise ValueError(
                'an [instrument] belongs to an arm of generation "own", and to no other'
            )
        if self.generation == "own" and len(self.joint) < 6:
            raise ValueError("an arm that keeps its port by software needs six joints or more")
        return self


class ToolFile(Table):
    """`robots/tools/<name>.toml`: an instrument."""

    schema_version: Literal[1] = Field(alias="schema")
    name: str
    generation: Literal["Classic", "Si"]
    joint: tuple[Joint, ...]
    tip_rotation: tuple[Vector3, Vector3, Vector3]
    jaw: Jaw
    shape: Shape = Shape()
    actuator_to_joint: tuple[tuple[float, float, float, float], ...]

    @model_validator(mode="after")
    def _proper_rotation(self) -> ToolFile:
        _proper(self.tip_rotation)
        if abs(np.linalg.det(np.array(self.actuator_to_joint))) < 1e-9:
            raise ValueError("actuator_to_joint must be a 4x4 matrix with an inverse")
        return self


T = TypeVar("T", bound=Table)


def read_toml(path: Path, schema: type[T]) -> T:
    """A validated data file.

    Raises:
        DataFileError: names file, key and reason.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DataFileError(path, "", f"cannot be read as TOML ({error}); correct it") from error
    return validated(path, schema, content)


def validated(path: Path, schema: type[T], content: dict[str, Any]) -> T:
    """`content` as an instance of `schema`; refuses with file, key and reason."""
    try:
        return schema.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        reason = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            reason = "unknown key; check its spelling and that its unit stands in it"
        elif first["type"] == "missing":
            reason = "missing; a number needs its unit in the key, such as lower_rad"
        raise DataFileError(path, key, reason) from error
