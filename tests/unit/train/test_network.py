import numpy as np
import onnxruntime
import pytest
import torch

from viskill_deploy.sim.tasks import load_task
from viskill_deploy.train.graph import skill_graph
from viskill_deploy.train.network import SkillNetwork, scaling_of

TASK = load_task("bipegtransfer")
OBS, GOAL = 35, 8


def states(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    obs = rng.uniform(-0.06, 0.06, (count, OBS)).astype(np.float32)
    obs[:, [3, 4, 5, 10, 11, 12, 26, 27, 28, 32, 33, 34]] *= 40
    goal = rng.uniform(-0.06, 0.06, (count, GOAL)).astype(np.float32)
    return torch.from_numpy(obs), torch.from_numpy(goal)


def test_the_graph_computes_what_the_network_computes() -> None:
    scaling = scaling_of(TASK)
    torch.manual_seed(0)
    network = SkillNetwork(scaling, 10)
    obs, goal = states(500)
    with torch.no_grad():
        expected = network(obs, goal).numpy()
    graph = skill_graph(scaling, network.weights(), OBS, GOAL)
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    (action,) = session.run(["action"], {"obs": obs.numpy(), "goal": goal.numpy()})
    assert action.shape == (500, 10)
    assert action.dtype == np.float32
    assert np.abs(action - expected).max() < 1e-6


def test_a_graph_takes_any_number_of_states() -> None:
    scaling = scaling_of(TASK)
    network = SkillNetwork(scaling, 10)
    graph = skill_graph(scaling, network.weights(), OBS, GOAL)
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    for count in (1, 7):
        obs, goal = states(count)
        (action,) = session.run(None, {"obs": obs.numpy(), "goal": goal.numpy()})
        assert action.shape == (count, 10)


def test_inputs_inside_the_workspace_are_scaled_to_about_one() -> None:
    scaling = scaling_of(TASK)
    features = SkillNetwork(scaling, 10).features(*states(200))
    assert features.shape == (200, scaling.width)
    assert float(features.abs().max()) < 4.0


def test_distances_from_tip_to_grasp_frame_are_among_the_features() -> None:
    scaling = scaling_of(TASK)
    obs, goal = states(1)
    x = np.concatenate([obs.numpy()[0], goal.numpy()[0]])
    distances = scaling.differences @ x
    for wished in (x[29:32] - x[7:10], x[23:26] - x[0:3], x[35:38] - x[0:3], x[38:41] - x[14:17]):
        rows = distances.reshape(-1, 3)
        assert np.abs(rows - wished).max(axis=1).min() < 1e-7


def test_a_jaw_turned_by_half_a_turn_gives_the_same_turn_features() -> None:
    scaling = scaling_of(TASK)
    network = SkillNetwork(scaling, 10)
    obs, goal = states(1)
    turned = obs.clone()
    turned[:, 12] += np.pi
    first = network.features(obs, goal)[:, -len(scaling.turns) :]
    second = network.features(turned, goal)[:, -len(scaling.turns) :]
    assert first.numpy() == pytest.approx(second.numpy(), abs=1e-5)


def test_weights_go_out_and_come_back_unchanged() -> None:
    scaling = scaling_of(TASK)
    one, other = SkillNetwork(scaling, 10), SkillNetwork(scaling, 10)
    other.load(one.weights())
    obs, goal = states(5)
    with torch.no_grad():
        assert torch.equal(one(obs, goal), other(obs, goal))
