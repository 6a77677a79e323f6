"""The scripted controller of MatchBoardPanel: a function of observation and subgoal, no memory.

Which phase a skill is in is read off what is seen: where the arm stands to the handle or to the
letter, how far the door has gone, how far the jaw is open. A jaw on a letter's stroke stands at
about 0.15 rad, an open one at 0.7, an empty closed one at 0.

Works on one observation or on many at once: `...` stands for the leading dimensions. Both sides of
each decision are worked out, and `where` picks one for each observation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.waypoints import ActionSpec
from viskill_deploy.sim.letters import GRASP_YAW_RAD

Flags = npt.NDArray[np.bool_]

GRASP_M = 0.0093
"""Height of the jaw pivot over a stroke's centre when a jaw closes: 0.5 mm above the table."""
LIFT_M = 0.025
"""How far a letter is lifted: over the handles of closed doors."""
LOWERED_M = 0.0004
"""Height above rest at which the letter is let go."""
AT_CELL_M = 0.0025
"""How well the letter is over the middle of its cell when it is let go: it has 6 mm of room."""

PUSH_M = 0.0104
"""Height of the pivot over a handle that the closed jaw pushes at the knob."""
CLEAR_M = 0.020
"""Height of the pivot over a handle at which the jaw passes above it."""
CONTACT_M = 0.0022
"""Distance along y from pivot to handle while the jaw pushes: half a jaw and the knob's radius."""
BESIDE_M = 0.0045
"""The same where the jaw comes down beside the handle."""

GAIN = 0.75
STEP_M = 0.008
YAW_STEP_RAD = 0.3
OPEN, CLOSE = 0.5, -0.5

HELD_JAW_RAD = (0.05, 0.45)
AT_ACROSS_M, AT_ALONG_M, AT_Z_M, AT_YAW_RAD = 0.0018, 0.0012, 0.0012, math.radians(6.0)
"""How well a jaw stands over a stroke when it closes: across and along the stroke, in height."""
NEAR = 0.7
"""Part of that within which it comes all the way down."""
AT_KNOB_M = 0.002
"""How far aside a jaw may push a knob: it is 2.8 mm wide, the knob 2.5 mm."""
AT_KNOB_LOW_M, AT_KNOB_HIGH_M = -0.0012, 0.002
"""How far under and over its height a jaw may push: the door is below, the knob's top above."""
HELD_M = 0.004
FUNNEL = 4.0
"""The jaw comes down by this much for each metre that it comes nearer to its place."""
MIDDLE_YAW_RAD = math.pi / 4
"""A jaw turned by pi is the same jaw; of the two yaws the one nearer to this is taken, which keeps
the roll in the middle of its range."""


@dataclass(frozen=True, slots=True)
class Seen:
    """The observation, taken apart: the jaw, the letter, the door of the target row."""

    position: FloatArray
    yaw: FloatArray
    jaw: FloatArray
    letter: FloatArray
    frame: FloatArray
    frame_yaw: FloatArray
    handle: FloatArray
    goal: FloatArray
    closed: FloatArray


@dataclass(frozen=True, slots=True)
class Move:
    """Where the arm shall go: position (..., 3), yaw and jaw (...)."""

    target: FloatArray
    yaw: FloatArray
    jaw: npt.ArrayLike


def read(obs: FloatArray) -> Seen:
    """The named parts of observations (..., 31)."""
    return Seen(
        position=obs[..., 0:3],
        yaw=obs[..., 5],
        jaw=obs[..., 6],
        letter=obs[..., 7:10],
        frame=obs[..., 13:16],
        frame_yaw=obs[..., 18],
        handle=obs[..., 22:25],
        goal=obs[..., 25:28],
        closed=obs[..., 28:31],
    )


def act(skill: str, observation: FloatArray, subgoal: FloatArray, spec: ActionSpec) -> FloatArray:
    """The actions (..., 5) of a skill."""
    seen = read(observation)
    match skill:
        case "pull":
            move = _slide(seen, subgoal, 1.0)
        case "grasp":
            move = _grasp(seen, subgoal)
        case "release":
            move = _release(seen, subgoal)
        case _:
            move = _slide(seen, subgoal, -1.0)
    return _action(seen, move, spec)


def _action(seen: Seen, move: Move, spec: ActionSpec) -> FloatArray:
    step = GAIN * (move.target - seen.position)
    length = np.sqrt((step**2).sum(axis=-1, keepdims=True))
    step = step * (STEP_M / np.maximum(length, STEP_M)) / spec.displacement_m
    turn = np.clip(GAIN * _wrapped(move.yaw - seen.yaw), -YAW_STEP_RAD, YAW_STEP_RAD)
    jaw = np.broadcast_to(np.asarray(move.jaw, dtype=np.float64), seen.yaw.shape)
    return np.concatenate([step, (turn / spec.rotation_rad)[..., None], jaw[..., None]], axis=-1)


