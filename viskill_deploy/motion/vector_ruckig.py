"""Ruckig asked for many arms, one after the other; its answers read as paths in pieces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ruckig

from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.limits import PlanLimits
from viskill_deploy.motion.smoothing import AXES
from viskill_deploy.motion.vector_paths import PHASES, Motions, Paths

BRAKE_PHASES = 2
PROFILE_PHASES = PHASES - BRAKE_PHASES
NO_PHASES = [[0.0] * PROFILE_PHASES] * AXES
NO_EXTREMA = [(0.0, 0.0)] * AXES


@dataclass(frozen=True, slots=True)
class Answers:
    """What Ruckig answers for every arm of every environment.

    Attributes:
        paths: the motions.
        duration: of each, (N, arms) s; NaN where there is none.
        low: lowest position as Ruckig says it, (N, arms, 7).
        high: highest position likewise.
    """

    paths: Paths
    duration: FloatArray
    low: FloatArray
    high: FloatArray


class Ruckigs:
    """Ruckig for every arm of a cell, its objects kept from call to call.

    Args:
        limits: of the arms.
    """

    def __init__(self, limits: Sequence[PlanLimits]) -> None:
        self._ruckig, self._trajectory = ruckig.Ruckig(AXES), ruckig.Trajectory(AXES)
        self._requests = [_request(of_arm) for of_arm in limits]

    def calculate(
        self, start: Motions, target: FloatArray, end_velocity: FloatArray, minimum_s: FloatArray
    ) -> Answers:
        """The motions of each arm on its own.

        Args:
            start: present states inside the limits.
            target: positions at the end, (N, arms, 7).
            end_velocity: velocities at the end, (N, arms, 7).
            minimum_s: the least that each environment's motions shall take, (N,) s.
        """
        durations: list[float] = []
        lengths, jerks, extrema = [], [], []
        brakes: list[tuple[int, list[Any]]] = []
        lists = [x.tolist() for x in (start.p, start.v, start.a, target, end_velocity)]
        for seconds, *rows in zip(minimum_s.tolist(), *lists, strict=True):
            for request, p, v, a, goal, w in zip(self._requests, *rows, strict=True):
                request.current_position, request.current_velocity = p, v
                request.current_acceleration = a
                request.target_position, request.target_velocity = goal, w
                request.minimum_duration = seconds
                if not self._solve(request):
                    durations.append(np.nan)
                    lengths.append(NO_PHASES)
                    jerks.append(NO_PHASES)
                    extrema.append(NO_EXTREMA)
                    continue
                profiles, duration = self._trajectory.profiles[0], self._trajectory.duration
                length = [profile.t for profile in profiles]
                if min(map(sum, length)) < duration - 1e-9:  # the rest is braking
                    brakes.append((len(durations), [profile.brake for profile in profiles]))
                durations.append(duration)
                lengths.append(length)
                jerks.append([profile.j for profile in profiles])
                extrema.append([(e.min, e.max) for e in self._trajectory.position_extrema])
        shape = start.p.shape
        length_of, jerk_of = (_phases(values, shape) for values in (lengths, jerks))
        for number, of_axes in brakes:
            place = (slice(BRAKE_PHASES), *divmod(number, shape[1]))
            length_of[place] = np.transpose([brake.t for brake in of_axes])
            jerk_of[place] = np.transpose([brake.j for brake in of_axes])
        low, high = np.moveaxis(np.array(extrema).reshape(*shape, 2), -1, 0)
        duration_of = np.array(durations).reshape(shape[:2])
        return Answers(Paths.integrated(start, length_of, jerk_of), duration_of, low, high)

    def _solve(self, request: Any) -> bool:
        try:
            self._ruckig.calculate(request, self._trajectory)
        except (ruckig.RuckigError, ValueError):
            return False
        return True


def _phases(values: list[list[list[float]]], shape: tuple[int, ...]) -> FloatArray:
    """Numbers of profiles by arm, axis and phase as (9, N, arms, 7), those of braking 0."""
    result = np.zeros((PHASES, *shape))
    result[BRAKE_PHASES:] = np.moveaxis(np.array(values).reshape(*shape, PROFILE_PHASES), -1, 0)
    return result


def _request(limits: PlanLimits) -> Any:
    request = ruckig.InputParameter(AXES)
    request.max_velocity = list(limits.velocity)
    request.max_acceleration = list(limits.acceleration)
    request.max_jerk = list(limits.jerk)
    return request
