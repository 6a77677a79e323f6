"""The schema of a truth file: a hidden robot, which is not as the cell's files say.

Nobody on a real robot has such a file. The simulated cell takes one to be such a robot, so that a
calibration can be held against what it should have found.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.robot_files import NonNegative, Table, Vector3, validated

SIZES = {"base_rotation_rad": 3, "base_translation_m": 3, "joint_offset": 6}
"""How many numbers an arm's errors have; its cables have 3, and 3 by 3."""

Part = Annotated[float, Field(ge=0.0, lt=1.0)]


class TruthFile(Table):
    """A hidden robot.

    Attributes:
        cell: whose arms it has.
        arms: what each of them is, beside its file.
        joint_noise_rad, joint_noise_m: standard deviation of measured angles and insertions.
        command_delay_s: between a setpoint and its effect.
        board_translation_m, board_rotation_rad: where the board really is in the task frame, in
            which arms and tracker are registered: its origin, and a rotation vector.
        object_error_m: standard deviations, along the axes, of how far from its place a thing is
            seen; drawn whenever things are put down.
        object_error_rad: the same of a turn about the vertical.
        object_noise_m: standard deviation of a coordinate of a thing from one look to the next.
        tracker_noise_m: standard deviation of a coordinate of a tip that a tracker sees.
        tracker_point_m: how far beyond the jaw pivot, along the tip, what the tracker sees is.
        outlier_share: part of those points that are wrong by centimetres.
        outlier_m: standard deviation of a coordinate of these.
    """

    schema_version: Literal[1] = Field(alias="schema")
    cell: str
    arms: dict[str, ArmErrors] = Field(min_length=1)
    joint_noise_rad: NonNegative = 0.0
    joint_noise_m: NonNegative = 0.0
    command_delay_s: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    board_translation_m: Vector3 = (0.0, 0.0, 0.0)
    board_rotation_rad: Vector3 = (0.0, 0.0, 0.0)
    object_error_m: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)
    object_error_rad: NonNegative = 0.0
    object_noise_m: NonNegative = 0.0
    tracker_noise_m: NonNegative = 0.0
    tracker_point_m: NonNegative = 0.0
    outlier_share: Part = 0.0
    outlier_m: NonNegative = 0.02

    @field_validator("arms")
    @classmethod
    def _have_their_numbers(cls, arms: dict[str, ArmErrors]) -> dict[str, ArmErrors]:
        for name, errors in arms.items():
            cables = errors.cables
            sizes = {key: len(getattr(errors, key)) for key in SIZES}
            if sizes != SIZES or len(cables.backlash_rad) != 3:
                raise ValueError(f"{name} has {sizes} numbers; it needs {SIZES}, cables 3")
            if [len(row) for row in cables.coupling] != [3, 3, 3]:
                raise ValueError(f"{name}: the coupling of its cables is 3 by 3")
            if min(cables.backlash_rad) < 0.0 or errors.delay_s < 0.0:
                raise ValueError(f"{name}: neither play nor delay is negative")
        return arms

    def errors(self, cell: CellDescription) -> tuple[ArmErrors, ...]:
        """What every arm of a cell is, in the cell's order."""
        return tuple(self.arms[arm.name] for arm in cell.arms)

    def text(self) -> str:
        """The file's text."""
        return json.dumps(self.model_dump(mode="json", by_alias=True), indent=2) + "\n"


def read_truth(path: Path, cell: CellDescription) -> TruthFile:
    """The hidden robot in a file.

    Raises:
        DataFileError: it cannot be read, is wrong, or is another cell's; names the key.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataFileError(
            path, "", f"cannot be read as JSON ({error}); write one with `viskill calibrate truth`"
        ) from error
    truth = validated(path, TruthFile, content)
    names = [arm.name for arm in cell.arms]
    if truth.cell != cell.name or sorted(truth.arms) != sorted(names):
        raise DataFileError(
            path,
            "cell",
            f"is {truth.cell!r} with {', '.join(truth.arms)}; this cell is {cell.name!r} with "
            f"{', '.join(names)}",
        )
    return truth
