"""S01: every number sent is finite, float64 and in the right place."""

from __future__ import annotations

from collections.abc import Iterator
from math import isnan
from typing import Any, ClassVar

from viskill_deploy.core.types import Action, JointSetpoint, Request, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.soundness import are_sound, first_unsound, is_vector


class Rule:
    """FAULT: a line that makes such a number cannot be trusted with the next one."""

    id: ClassVar[str] = "S01"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        self._arms = len(cell.arms)
        self._joints = tuple(len(arm.joint_names) for arm in cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """1.0 for a sound request, also for none at all (that is S16's)."""
        request = cycle.request
        return 1.0 if request.setpoints is None or self._is_sound(request) else -1.0

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an unsound arm; one for the cell when the shape is wrong."""
        setpoints: Any = cycle.request.setpoints
        if is_vector(setpoints, self._arms):
            for arm, (setpoint, joints) in enumerate(zip(setpoints, self._joints, strict=True)):
                if not _is_sound(setpoint, joints):
                    yield Verdict(self.id, Action.FAULT, arm, _joint(setpoint, joints))
            if not self._has_sound_rest(cycle.request):
                yield Verdict(self.id, Action.FAULT)
        else:
            yield Verdict(self.id, Action.FAULT)

    def _is_sound(self, request: Request) -> bool:
        setpoints: Any = request.setpoints
        return (
            is_vector(setpoints, self._arms)
            and all(map(_is_sound, setpoints, self._joints))
            and self._has_sound_rest(request)
        )

    def _has_sound_rest(self, request: Request) -> bool:
        due = request.waypoint_due_s
        return (
            isinstance(due, float)
            and not isnan(due)
            and len(request.may_open_jaw) in (0, self._arms)
            and len(request.holding) in (0, self._arms)
            and self._has_sound_tips(request.tips)
        )

    def _has_sound_tips(self, tips: Any) -> bool:
        if tips.__class__ is not tuple or len(tips) not in (0, self._arms):
            return False
        return all(tip.__class__ is tuple and len(tip) == 3 and are_sound(tip) for tip in tips)


def _is_sound(setpoint: Any, joints: int) -> bool:
    return (
        setpoint.__class__ is JointSetpoint
        and is_vector(setpoint.jp, joints)
        and is_vector(setpoint.jv, joints)
        and are_sound((*setpoint.jp, *setpoint.jv, setpoint.jaw, setpoint.jaw_v))
    )


def _joint(setpoint: Any, joints: int) -> int:
    """Index of the first bad joint, then the jaw's, -1 for the whole setpoint."""
    if setpoint.__class__ is not JointSetpoint:
        return -1
    if not (is_vector(setpoint.jp, joints) and is_vector(setpoint.jv, joints)):
        return -1
    axes = (*setpoint.jp, setpoint.jaw), (*setpoint.jv, setpoint.jaw_v)
    return min(*map(first_unsound, axes), joints)
