"""One drive as its master knows it: what it was told, what it says, and what is wrong with it."""

from __future__ import annotations

import math

from viskill_deploy.drivers.can.codec import AxisCodec, Control, Drive, Reading

OPERATIONAL = 5
"""State in a heartbeat."""

LOST_HEARTBEATS = 3
MOST_UNANSWERED = 3
"""SYNCs that may go unanswered: the gate meanwhile sees old feedback (S18)."""

WATCHDOG_CODES = {0x8130: "heartbeat", 0x8250: "target", 0x8700: "SYNC"}
"""Emergency codes with which a drive says that it lost us."""

CLASSES = {
    0x10: "generic error",
    0x20: "current",
    0x30: "voltage",
    0x40: "temperature",
    0x50: "hardware",
    0x60: "software",
    0x70: "additional module",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x84: "speed control",
    0x85: "position control",
    0x86: "positioning",
    0x87: "SYNC control",
    0x90: "external error",
    0xF0: "additional function",
    0xFF: "device specific",
}


class Axis:
    """A drive.

    Args:
        name: how messages call it.
        codec: its language.
        heartbeat_s: how often it says that it lives.

    Attributes:
        control, target: what it is told in every cycle; the target in counts.
        reading: what it said last; None before it said anything.
        stamp_s: when.
        trouble: the first thing that is wrong with it; "" when all is well.
        unanswered: SYNCs since its last answer, the one under way included.
        has_lost_us: it has stopped because it did not hear us.
        spoilt: frames in its name that were none of its language.
    """

    def __init__(self, name: str, codec: AxisCodec, heartbeat_s: float) -> None:
        self.name, self.codec, self._heartbeat_s = name, codec, heartbeat_s
        self.control, self.target = int(Control.DISABLE_VOLTAGE), 0
        self.reading: Reading | None = None
        self.stamp_s, self.trouble, self.has_lost_us, self.spoilt = -math.inf, "", False, 0
        self._heard_s, self.unanswered = -math.inf, 0

    def restart(self, now: float) -> None:
        """Forgets what was wrong; from now on it is watched."""
        self.trouble, self.has_lost_us, self._heard_s, self.unanswered = "", False, now, 0

    def command(self) -> bytes:
        """What it is told in this cycle, which it has to answer at the next SYNC."""
        self.unanswered += 1
        return self.codec.command(self.control, self.target)

    def hear_feedback(self, data: bytes, now: float) -> None:
        """An answer to a SYNC."""
        reading = self.codec.reading(data)
        if reading is None or reading.state is None:
            self.spoilt += 1
            return
        self.reading, self.stamp_s = reading, now
        if self.unanswered == 0:
            self._say("has answered one SYNC twice: two drives have one node id")
        self.unanswered = max(self.unanswered - 1, 0)

    def hear_emergency(self, data: bytes) -> None:
        """Its emergency object."""
        if len(data) != 8:
            self.spoilt += 1
            return
        code = int.from_bytes(data[:2], "little")
        if code == 0:
            return  # what it complained of is over
        kind = CLASSES.get(code >> 8, CLASSES.get(code >> 8 & 0xF0, "unknown"))
        if code in WATCHDOG_CODES:
            self.has_lost_us = True
            kind = f"it lost our {WATCHDOG_CODES[code]}"
        elif code == 0x8611:
            kind = "following error"
        self._say(f"reports emergency 0x{code:04X} ({kind})")

    def hear_heartbeat(self, data: bytes, now: float) -> None:
        """Its heartbeat, once it has been started."""
        if len(data) != 1:
            self.spoilt += 1
            return
        self._heard_s = now
        if data[0] == 0:
            self._say("has restarted by itself")
        elif data[0] != OPERATIONAL:
            self._say(f"is not operational any more (NMT state {data[0]})")

    def look(self, now: float, is_enabled: bool) -> None:
        """Finds what it does not say: silence, or that it has left operation."""
        if now - self._heard_s > LOST_HEARTBEATS * self._heartbeat_s + 1e-9:
            self._say(f"has lost its heartbeat for {now - self._heard_s:.3f} s")
        if self.unanswered > MOST_UNANSWERED:
            self._say(f"has not answered {self.unanswered} SYNCs")
        state = self.reading.state if self.reading else None
        if state in {Drive.FAULT, Drive.FAULT_REACTION_ACTIVE}:
            self._say("is in fault")
        elif is_enabled and state is not Drive.OPERATION_ENABLED:
            self._say(f"has left operation ({state.name if state else 'no state'})")

    def _say(self, what: str) -> None:
        if not self.trouble:
            self.trouble = f"{self.name} {what}; put that right and enable the arms again"
