"""The scripted controller of BiPegTransfer: a function of observation and subgoal, without memory.

Which phase a skill is in is read off what is seen: where the arms stand to the grasp frames and how
far the jaws are open. A jaw on the block's wall stands at about 0.2 rad, an open one at 0.5, an
empty closed one at 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.waypoints import ActionSpec

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
    """A place on the block where a jaw takes hold: position (3,) and the frame's yaw."""

    position: FloatArray
    yaw: float


@dataclass(frozen=True, slots=True)
class Arm:
    """One arm as observed: EEF position (3,), yaw, jaw opening."""

    position: FloatArray
    yaw: float
    jaw: float


@dataclass(frozen=True, slots=True)
class Seen:
    """The observation, taken apart."""

    arms: tuple[Arm, Arm]
    thing: FloatArray
    frames: tuple[Frame, Frame]


@dataclass(frozen=True, slots=True)
class Move:
    """Where an arm shall go: position (3,), change of yaw, jaw."""

    target: FloatArray
    turn: float
    jaw: float


def read(obs: FloatArray) -> Seen:
    """The named parts of an observation (35,)."""
    arms = (Arm(obs[0:3], obs[5], obs[6]), Arm(obs[7:10], obs[12], obs[13]))
    return Seen(arms, obs[14:17], (Frame(obs[23:26], obs[28]), Frame(obs[29:32], obs[34])))


def act(skill: str, observation: FloatArray, subgoal: FloatArray, spec: ActionSpec) -> FloatArray:
    """The action (10,) of a skill."""
    seen = read(observation)
    moves = {"grasp": _grasp, "handover": _handover, "release": _release}[skill](seen, subgoal)
    parts = [_action(arm, move, spec) for arm, move in zip(seen.arms, moves, strict=True)]
    return np.concatenate(parts)


def _action(arm: Arm, move: Move, spec: ActionSpec) -> FloatArray:
    step = GAIN * (move.target - arm.position)
    length = math.sqrt(step @ step)
    if length > STEP_M:
        step = step * (STEP_M / length)
    turn = min(max(GAIN * move.turn, -YAW_STEP_RAD), YAW_STEP_RAD)
    return np.array([*(step / spec.displacement_m), turn / spec.rotation_rad, move.jaw])


def _grasp(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM2 takes the block and lifts it; PSM1 goes to the meeting place, open."""
    psm1, psm2 = seen.arms
    waiting = Move(goal[0:3], _turn(psm1, seen.frames[0]), OPEN)
    if _holds(psm2, seen.frames[1]):
        return waiting, Move(goal[3:6], 0.0, CLOSE)
    return waiting, _take(psm2, seen.frames[1], TRAVEL_M - GRASP_M, 0.0)


def _handover(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM2 brings the block, PSM1 takes it, PSM2 lets go and steps back, PSM1 carries it on."""
    psm1, psm2 = seen.arms
    frame1, frame2 = seen.frames
    away = goal[0:3]
    meet = away - np.array([0.0, 0.0, STEP_BACK_M])
    taken = _holds(psm1, frame1)
    if taken and psm2.jaw < OPEN_JAW_RAD:
        return Move(psm1.position, 0.0, CLOSE), Move(psm2.position, 0.0, OPEN)
    if taken:
        clear = psm2.position[2] - frame2.position[2] - GRASP_M > 0.5 * STEP_BACK_M
        target = goal[3:6] if clear else psm1.position
        return Move(target, 0.0, CLOSE), Move(away, 0.0, OPEN)
    late = max(0.0, float(np.linalg.norm(psm2.position - meet)) - 0.002)
    return _take(psm1, frame1, STEP_BACK_M, late), Move(meet, 0.0, CLOSE)


def _release(seen: Seen, goal: FloatArray) -> tuple[Move, Move]:
    """PSM1 carries the block over its peg, lowers it onto the peg, lets go and rises."""
    psm1, frame1 = seen.arms[0], seen.frames[0]
    waiting = Move(goal[0:3], 0.0, OPEN)
    to_goal = goal[3:6] - seen.thing
    off_axis = math.hypot(to_goal[0], to_goal[1])
    low = off_axis < 0.004 and -to_goal[2] < LOWERED_M + 0.0015
    if low or psm1.jaw > OPEN_JAW_RAD:
        rise = psm1.jaw > OPEN_JAW_RAD
        target = psm1.position.copy()
        if rise:
            target[2] = frame1.position[2] + TRAVEL_M
        return Move(target, 0.0, OPEN), waiting
    target = psm1.position + to_goal
    height = LOWERED_M + FUNNEL * max(0.0, off_axis - 0.0015)
    target[2] += min(height, TRAVEL_M - GRASP_M + 0.004)
    return Move(target, 0.0, CLOSE), waiting


def _take(arm: Arm, frame: Frame, hover: float, wait: float) -> Move:
    """Down a funnel onto a grasp frame, then close. `wait` (m) keeps the arm up in the funnel."""
    to_frame = frame.position - arm.position
    off_axis, turn = math.hypot(to_frame[0], to_frame[1]), _turn(arm, frame)
    off_turn = max(0.0, abs(turn) - AT_YAW_RAD)
    spread = max(0.0, off_axis - 0.001) + 0.02 * off_turn + wait
    target = frame.position.copy()
    target[2] += GRASP_M + min(hover, FUNNEL * spread)
    there = off_axis < AT_XY_M and abs(to_frame[2] + GRASP_M) < AT_Z_M and abs(turn) < AT_YAW_RAD
    return Move(target, turn, CLOSE if there and wait == 0.0 else OPEN)


def _holds(arm: Arm, frame: Frame) -> bool:
    """Whether a jaw is closed on the wall at a grasp frame."""
    offset = arm.position - frame.position
    offset = offset - np.array([0.0, 0.0, GRASP_M])
    low, high = HELD_JAW_RAD
    return low < arm.jaw < high and math.sqrt(offset @ offset) < HELD_M


def _turn(arm: Arm, frame: Frame) -> float:
    """Smallest turn that lines the jaw up with the frame, which looks the same turned by pi."""
    return math.remainder(frame.yaw - arm.yaw, math.pi)
