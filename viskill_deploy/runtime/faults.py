"""The faults that can be asked for, and what has to happen then: one table for all who need it.

Command line, tests, report and documents read it. What brings a fault about stands in
`fault_injection`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from viskill_deploy.core.types import Action

CYCLE_S = 0.008
"""In the cycle that meets the fault: a period until it begins, and one in which it is judged."""

SAID_S = 0.012
"""What the robot has to say first: a period until it does, and one until that is read and judged,
which the processor may take a good part of."""


@dataclass(frozen=True, slots=True)
class Reaction:
    """What the gate has to come to.

    Attributes:
        rule: id of a rule that says so; "" when nothing has to happen.
        action: what the gate does then.
        within_s: time from the beginning of the fault.
    """

    rule: str
    action: Action
    within_s: float


TOLERATED = Reaction("", Action.PASS, math.inf)


@dataclass(frozen=True, slots=True)
class Fault:
    """One way in which things go wrong.

    Attributes:
        name: what people call it on the command line.
        what: what happens, in a line.
        reaction: what the gate has to do about it while the arms move.
        at_rest: the same while nothing moves; a fault that shows only in motion is tolerated then.
        lasts_s: how long it lasts when nobody says so.
        family: the one name of faults that differ only in size; "" for a fault of its own.
    """

    name: str
    what: str
    reaction: Reaction
    at_rest: Reaction
    lasts_s: float = math.inf
    family: str = ""


def _always(rule: str, action: Action, within_s: float) -> tuple[Reaction, Reaction]:
    reaction = Reaction(rule, action, within_s)
    return reaction, reaction


def _moving(rule: str, action: Action, within_s: float) -> tuple[Reaction, Reaction]:
    return Reaction(rule, action, within_s), TOLERATED


_NEVER = (TOLERATED, TOLERATED)
_H, _S, _F, _E = Action.HOLD, Action.STOP, Action.FAULT, Action.ESTOP

FAULTS: tuple[Fault, ...] = (
    Fault("drop", "no new sample arrives", *_always("S18", _H, 0.06)),
    Fault("delay", "samples arrive 80 ms late", *_always("S18", _H, 0.06)),
    Fault("freeze", "samples arrive and always say the same", *_moving("S18", _F, 0.5)),
    Fault("duplicate", "every sample arrives twice", *_NEVER),
    Fault("reorder", "samples arrive in the wrong order", *_NEVER),
    Fault("nan", "a measured joint is NaN", *_always("S02", _F, CYCLE_S)),
    Fault("spike", "a setpoint is asked for that is 17° away", *_always("S10", _S, CYCLE_S)),
    Fault("bias", "a measured joint drifts away by 11°/s", *_always("S17", _S, 0.4)),
    Fault("bit-flip", "a bit of a measured joint is flipped", *_always("S04", _F, CYCLE_S)),
    Fault("stuck", "the joint that moves fastest is stuck", *_moving("S17", _S, 0.6)),
    Fault("slip", "the cable of the fastest joint slips", *_moving("S17", _S, 0.6)),
    Fault("encoder-jump", "a measured joint jumps by 4.6°", *_always("S17", _S, 0.07)),
    Fault("partial-write", "only the first arm gets its setpoint", *_always("S24", _F, CYCLE_S)),
    Fault("disconnect", "the connection to the robot is gone", *_always("S24", _F, CYCLE_S)),
    Fault(
        "reconnect",
        "the connection is gone, and comes back",
        *_always("S24", _F, CYCLE_S),
        lasts_s=0.1,
    ),
    Fault("slow-policy", "the policy takes 80 ms longer to decide", *_NEVER),
    Fault("hung-policy", "the policy does not decide any more", *_moving("S19", _H, 0.6)),
    Fault("infeasible", "the QP of the IK has no solution", *_always("S16", _H, CYCLE_S)),
    Fault("recorder-full", "the recorder's disk is full", *_always("S32", _S, 2.0)),
    *(
        Fault(
            f"clock{jump}",
            f"the robot's clock jumps {words}",
            *_always("S18", _F, CYCLE_S),
            family="clock",
        )
        for jump, words in (
            ("+1h", "ahead by an hour"),
            ("-1h", "back by an hour"),
            ("+1d", "ahead by a day"),
            ("-1d", "back by a day"),
        )
    ),
    Fault(
        "clock-back",
        "this machine's clock goes back by a second",
        *_always("S21", _F, CYCLE_S),
        family="clock",
    ),
    Fault("kill-runtime", "this program is killed (kill -9)", *_always("S25", _E, 0.1)),
    Fault("kill-watchdog", "the watchdog is killed (kill -9)", *_always("S26", _S, 0.06)),
    Fault(
        "sigstop", "this program stands still for a second", *_always("S25", _E, 1.1), lasts_s=1.0
    ),
    Fault("estop", "the emergency stop is pressed", *_always("S23", _E, SAID_S)),
)

GRAMMAR = "name@start or name@start:duration, in seconds"

_BY_NAME = {fault.name: fault for fault in FAULTS}


@dataclass(frozen=True, slots=True)
class Injection:
    """A fault that is asked for.

    Attributes:
        fault: which.
        start_s: when it begins, s after the first setpoint of the run.
        lasts_s: for how long; inf to the end.
    """

    fault: Fault
    start_s: float
    lasts_s: float

    def is_on(self, elapsed_s: float) -> bool:
        """Whether it acts at a time since the first setpoint."""
        # a sum of periods may miss its end by rounding
        return self.start_s - 1e-9 <= elapsed_s < self.start_s + self.lasts_s - 1e-9

    def __str__(self) -> str:
        duration = f":{self.lasts_s:g}" if self.lasts_s < math.inf else ""
        return f"{self.fault.name}@{self.start_s:g}{duration}"


def parse_fault(text: str) -> Injection:
    """The fault that a text such as "drop@2.0:0.3" asks for.

    Raises:
        ValueError: it names no fault, or a time that is none.
    """
    name, at, times = text.partition("@")
    if name not in _BY_NAME:
        raise ValueError(f"{text!r}: no fault is called {name!r}; `viskill faults` lists them")
    fault = _BY_NAME[name]
    start, colon, duration = times.partition(":")
    try:
        start_s = float(start)
        lasts_s = float(duration) if colon else fault.lasts_s
    except ValueError:
        start_s = lasts_s = math.nan
    if not (at and 0.0 <= start_s < math.inf and lasts_s > 0.0):
        raise ValueError(f"{text!r}: write {GRAMMAR}, such as {name}@2.0:0.3")
    return Injection(fault, start_s, lasts_s)
