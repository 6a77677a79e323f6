"""What the gate answers in each cycle."""

from __future__ import annotations

from dataclasses import dataclass

from viskill_deploy.core.types import Action, Mode, Verdict
from viskill_deploy.safety.checked import CheckedSetpoint


@dataclass(frozen=True, slots=True)
class Decision:
    """One cycle of the gate.

    Attributes:
        setpoints: what goes to the driver now, one an arm: the request bit for bit, or the gate's
            own jerk-limited stop and then its last sample again. Empty until the cell was armed.
        action: the worst of this cycle's verdicts and of what is latched.
        verdicts: what rules said in this cycle; empty on a quiet one.
        mode: mode of the supervisor after this cycle.
        speed_scale: at most 1.0; what the one time base of the cell shall multiply its speed with
            (SCALE: limit / value of the worst verdict).
        passed: the request itself goes out.
        at_rest: the gate's own stop has ended; False while requests pass.
        margins: smallest normalised distance to the threshold, one a rule in the order of
            `Supervisor.rules`: 1.0 far away or not asked in this cycle, 0.0 at the threshold,
            negative beyond it.
    """

    setpoints: tuple[CheckedSetpoint, ...]
    action: Action
    verdicts: tuple[Verdict, ...]
    mode: Mode
    speed_scale: float
    passed: bool
    at_rest: bool
    margins: tuple[float, ...]
