"""Hears what is said to dVRK arms, and by them, on a node of its own."""

from __future__ import annotations

import time
from functools import partial

from viskill_deploy.core import realtime
from viskill_deploy.drivers.base import DISABLED, PAUSED
from viskill_deploy.drivers.crtk.messages import Empty, JointState, OperatingState, StringStamped
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.safety.watchdog import DISABLE_S, LOST_S

ARMS = ("PSM1", "PSM2")
HELD_WITHIN_S = 0.1


class Witness:
    """Hears what is said to the arms, and by them.

    Attributes:
        states: operating states of every arm, with when they were first heard.
        words: state commands, and "hold".
        setpoints: what every arm holds.
    """

    def __init__(self, domain: int) -> None:
        self.states: dict[str, list[tuple[float, str]]] = {arm: [] for arm in ARMS}
        self.words: dict[str, list[tuple[float, str]]] = {arm: [] for arm in ARMS}
        self.setpoints: dict[str, JointState] = {}
        self.node = open_transport("dds", Network(domain, LOOPBACK))
        for arm in ARMS:
            hear = self.node.subscribe
            hear(f"/{arm}/operating_state", OperatingState, partial(self._state, arm), True)
            hear(f"/{arm}/setpoint_js", JointState, partial(self._setpoint, arm))
            hear(f"/{arm}/hold", Empty, partial(self._hold, arm))
            hear(f"/{arm}/state_command", StringStamped, partial(self._word, arm))

    def _state(self, arm: str, message: OperatingState, now: float) -> None:
        if not self.states[arm] or self.states[arm][-1][1] != message.state:
            self.states[arm].append((now, message.state))

    def _setpoint(self, arm: str, message: JointState, now: float) -> None:
        self.setpoints[arm] = message

    def _word(self, arm: str, message: StringStamped, now: float) -> None:
        self.words[arm].append((now, message.string))

    def _hold(self, arm: str, message: Empty, now: float) -> None:
        self.words[arm].append((now, "hold"))

    def when(self, arm: str, state: str, since: float = 0.0, timeout_s: float = 5.0) -> float:
        """When an arm first came to a state, from a moment on."""
        deadline = time.monotonic() + timeout_s
        while True:
            for at, name in self.states[arm]:
                if name == state and at >= since:
                    return at
            assert time.monotonic() < deadline, f"{arm} never was {state}, only {self.states}"
            time.sleep(0.002)


def assert_held_in_time(witness: Witness, since: float) -> None:
    """Both arms were held and paused within 100 ms where the system permits promptness."""
    for arm in ARMS:
        paused, disabled = witness.when(arm, PAUSED, since), witness.when(arm, DISABLED, since)
        if not realtime.refusals():
            assert paused - since <= HELD_WITHIN_S
        assert disabled - paused >= DISABLE_S - LOST_S - 0.05
        order = [word for at, word in witness.words[arm] if at >= since]
        assert "hold" in order[:2], "what comes on two topics may come in either order"
        assert set(order) == {"hold", "pause", "disable"}
        assert order.index("disable") > len(order) - 1 - order[::-1].index("pause")
