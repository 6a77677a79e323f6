"""One file a method: a name is a file with `learn(run) -> TaskPolicy`."""

from __future__ import annotations

import importlib
import pkgutil
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
    if name not in method_names():
        raise TrainingError(
            f"method {name!r} is unknown; choose one of {', '.join(method_names())}"
        )
    module = importlib.import_module(f"{__name__}.{name}")
    return cast(TaskPolicy, module.learn(run))
