"""The model card of a bundle, in the form that the Hugging Face hub shows."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence

from viskill_deploy.bundle.format import Manifest
from viskill_deploy.train import methods
from viskill_deploy.train.evaluate import Score
from viskill_deploy.train.settings import RunSettings, settings_facts

CARD = """---
license: mit
library_name: onnx
tags:
- robotics
- surgical-robotics
- dvrk
- reinforcement-learning
- skill-chaining
pipeline_tag: robotics
---

# {name}

Skills and chaining policies for the task **{task}** on {arms}, trained by {created_by}.

## What it does
{skills}

A long task is cut into skills; at the start of each skill but the last, a chaining policy chooses
the subgoal that the skill has to reach (T. Huang et al., IROS 2023). {about} {value}

Graphs, inputs, units and frames are those of the bundle format: metres and radians in the task
frame, control point at the jaw pivot, scaling inside the graphs. An action holds, per arm, a
displacement of {displacement:g} m per unit (shortened to {longest:g} m), a turn, and the jaw (below
0 closes it). One action is one waypoint of {step:g} s.

## How well
Measured in the learning world of this project (both arms at joint level in MuJoCo), deterministic
policies, full-length episodes, layouts that neither training nor selection has seen:

{scores}

## How it was trained
Skills: imitation of at least {demos} demonstrations and {corrected} disturbed ones of the task's
scripted controller, {corrections} rounds in which the script corrects the learner, then DEX with
goals in hindsight; the weights of the best test are kept. Chaining: over frozen skills, values
without discount. Seed {seed}.

    viskill train {task} --method {method} --seed {seed} --output {run}{file}
    {command}

train, export and measure it again{settings}.

## Limits
- Trained and measured in simulation only. Nothing here says how it does on a real robot, where
  cable stretch, registration and camera errors of several millimetres are common.
- {poses}
- Outside the manifest's `training_range` it was never asked anything.
- It is no medical device.
"""


VALUE = "A value tells how likely the whole task is to succeed."
NO_VALUE = "It has no value that tells how likely the whole task is to succeed."
EXACT = "It was trained with exact poses of arms and objects."
HIDDEN = (
    "It was trained on arms and objects whose poses are wrong by {scale:g} of the errors of a "
    "robot that nobody has calibrated."
)


def model_card(
    manifest: Manifest, settings: RunSettings, scores: Sequence[Score], command: str, run: str
) -> str:
    """The text of `MODEL_CARD.md`.

    Args:
        manifest: of the bundle.
        settings: of the run.
        scores: in the learning world.
        command: that exported it.
        run: folder of the run.
    """
    arms = " and ".join(f"{arm.name} ({arm.robot}, {arm.tool})" for arm in manifest.arms)
    facts = settings_facts(settings)
    is_usual = settings == RunSettings()
    return CARD.format(
        name=manifest.name,
        task=manifest.task,
        method=manifest.method,
        about=methods.about(manifest.method),
        value=VALUE if manifest.value else NO_VALUE,
        arms=arms,
        created_by=manifest.created_by,
        skills="\n".join(f"- `{s.name}`, {s.budget} steps: `{s.file}`" for s in manifest.skills),
        displacement=manifest.action.displacement_m,
        longest=manifest.action.max_displacement_m,
        step=manifest.step_s,
        scores=_table(scores),
        command=command,
        run=shlex.quote(run),
        demos=settings.demos.episodes,
        corrected=settings.demos.corrected,
        corrections=settings.skill.corrections,
        seed=manifest.seeds[0],
        file="" if is_usual else " --settings settings.json",
        settings="" if is_usual else f", with `settings.json`: `{json.dumps(facts)}`",
        poses=HIDDEN.format(scale=settings.hidden.scale) if settings.hidden.scale else EXACT,
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
            f"| {score.distribution} | {score.episodes} | {score.success_rate:.3f} | {parts} |"
        )
    return "\n".join(rows)
