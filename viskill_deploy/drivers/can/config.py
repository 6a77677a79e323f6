"""The schema of `robots/can/<name>.toml`: which drives move which axes, and how fast they are told.

One bus an arm. Every number carries its unit in its key; the position of a drive is
`counts = sign * (actuator - offset) * counts_per_unit`. What an actuator is to the joints says the
coupling matrix in the instrument's own file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from viskill_deploy.core import data
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import DataFileError, DriverError
from viskill_deploy.core.robot_files import Positive, Table, read_toml
from viskill_deploy.core.types import PSM_JOINTS
from viskill_deploy.drivers.can.coupling import WIDER, actuator_ranges
from viskill_deploy.drivers.can.load import BusTraffic, check_load

AXES = (*PSM_JOINTS, "jaw")
"""Axes of an arm in order; the last four drive the instrument through its coupling."""

INT32 = 2**31
Interface = Literal["virtual", "udp_multicast", "socketcan"]
NodeId = Annotated[int, Field(ge=1, le=127)]


class _Axis(Table):
    joint: str
    node_id: NodeId
    sign: Literal[1, -1]
    following_s: Positive
    torque_permille: Annotated[int, Field(ge=1, le=1000)]


class RotaryAxis(_Axis):
    """A drive that turns. `torque_permille`: at most this part of its rated torque."""

    type: Literal["rotary"]
    counts_per_rad: Positive
    offset_rad: float
    lower_rad: float
    upper_rad: float
    following_rad: Positive
    speed_rad_s: Positive
    quick_stop_rad_s2: Positive

    @property
    def scale(self) -> float:
        """Counts per rad."""
        return self.counts_per_rad

    @property
    def offset(self) -> float:
        """Actuator position at 0 counts, rad."""
        return self.offset_rad

    @property
    def limits(self) -> tuple[float, float]:
        """Of the actuator, rad."""
        return self.lower_rad, self.upper_rad

    @property
    def following(self) -> float:
        """Following error at which the drive gives up, rad."""
        return self.following_rad

    @property
    def speed(self) -> float:
        """Speed that the drive never exceeds, rad/s."""
        return self.speed_rad_s

    @property
    def quick_stop(self) -> float:
        """Deceleration of the quick stop, rad/s²."""
        return self.quick_stop_rad_s2


class LinearAxis(_Axis):
    """A drive that slides."""

    type: Literal["linear"]
    counts_per_m: Positive
    offset_m: float
    lower_m: float
    upper_m: float
    following_m: Positive
    speed_m_s: Positive
    quick_stop_m_s2: Positive

    @property
    def scale(self) -> float:
        """Counts per m."""
        return self.counts_per_m

    @property
    def offset(self) -> float:
        """Actuator position at 0 counts, m."""
        return self.offset_m

    @property
    def limits(self) -> tuple[float, float]:
        """Of the actuator, m."""
        return self.lower_m, self.upper_m

    @property
    def following(self) -> float:
        """Following error at which the drive gives up, m."""
        return self.following_m

    @property
    def speed(self) -> float:
        """Speed that the drive never exceeds, m/s."""
        return self.speed_m_s

    @property
    def quick_stop(self) -> float:
        """Deceleration of the quick stop, m/s²."""
        return self.quick_stop_m_s2


Axis = Annotated[RotaryAxis | LinearAxis, Field(discriminator="type")]


class Bus(Table):
    """One bus, one arm. With `data_bitrate_bit_s` the cyclic frames are CAN FD."""

    arm: str
    channel: str
    bitrate_bit_s: Annotated[int, Field(ge=10_000, le=1_000_000)]
    data_bitrate_bit_s: Annotated[int, Field(ge=1_000_000, le=8_000_000)] | None = None
    axis: tuple[Axis, ...]

    @model_validator(mode="after")
    def _complete(self) -> Bus:
        if tuple(axis.joint for axis in self.axis) != AXES:
            raise ValueError(f"axis tables must be {', '.join(AXES)}, in this order")
        if [axis.type for axis in self.axis] != ["rotary"] * 2 + ["linear"] + ["rotary"] * 4:
            raise ValueError("the insertion is linear, all other axes are rotary")
        for axis in self.axis:
            lower, upper = axis.limits
            if lower >= upper:
                raise ValueError(f"{axis.joint}: the lower limit must be below the upper one")
            if max(abs(x - axis.offset) for x in axis.limits) * axis.scale >= INT32:
                raise ValueError(
                    f"{axis.joint}: its limits do not fit into 32 bits of counts; use fewer counts"
                )
        return self


class Input(Table):
    """A node that says consent and emergency stop; see docs/can.md for its frame."""

    bus: str
    node_id: NodeId


class CanFile(Table):
    """`robots/can/<name>.toml`.

    Attributes:
        heartbeat_s: period of everybody's heartbeat; three lost ones are a lost node.
        watchdog_s: a drive that hears no SYNC or no target for this long stops by itself.
        sync_window_s: how far from its time a SYNC may come before it is counted as late.
        master_node_id: node id under which this computer sends its heartbeat.
    """

    schema_version: Literal[1] = Field(alias="schema")
    name: str
    cell: str
    interface: Interface
    cycle_hz: Annotated[float, Field(ge=100, le=1000)]
    heartbeat_s: Annotated[float, Field(ge=0.01, le=0.5)]
    watchdog_s: Annotated[float, Field(ge=0.005, le=0.05)]
    sync_window_s: Positive
    master_node_id: NodeId
    bus: tuple[Bus, ...]
    input: Input

    @model_validator(mode="after")
    def _consistent(self) -> CanFile:
        arms = [bus.arm for bus in self.bus]
        if self.input.bus not in arms:
            raise ValueError(f"input.bus {self.input.bus!r} is no bus; there are {arms}")
        if len({bus.channel for bus in self.bus}) != len(self.bus):
            raise ValueError("two buses have one channel; every arm needs a bus of its own")
        for bus in self.bus:
            ids = [axis.node_id for axis in bus.axis] + [self.master_node_id]
            ids += [self.input.node_id] if bus.arm == self.input.bus else []
            twice = sorted({i for i in ids if ids.count(i) > 1})
            if twice:
                raise ValueError(f"bus of {bus.arm}: node id {twice[0]} is used twice")
            try:
                check_load(bus.arm, self.traffic(bus, 1.0 / self.cycle_hz))
            except DriverError as error:
                raise ValueError(str(error)) from error
        return self

    def traffic(self, bus: Bus, period_s: float) -> BusTraffic:
        """What goes over a bus at a control period."""
        nodes = len(bus.axis) + 1 + (bus.arm == self.input.bus)
        return BusTraffic(
            axes=len(bus.axis),
            period_s=period_s,
            heartbeats_s=self.heartbeat_s / nodes,
            inputs_s=INPUT_PERIOD_S if bus.arm == self.input.bus else None,
            bitrate_bit_s=bus.bitrate_bit_s,
            data_bitrate_bit_s=bus.data_bitrate_bit_s,
        )


INPUT_PERIOD_S = 0.02
"""An input node repeats its word 50 times a second."""


def load_can(name: str, cell: CellDescription, interface: Interface | None = None) -> CanFile:
    """A CAN file, held against its cell.

    Args:
        name: `robots/can/<name>.toml`, or the path of a TOML file.
        cell: the cell that it is for.
        interface: what the buses are, if not what the file says.

    Raises:
        DataFileError: the file is wrong or does not fit the cell.
    """
    path = _path(name)
    file = read_toml(path, CanFile)
    _hold_against(path, file, cell)
    return file.model_copy(update={"interface": interface}) if interface else file


def load_with_cell(
    name: str, interface: Interface | None = None, robot: str = ""
) -> tuple[CanFile, CellDescription]:
    """A CAN file and its cell: the one that it names, or the one in the file `robot`.

    Raises:
        DataFileError: either is wrong, or they do not fit.
    """
    cell = load_cell(robot or read_toml(_path(name), CanFile).cell)
    return load_can(name, cell, interface), cell


def _path(name: str) -> Path:
    return Path(name) if name.endswith(".toml") else data.find(f"robots/can/{name}.toml")


def _hold_against(path: Path, file: CanFile, cell: CellDescription) -> None:
    if file.cell != cell.name:
        raise DataFileError(path, "cell", f"is {file.cell!r}; this run is in {cell.name!r}")
    arms = [arm.name for arm in cell.arms]
    if [bus.arm for bus in file.bus] != arms:
        raise DataFileError(path, "bus", f"needs one bus for each of {', '.join(arms)}, in order")
    for bus, arm in zip(file.bus, cell.arms, strict=True):
        for axis, (low, high) in zip(bus.axis, actuator_ranges(arm.arm), strict=True):
            spare = WIDER * (high - low)
            lower, upper = axis.limits
            if lower < low - spare or upper > high + spare:
                raise DataFileError(
                    path,
                    f"bus.{bus.arm}.{axis.joint}",
                    f"limits {lower:.4g} to {upper:.4g} are wider than {arm.arm.tool} can use "
                    f"({low:.4g} to {high:.4g}); narrow them",
                )
