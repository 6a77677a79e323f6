"""Holds an imported official checkpoint against numbers that the official code computed.

Usage: python benchmarks/official_reference.py CHECKPOINT_FOLDER

The folder holds the checkpoints and, from the official code on the same weights,
`reference_vectors.npz` (single calls) and `reference_rollouts.npz` (whole episodes, step by step).
Prints the largest difference of every quantity and exits with 1 when one is above 1e-5.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime

from viskill_deploy.bundle.format import chain_file, skill_file, value_file
from viskill_deploy.bundle.official.checkpoint import Official, read_official
from viskill_deploy.bundle.official.convert import write_bundle
from viskill_deploy.bundle.official.layout import find_checkpoints
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.tasks.bipegtransfer import CONTACTS

TOLERANCE = 1e-5
ROUNDED_INPUT = "network input from float32"
ROUNDING = 1.2e-5
"""Half a unit in the last place of a scaled position (2.4e-7 / 2 between 2 and 4) over the smallest
standard deviation of a normalizer (0.01): what taking float32 inputs costs, whoever computes."""

Run = Callable[..., dict[str, np.ndarray]]


def runner(path: Path) -> Run:
    """Runs a graph on rows; gives all outputs by name."""
    session = onnxruntime.InferenceSession(path.read_bytes())
    names = [node.name for node in session.get_outputs()]

    def run(**inputs: np.ndarray) -> dict[str, np.ndarray]:
        feed = {name: values.astype(np.float32) for name, values in inputs.items()}
        return dict(zip(names, session.run(names, feed), strict=True))

    return run


def vectors(policy: Official, bundle: Path, file: Path) -> dict[str, float]:
    """Largest difference of every quantity over the single calls."""
    data, worst = np.load(file), {}

    def note(name: str, found: np.ndarray, wished: np.ndarray) -> None:
        difference = np.abs(found.reshape(wished.shape) - wished).max(initial=0.0)
        worst[name] = max(worst.get(name, 0.0), float(difference))

    for skill in np.unique(data["subtask"]).tolist():
        rows = data["subtask"] == skill
        obs, goal = data["obs"][rows], data["desired_goal"][rows]
        low = runner(bundle / skill_file(skill))(obs=obs, goal=goal)
        note("action", low["action"], data["sl_action"][rows])
        note(ROUNDED_INPUT, low["network_input"], data["sl_input_norm"][rows])
        scaled = [
            np.clip((x - n.mean) / n.std, -n.clip, n.clip)
            for x, n in ((obs, policy.skills[skill].observation), (goal, policy.skills[skill].goal))
        ]
        note("network input", np.hstack(scaled), data["sl_input_norm"][rows])
        note("skill's Q", low["q"], data["sl_q"][rows])
        if not (bundle / chain_file(skill)).exists():
            continue
        unused = np.zeros((rows.sum(), 3))
        chain = runner(bundle / chain_file(skill))(obs=obs, task_goal=unused)
        note("subgoal", chain["subgoal"], data["sc_mean_subgoal"][rows])
        note("log-std", chain["log_std"], data["sc_log_std"][rows])
        value = runner(bundle / value_file(skill))
        for subgoal, names in (
            (data["sc_mean_subgoal"], {"q1": "sc_q1", "q2": "sc_q2", "value": "sc_qmin"}),
            (data["test_subgoal"], {"value": "sc_test_subgoal_q"}),
        ):
            whole = np.pad(subgoal[rows], ((0, 0), (0, goal.shape[1] - subgoal.shape[1])))
            told = value(obs=obs, task_goal=unused, subgoal=whole)
            for output, name in names.items():
                note(f"chain's {name}", told[output], data[name][rows])
    return worst


def rollouts(bundle: Path, file: Path) -> dict[str, float]:
    """Largest difference of adapted goals and actions over whole episodes, step by step."""
    data = np.load(file)
    names, worst, goal = data["subtask_names"].tolist(), {"goal": 0.0, "rollout action": 0.0}, None
    skills = {name: runner(bundle / skill_file(name)) for name in names}
    chains = {name: runner(bundle / chain_file(name)) for name in names[:-1]}
    for row in range(len(data["t"])):
        name, obs = names[data["subtask"][row]], data["obs"][row : row + 1]
        if data["is_sc_step"][row] and name in chains:
            chosen = chains[name](obs=obs, task_goal=np.zeros((1, 3)))["subgoal"][0]
            goal = np.concatenate([chosen, CONTACTS[name]])
        if name not in chains:
            goal = data["desired_goal_env"][row]
        action = skills[name](obs=obs, goal=goal[None])["action"][0]
        for what, found, wished in (
            ("goal", goal, data["desired_goal_adapted"][row]),
            ("rollout action", action, data["sl_action"][row]),
        ):
            worst[what] = max(worst[what], float(np.abs(found - wished).max()))
    return worst


def main() -> None:
    """Imports, compares, prints."""
    folder = Path(sys.argv[1])
    found = find_checkpoints(folder)
    task = load_task(found.task)
    with tempfile.TemporaryDirectory() as name:
        policy = read_official(found, task)
        bundle = write_bundle(policy, task, Path(name) / "bundle")
        worst = vectors(policy, bundle, folder / "reference_vectors.npz")
        worst |= rollouts(bundle, folder / "reference_rollouts.npz")
    for quantity, difference in worst.items():
        print(f"{quantity:28} {difference:.2e}")
    allowed = {ROUNDED_INPUT: TOLERANCE + ROUNDING}
    sys.exit(any(not x <= allowed.get(name, TOLERANCE) for name, x in worst.items()))


if __name__ == "__main__":
    main()
