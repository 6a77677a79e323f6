"""How well calibration finds hidden robots: measured on many, drawn from seeds."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from viskill_deploy.calibrate.collect import LOT, MOVING_EVERY, collect
from viskill_deploy.calibrate.error_model import ErrorModel
from viskill_deploy.calibrate.fit import fit_arm
from viskill_deploy.calibrate.landmarks import Landmark, board_landmarks, choose_landmarks
from viskill_deploy.calibrate.measurements import Measurements, load
from viskill_deploy.calibrate.parameters import (
    BASE_ROTATION,
    BASE_TRANSLATION,
    DELAY,
    INSERTION,
    NAMES,
    vector_of,
)
from viskill_deploy.calibrate.programme import choose_poses
from viskill_deploy.calibrate.simulated_hand import HandOptions, SimulatedHand
from viskill_deploy.calibrate.touching import touch
from viskill_deploy.calibrate.truths import ENCODER_M, ENCODER_RAD, MARKER_M, draw_truth
from viskill_deploy.core.arm_errors import ArmErrors, rotation
from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.record import Recorder
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.tracker import SimulatedTracker, TrackerOptions
from viskill_deploy.sim.world import WorldOptions

WAYS = ("tracker", "touch")
"""How arms are measured."""

CALIBRATING = WorldOptions(period_s=0.01, joint_noise_rad=ENCODER_RAD, joint_noise_m=ENCODER_M)
"""Poses are visited at 100 Hz: points at rest do not tell the difference, and it is quicker."""

HELD_OUT = 200
"""Poses of the same kind, not measured, at which a calibrated arm is held against the truth."""


@dataclass(frozen=True)
class Trial:
    """One arm of one hidden robot.

    Attributes:
        truth: what it really was, (27,).
        found: what was fitted, (27,).
        sigma: standard deviations, NaN where frozen, (27,).
        tip_errors_m: distances of the calibrated from the true tip at `HELD_OUT` poses.
        before_m: the same of the arm as its file has it.
        tip_turns_rad: angles between the calibrated and the true tip frame at these poses.
        samples: rows of measurements.
    """

    truth: FloatArray
    found: FloatArray
    sigma: FloatArray
    tip_errors_m: FloatArray
    before_m: FloatArray
    tip_turns_rad: FloatArray
    samples: int

    def row(self) -> dict[str, Any]:
        """Itself for JSON."""
        numbers = {name: getattr(self, name).tolist() for name in _ARRAYS}
        sigma = [None if math.isnan(s) else s for s in self.sigma.tolist()]
        return {**numbers, "sigma": sigma, "samples": self.samples}

    @classmethod
    def of(cls, row: dict[str, Any]) -> Trial:
        """From a row."""
        numbers = {name: np.array(row[name], dtype=np.float64) for name in (*_ARRAYS, "sigma")}
        return cls(**numbers, samples=int(row["samples"]))


_ARRAYS = ("truth", "found", "tip_errors_m", "before_m", "tip_turns_rad")


def poses_for(samples: int) -> int:
    """How many poses give so many rows at most: each at rest, some on the way too."""
    whole, rest = divmod(samples, LOT + math.ceil(LOT / MOVING_EVERY))
    return whole * LOT + max(n for n in range(LOT) if n + math.ceil(n / MOVING_EVERY) <= rest)


@dataclass(frozen=True)
class Study:
    """What is studied.

    Attributes:
        cell: nominal cell; the task of the same name gives the scene.
        seed: of truths, poses and noise.
        samples: rows of a tracker's measurements an arm.
        points: points that each arm touches instead.
        ways: which of `WAYS` are studied.
    """

    cell: CellDescription
    seed: int
    samples: int
    points: int
    ways: tuple[str, ...] = WAYS

    def truth(
        self,
        number: int,
        record: Callable[[Path, float], AbstractContextManager[Recorder]],
    ) -> dict[str, list[Trial]]:
        """Hides a robot, measures it in every way, fits it and compares.

        Args:
            number: of the truth.
            record: makes the session's recorder, given a folder and the control period.

        Returns:
            A trial an arm, by how it was measured.

        Raises:
            SafetyStop: the gate stepped in.
            CalibrationError: the measurements could not be fitted.
        """
        rng = np.random.default_rng([self.seed, number])
        truth = tuple(draw_truth(rng) for _ in self.cell.arms)
        fresh = [_unseen(self.cell, index, rng) for index in range(len(self.cell.arms))]
        found = dict[str, list[Trial]]()
        with tempfile.TemporaryDirectory(prefix="viskill-study-") as folder:
            for way in self.ways:
                points = Path(folder) / way
                if way == "tracker":
                    with_recorder = partial(record, Path(folder) / "recording")
                    self._track(number, truth, rng, points, with_recorder)
                else:
                    self._touch(number, truth, points)
                found[way] = [
                    _trial(arm, errors, load(points / f"{arm.name}.csv"), self.seed, unseen)
                    for arm, errors, unseen in zip(self.cell.arms, truth, fresh, strict=True)
                ]
        return found

    def _track(
        self,
        number: int,
        truth: tuple[ArmErrors, ...],
        rng: np.random.Generator,
        folder: Path,
        record: Callable[[float], AbstractContextManager[Recorder]],
    ) -> None:
        """The arms visit poses through the gate, a tracker sees their tips."""
        cell, dice = self.cell, self.seed + number
        count = poses_for(self.samples)
        chosen = [choose_poses(cell, index, count, dice) for index in range(len(cell.arms))]
        driver = LoopbackDriver(cell, replace(CALIBRATING, truth=truth), dice)
        driver.connect()
        task = load_task(cell.name)
        driver.reset(task.sample_layout(rng, task.distributions[0]))
        delays = tuple(errors.delay_s for errors in truth)
        options = TrackerOptions(delay_s=delays, point_m=MARKER_M)
        tracker = SimulatedTracker(driver.world, options, dice)
        with (
            record(driver.period_s) as recorder,
            Session(cell, driver, Line(cell, driver.period_s), recorder) as session,
        ):
            collect(session, tracker, np.stack(chosen, axis=1), folder, "study")

    def _touch(self, number: int, truth: tuple[ArmErrors, ...], folder: Path) -> None:
        """A person touches points of the board."""
        world = replace(CALIBRATING, truth=truth)
        hand = SimulatedHand(self.cell, world, HandOptions(), self.seed + number)
        touch(self.cell, hand, hand, self._marks, folder)

    @cached_property
    def _marks(self) -> list[tuple[Landmark, ...]]:
        marks = board_landmarks(self.cell)
        arms = range(len(self.cell.arms))
        return [choose_landmarks(self.cell, index, marks, self.points) for index in arms]


def _trial(
    arm: CellArm, truth: ArmErrors, measured: Measurements, seed: int, fresh: Measurements
) -> Trial:
    fit, model = fit_arm(arm, measured, seed), ErrorModel(arm)
    true = model.points(vector_of(truth), fresh)
    R_true, R_found = (model.rotations(v, fresh) for v in (vector_of(truth), fit.vector))
    return Trial(
        vector_of(truth),
        fit.vector,
        fit.sigma,
        np.linalg.norm(model.points(fit.vector, fresh) - true, axis=1),
        np.linalg.norm(model.points(np.zeros(len(NAMES)), fresh) - true, axis=1),
        np.array([_angle(*pair) for pair in zip(R_true, R_found, strict=True)]),
        len(fit.is_outlier),
    )


def _unseen(cell: CellDescription, index: int, rng: np.random.Generator) -> Measurements:
    q = choose_poses(cell, index, HELD_OUT, int(rng.integers(2**31)))
    turns = rng.choice([-1.0, 1.0], (HELD_OUT, 3))
    still = np.zeros((HELD_OUT, 6))
    return Measurements(np.arange(float(HELD_OUT)), q, still, turns, np.zeros((HELD_OUT, 3)))


def figures(trials: Sequence[Trial]) -> dict[str, Any]:
    """What a study came to, ready for JSON: median and 95th percentile of every error."""
    scores = np.concatenate([_scores(trial) for trial in trials])
    off = np.array([trial.found - trial.truth for trial in trials])
    spreads = {
        "tip_error": (np.concatenate([trial.tip_errors_m for trial in trials]), "m"),
        "tip_turn": (np.degrees(np.concatenate([trial.tip_turns_rad for trial in trials])), "deg"),
        "uncalibrated_tip_error": (np.concatenate([trial.before_m for trial in trials]), "m"),
        "insertion_offset_error": (np.abs(off[:, INSERTION]), "m"),
        "base_shift_error": (np.linalg.norm(off[:, BASE_TRANSLATION], axis=1), "m"),
        "base_turn_error": (np.array([_turn_error(trial) for trial in trials]), "deg"),
        "delay_error": (np.abs(off[:, DELAY]), "s"),
    }
    result: dict[str, Any] = {
        "arms": len(trials),
        "samples_median": float(np.median([trial.samples for trial in trials])),
        "within_2_sigma": float(np.mean(scores <= 2.0)),
    }
    for name, (values, unit) in spreads.items():
        result[f"{name}_median_{unit}"] = float(np.median(values))
        result[f"{name}_p95_{unit}"] = float(np.quantile(values, 0.95))
    return result


def _scores(trial: Trial) -> FloatArray:
    """How many sigmas each fitted parameter is off."""
    z = np.abs(trial.found - trial.truth) / trial.sigma
    return np.asarray(z[np.isfinite(z)])


def _turn_error(trial: Trial) -> float:
    """Angle between the fitted and the true base, degrees."""
    found, true = (rotation(tuple(v[BASE_ROTATION])) for v in (trial.found, trial.truth))
    return math.degrees(_angle(true, found))


def _angle(R_true: FloatArray, R_found: FloatArray) -> float:
    return float(np.linalg.norm(pin.log3(R_found.T @ R_true)))
