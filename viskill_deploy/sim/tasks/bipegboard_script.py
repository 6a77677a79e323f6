"""The scripted controller of BiPegBoard: a function of observation and subgoal, without memory.

Which phase a skill is in is read off what is seen: where the arms stand to the grasp frames and how
far the jaws are open. A jaw on the ring stands at about 0.25 rad, an open one at 0.7, an empty
closed one at 0. Every function works on one state or on many: arrays are (..., n).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.waypoints import PITCH_MODE_TILT_RAD, ActionSpec

BoolArray = npt.NDArray[np.bool_]

UP = np.array([0.0, 0.0, 1.0])
BACK = np.array([0.0, math.cos(PITCH_MODE_TILT_RAD), math.sin(PITCH_MODE_TILT_RAD)])
"""Where PSM1's tool comes from at a pitch of 0."""

LATE_M = 0.003
"""PSM2 brings the ring so near to the meeting place before PSM1 takes it."""
HOVER_M = 0.012
"""How far from a grasp frame an arm lines up before it goes there."""
LIFTED_M = 0.002
FREE_M = 0.012
"""So near to the end of the pull the ring is off its peg."""
ABOVE_PEG_M = 0.029
"""Height over its rest at which a flat ring passes over the top of a standing peg."""
RING_REACH_M = 0.0095
"""Outer radius of a ring: an upright one reaches this far below its centre."""
LOWERED_M = 0.006
"""Height above rest at which the ring is let go: 15 mm of the peg are in it."""
RETREAT_M = 0.031
"""Distance of PSM1's pivot from the ring's centre, along y, once it has let go."""
FLAT_RAD = math.pi / 2.1
"""PSM1's pitch with a ring that lies; short of the quarter turn, where its angles are undefined."""

GAIN = 0.75
STEP_M = 0.008
TURN_STEPS = (1.0, 0.57)
"""Largest turn a step, in units of the action, of PSM1's pitch and PSM2's yaw."""
OPEN, CLOSE = 0.5, -0.5

HELD_JAW_RAD = (0.12, 0.45)
OPEN_JAW_RAD = 0.55
ACROSS_M, SHORT_M, DEEP_M, AT_TURN_RAD = 0.0016, 0.0012, 0.0025, math.radians(5.0)
"""A jaw closes when it is so near to a grasp frame: across its way there, before it and beyond."""
SLACK_M = 0.0012
SIDEWAYS = np.array([1.0, 0.6, 0.6])
"""Along the ring a jaw may be farther from its frame than in x, in which it closes."""
HELD_M = 0.006
"""How far the ring may slip in a closing jaw and still count as held."""
FUNNEL = 4.0
"""An arm comes nearer by this much for each metre that it comes nearer to the axis."""


@dataclass(frozen=True, slots=True)
class Arm:
    """One arm as observed: EEF position (..., 3), the angle that it commands, jaw opening."""

    position: FloatArray
    angle: FloatArray
    jaw: FloatArray


@dataclass(frozen=True, slots=True)
class Seen:
    """The observation, taken apart.

    Attributes:
        arms: PSM1 and PSM2.
        ring: its centre, (..., 3).
        frames: positions of both grasp frames, (..., 3).
        pitch: of PSM1 if it held the ring without slip.
        yaw: of PSM2 if it did.
    """

    arms: tuple[Arm, Arm]
    ring: FloatArray
    frames: tuple[FloatArray, FloatArray]
    pitch: FloatArray
    yaw: FloatArray


@dataclass(frozen=True, slots=True)
class Move:
    """Where an arm shall go: position (..., 3), change of its angle, jaw."""

    target: FloatArray
    turn: FloatArray
    jaw: FloatArray


def read(obs: FloatArray) -> Seen:
    """The named parts of an observation (..., 35)."""
    arms = (
        Arm(obs[..., 0:3], obs[..., 4], obs[..., 6]),
        Arm(obs[..., 7:10], obs[..., 12], obs[..., 13]),
    )
    frames = (obs[..., 23:26], obs[..., 29:32])
    return Seen(arms, obs[..., 14:17], frames, -obs[..., 26], obs[..., 34] - math.pi / 2)


def act(skill: str, observation: FloatArray, subgoal: FloatArray, spec: ActionSpec) -> FloatArray:
    """The action (..., 10) of a skill."""
    seen = read(observation)
    moves = {"grasp": _grasp, "handover": _handover, "release": _release}[skill](seen, subgoal)
    units = (spec.pitch_rad, spec.rotation_rad)
    parts = [
        _action(arm, move, spec.displacement_m, unit, most)
        for arm, move, unit, most in zip(seen.arms, moves, units, TURN_STEPS, strict=True)
    ]
    return np.concatenate(parts, axis=-1)


def _action(arm: Arm, move: Move, unit_m: float, unit_rad: float, most: float) -> FloatArray:
    step = GAIN * (move.target - arm.position)
    length = _length(step)[..., None]
    step = step * np.minimum(1.0, STEP_M / np.maximum(length, STEP_M)) / unit_m
    turn = np.clip(GAIN * move.turn / unit_rad, -most, most)
    return np.concatenate([step, turn[..., None], move.jaw[..., None]], axis=-1)


