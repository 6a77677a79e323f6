"""Laws of the kinematics, on whatever hypothesis can think of."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from viskill_deploy import IkSolver, load_arm

ARM = load_arm("psm_classic", tool="large_needle_driver_400006")
SOLVER = IkSolver.for_arm(ARM)
PAST_RCM_M = 0.003 - ARM.description.wrist_offset_m


def configurations(lower: np.ndarray, upper: np.ndarray) -> st.SearchStrategy[tuple[float, ...]]:
    """Joints inside limits, the wrist past the remote centre."""
    low = lower.copy()
    low[2] = max(low[2], PAST_RCM_M)
    return st.tuples(*map(st.floats, low.tolist(), upper.tolist()))


ANYWHERE = configurations(ARM.lower, ARM.upper)
PLANNED = configurations(np.array(SOLVER.limits.lower), np.array(SOLVER.limits.upper))
SPEEDS = st.tuples(*(st.floats(-v / 20, v / 20) for v in SOLVER.limits.velocity))


@given(q=ANYWHERE)
def test_inverse_of_forward_is_the_identity_inside_the_limits(q: tuple[float, ...]) -> None:
    again = ARM.inverse(ARM.forward(q), q)
    assert (again >= ARM.lower).all() and (again <= ARM.upper).all()
    np.testing.assert_allclose(again, q, rtol=0, atol=1e-9)


@given(q=ANYWHERE, seed=ANYWHERE)
def test_forward_of_inverse_is_the_identity_whatever_the_seed(
    q: tuple[float, ...], seed: tuple[float, ...]
) -> None:
    pose = ARM.forward(q)
    found = ARM.inverse(pose, seed)
    np.testing.assert_allclose(ARM.forward(found).homogeneous, pose.homogeneous, rtol=0, atol=1e-9)
    assert abs(found[3] - seed[3]) <= abs(q[3] - seed[3]) + 1e-9


@given(q=ANYWHERE)
def test_the_determinant_of_the_jacobian_is_the_one_derived_by_hand(q: tuple[float, ...]) -> None:
    depth = q[2] + ARM.description.wrist_offset_m
    expected = depth * np.cos(q[1]) * (depth * np.cos(q[4]) + ARM.description.joints[5].a_m)
    assert abs(abs(np.linalg.det(ARM.jacobian(q))) - expected) < 1e-12


@given(q=PLANNED, v=SPEEDS, goal=ANYWHERE)
@settings(max_examples=200)
def test_one_tick_never_leaves_a_box(
    q: tuple[float, ...], v: tuple[float, ...], goal: tuple[float, ...]
) -> None:
    # A state from which the joints can stop: no joint moves towards a limit that it is near.
    limits, dt = SOLVER.limits, 0.004
    middle = [(low + high) / 2 for low, high in zip(limits.lower, limits.upper, strict=True)]
    v = tuple(abs(x) if p < m else -abs(x) for x, p, m in zip(v, q, middle, strict=True))
    answer = SOLVER.step(q, v, ARM.forward(goal), dt)
    for i in range(6):
        assert limits.lower[i] - 1e-9 <= answer.q[i] <= limits.upper[i] + 1e-9
        assert abs(answer.v[i]) <= limits.velocity[i] + 1e-9
        assert abs(answer.v[i] - v[i]) <= limits.acceleration[i] * dt + 1e-9
