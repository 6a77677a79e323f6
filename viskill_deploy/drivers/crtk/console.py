"""The operator's presence at the console, by which a person agrees to motion."""

from __future__ import annotations

import math

from viskill_deploy.core.types import Inputs
from viskill_deploy.drivers.crtk.messages import Joy
from viskill_deploy.drivers.crtk.transport import Transport

PRESSED = 1


class Console:
    """What is heard of one console. It speaks at changes only.

    Args:
        transport: where it speaks.
        name: of the console, such as "console"; systems with several number them.
        source: how the gate calls it.
    """

    def __init__(self, transport: Transport, name: str, source: str) -> None:
        self.topic = f"/{name}/operator_present"
        self._transport, self._source = transport, source
        self._is_present, self._stamp_s = False, -math.inf
        transport.subscribe(self.topic, Joy, self._hear, is_latched=True)

    def inputs(self, alive_s: float, estop: bool) -> Inputs:
        """The operator's word, which holds as long as console and arms are heard.

        Args:
            alive_s: driver's clock at the newest feedback of the arm heard longest ago.
            estop: an arm has lost its power.
        """
        if self._transport.peers(self.topic) == 0:
            self._is_present, alive_s = False, -math.inf  # who comes back has to agree anew
        return Inputs(
            consent=self._is_present,
            consent_stamp_s=self._stamp_s,
            consent_source=self._source,
            estop=estop,
            consent_is_streamed=False,
            consent_alive_s=alive_s,
        )

    def _hear(self, word: Joy, received_s: float) -> None:
        self._is_present = bool(word.buttons) and word.buttons[0] == PRESSED
        self._stamp_s = received_s