def _grasp(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM2 takes the ring, lifts it and pulls it off its peg; PSM1 goes to wait, open."""
    psm1, psm2 = seen.arms
    waiting = _move(goal[..., 0:3], -psm1.angle, OPEN)
    end = goal[..., 3:6]
    pull = end - psm2.position
    is_free = pull[..., 0] < FREE_M
    is_lifted = pull[..., 2] < LIFTED_M
    lift = np.stack([psm2.position[..., 0], end[..., 1], end[..., 2]], axis=-1)
    off = _move(
        np.where((is_free | is_lifted)[..., None], end, lift), _turn(0.0, psm2.angle), CLOSE
    )
    take = _take(psm2, seen.frames[1], _turn(seen.yaw, psm2.angle), UP, np.zeros_like(psm2.jaw))
    return waiting, _where(_holds(psm2, seen.frames[1]), off, take)


def _handover(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM2 brings the ring, PSM1 takes it, PSM2 lets go, PSM1 carries it on."""
    psm1, psm2 = seen.arms
    meet, end = goal[..., 0:3], goal[..., 3:6]
    way = meet - psm2.position
    late = np.maximum(0.0, _length(way) - LATE_M)
    place = seen.frames[0] + np.where((late > 0.0)[..., None], way, 0.0)
    take = _take(psm1, place, _turn(seen.pitch, psm1.angle), BACK, late)
    is_taken = _holds(psm1, seen.frames[0])
    is_let_go = psm2.jaw > OPEN_JAW_RAD
    carry = _move(np.where(is_let_go[..., None], end, psm1.position), -psm1.angle, CLOSE)
    away = np.where((is_taken & ~is_let_go)[..., None], psm2.position, meet)
    bring = _move(away, _turn(0.0, psm2.angle), np.where(is_taken | is_let_go, OPEN, CLOSE))
    return _where(is_taken, carry, take), bring


def _release(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM1 lays the ring over its peg, lowers it, lets go and draws back."""
    psm1, _ = seen.arms
    to_goal = goal[..., 3:6] - seen.ring
    off_axis = _length(to_goal[..., :2])
    turn = np.clip(FLAT_RAD - seen.pitch, -np.inf, math.pi / 2 - psm1.angle)
    upright = np.clip(np.cos(seen.pitch), 0.0, 1.0)
    over = ABOVE_PEG_M + RING_REACH_M * upright
    tilted = np.maximum(0.0, np.abs(FLAT_RAD - seen.pitch) - 2 * AT_TURN_RAD)
    spread = np.maximum(0.0, off_axis - 0.0015) + 0.02 * tilted
    target = psm1.position + to_goal
    target[..., 2] += np.minimum(over, LOWERED_M + FUNNEL * spread)
    is_open = psm1.jaw > OPEN_JAW_RAD
    is_low = (off_axis < 0.004) & (-to_goal[..., 2] < LOWERED_M + 0.0015)
    back = psm1.position.copy()
    back[..., 1] = np.where(is_open, seen.ring[..., 1] + RETREAT_M, psm1.position[..., 1])
    lower, leave = _move(target, turn, CLOSE), _move(back, 0.0 * turn, OPEN)
    return _where(is_low | is_open, leave, lower), _move(goal[..., 0:3], 0.0 * turn, OPEN)


def _take(
    arm: Arm, frame: FloatArray, turn: FloatArray, axis: FloatArray, wait: FloatArray
) -> Move:
    """Along `axis` down a funnel onto a grasp frame, then close.

    `wait` (m) keeps the arm up in the funnel, and so does a jaw that is not open yet.
    """
    to_frame = frame - arm.position
    along = to_frame @ axis
    off_axis = _length((to_frame - along[..., None] * axis) * SIDEWAYS)
    is_there = (off_axis < ACROSS_M) & (along > -SHORT_M) & (along < DEEP_M)
    is_there &= (np.abs(turn) < AT_TURN_RAD) & (wait == 0.0)
    off_turn = np.maximum(0.0, np.abs(turn) - AT_TURN_RAD)
    shut = np.where(arm.jaw < OPEN_JAW_RAD, HOVER_M, 0.0)
    spread = np.maximum(0.0, off_axis - SLACK_M) + 0.02 * off_turn + wait + shut
    hover = np.where(is_there, 0.0, np.minimum(HOVER_M, FUNNEL * spread))
    return _move(frame + hover[..., None] * axis, turn, np.where(is_there, CLOSE, OPEN))


def _holds(arm: Arm, frame: FloatArray) -> BoolArray:
    """Whether a jaw is closed on the ring at a grasp frame."""
    low, high = HELD_JAW_RAD
    near = _length(arm.position - frame) < HELD_M
    held: BoolArray = (low < arm.jaw) & (arm.jaw < high) & near
    return held


def _turn(wanted: float | FloatArray, angle: FloatArray) -> FloatArray:
    """Smallest turn that lines a jaw up with the ring, which looks the same turned by pi."""
    turn: FloatArray = np.remainder(wanted - angle + math.pi / 2, math.pi) - math.pi / 2
    return turn


def _move(target: FloatArray, turn: FloatArray, jaw: float | FloatArray) -> Move:
    return Move(target, turn, np.broadcast_to(jaw, turn.shape))


def _where(condition: BoolArray, a: Move, b: Move) -> Move:
    return Move(
        np.where(condition[..., None], a.target, b.target),
        np.where(condition, a.turn, b.turn),
        np.where(condition, a.jaw, b.jaw),
    )


def _length(vector: FloatArray) -> FloatArray:
    length: FloatArray = np.sqrt((vector**2).sum(axis=-1))
    return length
