"""How often the scripted controller of a task succeeds, and how fast the worlds are side by side.

python benchmarks/world.py [--task bipegtransfer] [--episodes 100] [--seed 0]
"""

from __future__ import annotations

import argparse
import time

from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.demos import script
from viskill_deploy.train.evaluate import evaluate
from viskill_deploy.train.methods.tstar import Scripted

COUNT = 50


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="bipegtransfer")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    task = load_task(options.task)
    loop = VectorLoop(task, COUNT)
    policy = Scripted([script(task, index) for index in range(len(task.skills))], options.seed)
    lots = -(-options.episodes // COUNT)
    steps = lots * COUNT * sum(skill.budget for skill in task.skills)
    for distribution in task.distributions:
        start = time.process_time()
        score = evaluate(loop, policy, distribution, options.episodes, options.seed)
        rate = steps / (time.process_time() - start)
        skills = ", ".join(f"{name} {share:.2f}" for name, share in score.skills.items())
        print(
            f"{distribution}: success {score.success_rate:.2f} of {score.episodes} ({skills}); "
            f"{rate:.0f} policy steps a second of one core, resets included"
        )


if __name__ == "__main__":
    main()
