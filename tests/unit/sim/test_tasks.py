from collections import Counter

import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.sim.tasks import load_task, task_names


def test_a_task_is_found_by_the_name_of_its_file() -> None:
    assert "bipegtransfer" in task_names()
    for name in task_names():
        assert load_task(name).name == name


def test_an_unknown_task_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(DataFileError, match="bipegtransfer"):
        load_task("knot_tying")


def test_a_cell_without_a_board_is_refused() -> None:
    cell = load_cell("bipegtransfer")
    bare = cell.file.model_copy(update={"board": None})
    with pytest.raises(DataFileError, match="board"):
        load_task("bipegtransfer", cell.__class__(cell.name, cell.arms, bare, cell.files))


@pytest.mark.parametrize("name", task_names())
def test_layouts_have_the_sizes_of_what_the_task_makes(name: str) -> None:
    task = load_task(name)
    rng = np.random.default_rng(0)
    arms = len(task.cell.arms)
    size = sum(length for _, length in task.observation_layout)
    for distribution in task.distributions:
        scene = task.sample_layout(rng, distribution)
        obs = task.observe([np.eye(4)] * arms, [0.0] * arms, scene)
        assert obs.shape == (size,)
        goals = task.subgoals(obs, scene, rng)
        for skill in task.skills:
            assert goals[skill.name].shape == (sum(n for _, n in task.goal_layout),)
            assert len(skill.may_open_jaw) == arms
            action = task.scripted_action(skill.name, obs, goals[skill.name])
            assert action.shape == (5 * arms,)
            assert np.isfinite(action).all()


@pytest.mark.parametrize("name", task_names())
def test_the_same_seed_gives_the_same_layout(name: str) -> None:
    task = load_task(name)
    for distribution in task.distributions:
        a, b = (task.sample_layout(np.random.default_rng(5), distribution) for _ in range(2))
        assert a.active == b.active
        assert np.array_equal(a.goal, b.goal)
        for one, other in zip(a.objects, b.objects, strict=True):
            assert np.array_equal(one.T_task_object, other.T_task_object)


@pytest.mark.parametrize("name", task_names())
def test_an_unknown_distribution_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="wide"):
        load_task(name).sample_layout(np.random.default_rng(0), "narrow")


def test_wide_layouts_use_every_start_and_goal_peg_about_equally() -> None:
    task = load_task("bipegtransfer")
    board = task.cell.file.board
    assert board is not None
    rng = np.random.default_rng(1)
    starts: Counter[int] = Counter()
    goals: Counter[int] = Counter()
    pegs = np.array(board.peg_xy_m)
    for _ in range(600):
        scene = task.sample_layout(rng, "wide")
        place = scene.pose(scene.active)[:2, 3]
        starts[int(np.argmin(np.linalg.norm(pegs - place, axis=1)))] += 1
        goals[int(np.argmin(np.linalg.norm(pegs - scene.goal[:2], axis=1)))] += 1
        places = np.array([thing.T_task_object[:2, 3] for thing in scene.objects])
        apart = np.linalg.norm(places[:, None] - places[None], axis=2)[~np.eye(4, dtype=bool)]
        assert apart.min() > 0.02
    assert set(starts) == {6, 7, 8, 9, 10, 11}
    assert set(goals) == {0, 1, 2, 3, 4, 5}
    assert min(starts.values()) > 60
    assert min(goals.values()) > 60


def test_reference_layouts_are_those_of_the_reference_task() -> None:
    task = load_task("bipegtransfer")
    board = task.cell.file.board
    assert board is not None
    rng = np.random.default_rng(2)
    active: Counter[str] = Counter()
    yaws = []
    for _ in range(400):
        scene = task.sample_layout(rng, "reference")
        assert scene.goal[:2] == pytest.approx(board.peg_xy_m[2])
        for thing, peg in zip(scene.objects, (11, 6, 9, 10), strict=True):
            assert thing.T_task_object[:2, 3] == pytest.approx(board.peg_xy_m[peg])
            yaws.append(np.arctan2(thing.T_task_object[1, 0], thing.T_task_object[0, 0]))
        active[scene.active] += 1
    assert min(active.values()) > 70
    assert max(map(abs, yaws)) <= np.radians(30)
    assert np.std(yaws) == pytest.approx(np.radians(60) / np.sqrt(12), rel=0.1)
