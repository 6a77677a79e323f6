"""What a guard tells its clients and the people at its terminal: states, verdicts and reasons."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ArmState, CellState, Mode, Verdict
from viskill_deploy.drivers.base import ENABLED, PAUSED
from viskill_deploy.drivers.crtk.offered_arm import Condition, OfferedArm


def silent(verdicts: Sequence[Verdict], mode: Mode) -> None:
    """Nobody looks on."""


class Telling:
    """The guard's voice. A client that cannot be told stops nothing.

    Args:
        arms: what clients see of the cell.
        show: shows people new verdicts and the mode.
        say: tells people why arms are stopped, and what the driver complains of.
        named: words for a rule's id.
    """

    def __init__(
        self,
        arms: Sequence[OfferedArm],
        show: Callable[[Sequence[Verdict], Mode], None] = silent,
        say: Callable[[str], None] = lambda _: None,
        named: Callable[[str], str] = str,
    ) -> None:
        self._arms, self._show, self._say, self._named = arms, show, say, named
        self._rules, self._mode, self._reason = set[str](), Mode.OFF, ""

    def begin(self, mode: Mode) -> None:
        """What was told before is past."""
        self._rules, self._mode, self._reason = set(), mode, ""

    def cycle(self, verdicts: Sequence[Verdict], mode: Mode, passed: bool, now: float) -> None:
        """Tells of a cycle of the gate if there is anything new in it.

        Args:
            verdicts: of all rules that spoke.
            mode: of the gate.
            passed: whether the request passed; until it does, what was told is known.
            now: driver's clock, s.
        """
        rules = {verdict.rule for verdict in verdicts}
        known = self._rules if mode is self._mode else set()
        is_news = mode is not self._mode or not rules <= known
        self._mode, self._rules = mode, rules if passed else known | rules
        if is_news:
            self.verdicts(verdicts, mode, now)

    def verdicts(self, verdicts: Sequence[Verdict], mode: Mode, now: float) -> None:
        """Clients hear verdicts on `warning`, and a mode without one on `status`."""
        self._show(verdicts, mode)
        said = [f"{self._named(v.rule)}: {v.action.name}" for v in verdicts]
        text = f"gate {mode.value}{': ' * bool(said)}{'; '.join(dict.fromkeys(said))}"
        for arm in self._arms:
            with contextlib.suppress(DriverError):
                arm.tell(text, bool(said), now)

    def reason(self, text: str, now: float) -> None:
        """Why arms are stopped, or what the driver complains of; people hear the same once."""
        if text != self._reason:
            self._reason = text
            self._say(text)
        for arm in self._arms:
            with contextlib.suppress(DriverError):
                arm.error(text, now)

    def states(self, state: CellState, mode: Mode, is_armed: bool, now: float) -> None:
        """Where the arms are, and in what condition.

        Args:
            state: of the robot.
            mode: of the gate.
            is_armed: whether the gate is in charge; else an arm without power speaks for itself.
            now: driver's clock, s.
        """
        for arm, arm_state in zip(self._arms, state.arms, strict=True):
            is_gates = is_armed or arm_state.operating_state == ENABLED
            condition = _condition(arm_state, mode if is_gates else Mode.OFF)
            self._speak(arm, arm_state, condition, now)

    def busy(self, state: CellState, now: float) -> None:
        """That enabling and homing take a while."""
        for arm, arm_state in zip(self._arms, state.arms, strict=True):
            condition = Condition(arm_state.operating_state, arm_state.is_homed, True)
            self._speak(arm, arm_state, condition, now)

    def _speak(self, arm: OfferedArm, state: ArmState, condition: Condition, now: float) -> None:
        with contextlib.suppress(DriverError):
            arm.speak(state, condition, now)


def _condition(arm: ArmState, mode: Mode) -> Condition:
    """What a client is told: PAUSED while the gate holds, busy until the operator agrees."""
    match mode:
        case Mode.ARMED | Mode.RUNNING:
            return Condition(ENABLED, True, False)
        case Mode.HOLDING:
            return Condition(PAUSED, True, False)
        case Mode.FAULT | Mode.ESTOPPED:
            return Condition("FAULT", arm.is_homed, False)
    is_waiting = arm.operating_state == ENABLED and arm.is_homed
    return Condition(arm.operating_state, arm.is_homed, arm.is_busy or is_waiting)
