"""How fast episodes run side by side, beside the same episodes one by one, and where time goes.

OMP_NUM_THREADS=1 python benchmarks/learning_world.py [--task NAME] [--count 32] [--bystanders]

All in one process and thread: physics, kinematics, smoothing, observation, scripted controller.
Times are of the CPU. Both run in turns, step by step, so that a machine that changes its speed
changes it for both.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from viskill_deploy.sim import vector_loop, vector_task
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks import SkillSpec, Task, load_task
from viskill_deploy.sim.vector_loop import VectorLoop

Goals = list[dict[str, np.ndarray[Any, np.dtype[np.float64]]]]


class Stopwatch:
    """CPU seconds by name, and simulated seconds and policy steps that were done in them."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()

    def watch(self, owner: object, method: str, name: str) -> None:
        """Adds the time that calls of a method take to `name` from now on."""
        original: Callable[..., Any] = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.process_time()
            result = original(*args, **kwargs)
            self.seconds[name] += time.process_time() - start
            return result

        setattr(owner, method, timed)


def run_skill(
    loop: VectorLoop, alone: ClosedLoop, skill: SkillSpec, goals: Goals, watch: Stopwatch
) -> float:
    """Runs one skill everywhere and alone, step by step in turns; returns simulated seconds."""
    names, skills = [skill.name] * loop.count, [skill] * loop.count
    wanted, simulated = np.array([goal[skill.name] for goal in goals]), 0.0
    rows, row = loop.observe(), alone.observe()
    for _ in range(skill.budget):
        start = time.process_time()
        actions = vector_task.scripted_actions(loop.task, names, rows, wanted)
        scripted = time.process_time()
        loop.step(actions, skills)
        stepped = time.process_time()
        rows = loop.observe()
        seen = time.process_time()
        action = alone.task.scripted_action(skill.name, row, wanted[0])
        row = alone.step(action, skill)
        watch.seconds["script"] += scripted - start
        watch.seconds["observation"] += seen - stepped
        watch.seconds["side by side"] += seen - start
        watch.seconds["one by one"] += time.process_time() - seen
        simulated += float(loop.stretch.sum()) * loop.task.cell.file.motion.step_s
    return simulated


def measure(task: Task, count: int, episodes: int, seed: int, bystanders: bool) -> None:
    loop, alone = VectorLoop(task, count, bystanders=bystanders), ClosedLoop(task)
    watch = Stopwatch()
    watch.watch(vector_loop, "apply_actions", "waypoints")
    watch.watch(vector_loop, "targets", "inverse kinematics")
    watch.watch(loop._planner, "plan", "segments")
    watch.watch(loop._physics, "run", "physics")
    simulated = resets = 0.0
    done = []
    for episode in range(episodes):
        rngs = [np.random.default_rng((seed, episode, index)) for index in range(count)]
        scenes = [task.sample_layout(rng, task.distributions[0]) for rng in rngs]
        start = time.process_time()
        loop.reset(dict(enumerate(scenes)))
        resets += time.process_time() - start
        rows = zip(loop.observe(), loop.scenes(), rngs, strict=True)
        goals = [task.subgoals(obs, scene, rng) for obs, scene, rng in rows]
        alone.reset(scenes[0])
        simulated += sum(run_skill(loop, alone, skill, goals, watch) for skill in task.skills)
        done.append(loop.success().mean())
    budget = episodes * sum(skill.budget for skill in task.skills)
    steps, step_s = count * budget, task.cell.file.motion.step_s
    spent = watch.seconds.pop("side by side")
    rate, peer_rate = steps / spent, budget / watch.seconds.pop("one by one")
    print(
        f"{task.name}, {count} side by side, success {np.mean(done):.2f}: {rate:.0f} policy "
        f"steps/s and core, {simulated / step_s / spent:.0f} of {step_s:g} s simulated; one by one "
        f"{peer_rate:.0f}; ratio {rate / peer_rate:.2f}"
    )
    parts = {name: value / steps * 1e6 for name, value in watch.seconds.most_common()}
    parts["rest"] = spent / steps * 1e6 - sum(parts.values())
    print("  us a step: " + ", ".join(f"{name} {value:.0f}" for name, value in parts.items()))
    print(f"  a reset: {resets / (count * episodes) * 1e3:.1f} ms of CPU, not counted above")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="bipegtransfer")
    parser.add_argument("--count", type=int, nargs="+", default=[32])
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bystanders", action="store_true", help="simulate what is not moved, too")
    options = parser.parse_args()
    task = load_task(options.task)
    for count in options.count:
        measure(task, count, options.episodes, options.seed, options.bystanders)


if __name__ == "__main__":
    main()
