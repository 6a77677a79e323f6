"""One file a method: a name is a file with `learn(run) -> TaskPolicy`.

A file that says `NEEDS_SKILLS = False` uses the demonstrations of a run and not its skills.
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


def _module(name: str) -> ModuleType:
    if name not in method_names():
        raise TrainingError(
            f"method {name!r} is unknown; choose one of {', '.join(method_names())}"
        )
    return importlib.import_module(f"{__name__}.{name}")
