"""The doors to the QP solvers agree with each other and refuse what has no solution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import qpsolvers

from viskill_deploy.core.errors import IkError
from viskill_deploy.kinematics import qp
from viskill_deploy.kinematics.qp import make_solver

SOLVERS = ("daqp", "osqp", "quadprog", "proxqp")


def random_problem(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, list[float], list[float]]:
    """A definite problem in a box that holds some of it back."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(n, n))
    return J.T @ J + 0.1 * np.eye(n), rng.normal(size=n), [-0.2] * n, [0.2] * n


@pytest.mark.parametrize("name", SOLVERS[1:])
def test_every_solver_gives_the_same_answer_and_multipliers(name: str) -> None:
    rng = np.random.default_rng(0)
    for seed in range(20):
        H, f, lower, upper = random_problem(6, seed)
        rows = (rng.normal(size=(2, 6)), np.array([-0.05, -0.05]), np.array([0.05, 0.05]))
        x, multipliers = make_solver("daqp", 6, 2, 0.0).solve(H, f, lower, upper, rows)
        other, others = make_solver(name, 6, 2, 0.0).solve(H, f, lower, upper, rows)
        np.testing.assert_allclose(other, x, atol=1e-7)
        assert multipliers is not None and others is not None
        np.testing.assert_allclose(others, multipliers, atol=1e-5)


@pytest.mark.parametrize("name", SOLVERS)
def test_rows_that_cannot_be_met_are_refused_and_the_next_problem_is_solved(name: str) -> None:
    H, f, lower, upper = random_problem(6, 0)
    solver = make_solver(name, 6, 2, 0.0)
    sound = (np.eye(2, 6), np.array([-0.1, -0.1]), np.array([0.1, 0.1]))
    impossible = (np.eye(2, 6), np.array([5.0, 5.0]), np.array([6.0, 6.0]))
    expected = solver.solve(H, f, lower, upper, sound)[0]
    with pytest.raises(IkError) as refusal:
        solver.solve(H, f, lower, upper, impossible)
    assert refusal.value.cause == "infeasible"
    again = solver.solve(H, f, lower, upper, sound)[0]
    np.testing.assert_allclose(again, expected, atol=1e-8)


def large_problem(solve: Callable[..., object]) -> object:
    """A problem that takes many iterations."""
    rng = np.random.default_rng(0)
    J, A = rng.normal(size=(60, 60)), rng.normal(size=(900, 60))
    H, f = J.T @ J + 1e-6 * np.eye(60), 100 * rng.normal(size=60)
    return solve(H, f, [-9.0] * 60, [9.0] * 60, (A, -np.ones(900), np.ones(900)))


def test_daqp_stops_when_its_time_is_over() -> None:
    with pytest.raises(IkError) as refusal:
        large_problem(make_solver("daqp", 60, 900, 1e-9).solve)
    assert refusal.value.cause == "time"


def test_daqp_stops_when_its_iterations_are_used_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(qp, "ITERATION_LIMIT", 3)
    with pytest.raises(IkError) as refusal:
        large_problem(make_solver("daqp", 60, 900, 0.0).solve)
    assert refusal.value.cause == "time"


def test_osqp_takes_a_time_limit() -> None:
    H, f, lower, upper = random_problem(6, 1)
    x, _ = make_solver("osqp", 6, 0, 1.0).solve(H, f, lower, upper, None)
    np.testing.assert_allclose(
        x, make_solver("daqp", 6, 0, 0.0).solve(H, f, lower, upper, None)[0], atol=1e-7
    )


def test_what_qpsolvers_raises_becomes_a_named_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    H, f, lower, upper = random_problem(6, 1)

    def fail(*_: object, **__: object) -> None:
        raise qpsolvers.exceptions.SolverError("gave up")

    monkeypatch.setattr(qpsolvers, "solve_problem", fail)
    with pytest.raises(IkError, match="gave up") as refusal:
        make_solver("proxqp", 6, 0, 0.0).solve(H, f, lower, upper, None)
    assert refusal.value.cause == "infeasible"
