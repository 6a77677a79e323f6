"""How fast the world is and how often the scripted controller succeeds in it.

python benchmarks/world.py [--task bipegtransfer] [--episodes 100] [--seed 0] [--processes 2]
"""

from __future__ import annotations

import argparse
import time

from viskill_deploy.sim.tasks import load_task
from viskill_deploy.train.episodes import workers
from viskill_deploy.train.evaluate import evaluate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="bipegtransfer")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    task = load_task(options.task)
    steps = options.episodes * sum(skill.budget for skill in task.skills)
    with workers(options.processes) as pool:
        for distribution in task.distributions:
            evaluate(task, None, distribution, options.processes, options.seed + 1, pool)  # warm up
            start = time.perf_counter()
            score = evaluate(task, None, distribution, options.episodes, options.seed, pool)
            rate = steps / (time.perf_counter() - start)
            skills = ", ".join(f"{name} {share:.2f}" for name, share in score.skills.items())
            print(
                f"{distribution}: success {score.success_rate:.2f} of {score.episodes} ({skills}); "
                f"{rate:.0f} policy steps/s in {options.processes} processes"
            )


if __name__ == "__main__":
    main()
