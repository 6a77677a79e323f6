"""Joints of an arm that a person holds still, averaged; nothing here can move an arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.description import CellArm
from viskill_deploy.core.types import ArmState, CellState, FloatArray
from viskill_deploy.kinematics.model import forward_batch

STILL_S = 0.4
"""How long an arm has to be still: long enough to average encoder noise, short for a hand."""

STILL_M, STILL_RAD = 0.0003, 0.006
"""How far the end of its jaw may stray from its mean in that time, and how far its tip may turn."""

FRESH_S = 0.1
"""A reading that is older says nothing about now."""

FEWEST_SAMPLES = 10
"""New readings that there have to be in `STILL_S`: 25 Hz."""

CLOSED_RAD = 0.1
"""A jaw that is open by more has two ends."""


class Arms(Protocol):
    """What is needed of a driver to listen to its arms."""

    clock: Clock
    period_s: float

    def state(self) -> CellState:
        """The newest measurement of every arm."""
        ...


@dataclass(frozen=True)
class Rested:
    """An arm that was still.

    Attributes:
        stamp_s: driver's clock in the middle.
        joints: their mean, (6,), rad and m.
        spread_m: how far the end of the jaw strayed from its mean, at most.
    """

    stamp_s: float
    joints: FloatArray
    spread_m: float


def rested(arms: Arms, arm: CellArm, index: int) -> Rested | str:
    """An arm's joints over `STILL_S` from now on; or, in words, why they are no measurement.

    Args:
        arms: the driver, or whatever else reports joints.
        arm: the arm, as the cell has it.
        index: its place among the driver's arms.

    Raises:
        DriverError: the driver has lost the arm.
    """
    clock, samples, stamps = arms.clock, list[tuple[float, ...]](), list[float]()
    began = clock.now()
    while clock.now() < began + STILL_S:
        clock.sleep_until(clock.now() + arms.period_s)
        state = arms.state().arms[index]
        doubt = _doubt(state, arm, clock.now())
        if doubt:
            return doubt
        if not stamps or state.stamp_s > stamps[-1]:
            samples.append(state.measured_jp)
            stamps.append(state.stamp_s)
    if len(samples) < FEWEST_SAMPLES:
        return f"{arm.name} said only {len(samples)} times where it is; look at the network"
    q = np.array(samples)
    T = forward_batch(arm.arm, q)
    ends = T[:, :3, 3] + arm.arm.jaw.finger_length_m * T[:, :3, 2]
    strayed = float(np.linalg.norm(ends - ends.mean(axis=0), axis=1).max())
    turned = float(np.abs(T[:, :3, :3] - T[:, :3, :3].mean(axis=0)).max())
    if not (strayed <= STILL_M and turned <= STILL_RAD):
        return f"{arm.name} moves by {1e3 * strayed:.1f} mm; let it come to rest first"
    return Rested(float(np.mean(stamps)), np.asarray(q.mean(axis=0)), strayed)


def _doubt(state: ArmState, arm: CellArm, now: float) -> str:
    """Why a reading is no measurement of this arm at the end of its jaw; "" when it is one."""
    name = arm.name
    if not (state.valid and state.is_homed and np.isfinite(state.measured_jp).all()):
        return f"{name} does not know where it is; power and home it at its console"
    if not now - state.stamp_s <= FRESH_S:
        return f"{name}'s joints are {now - state.stamp_s:.1f} s old; look at its program"
    if state.tool and state.tool != arm.arm.tool:
        return f"{name} has {state.tool}, the cell's file says {arm.arm.tool}; change one of them"
    if not state.jaw_measured_jp <= CLOSED_RAD:
        return f"{name}'s jaw is open by {state.jaw_measured_jp:.2f} rad; close it"
    return ""
