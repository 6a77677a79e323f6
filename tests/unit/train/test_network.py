import numpy as np
import onnxruntime
import pytest
import torch

from viskill_deploy.sim.tasks import load_task
from viskill_deploy.train.graph import chain_graph, skill_graph, value_graph
from viskill_deploy.train.network import Network, scaling_of, size
from viskill_deploy.train.subgoal_space import SubgoalSpace, chain_layout, value_layout

TASK = load_task("bipegtransfer")
OBS, GOAL = size(TASK.observation_layout), size(TASK.goal_layout)


def states(count: int, width: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-0.06, 0.06, (count, width)).astype(np.float32)
    x[:, [3, 4, 5, 10, 11, 12, 26, 27, 28, 32, 33, 34]] *= 40
    return x


def run(graph: bytes, **feed: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    return session.run(None, feed)[0]


def network(layout: tuple[tuple[str, int], ...] | None, outputs: int) -> Network:
    torch.manual_seed(0)
    return Network(scaling_of(TASK, layout), outputs)


def test_a_skill_graph_computes_what_the_network_computes() -> None:
    actor = network(None, 10)
    x = states(500, OBS + GOAL)
    graph = skill_graph(scaling_of(TASK), actor.weights(), OBS, GOAL)
    action = run(graph, obs=x[:, :OBS], goal=x[:, OBS:])
    assert action.shape == (500, 10)
    assert action.dtype == np.float32
    with torch.no_grad():
        assert np.abs(action - torch.tanh(actor(torch.from_numpy(x))).numpy()).max() < 1e-6


def test_a_chain_graph_gives_positions_in_metres() -> None:
    policy, space = network(chain_layout(TASK), 12), SubgoalSpace.of(TASK)
    x = states(50, OBS + 3)
    graph = chain_graph(scaling_of(TASK, chain_layout(TASK)), policy.weights(), space, OBS)
    with torch.no_grad():
        image = torch.tanh(policy(torch.from_numpy(x))[:, :6]).numpy()
    found = run(graph, obs=x[:, :OBS], task_goal=x[:, OBS:])
    assert np.abs(found - (space.centre + space.half * image)).max() < 1e-6


def test_a_value_graph_gives_a_probability_and_reads_positions_alone() -> None:
    layout = value_layout(TASK)
    value = network(layout, 1)
    x = states(50, OBS + 3 + 6)
    graph = value_graph(scaling_of(TASK, layout), value.weights(), OBS, GOAL)
    with torch.no_grad():
        wished = torch.sigmoid(value(torch.from_numpy(x))).numpy()
    for flags in (0.0, 1.0):
        subgoal = np.concatenate([x[:, OBS + 3 :], np.full((50, 2), flags, np.float32)], axis=1)
        found = run(graph, obs=x[:, :OBS], task_goal=x[:, OBS : OBS + 3], subgoal=subgoal)
        assert np.abs(found - wished).max() < 1e-6


def test_features_do_not_care_about_a_full_turn() -> None:
    net = network(None, 1)
    x = states(20, OBS + GOAL)
    turned = x.copy()
    turned[:, 12] += 2 * np.pi
    plain = np.arange(len(net.centre))
    difference = (net.features(torch.from_numpy(turned)) - net.features(torch.from_numpy(x))).abs()
    difference[:, plain] = 0.0
    assert float(difference.max()) < 1e-4


def test_scaling_is_fixed_by_the_workspace() -> None:
    scaling = scaling_of(TASK)
    low, high = TASK.cell.arms[1].entry.workspace_lower_m, TASK.cell.arms[0].entry.workspace_upper_m
    assert scaling.centre[:3] == pytest.approx((np.array(low) + high) / 2)
    assert scaling.scale[:3] == pytest.approx((np.array(high) - low) / 2)
    assert (scaling.differences.sum(axis=1) == 0.0).all()
    assert (np.abs(scaling.differences).sum(axis=1) == 2.0).all()


def test_every_free_position_is_chosen() -> None:
    space = SubgoalSpace.of(TASK)
    assert space.free.tolist() == [[1.0] * 6, [1.0] * 6, [0.0] * 6]
    image = torch.tensor([[0.5, -0.5, 0.1, 0.0, 0.9, -0.9]])
    positions = space.positions(image.numpy())
    back = space.image(torch.from_numpy(positions.astype(np.float32)))
    assert back.numpy() == pytest.approx(image.numpy(), abs=1e-6)
