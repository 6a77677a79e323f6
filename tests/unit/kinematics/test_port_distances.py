"""Distances of the shaft from a port, for many configurations at once."""

import numpy as np

from viskill_deploy import load_arm
from viskill_deploy.kinematics.model import port_distances


def test_distances_to_a_port_in_a_batch_equal_those_one_by_one() -> None:
    arm = load_arm("psm_classic")
    rng = np.random.default_rng(0)
    q = rng.uniform(arm.lower, arm.upper, (200, 6))
    port = np.array([0.002, -0.001, 0.003])
    expected = [arm.rcm_error(row, port) for row in q]
    np.testing.assert_allclose(port_distances(arm.description, q, port), expected, atol=1e-12)
    assert port_distances(arm.description, q, np.zeros(3)).max() < 1e-12
