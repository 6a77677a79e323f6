"""Consent and emergency stop from a node on CAN.

The node sends 0x180 + its id every 20 ms: a byte of states (bit 0 consent, bit 1 emergency stop),
its complement, and a 16-bit counter; and a heartbeat. Silence, a wrong complement or a counter that
stands still is no consent and an emergency stop: a line that is lost says nothing good.
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace

from viskill_deploy.core.types import Inputs
from viskill_deploy.drivers.can.axis import LOST_HEARTBEATS, OPERATIONAL
from viskill_deploy.drivers.can.codec import HEARTBEAT_ID, TPDO_ID

_WORD = struct.Struct("<BBH")
CONSENT, ESTOP = 1, 2
SILENT_S = 0.1
"""Five lost words: the gate holds after 0.2 s without consent, and this is no consent."""


def pack_input(consent: bool, estop: bool, counter: int) -> bytes:
    """What an input node sends."""
    bits = consent * CONSENT | estop * ESTOP
    return _WORD.pack(bits, ~bits & 0xFF, counter & 0xFFFF)


class InputNode:
    """What is known of an input node.

    Args:
        node_id: its number.
        heartbeat_s: how often it says that it lives.
        source: how the gate calls who agrees.
    """

    def __init__(self, node_id: int, heartbeat_s: float, source: str) -> None:
        self.feedback_id, self.heartbeat_id = TPDO_ID + node_id, HEARTBEAT_ID + node_id
        self._source, self._silent_s = source, LOST_HEARTBEATS * heartbeat_s
        self._consent, self._estop = False, True
        self._counter, self._stamp_s, self._beat_s = -1, -math.inf, -math.inf

    @property
    def has_spoken(self) -> bool:
        """Whether anything good was ever heard of it."""
        return self._counter >= 0 and self._beat_s > -math.inf

    def hear_word(self, data: bytes, now: float) -> None:
        """Its word; one that is spoilt or repeated does not count."""
        if len(data) != _WORD.size:
            return
        bits, complement, counter = _WORD.unpack(data)
        if bits ^ complement != 0xFF or counter == self._counter:
            return
        self._counter, self._stamp_s = counter, now
        self._consent, self._estop = bool(bits & CONSENT), bool(bits & ESTOP)

    def hear_heartbeat(self, data: bytes, now: float) -> None:
        """Its heartbeat; only an operational node counts as alive."""
        if data == bytes([OPERATIONAL]):
            self._beat_s = now

    def inputs(self, now: float) -> Inputs:
        """What it says now."""
        is_alive = now - self._stamp_s <= SILENT_S and now - self._beat_s <= self._silent_s + 1e-9
        if not is_alive:
            return Inputs(False, now, self._source, True)
        return Inputs(self._consent, self._stamp_s, self._source, self._estop)

    def over(self, inputs: Inputs, now: float) -> Inputs:
        """`inputs` of a driver with this node's consent; either emergency stop counts."""
        mine = self.inputs(now)
        return replace(
            inputs,
            consent=mine.consent,
            consent_stamp_s=mine.consent_stamp_s,
            consent_source=mine.consent_source,
            consent_is_streamed=True,
            estop=mine.estop or inputs.estop,
        )
