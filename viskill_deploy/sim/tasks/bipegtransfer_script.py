"""The scripted controller of BiPegTransfer: a function of observation and subgoal, without memory.

Which phase a skill is in is read off what is seen: where the arms stand to the grasp frames and how
far the jaws are open. A jaw on the block's wall stands at about 0.2 rad, an open one at 0.5, an
empty closed one at 0.

Works on one observation or on many at once: `...` stands for the leading dimensions. Both sides of
each decision are worked out, and `where` picks one for each observation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.waypoints import ActionSpec

Truth: TypeAlias = npt.NDArray[np.bool_]

GRASP_M = 0.0132
"""Height of the jaw pivot over the grasp frame when a jaw closes: fingers overlap 3.6 mm."""
TRAVEL_M = 0.043
"""Height of the pivot over a resting block's frame in travel: a held block clears the pegs."""
STEP_BACK_M = 0.015
LOWERED_M = 0.008
"""Height above rest at which the block is let go: its walls are 17 mm down the peg."""

GAIN = 0.75
STEP_M = 0.008
YAW_STEP_RAD = 0.3
OPEN, CLOSE = 0.5, -0.5

HELD_JAW_RAD = (0.05, 0.36)
OPEN_JAW_RAD = 0.42
AT_XY_M, AT_Z_M, AT_YAW_RAD = 0.0015, 0.0015, math.radians(4.0)
HELD_M = 0.004
"""How far a wall may slip in a closing jaw and still count as held."""
FUNNEL = 4.0
"""An arm comes down by this much for each metre that it comes nearer to the axis."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A place on the block where a jaw takes hold: position (..., 3) and the frame's yaw (...)."""

    position: FloatArray
    yaw: FloatArray


@dataclass(frozen=True, slots=True)
class Arm:
    """One arm as observed: EEF position (..., 3), yaw (...), jaw opening (...)."""

    position: FloatArray
    yaw: FloatArray
    jaw: FloatArray


@dataclass(frozen=True, slots=True)
class Seen:
    """The observation, taken apart."""

    arms: tuple[Arm, Arm]
    thing: FloatArray
    frames: tuple[Frame, Frame]


@dataclass(frozen=True, slots=True)
class Move:
    """Where an arm shall go: position (..., 3), change of yaw (...), jaw (...)."""

    target: FloatArray
    turn: FloatArray | float
    jaw: FloatArray | float


def read(obs: FloatArray) -> Seen:
    """The named parts of observations (..., 35)."""
    arms = (
        Arm(obs[..., 0:3], obs[..., 5], obs[..., 6]),
        Arm(obs[..., 7:10], obs[..., 12], obs[..., 13]),
    )
    frames = (Frame(obs[..., 23:26], obs[..., 28]), Frame(obs[..., 29:32], obs[..., 34]))
    return Seen(arms, obs[..., 14:17], frames)


def act(skill: str, observation: FloatArray, subgoal: FloatArray, spec: ActionSpec) -> FloatArray:
    """The actions (..., 10) of a skill."""
    seen = read(observation)
    moves = {"grasp": _grasp, "handover": _handover, "release": _release}[skill](seen, subgoal)
    action = np.empty((*observation.shape[:-1], 10))
    for index, (arm, move) in enumerate(zip(seen.arms, moves, strict=True)):
        _write(action[..., 5 * index : 5 * index + 5], arm, move, spec)
    return action


def _write(action: FloatArray, arm: Arm, move: Move, spec: ActionSpec) -> None:
    step = GAIN * (move.target - arm.position)
    shorter = STEP_M / np.maximum(_length(step), STEP_M)
    action[..., :3] = step * shorter[..., None] / spec.displacement_m
    turn = np.minimum(np.maximum(GAIN * move.turn, -YAW_STEP_RAD), YAW_STEP_RAD)
    action[..., 3], action[..., 4] = turn / spec.rotation_rad, move.jaw


