"""The remote-centre constraint on an arm that has none by mechanism, and on one that has."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pinocchio as pin
import pytest
from chain7 import BENT, LIMITS, SHAFT_M, chain7, tool_pose

from viskill_deploy import IkSolver, load_arm
from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.kinematics.port import PortConstraint, PortRows

MODEL = chain7()
START = tool_pose(MODEL, BENT)
PORT = START.translation - SHAFT_M / 2 * START.rotation[:, 2]
TICK_S, TICKS, RADIUS_M = 0.004, 800, 0.02


def follow_circle(port: PortConstraint | None) -> tuple[float, float]:
    """Leads the tool's end round a 40 mm circle; the worst port distance and tip error, m.

    The orientation asked for stays as it was, with little weight: without the constraint the
    shaft moves sideways with the tip.
    """
    solver = IkSolver(MODEL, "tool", LIMITS, port=port, orientation_cost=0.1, damping=1e-6)
    probe = IkSolver(MODEL, "tool", LIMITS, port=PortConstraint(PORT, "tool", (0, 0, 1)))
    q, v, off_port, off_path = BENT, (0.0,) * 7, 0.0, 0.0
    for tick in range(TICKS):
        turn = 2 * math.pi * tick / TICKS
        angle = turn - math.sin(turn)  # from rest to rest
        offset = np.array([math.cos(angle) - 1.0, math.sin(angle), 0.0])
        place = START.translation + RADIUS_M * START.rotation @ offset
        answer = solver.step(q, v, pin.SE3(START.rotation, place), TICK_S)
        q, v = answer.q, answer.v
        off_port = max(off_port, probe.port_distance(q))
        off_path = max(off_path, float(np.linalg.norm(tool_pose(MODEL, q).translation - place)))
    return off_port, off_path


@pytest.mark.parametrize("mode", ["soft", "band"])
def test_a_seven_joint_arm_keeps_its_shaft_in_the_port_round_a_circle_and_not_without(
    mode: Literal["soft", "band"],
) -> None:
    port = PortConstraint(PORT, "tool", (0, 0, 1), mode=mode, tolerance_m=5e-5)
    off_port, off_path = follow_circle(port)
    assert off_port <= 1e-4
    assert off_path <= 1e-4
    assert follow_circle(None)[0] > 5e-3


def test_the_rows_are_the_derivative_of_the_offset() -> None:
    port = PortConstraint(PORT, "tool", (0.1, 0.2, 1.0))
    rows, data, step = PortRows(MODEL, port), MODEL.createData(), 1e-6
    q = np.array(BENT) + np.random.default_rng(0).normal(size=7) * 0.2

    def offset(at: np.ndarray) -> np.ndarray:
        pin.computeJointJacobians(MODEL, data, at)
        return rows.evaluate(data)[0].copy()

    columns = [(offset(q + step * e) - offset(q - step * e)) / (2 * step) for e in np.eye(7)]
    pin.computeJointJacobians(MODEL, data, q)
    np.testing.assert_allclose(rows.evaluate(data)[1], np.array(columns).T, atol=1e-8)


def test_on_a_psm_the_mechanism_does_it_and_the_rows_are_zero() -> None:
    arm = load_arm("psm_classic")
    rows = PortRows(arm.model, PortConstraint((0, 0, 0), "shaft", (0, 0, 1)))
    data = arm.model.createData()
    for q in np.random.default_rng(1).uniform(arm.lower, arm.upper, (20, 6)):
        pin.computeJointJacobians(arm.model, data, q)
        offset, rate = rows.evaluate(data)
        assert np.abs(offset).max() < 1e-15
        assert np.abs(rate).max() < 1e-15


def test_a_port_two_millimetres_off_is_measured_and_pulled_at_softly() -> None:
    arm = load_arm("psm_classic")
    q = (0.0, 0.0, 0.12, 0.0, 0.0, 0.0)
    port = PortConstraint((0.002, 0.0, 0.0), "shaft", (0, 0, 1))
    solver = IkSolver.for_arm(arm, port=port)
    assert solver.port_distance(q) == pytest.approx(0.002)
    answer = solver.step(q, (0.0,) * 6, arm.forward(q), TICK_S)
    # The shaft can meet a port at the height of the remote centre by no motion at all.
    assert solver.port_distance(answer.q) <= 0.002
    assert IkSolver.for_arm(arm).port_distance(q) == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": (0.0, math.nan, 0.0)},
        {"position": (0.0, 0.0)},
        {"axis": (0.0, 0.0, 0.0)},
        {"weight": 0.0},
        {"tolerance_m": -1e-4},
        {"return_rate": 1.5},
    ],
)
def test_a_constraint_that_makes_no_sense_is_refused(wrong: dict[str, object]) -> None:
    sound: dict[str, object] = {"position": (0, 0, 0), "frame": "tool", "axis": (0, 0, 1)}
    with pytest.raises(KinematicsError):
        PortConstraint(**(sound | wrong))  # type: ignore[arg-type]


def test_a_shaft_on_a_frame_that_is_not_there_is_refused() -> None:
    with pytest.raises(KinematicsError, match="no frame 'nose'"):
        IkSolver(MODEL, "tool", LIMITS, port=PortConstraint(PORT, "nose", (0, 0, 1)))
