"""One file a method: a name is a file with `learn(run) -> TaskPolicy`.

A file that says `NEEDS_SKILLS = False` uses the demonstrations of a run and not its skills, one
with `CHAINS = False` has no chaining policy, and one with `VALUE_IS_PROBABILITY = True` has a value
that is the probability of the whole task's success.
"""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType
from typing import cast

from viskill_deploy.core.errors import TrainingError
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run


def method_names() -> list[str]:
    """Every method there is, sorted."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def learn(name: str, run: Run) -> TaskPolicy:
    """What the method in `methods/<name>.py` learns in `run`.

    Raises:
        TrainingError: there is no such method.
    """
    return cast(TaskPolicy, _module(name).learn(run))


def needs_skills(name: str) -> bool:
    """Whether a method builds on the skills that all methods of a run share.

    Raises:
        TrainingError: there is no such method.
    """
    return bool(getattr(_module(name), "NEEDS_SKILLS", True))


def chains(name: str) -> bool:
    """Whether a method learns a chaining policy over the skills.

    Raises:
        TrainingError: there is no such method.
    """
    return bool(getattr(_module(name), "CHAINS", True))


def value_is_probability(name: str) -> bool:
    """Whether a method's value says how likely the whole task succeeds.

    Raises:
        TrainingError: there is no such method.
    """
    return bool(getattr(_module(name), "VALUE_IS_PROBABILITY", False))


def about(name: str) -> str:
    """The first sentence of a method's file.

    Raises:
        TrainingError: there is no such method.
    """
    return (_module(name).__doc__ or "").split("\n", 1)[0]


def _module(name: str) -> ModuleType:
    if name not in method_names():
        raise TrainingError(
            f"method {name!r} is unknown; choose one of {', '.join(method_names())}"
        )
    return importlib.import_module(f"{__name__}.{name}")
