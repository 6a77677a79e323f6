"""The QP: convergence, boxes, refusals, and that it believes no solver."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from chain7 import BENT, LIMITS, chain7, tool_pose

from viskill_deploy import IkSolver, load_arm
from viskill_deploy.core.errors import IkError, KinematicsError, NoSolutionError
from viskill_deploy.kinematics.limits import JointLimits
from viskill_deploy.kinematics.port import PortConstraint

ARM = load_arm("psm_classic", tool="large_needle_driver_400006")
HOME = (0.1, -0.1, 0.12, 0.3, 0.2, -0.2)
STILL = (0.0,) * 6
TICK_S = 0.004


def random_ticks(solver: IkSolver, ticks: int, seed: int) -> tuple[float, float]:
    """Chases random targets, near and far; the worst excess over any box, and the part limited."""
    limits = solver.limits
    lower, upper = np.array(limits.lower), np.array(limits.upper)
    speed, step = np.array(limits.velocity), np.array(limits.acceleration) * TICK_S
    rng = np.random.default_rng(seed)
    q, v = rng.uniform(lower, upper), np.zeros(6)
    worst, limited, target = 0.0, 0, ARM.forward(q)
    for tick in range(ticks):
        if tick % 50 == 0:
            near = np.clip(q + rng.normal(size=6) * 0.02 * (upper - lower), ARM.lower, ARM.upper)
            target = ARM.forward(near if rng.random() < 0.5 else rng.uniform(ARM.lower, ARM.upper))
        answer = solver.step(q, v, target, TICK_S)
        q_next, v_next = np.array(answer.q), np.array(answer.v)
        worst = max(
            worst,
            float((lower - q_next).max()),
            float((q_next - upper).max()),
            float((np.abs(v_next) - speed).max()),
            float((np.abs(v_next - v) - step).max()),
            float(np.abs(q_next - q - v_next * TICK_S).max()),
        )
        limited += answer.is_limited
        q, v = q_next, v_next
    return worst, limited / ticks


def test_the_qp_and_the_closed_form_agree_after_five_iterations() -> None:
    solver = IkSolver.for_arm(ARM)
    lower, upper = np.array(solver.limits.lower), np.array(solver.limits.upper)
    rng = np.random.default_rng(0)
    for _ in range(300):
        q = rng.uniform(lower, upper)
        seed = np.clip(q + rng.normal(size=6) * [0.05, 0.05, 0.005, 0.05, 0.05, 0.05], lower, upper)
        answer = solver.solve(ARM.forward(q), seed, max_iterations=5)
        assert answer.iterations <= 5
        exact = ARM.inverse(ARM.forward(q), seed)
        np.testing.assert_allclose(answer.q, exact, rtol=0, atol=1e-6)


def test_one_tick_towards_a_near_target_arrives_and_says_that_nothing_limits_it() -> None:
    q = np.array(HOME) + 1e-5
    answer = IkSolver.for_arm(ARM).step(HOME, STILL, ARM.forward(q), TICK_S)
    np.testing.assert_allclose(answer.q, q, rtol=0, atol=1e-9)
    assert not answer.is_limited and answer.active == (0,) * 6 and answer.residual < 1e-6


def test_a_tick_that_acceleration_limits_says_which_joint_it_holds_back() -> None:
    q = np.array(HOME)
    q[0] += 0.05
    answer = IkSolver.for_arm(ARM).step(HOME, STILL, ARM.forward(q), TICK_S)
    assert answer.is_limited and answer.active[0] == 1


def test_no_box_is_left_while_limits_are_active() -> None:
    worst, limited = random_ticks(IkSolver.for_arm(ARM), 10_000, seed=0)
    assert worst <= 1e-9
    assert limited > 0.5


@pytest.mark.slow
def test_no_box_is_left_on_a_hundred_thousand_ticks() -> None:
    worst, limited = random_ticks(IkSolver.for_arm(ARM), 100_000, seed=1)
    assert worst <= 1e-9
    assert limited > 0.5


@pytest.mark.parametrize("name", ["osqp", "quadprog", "proxqp"])
def test_another_solver_keeps_the_boxes_and_finds_the_same_velocities(name: str) -> None:
    other, daqp = IkSolver.for_arm(ARM, solver=name), IkSolver.for_arm(ARM)
    assert random_ticks(other, 300, seed=2)[0] <= 1e-9
    rng = np.random.default_rng(3)
    for _ in range(50):
        q = rng.uniform(other.limits.lower, other.limits.upper)
        target = ARM.forward(q + rng.normal(size=6) * 1e-3)
        ours, theirs = (s.step(q, STILL, target, TICK_S).v for s in (daqp, other))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)


def test_osqp_says_nothing_on_standard_output(capfd: pytest.CaptureFixture[str]) -> None:
    solver = IkSolver.for_arm(ARM, solver="osqp")
    random_ticks(solver, 20, seed=4)
    solver.step(HOME, STILL, ARM.forward(HOME), TICK_S)
    assert capfd.readouterr().out == ""


def test_a_solver_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(KinematicsError, match="daqp"):
        IkSolver.for_arm(ARM, solver="no-such-solver")


def bad_calls() -> dict[str, tuple[str, Callable[[], object]]]:
    """Cause and call of each refusal."""
    solver = IkSolver.for_arm(ARM)
    target, far_port = ARM.forward(HOME), PortConstraint((0.01, 0, 0), "shaft", (0, 0, 1), "band")
    squeezed = IkSolver.for_arm(ARM, port=far_port)
    nan = (math.nan,) * 6
    at_the_stop = (solver.limits.upper[0] - 1e-4, *HOME[1:])
    crossed = (solver.limits.upper, solver.limits.lower)
    return {
        "NaN joints": ("not-finite", lambda: solver.step(nan, STILL, target, TICK_S)),
        "NaN velocity": ("not-finite", lambda: solver.step(HOME, nan, target, TICK_S)),
        "NaN pose": (
            "not-finite",
            lambda: solver.step(HOME, STILL, np.full((4, 4), math.nan), TICK_S),
        ),
        "NaN feedforward": (
            "not-finite",
            lambda: solver.step(HOME, STILL, target, TICK_S, v_feedforward=nan),
        ),
        "NaN tick": ("not-finite", lambda: solver.step(HOME, STILL, target, math.nan)),
        "no tick": ("not-finite", lambda: solver.step(HOME, STILL, target, 0.0)),
        "NaN seed": ("not-finite", lambda: solver.solve(target, nan)),
        "NaN limits": ("not-finite", lambda: JointLimits(nan, *[(1.0,) * 6] * 3)),
        "lower above upper": (
            "bad-bounds",
            lambda: JointLimits(*crossed, *[(1.0,) * 6] * 2),
        ),
        "port out of reach": ("infeasible", lambda: squeezed.step(HOME, STILL, target, TICK_S)),
        "too fast to stop": (
            "infeasible",
            lambda: solver.step(at_the_stop, (1.0, *STILL[1:]), target, TICK_S),
        ),
        "faster than allowed": (
            "infeasible",
            lambda: solver.step(HOME, (9.0, *STILL[1:]), target, TICK_S),
        ),
    }


@pytest.mark.parametrize("name", bad_calls())
def test_bad_input_is_refused_by_name_within_a_millisecond(name: str) -> None:
    cause, call = bad_calls()[name]
    fastest = math.inf
    for _ in range(10):
        begin = time.perf_counter()
        with pytest.raises(IkError) as refusal:
            call()
        fastest = min(fastest, time.perf_counter() - begin)
        assert refusal.value.cause == cause
    assert fastest < 1e-3


def test_the_solver_still_answers_after_every_refusal() -> None:
    solver = IkSolver.for_arm(ARM)
    expected = solver.step(HOME, STILL, ARM.forward(np.array(HOME) + 1e-5), TICK_S)
    for bad in (math.nan, math.inf):
        with pytest.raises(IkError):
            solver.step((bad,) * 6, STILL, ARM.forward(HOME), TICK_S)
    assert solver.step(HOME, STILL, ARM.forward(np.array(HOME) + 1e-5), TICK_S) == expected


class Liar:
    """A solver that says it has solved the problem, and hands out whatever it likes."""

    def __init__(self, answer: Callable[[np.ndarray], np.ndarray]) -> None:
        self._answer = answer

    def solve(self, H: Any, f: Any, lb: Any, ub: Any, rows: Any) -> tuple[np.ndarray, None]:
        """A lie about the problem."""
        honest = np.clip(np.linalg.solve(H, -f), lb, ub)
        return self._answer(honest), None


@pytest.mark.parametrize(
    ("answer", "cause"),
    [
        (lambda x: x * math.nan, "not-finite"),
        (lambda x: x + 10.0, "outside-box"),
        (lambda x: x + 1e-3, "residual"),
        (lambda x: np.zeros(6), "residual"),
    ],
)
def test_a_solver_that_lies_is_found_out(answer: Any, cause: str) -> None:
    solver = IkSolver.for_arm(ARM)
    solver._solver = Liar(answer)
    with pytest.raises(IkError) as refusal:
        solver.step(HOME, STILL, ARM.forward(np.array(HOME) + 1e-5), TICK_S)
    assert refusal.value.cause == cause


def test_an_answer_a_hair_outside_is_put_onto_the_box() -> None:
    solver = IkSolver.for_arm(ARM)
    target = ARM.forward(np.array(HOME) + 0.1)
    honest = solver.step(HOME, STILL, target, TICK_S)
    solver._solver = Liar(lambda _: np.array(honest.v) + 1e-8 * np.sign(honest.v))
    again = solver.step(HOME, STILL, target, TICK_S)
    np.testing.assert_allclose(again.v, honest.v, rtol=0, atol=2e-8)
    step = np.array(solver.limits.acceleration) * TICK_S
    assert (np.abs(again.v) <= step).all()


def test_a_moving_target_is_followed_with_its_feedforward_and_a_gentle_gain() -> None:
    solver = IkSolver.for_arm(ARM, gain=0.2)
    velocity = np.array([0.05, -0.03, 0.01, 0.2, 0.1, -0.1])
    q, v, errors = np.array(HOME), tuple(velocity), []
    goal = np.array(HOME)
    for _ in range(100):
        target = ARM.forward(goal)
        twist = pin.log6(target.actInv(ARM.forward(goal + velocity * TICK_S))).vector / TICK_S
        answer = solver.step(q, v, target, TICK_S, v_feedforward=twist)
        q, v, goal = np.array(answer.q), answer.v, goal + velocity * TICK_S
        errors.append(np.abs(ARM.forward(q).translation - ARM.forward(goal).translation).max())
    assert max(errors) < 1e-6


def test_a_joint_outside_its_limits_is_brought_back_inside() -> None:
    solver = IkSolver.for_arm(ARM)
    q = np.array(HOME)
    q[0] = solver.limits.upper[0] + 0.01
    target, v = ARM.forward(q), STILL
    for _ in range(100):
        answer = solver.step(q, v, target, TICK_S)
        assert answer.q[0] <= max(q[0], solver.limits.upper[0]) + 1e-9
        q, v = np.array(answer.q), answer.v
    assert q[0] <= solver.limits.upper[0] + 1e-9


def test_a_gentle_gain_does_not_slow_the_solution_of_a_single_pose() -> None:
    q = np.array(HOME) + 0.02
    assert IkSolver.for_arm(ARM, gain=0.1).solve(ARM.forward(q), HOME).iterations <= 6


def test_an_unreachable_pose_is_not_called_solved() -> None:
    q = np.array(HOME)
    q[2] = ARM.upper[2] + 0.05
    with pytest.raises(IkError) as refusal:
        IkSolver.for_arm(ARM).solve(ARM.forward(q), HOME)
    assert refusal.value.cause == "residual"


def test_a_psms_path_is_resolved_by_closed_form_inside_the_plans_limits() -> None:
    solver = IkSolver.for_arm(ARM)
    end = np.array(HOME) + np.array([0.2, 0.2, 0.03, 1.0, 0.2, 0.2])
    path = np.linspace(HOME, end, 100)
    np.testing.assert_allclose(solver.resolve(ARM.forward_batch(path), HOME), path, atol=1e-9)
    path[-1, 2] = ARM.upper[2] - 1e-4
    with pytest.raises(NoSolutionError, match="of the plan") as refusal:
        solver.resolve(ARM.forward_batch(path), HOME)
    assert refusal.value.name == "insertion"


def test_another_arms_path_is_resolved_pose_by_pose() -> None:
    model = chain7()
    solver = IkSolver(model, "tool", LIMITS, damping=1e-6)
    joints = [tuple(np.array(BENT) + 0.05 * i) for i in range(4)]
    poses = np.array([tool_pose(model, q).homogeneous for q in joints])
    for pose, q in zip(poses, solver.resolve(poses, BENT), strict=True):
        np.testing.assert_allclose(tool_pose(model, tuple(q)).homogeneous, pose, atol=1e-8)


def test_models_and_options_that_do_not_fit_are_refused() -> None:
    with pytest.raises(KinematicsError, match="limits for each"):
        IkSolver(chain7(), "tool", JointLimits.planning(ARM.description))
    with pytest.raises(KinematicsError, match="no frame 'nose'"):
        IkSolver(chain7(), "nose", LIMITS)
    with pytest.raises(KinematicsError, match="gain"):
        IkSolver.for_arm(ARM, gain=1.5)
    with pytest.raises(KinematicsError, match="must be 6 numbers"):
        IkSolver.for_arm(ARM).step((0.0,) * 5, STILL, ARM.forward(HOME), TICK_S)


def test_too_few_iterations_are_not_called_solved() -> None:
    with pytest.raises(IkError, match="1 iterations") as refusal:
        IkSolver.for_arm(ARM).solve(ARM.forward(np.array(HOME) + 0.05), HOME, max_iterations=1)
    assert refusal.value.cause == "residual"
