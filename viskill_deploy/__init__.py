"""ViSkill policies on the da Vinci Research Kit, safely.

`load_arm`, `Arm` and `IkSolver` are loaded when first asked for: importing the package costs
nothing to those who want something else of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from viskill_deploy.kinematics.arm import Arm, load_arm
    from viskill_deploy.kinematics.ik import IkSolver

__all__ = ["Arm", "IkSolver", "load_arm"]


def __getattr__(name: str) -> Any:
    if name in {"Arm", "load_arm"}:
        from viskill_deploy.kinematics import arm  # noqa: PLC0415 - the point of this function

        return getattr(arm, name)
    if name == "IkSolver":
        from viskill_deploy.kinematics import ik  # noqa: PLC0415

        return ik.IkSolver
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
