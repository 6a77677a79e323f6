import numpy as np

from viskill_deploy.sim.tasks import load_task
from viskill_deploy.train.fit import Fit, Labelled, fit
from viskill_deploy.train.network import scaling_of

SCALING = scaling_of(load_task("bipegtransfer"))


def towards_the_goal(count: int) -> Labelled:
    """PSM1 goes to the goal's first position at up to 10 mm a step, jaw open."""
    rng = np.random.default_rng(0)
    obs = rng.uniform(-0.05, 0.05, (count, 35)).astype(np.float32)
    goal = rng.uniform(-0.05, 0.05, (count, 8)).astype(np.float32)
    action = np.zeros((count, 10), np.float32)
    action[:, :3] = np.clip((goal[:, :3] - obs[:, :3]) / 0.1, -1, 1)
    action[:, 4] = 0.5
    return Labelled(obs, goal, action)


def test_fitting_learns_a_simple_controller() -> None:
    data = towards_the_goal(2000)
    _, before = fit(SCALING, data, None, Fit(5, 128, 0))
    _, after = fit(SCALING, data, None, Fit(400, 128, 0))
    assert after < 0.003
    assert after < before / 10


def test_the_same_seed_fits_the_same_weights() -> None:
    data = towards_the_goal(100)
    first, _ = fit(SCALING, data, None, Fit(20, 32, 5))
    second, _ = fit(SCALING, data, None, Fit(20, 32, 5))
    for key, value in first.items():
        assert np.array_equal(value, second[key])


def test_fitting_goes_on_from_given_weights() -> None:
    data = towards_the_goal(2000)
    weights, first = fit(SCALING, data, None, Fit(200, 128, 0))
    _, second = fit(SCALING, data, weights, Fit(200, 128, 1))
    assert second < first


def test_states_can_be_joined() -> None:
    first, second = towards_the_goal(3), towards_the_goal(2)
    both = first.joined(second)
    assert both.obs.shape == (5, 35)
    assert both.goal.shape == (5, 8)
    assert np.array_equal(both.action[3:], second.action)
