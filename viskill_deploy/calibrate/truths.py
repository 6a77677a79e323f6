"""Hidden robots: errors of the sizes that the literature reports, drawn from a seed."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.cables import Cables
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.truth_files import TruthFile, read_truth
from viskill_deploy.sim.tracker import TrackerOptions
from viskill_deploy.sim.world import WorldOptions

BASE_M, BASE_RAD = 0.004, math.radians(1.0)
"""Standard deviations, an axis, of a base that was registered by hand; a set-up joint's
potentiometers alone are good to a centimetre."""

PITCH_RAD, WRIST_RAD = math.radians(0.5), math.radians(1.5)
"""Standard deviations of joint 2's and the wrist's zeros."""

INSERTION_M = 0.010
"""Joint 3 reads wrong by up to this, either way."""

BACKLASH_RAD, COUPLING = 0.02, 0.02
"""Play of a wrist joint, at most; stretch per angle, standard deviation: together a few mm of tip
error, as tendon-driven instruments have uncalibrated."""

DELAY_S = 0.04
"""Oldest that a tracker's point is when it gets its stamp."""


TOOL_M = 0.001
"""Standard deviation of the length of a shaft, beside its file."""

BOARD_M, BOARD_RAD = (0.0005, 0.0005, 0.0002), (0.002, 0.002, 0.005)
"""Standard deviations of the board's place: it is touched or seen from above, and flat."""

OBJECT_M, OBJECT_RAD = (0.0005, 0.0005, 0.0002), 0.03
"""Standard deviations of where a thing is seen: those of the scene file of docs/execute.md."""

ENCODER_RAD, ENCODER_M, LOOK_M = 2e-4, 2e-5, 2e-4
"""Noise: four times the resolution of a Classic's yaw encoder, 20 um of insertion, a tracker's."""

COMMAND_S = 0.008
"""Longest time between a setpoint and its effect."""

OUTLIER_SHARE = 0.05

MARKER_M = 0.010
"""What the tracker sees, beyond the jaw pivot: a ball that the closed jaw holds. A marker at the
pivot does not tell how the jaw is turned about it, which costs grasps."""


@dataclass(frozen=True, slots=True)
class HiddenRobot:
    """A hidden robot, and what a result says of where it came from.

    Attributes:
        truth: what it is.
        about: its seed, or its file and that file's SHA-256; ready for JSON.
    """

    truth: TruthFile
    about: dict[str, Any]

    def world(self, cell: CellDescription, options: WorldOptions) -> WorldOptions:
        """Options of a simulated cell that is this robot; what else they ask for stays."""
        truth = self.truth
        return replace(
            options,
            truth=truth.errors(cell),
            joint_noise_rad=max(options.joint_noise_rad, truth.joint_noise_rad),
            joint_noise_m=max(options.joint_noise_m, truth.joint_noise_m),
            object_noise_m=max(options.object_noise_m, truth.object_noise_m),
            delay_periods=options.delay_periods + round(truth.command_delay_s / options.period_s),
            board_translation_m=truth.board_translation_m,
            board_rotation_rad=truth.board_rotation_rad,
            object_error_m=truth.object_error_m,
            object_error_rad=truth.object_error_rad,
        )

    def tracker(self, cell: CellDescription) -> TrackerOptions:
        """The tracker that sees its tips."""
        truth = self.truth
        delays = tuple(errors.delay_s for errors in truth.errors(cell))
        return TrackerOptions(
            truth.tracker_noise_m,
            truth.outlier_share,
            truth.outlier_m,
            delays,
            truth.tracker_point_m,
        )


def hidden_robot(text: str, cell: CellDescription) -> HiddenRobot:
    """The robot that `--truth` names: a seed to draw it from, or a file.

    Raises:
        DataFileError: the file is wrong, or of another cell.
    """
    if text.isdecimal():
        return HiddenRobot(draw_robot(cell, int(text)), {"seed": int(text)})
    path = Path(text)
    truth = read_truth(path, cell)
    return HiddenRobot(
        truth, {"file": text, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    )


def draw_robot(cell: CellDescription, seed: int) -> TruthFile:
    """A whole hidden robot: its arms, its board, and how well it is seen."""
    dice, more = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1])
    arms = {arm.name: draw_truth(dice) for arm in cell.arms}
    for name, errors in arms.items():
        arms[name] = replace(errors, tool_length_m=float(more.normal(0.0, TOOL_M)))
    content = {
        "schema": 1,
        "cell": cell.name,
        "arms": arms,
        "joint_noise_rad": ENCODER_RAD,
        "joint_noise_m": ENCODER_M,
        "command_delay_s": float(more.uniform(0.0, COMMAND_S)),
        "board_translation_m": tuple(more.normal(0.0, BOARD_M).tolist()),
        "board_rotation_rad": tuple(more.normal(0.0, BOARD_RAD).tolist()),
        "object_error_m": OBJECT_M,
        "object_error_rad": OBJECT_RAD,
        "object_noise_m": LOOK_M,
        "tracker_noise_m": LOOK_M,
        "tracker_point_m": MARKER_M,
        "outlier_share": OUTLIER_SHARE,
    }
    return TruthFile.model_validate(content)


def scaled(truth: TruthFile, part: float) -> TruthFile:
    """A robot with this part of another one's errors, noises and delays; its marker stays."""

    def times(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: times(each) for key, each in value.items()}
        if isinstance(value, list):
            return [times(each) for each in value]
        return part * value if isinstance(value, float) else value

    content = times(truth.model_dump(mode="json", by_alias=True))
    return TruthFile.model_validate(content | {"tracker_point_m": truth.tracker_point_m})


def draw_truth(rng: np.random.Generator) -> ArmErrors:
    """What one arm might really be.

    Joint 1's offset is part of the base's rotation, and a longer shaft part of joint 3's offset:
    no tip position tells them apart, so they are not drawn here.
    """
    wrist = rng.normal(0.0, WRIST_RAD, 3).tolist()
    insertion = float(rng.uniform(-INSERTION_M, INSERTION_M))
    return ArmErrors(
        base_rotation_rad=tuple(rng.normal(0.0, BASE_RAD, 3).tolist()),
        base_translation_m=tuple(rng.normal(0.0, BASE_M, 3).tolist()),
        joint_offset=(0.0, float(rng.normal(0.0, PITCH_RAD)), insertion, *wrist),
        cables=Cables(
            tuple(rng.uniform(0.0, BACKLASH_RAD, 3).tolist()),
            tuple(tuple(row) for row in rng.normal(0.0, COUPLING, (3, 3)).tolist()),
        ),
        delay_s=float(rng.uniform(0.0, DELAY_S)),
    )
