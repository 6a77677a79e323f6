"""What a driver accepts: setpoints that the supervisor has passed, and nothing else."""

from __future__ import annotations

from typing import Final, NoReturn

from viskill_deploy.core.errors import SafetyStop
from viskill_deploy.core.types import JointSetpoint

_TOKEN: Final = object()
"""Only `supervisor.py` imports this; a test keeps it so."""


class CheckedSetpoint:
    """One arm's setpoint with the gate's word on it. Only the supervisor can make one.

    It cannot be subclassed, changed, copied, pickled or replaced, so that no second way to move
    comes into being by accident.

    Attributes:
        arm: index of the arm in the cell.
        setpoint: the very object that was asked for, or a sample of the gate's own stop.
    """

    __slots__ = ("arm", "setpoint")

    arm: int
    setpoint: JointSetpoint

    def __init__(self, arm: int, setpoint: JointSetpoint, token: object = None) -> None:
        if token is not _TOKEN:
            raise SafetyStop(
                "a CheckedSetpoint comes from Supervisor.check alone; ask it, and send what it "
                "returns"
            )
        _set_arm(self, arm)
        _set_setpoint(self, setpoint)

    def __init_subclass__(cls) -> None:
        raise SafetyStop("CheckedSetpoint cannot be subclassed; send what Supervisor.check returns")

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise SafetyStop(f"CheckedSetpoint.{name} cannot be set; ask Supervisor.check again")

    def __delattr__(self, name: str) -> NoReturn:
        raise SafetyStop(f"CheckedSetpoint.{name} cannot be deleted; ask Supervisor.check again")

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise SafetyStop("CheckedSetpoint cannot be copied or pickled; send it in this process")

    def __repr__(self) -> str:
        return f"CheckedSetpoint(arm={self.arm}, setpoint={self.setpoint})"


_set_arm = CheckedSetpoint.__dict__["arm"].__set__
_set_setpoint = CheckedSetpoint.__dict__["setpoint"].__set__
