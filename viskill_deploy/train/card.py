"""The model card of a bundle, in the form that the Hugging Face hub shows."""

from __future__ import annotations

from collections.abc import Sequence

from viskill_deploy.bundle.format import Manifest
from viskill_deploy.train.checkpoint import Checkpoint
from viskill_deploy.train.evaluate import Score

CARD = """---
license: mit
library_name: onnx
tags:
- robotics
- surgical-robotics
- dvrk
- imitation-learning
pipeline_tag: robotics
---

# {name}

Skill policies for the task **{task}** on {arms}, trained by {created_by}.

## What it does
{skills}

Each skill is an ONNX graph (float32, batch first): `obs` [N, {obs}] and `goal` [N, {goal}] →
`action` [N, {actions}]. Normalisation is inside. Lengths are metres and angles radians in the task
frame (centre of the board's top, x away from the arms' columns, y towards PSM1, z up). The control
point is the jaw pivot. An action holds, per arm, a displacement of {displacement:g} m per unit
(shortened to {longest:g} m), a turn about z of {rotation:.4f} rad per unit, and the jaw (below 0
closes it). One action is one waypoint of {step:g} s. Subgoals come from the scripted plan.

## How well
Measured in the MuJoCo cell of this project, deterministic policies, full-length episodes:

{scores}

```
{command}
```

## How it was trained
Imitation of the task's scripted controller with corrections (DAgger), seed {seed}: {states}
labelled states over {rounds} rounds of episodes in the same world, three hidden layers of {hidden}
for each skill. `viskill train {task} --seed {seed} --output RUN` and `viskill export` rebuild it.

## Limits
- Trained and measured in simulation only. Nothing here says how it does on a real robot, where
  cable stretch, registration and camera errors of several millimetres are common.
- It was trained with exact poses of arms and block.
- Blocks start upright, turned by at most 30 degrees; outside the manifest's `training_range` it was
  never asked anything.
- It is no medical device.
"""


def model_card(manifest: Manifest, state: Checkpoint, scores: Sequence[Score], command: str) -> str:
    """The text of `MODEL_CARD.md`."""
    arms = " and ".join(f"{arm.name} ({arm.robot}, {arm.tool})" for arm in manifest.arms)
    hidden = len(next(iter(state.weights.values()))["layers.0.bias"])
    return CARD.format(
        name=manifest.name,
        task=manifest.task,
        arms=arms,
        created_by=manifest.created_by,
        skills="\n".join(f"- `{s.name}`, {s.budget} steps: `{s.file}`" for s in manifest.skills),
        obs=manifest.observation_size,
        goal=manifest.goal_size,
        actions=5 * len(manifest.arms),
        displacement=manifest.action.displacement_m,
        longest=manifest.action.max_displacement_m,
        rotation=manifest.action.rotation_rad,
        step=manifest.step_s,
        scores=_table(scores),
        command=command,
        seed=state.seed,
        states=sum(len(data.obs) for data in state.data.values()),
        rounds=state.rounds_done,
        hidden=hidden,
    )


def _table(scores: Sequence[Score]) -> str:
    if not scores:
        return "Not measured."
    names = list(scores[0].skills)
    rows = ["| layouts | episodes | task | " + " | ".join(names) + " |"]
    rows.append("| --- " * (3 + len(names)) + "|")
    for score in scores:
        parts = " | ".join(f"{score.skills[name]:.2f}" for name in names)
        rows.append(
            f"| {score.distribution} | {score.episodes} | {score.success_rate:.2f} | {parts} |"
        )
    return "\n".join(rows)
