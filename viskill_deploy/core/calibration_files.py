"""The schema of the files in `calibration/`, and what they change in a cell.

A calibration says where the arms of one real cell stand. It belongs to these arms, by serial
number, and to the instruments in them. It carries its own digest (`core.sealed`), so that it is
used as it was written or not at all. `safety.calibration` says when it is too old or too coarse.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AwareDatetime, Field, ValidationError, field_validator, model_validator

from viskill_deploy.core.arm_errors import ArmErrors, shifted
from viskill_deploy.core.cables import Cables
from viskill_deploy.core.cell_files import SIMULATED
from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.robot_files import NonNegative, Table, Vector3
from viskill_deploy.core.sealed import read_sealed, sealed

MAX_BYTES = 2**20

ORTHONORMAL = 1e-6
"""Largest error of an entry of R R^T: nine printed digits leave less, a typing error more."""

AGAIN = "calibrate the cell again"

Row = tuple[float, float, float, float]
Three = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]


class ArmCalibration(Table):
    """One arm, as it was registered to the task frame.

    Attributes:
        serial: number of the arm, as in the cell's file.
        tool: the instrument that was in it.
        T_task_base: pose of its base (its RCM frame) in the task frame, m.
        port_in_base_m: registered port; that of the cell's file when it is not given.
        joint_offset: true minus reported joints, (6,), rad and m.
        tool_length_m: true minus nominal length of the instrument's shaft.
        backlash_rad, coupling: play and stretch of the wrist's cables, see `core.cables`.
        delay_s: how much older its joints are than the measured points' stamps say.
        sigma: standard deviation of what was fitted, by name.
        residual_rms_m: root mean square distance of the held-out points after the fit.
        samples: how many points were measured.
    """

    name: str
    robot: str
    serial: str
    tool: str
    T_task_base: tuple[Row, Row, Row, Row]
    port_in_base_m: Vector3 | None = None
    joint_offset: Six = (0.0,) * 6
    tool_length_m: float = 0.0
    backlash_rad: Three = (0.0,) * 3
    coupling: tuple[Three, Three, Three] = ((0.0,) * 3,) * 3
    delay_s: float = 0.0
    sigma: dict[str, NonNegative] = Field(default_factory=dict)
    residual_rms_m: NonNegative
    samples: int = Field(gt=0)

    @field_validator("T_task_base")
    @classmethod
    def _is_pose(cls, rows: tuple[Row, ...]) -> tuple[Row, ...]:
        T = np.array(rows)
        R = T[:3, :3]
        off = float(abs(R @ R.T - np.eye(3)).max())
        if off > ORTHONORMAL or np.linalg.det(R) < 0.0:
            raise ValueError(f"the rotation is not orthonormal and right-handed (off by {off:.2g})")
        if T[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            raise ValueError("the last row of a pose is 0 0 0 1")
        return rows


class CalibrationFile(Table):
    """`calibration/<cell>.json`.

    Attributes:
        created: when its data were taken, with time zone.
        method: how, for people.
        data_sha256: of the file of measurements that it was fitted to.
        simulated: it is about simulated arms, which are tomorrow what they are today: it does not
            age. Refused where an arm has a serial number.
    """

    schema_version: Literal[1] = Field(alias="schema")
    cell: str
    created: AwareDatetime
    method: str
    arms: tuple[ArmCalibration, ...] = Field(min_length=1)
    data_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    simulated: bool = False
    digest: str = ""

    @model_validator(mode="after")
    def _is_of_simulated_arms(self) -> CalibrationFile:
        real = [arm.name for arm in self.arms if arm.serial != SIMULATED]
        if self.simulated and real:
            raise ValueError(f"simulated, but {', '.join(real)} has a serial number")
        return self


def read_calibration(path: Path) -> CalibrationFile:
    """A calibration as it was written.

    Raises:
        CalibrationError: it is missing, was changed, or has another schema; names the entry.
    """
    try:
        return CalibrationFile.model_validate(read_sealed(path, MAX_BYTES))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        reason = first["msg"].removeprefix("Value error, ")
        raise CalibrationError(f"{path}: {key}: {reason}; {AGAIN}") from error
    except OSError as error:
        raise CalibrationError(
            f"{path}: cannot be read ({error.strerror}); name a calibration file"
        ) from error
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}; {AGAIN}, or copy the file again") from error


def write_calibration(path: Path, calibration: CalibrationFile) -> Path:
    """Writes a calibration with its digest; returns its path."""
    content = calibration.model_dump(mode="json", by_alias=True)
    path.write_text(sealed(content), encoding="utf-8")
    return path


def calibrated(cell: CellDescription, calibration: CalibrationFile, path: Path) -> CellDescription:
    """The cell with its arms, and their ports, as the calibration says.

    Raises:
        CalibrationError: it was made for another cell, or other arms or instruments; names them.
    """
    if calibration.cell != cell.name:
        raise CalibrationError(
            f"{path}: was made for cell {calibration.cell!r}, not {cell.name!r}; use that cell's"
        )
    made_for = [(a.name, a.robot, a.serial, a.tool) for a in calibration.arms]
    present = [(a.name, a.entry.robot, a.entry.serial, a.entry.tool) for a in cell.arms]
    if made_for != present:
        raise CalibrationError(
            f"{path}: was made for {_arms(made_for)}; the cell holds {_arms(present)}; {AGAIN}"
        )
    arms = tuple(
        _placed(arm, entry) for arm, entry in zip(cell.arms, calibration.arms, strict=True)
    )
    return replace(cell, arms=arms, files=(*cell.files, path), filed=cell)


def is_simulated(cell: CellDescription) -> bool:
    """Whether no arm of the cell is a real one, so that it needs no calibration."""
    return all(arm.entry.serial == SIMULATED for arm in cell.arms)


def insist_real(cell: CellDescription) -> None:
    """Refuses to let a cell of simulated arms stand in for a robot: what it says of it is nobody's.

    Raises:
        CalibrationError: its arms are simulated.
    """
    if is_simulated(cell):
        raise CalibrationError(
            f"{cell.files[0]}: its arms are simulated and the robot is real; name the robot's own "
            "cell, with the serial numbers of its arms, with --robot"
        )


def insist_simulated(cell: CellDescription) -> None:
    """Refuses to let simulated arms stand in for a cell whose arms have serial numbers.

    Raises:
        CalibrationError: it has real arms.
    """
    real = [arm.name for arm in cell.arms if arm.entry.serial != SIMULATED]
    if real:
        raise CalibrationError(
            f"{cell.files[0]}: {', '.join(real)} has a serial number, and simulated arms say "
            "nothing about it; name the robot with --driver, or take a cell without serial numbers"
        )


def _placed(arm: CellArm, measured: ArmCalibration) -> CellArm:
    T = np.array(measured.T_task_base)
    T.flags.writeable = False
    port = measured.port_in_base_m or arm.entry.port_in_base_m
    entry = arm.entry.model_copy(update={"port_in_base_m": port})
    errors = ArmErrors(joint_offset=measured.joint_offset, tool_length_m=measured.tool_length_m)
    return replace(
        arm,
        arm=shifted(arm.arm, errors),
        T_task_base=T,
        entry=entry,
        cables=Cables(measured.backlash_rad, measured.coupling),
    )


def _arms(arms: list[tuple[str, str, str, str]]) -> str:
    return ", ".join(f"{name} ({robot} {serial}, {tool})" for name, robot, serial, tool in arms)
