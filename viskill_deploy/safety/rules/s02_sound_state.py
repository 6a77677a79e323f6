"""S02: every measurement used is finite, of the right shape, from the right joints and tool."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, ArmState, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ArmEnvelope, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.soundness import are_sound, first_unsound, is_vector


class Rule:
    """FAULT: with such measurements nothing else can be judged."""

    id: ClassVar[str] = "S02"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        self._arms = cell.arms

    def margin(self, cycle: Cycle) -> float:
        """1.0 for a state that can be used."""
        arms = cycle.state.arms
        if is_vector(arms, len(self._arms)) and all(map(_can_be_used, arms, self._arms)):
            return 1.0
        return -1.0

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an unsound arm; one for the cell when their number is wrong."""
        arms = cycle.state.arms
        if not is_vector(arms, len(self._arms)):
            yield Verdict(self.id, Action.FAULT)
            return
        for index, (arm, envelope) in enumerate(zip(arms, self._arms, strict=True)):
            if not _is_expected(arm, envelope):
                yield Verdict(self.id, Action.FAULT, index)
            elif not _is_sound(arm, len(envelope.joint_names)):
                yield Verdict(self.id, Action.FAULT, index, _joint(arm, len(envelope.joint_names)))


def _can_be_used(arm: ArmState, envelope: ArmEnvelope) -> bool:
    return _is_expected(arm, envelope) and _is_sound(arm, len(envelope.joint_names))


def _is_expected(arm: ArmState, envelope: ArmEnvelope) -> bool:
    return (
        arm.__class__ is ArmState
        and arm.name == envelope.name
        and arm.tool == envelope.tool
        and arm.joint_names == envelope.joint_names
    )


def _is_sound(arm: ArmState, joints: int) -> bool:
    return _has_shape(arm, joints) and are_sound(
        (
            *arm.measured_jp,
            *arm.measured_jv,
            *arm.setpoint_jp,
            arm.jaw_measured_jp,
            arm.jaw_measured_jv,
            arm.jaw_setpoint_jp,
            arm.stamp_s,
        )
    )


def _has_shape(arm: ArmState, joints: int) -> bool:
    return (
        is_vector(arm.measured_jp, joints)
        and is_vector(arm.measured_jv, joints)
        and is_vector(arm.setpoint_jp, joints)
    )


def _joint(arm: ArmState, joints: int) -> int:
    """Index of the first bad joint, the jaw's for jaw or stamp, -1 for a wrong shape."""
    if not _has_shape(arm, joints):
        return -1
    return min(map(first_unsound, (arm.measured_jp, arm.measured_jv, arm.setpoint_jp)))