def _slide(seen: Seen, goal: FloatArray, way: float) -> Move:
    """Down beside the handle, pushes it along y by way (+1 or -1), and up again."""
    left = way * (goal[..., 4] - seen.handle[..., 1])
    above = seen.position[..., 2] - seen.handle[..., 2] - PUSH_M
    behind = way * (seen.handle[..., 1] - seen.position[..., 1])
    aside = np.abs(seen.handle[..., 0] - seen.position[..., 0])
    # once up, a door that has slipped a little is left alone
    done = left < np.where(above < 0.003, 0.0005, 0.002)
    near = (behind > CONTACT_M - 0.001) & (behind < BESIDE_M + 0.003)
    ready = (aside < AT_KNOB_M) & near & (above > AT_KNOB_LOW_M) & (above < AT_KNOB_HIGH_M)

    gap = np.maximum(behind - CONTACT_M, 0.0)
    pushed = seen.handle.copy()
    pushed[..., 1] = seen.position[..., 1] + way * (left + gap + 0.0003)
    pushed[..., 2] += PUSH_M

    beside = seen.handle.copy()
    beside[..., 1] -= way * BESIDE_M
    beside[..., 2] += PUSH_M
    spread = np.hypot(aside, np.maximum(behind - BESIDE_M, 0.0)) - 0.0015
    over = behind < CONTACT_M - 0.0006  # on the knob, or beyond it: all the way up first
    spread = np.where(over, CLEAR_M, spread)
    approach = _funnel(seen.position, beside, spread, CLEAR_M - PUSH_M)

    low = above < 0.5 * (CLEAR_M - PUSH_M)
    away = np.where((done & low)[..., None], _straight_up(seen.position, goal), goal[..., 0:3])
    target = np.where(ready[..., None], pushed, approach)
    return Move(np.where(done[..., None], away, target), np.zeros_like(left), CLOSE)


def _grasp(seen: Seen, goal: FloatArray) -> Move:
    """Down a funnel onto the letter's grasp frame, closes, lifts."""
    place = seen.frame.copy()
    place[..., 2] += GRASP_M
    off = place - seen.position
    yaw = _nearest_yaw(seen.frame_yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    across = np.abs(c * off[..., 0] + s * off[..., 1])
    along = np.abs(c * off[..., 1] - s * off[..., 0])
    off_turn = np.maximum(np.abs(_wrapped(yaw - seen.yaw)) - AT_YAW_RAD, 0.0)
    outside = (
        np.maximum(across - NEAR * AT_ACROSS_M, 0.0),
        np.maximum(along - NEAR * AT_ALONG_M, 0.0),
    )
    approach = _funnel(seen.position, place, np.hypot(*outside) + 0.02 * off_turn, LIFT_M)
    there = (across < AT_ACROSS_M) & (along < AT_ALONG_M) & (off_turn == 0.0)
    there &= np.abs(off[..., 2]) < AT_Z_M
    held = _holds(seen, HELD_M)
    target = np.where(held[..., None], goal[..., 0:3], approach)
    return Move(target, yaw, np.where(held | there, CLOSE, OPEN))


def _release(seen: Seen, goal: FloatArray) -> Move:
    """Carries the letter over its cell, lowers it onto the plate, lets go and rises."""
    to_goal = goal[..., 3:6] - seen.letter
    off_axis = np.hypot(to_goal[..., 0], to_goal[..., 1])
    opened = ~_holds(seen, 2.0 * HELD_M)
    down = (off_axis < AT_CELL_M) & (-to_goal[..., 2] < LOWERED_M + 0.001)

    carried = seen.position + to_goal
    height = LOWERED_M + FUNNEL * np.maximum(off_axis - NEAR * AT_CELL_M, 0.0)
    carried[..., 2] += np.minimum(height, LIFT_M)

    low = seen.position[..., 2] - seen.frame[..., 2] - GRASP_M < 0.005
    away = np.where(low[..., None], _straight_up(seen.position, goal), goal[..., 0:3])
    let_go = np.where(opened[..., None], away, seen.position)
    finished = opened | down
    target = np.where(finished[..., None], let_go, carried)
    return Move(target, _straight(seen, finished), np.where(finished, OPEN, CLOSE))


def _funnel(position: FloatArray, place: FloatArray, spread: FloatArray, high: float) -> FloatArray:
    """Above a place by as much as the jaw is off it, at most `high`; up first, where it is low."""
    target = place.copy()
    target[..., 2] += np.clip(FUNNEL * spread, 0.0, high)
    low = target[..., 2] - position[..., 2] > 0.003
    target[..., :2] = np.where(low[..., None], position[..., :2], target[..., :2])
    return target


def _straight_up(position: FloatArray, goal: FloatArray) -> FloatArray:
    return np.concatenate([position[..., :2], goal[..., 2:3]], axis=-1)


def _holds(seen: Seen, within: float) -> Flags:
    """Whether the jaw is closed on something, within some distance of the grasp frame."""
    offset = seen.position - seen.frame - np.array([0.0, 0.0, GRASP_M])
    low, high = HELD_JAW_RAD
    closed = (seen.jaw > low) & (seen.jaw < high)
    held: Flags = closed & (np.sqrt((offset**2).sum(axis=-1)) < within)
    return held


def _nearest_yaw(yaw: FloatArray) -> FloatArray:
    """The same line's yaw within a right angle of `MIDDLE_YAW_RAD`."""
    turned = yaw - MIDDLE_YAW_RAD
    return MIDDLE_YAW_RAD + turned - math.pi * np.round(turned / math.pi)


def _straight(seen: Seen, let_go: Flags) -> FloatArray:
    """The yaw that lays a held letter straight, whichever way up; the present one once let go."""
    turn = GRASP_YAW_RAD - seen.frame_yaw
    turned = seen.yaw + turn - math.pi * np.round(turn / math.pi)
    within = np.clip(turned, MIDDLE_YAW_RAD - math.pi / 2, MIDDLE_YAW_RAD + math.pi / 2)
    return np.where(let_go, seen.yaw, within)


def _wrapped(angle: FloatArray) -> FloatArray:
    """The same angle within (-pi, pi], rad."""
    return angle - 2.0 * math.pi * np.round(angle / (2.0 * math.pi))