def _grasp(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM2 takes the block and lifts it; PSM1 goes to the meeting place, open."""
    psm1, psm2 = seen.arms
    waiting = Move(goal[..., 0:3], _turn(psm1, seen.frames[0]), OPEN)
    held = _holds(psm2, seen.frames[1])
    lift = Move(goal[..., 3:6], 0.0, CLOSE)
    return waiting, _either(held, lift, _take(psm2, seen.frames[1], TRAVEL_M - GRASP_M, 0.0))


def _handover(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM2 brings the block, PSM1 takes it, PSM2 lets go and steps back, PSM1 carries it on."""
    psm1, psm2 = seen.arms
    frame1, frame2 = seen.frames
    away = goal[..., 0:3]
    meet = away - (0.0, 0.0, STEP_BACK_M)
    taken = _holds(psm1, frame1)
    held_twice = taken & (psm2.jaw < OPEN_JAW_RAD)
    clear = psm2.position[..., 2] - frame2.position[..., 2] - GRASP_M > 0.5 * STEP_BACK_M
    carry = _either(~held_twice & clear, Move(goal[..., 3:6], 0.0, CLOSE), _stay(psm1, CLOSE))
    leave = _either(held_twice, _stay(psm2, OPEN), Move(away, 0.0, OPEN))
    late = np.maximum(0.0, _length(psm2.position - meet) - 0.002)
    take, bring = _take(psm1, frame1, STEP_BACK_M, late), Move(meet, 0.0, CLOSE)
    return _either(taken, carry, take), _either(taken, leave, bring)


def _release(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM1 carries the block over its peg, lowers it onto the peg, lets go and rises."""
    psm1, frame1 = seen.arms[0], seen.frames[0]
    to_goal = goal[..., 3:6] - seen.thing
    off_axis = _length(to_goal[..., :2])
    low = (off_axis < 0.004) & (-to_goal[..., 2] < LOWERED_M + 0.0015)
    opened = psm1.jaw > OPEN_JAW_RAD
    rise = psm1.position.copy()
    rise[..., 2] = frame1.position[..., 2] + TRAVEL_M
    let_go = Move(np.where(opened[..., None], rise, psm1.position), 0.0, OPEN)
    down = psm1.position + to_goal
    height = LOWERED_M + FUNNEL * np.maximum(0.0, off_axis - 0.0015)
    down[..., 2] += np.minimum(height, TRAVEL_M - GRASP_M + 0.004)
    lower = Move(down, 0.0, CLOSE)
    return _either(low | opened, let_go, lower), Move(goal[..., 0:3], 0.0, OPEN)


def _take(arm: Arm, frame: Frame, hover: float, wait: FloatArray | float) -> Move:
    """Down a funnel onto a grasp frame, then close. `wait` (m) keeps the arm up in the funnel."""
    to_frame = frame.position - arm.position
    off_axis, turn = _length(to_frame[..., :2]), _turn(arm, frame)
    off_turn = np.abs(turn)
    wide = np.maximum(0.0, off_axis - 0.001) + 0.02 * np.maximum(0.0, off_turn - AT_YAW_RAD) + wait
    target = frame.position.copy()
    target[..., 2] += GRASP_M + np.minimum(hover, FUNNEL * wide)
    high = np.abs(to_frame[..., 2] + GRASP_M)
    there = (off_axis < AT_XY_M) & (high < AT_Z_M) & (off_turn < AT_YAW_RAD)
    return Move(target, turn, np.where(there & (np.asarray(wait) == 0.0), CLOSE, OPEN))


def _stay(arm: Arm, jaw: float) -> Move:
    return Move(arm.position, 0.0, jaw)


def _either(first: Truth, a: Move, b: Move) -> Move:
    """`a` where `first` holds, else `b`."""
    target = np.where(first[..., None], a.target, b.target)
    return Move(target, np.where(first, a.turn, b.turn), np.where(first, a.jaw, b.jaw))


def _holds(arm: Arm, frame: Frame) -> Truth:
    """Whether a jaw is closed on the wall at a grasp frame."""
    near = _length(arm.position - frame.position - (0.0, 0.0, GRASP_M)) < HELD_M
    low, high = HELD_JAW_RAD
    held: Truth = (low < arm.jaw) & (arm.jaw < high) & near
    return held


def _turn(arm: Arm, frame: Frame) -> FloatArray:
    """Smallest turn that lines the jaw up with the frame, which looks the same turned by pi."""
    turn = frame.yaw - arm.yaw
    smallest: FloatArray = turn - np.pi * np.rint(turn / np.pi)
    return smallest


def _length(vectors: FloatArray) -> FloatArray:
    length: FloatArray = np.sqrt((vectors * vectors).sum(axis=-1))
    return length
