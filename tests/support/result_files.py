"""Results as units leave them, made up."""

import json
from dataclasses import replace

import numpy as np

from viskill_deploy.train.calibration import Calibration
from viskill_deploy.train.reliability import reliability
from viskill_deploy.train.results import SCHEMA, Figures, Measuring, Result, Training, Unit
from viskill_deploy.train.settings import RunSettings, settings_facts

TRAINING = Training(
    seconds={"demos": 20.0, "skill-grasp": 100.0, "skill-release": 80.0, "chain-viskill": 150.0},
    curves={"skill-grasp": {"round": [0.0, 1.0], "exploring": [None, 0.4], "success": [0.2, 0.9]}},
    threads=1,
    peak_memory_mib=400.0,
    versions={"python": "3.11"},
    commit="0" * 40,
)


def figures(success: float, subtasks: float = 2.0, length: float | None = 60.0) -> Figures:
    return Figures(100, success, subtasks, length, {"grasp": 1.0, "release": success})


def honest_calibration(seed: int) -> Calibration:
    """Values that are true: 200 episodes a skill."""
    rng = np.random.default_rng(seed)
    parts = [rng.random(200) for _ in range(2)]
    outcomes = [rng.random(200) < values for values in parts]
    skills = [reliability(v, o) for v, o in zip(parts, outcomes, strict=True)]
    together = reliability(np.concatenate(parts), np.concatenate(outcomes))
    return Calibration(together, dict(zip(("grasp", "release"), skills, strict=True)))


def result(
    task: str, method: str, seed: int, success: float, wide: float = 0.8, **figure: float | None
) -> Result:
    return Result(
        schema=SCHEMA,
        unit=Unit(task, method, seed),
        settings=json.loads(json.dumps(settings_facts(RunSettings()))),
        measuring=Measuring(),
        training=TRAINING,
        scores={"reference": figures(success, **figure), "wide": figures(wide)},  # type: ignore[arg-type]
        calibration=honest_calibration(seed) if method == "viskill" else None,
        measuring_seconds={"evaluation": 30.0, "calibration": 60.0},
    )


def without_success(made: Result) -> Result:
    """The same, but no episode succeeded."""
    scores = {name: figures(0.0, 0.1, None) for name in made.scores}
    return replace(made, scores=scores)
