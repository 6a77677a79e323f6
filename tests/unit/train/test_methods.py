"""What sets baselines and ablations apart from ViSkill, against values computed by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from viskill_deploy.sim.tasks import load_task
from viskill_deploy.train.chaining import ChainSettings, Transitions
from viskill_deploy.train.demos import SkillDemos
from viskill_deploy.train.flat import uncorrected
from viskill_deploy.train.initiation import Likeness, Nearness
from viskill_deploy.train.methods.tstar import WEIGHT, TerminalState
from viskill_deploy.train.methods.viskill_dm import MeasuredChaining
from viskill_deploy.train.methods.viskill_ldm import LearnedMeasures
from viskill_deploy.train.replay import Batch, Episodes
from viskill_deploy.train.skill_learning import SkillSettings
from viskill_deploy.train.whole_task import WholeTask, whole_demos

TASK = load_task("bipegtransfer")
SIZE = 35
COUNT = 8


def draw(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.05, 0.05, shape).astype(np.float32)


def silenced(likeness: Likeness) -> Likeness:
    """A discriminator that says one half to everything."""
    with torch.no_grad():
        likeness.network.layers[-1].weight.zero_()
        likeness.network.layers[-1].bias.zero_()
    return likeness


def transitions() -> Transitions:
    outcome = np.tile([0.0, 1.0], COUNT // 2).astype(np.float32)
    return Transitions(
        draw(1, COUNT, SIZE),
        draw(2, COUNT, 3),
        draw(3, COUNT, 6),
        draw(4, COUNT, SIZE),
        draw(5, COUNT, 6),
        np.zeros(COUNT, np.float32),
        outcome,
        1.0 - outcome,
    )


def test_a_demonstrated_start_is_as_near_as_can_be() -> None:
    starts = draw(0, 20, SIZE)
    assert Nearness(TASK, starts).of(starts) == pytest.approx(1.0)


def test_nearness_falls_by_e_for_every_distance_between_neighbouring_starts() -> None:
    """Starts in a row of equal steps; a state as far beyond its end as n steps."""
    step = np.zeros(SIZE, np.float32)
    step[0] = 0.01
    starts = np.array([k * step for k in range(5)], np.float32)
    beyond = np.array([4 * step + n * step for n in (1, 2)], np.float32)
    nearness = Nearness(TASK, starts).of(beyond)
    assert nearness == pytest.approx([math.exp(-1), math.exp(-2)], rel=1e-3)


def test_dm_targets_are_nearness_to_the_next_skills_starts_and_at_last_the_outcome() -> None:
    batch = transitions()
    measures = [Nearness(TASK, draw(10 + k, 20, SIZE)) for k in range(3)]
    chaining = MeasuredChaining(TASK, ChainSettings(hidden=16), 0, measures)
    for index in (0, 1):
        expected = measures[index + 1].of(batch.next_obs)
        assert (chaining.value_target(index, batch).numpy() == expected).all()
    assert (chaining.value_target(2, batch).numpy() == batch.outcome).all()


def test_a_discriminator_that_knows_nothing_loses_log_2() -> None:
    likeness = silenced(Likeness(TASK, draw(0, 20, SIZE), 0, hidden=16))
    loss = likeness.update(draw(1, 64, SIZE), np.random.default_rng(0))
    assert loss == pytest.approx(math.log(2.0), rel=1e-6)


def test_the_discriminators_loss_is_the_cross_entropy_of_starts_and_states_met() -> None:
    starts, met = draw(0, 1, SIZE), draw(1, 4, SIZE)  # one start: whichever is drawn
    likeness = Likeness(TASK, starts, 0, hidden=16)
    a, b = likeness.of(starts)[0], likeness.of(met)
    by_hand = -(4 * math.log(a) + np.log(1.0 - b).sum()) / 8
    assert likeness.update(met, np.random.default_rng(0)) == pytest.approx(by_hand, rel=1e-5)


def test_a_discriminator_learns_to_tell_starts_from_other_states() -> None:
    starts, other = draw(0, 20, SIZE) + 0.05, draw(1, 200, SIZE) - 0.05
    likeness, rng = Likeness(TASK, starts, 0, hidden=16), np.random.default_rng(0)
    for _ in range(300):
        likeness.update(other[rng.integers(100, size=32)], rng)
    assert likeness.of(starts).mean() > 0.9
    assert likeness.of(other[100:]).mean() < 0.1


def test_ldm_goes_on_to_the_same_bits_after_a_break() -> None:
    def fresh() -> LearnedMeasures:
        measures = [Likeness(TASK, draw(10 + k, 20, SIZE), k, hidden=16) for k in range(3)]
        return LearnedMeasures(TASK, ChainSettings(hidden=16), 0, measures)

    whole, batch = fresh(), transitions()
    whole.update(0, batch, batch)
    broken = fresh()
    broken.restore(whole.state())
    for one in (whole, broken):
        one.update(1, batch, batch)
        one.update(0, batch, None)
    for index in range(3):
        assert torch.equal(whole.value_target(index, batch), broken.value_target(index, batch))
    a, b = (one.choose(0, batch.obs, batch.task_goal) for one in (whole, broken))
    assert np.array_equal(a, b)


def test_ldm_trains_the_measure_of_the_skill_that_follows() -> None:
    measures = [Likeness(TASK, draw(10 + k, 20, SIZE), k, hidden=16) for k in range(3)]
    chaining, batch = (
        LearnedMeasures(TASK, ChainSettings(hidden=16), 0, measures),
        transitions(),
    )
    before = [measure.of(batch.next_obs) for measure in measures]
    chaining.update(0, batch, None)
    changed = [
        not np.array_equal(measure.of(batch.next_obs), old)
        for measure, old in zip(measures, before, strict=True)
    ]
    assert changed == [False, True, False]


def test_tstar_takes_reward_from_last_states_only() -> None:
    shaping = TerminalState(silenced(Likeness(TASK, draw(0, 20, SIZE), 0, hidden=16)))
    last = np.array([True, False, True, False])
    batch = Batch(
        obs=draw(1, 4, SIZE),
        goal=draw(2, 4, 9),
        action=draw(3, 4, 10),
        reward=np.array([0.0, -1.0, -1.0, 0.0], np.float32),
        next_obs=draw(4, 4, SIZE),
        next_action=draw(5, 4, 10),
        last=last,
    )
    lost = np.where(last, 0.5 * WEIGHT, 0.0)
    assert shaping.shaped(batch).reward == pytest.approx(batch.reward - lost)


def test_tstar_goes_on_to_the_same_bits_after_a_break() -> None:
    def fresh() -> TerminalState:
        return TerminalState(Likeness(TASK, draw(0, 20, SIZE), 0, hidden=16))

    episodes = Episodes(draw(1, 6, 5, SIZE), draw(2, 6, 5, 9), draw(3, 6, 9), draw(4, 6, 4, 10))
    whole, rng = fresh(), np.random.default_rng(0)
    whole.meet(episodes, rng)
    broken = fresh()
    broken.restore(whole.state())
    for one in (whole, broken):
        one.meet(episodes, np.random.default_rng(1))
    assert all(np.array_equal(a, b) for a, b in zip(*map(weights, (whole, broken)), strict=True))


def weights(shaping: TerminalState) -> list[np.ndarray]:
    tree = shaping.state()["weights"]
    return [tree[key] for key in sorted(tree)]


def test_whole_demonstrations_are_those_of_the_skills_end_to_end() -> None:
    """The last observation of a skill is the first of the next one and stands there once."""
    parts, seen = [], 0
    for index, skill in enumerate(TASK.skills):
        obs = draw(20, 2, 1, SIZE) + np.arange(seen, seen + skill.budget + 1)[None, :, None]
        flags = np.full((2, skill.budget + 1, 3), index, np.float32)
        achieved = np.concatenate([draw(21, 2, skill.budget + 1, 6), flags], axis=2)
        goal, action = draw(22 + index, 2, 9), np.full((2, skill.budget, 10), index, np.float32)
        clean = Episodes(obs.astype(np.float32), achieved, goal, action)
        aims = draw(30, 2, 9)
        parts.append(SkillDemos(clean, clean, (), aims, aims))
        seen += skill.budget
    whole = whole_demos(TASK, parts).clean
    assert whole.obs.shape[1] == seen + 1 == sum(s.budget for s in TASK.skills) + 1
    assert np.diff(whole.obs, axis=1) == pytest.approx(1.0, abs=1e-4)
    budgets = [skill.budget for skill in TASK.skills]
    assert (whole.action[0, :, 0] == np.repeat([0, 1, 2], budgets)).all()
    assert (whole.goal == draw(30, 2, 9)).all()


def test_the_whole_task_has_one_skill_with_all_the_steps() -> None:
    whole = WholeTask(TASK)
    assert [skill.budget for skill in whole.skills] == [sum(s.budget for s in TASK.skills)]
    assert whole.cell is TASK.cell


def test_flat_methods_imitate_for_as_many_steps_as_all_skills_together() -> None:
    skill = SkillSettings(imitation_steps=3, corrections=6, correction_steps=5, polish_steps=7)
    flat = uncorrected(skill, 4)
    assert (flat.imitation_steps, flat.polish_steps, flat.corrections) == (4 * 28, 28, 0)
    assert uncorrected(replace(skill, corrections=0), 4).imitation_steps == 12
