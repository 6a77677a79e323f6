"""One simulated arm on a transport: its commands are heard, its states and readings published."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from viskill_deploy.core.types import ArmState, JointSetpoint
from viskill_deploy.drivers.crtk.messages import (
    NANO,
    Bool,
    Float,
    Header,
    JointState,
    Joy,
    OperatingState,
    String,
    StringStamped,
    Time,
)
from viskill_deploy.drivers.crtk.on_the_way import Arrivals
from viskill_deploy.drivers.crtk.readings import Reading
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated_arm import Event, SimulatedArm, Snapshot
from viskill_deploy.drivers.crtk.topics import ARM, following, named
from viskill_deploy.drivers.crtk.transport import Transport

REPEAT_S = 0.1
"""operating_state is repeated this often, for clients that subscribe without TRANSIENT_LOCAL."""

STALE_NS = 5 * NANO
"""A state command stamped this much earlier or later than now is not acted upon."""


class StaleCheck:
    """Which state commands are of now: a client latches them, and a new server is handed old ones.

    Args:
        start_ns: when the server began, as messages are stamped.
    """

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns

    def refusal(self, sent_ns: int, now_ns: int) -> str:
        """Why a command stamped `sent_ns` is not acted upon; "" when it is.

        dVRK's own Python client does not stamp: its commands are taken, as dVRK takes all, but not
        in the first moments, in which a latched one arrives that was meant for an earlier server.
        """
        if sent_ns == 0:
            if now_ns - self._start_ns >= STALE_NS:
                return ""
            return "has no stamp and may be an old one; send it again in 5 s, or stamp it"
        if sent_ns < self._start_ns:
            return "was sent before this server began; send it again"
        if abs(now_ns - sent_ns) > STALE_NS:
            return "is not of now; send it again, and compare the clocks of the computers"
        return ""


class ArmOnWire:
    """An arm's topics.

    Args:
        arm: the arm.
        transport: where it is published.
        options: version and rates.
        tell: called with every event of the arm, for people who look on.
        arrivals: told of every servo_jp.

    Attributes:
        is_silent: nothing periodic is published; for tests.
        is_invalid: periodic data is marked as invalid; for tests.
        spoil: changes a periodic message before it is published; for tests.
        has_supply: the amplifiers can have power; for tests.
        intruder: joints (6,) that a second commander asks for all the time; () without one.
    """

    def __init__(
        self,
        arm: SimulatedArm,
        transport: Transport,
        options: ServerOptions,
        tell: Callable[[str, Event], None],
        arrivals: Arrivals,
    ) -> None:
        self._arrivals = arrivals
        self.arm, self._transport, self._options, self._tell = arm, transport, options, tell
        self._stale = StaleCheck(transport.stamp_ns())
        self._inbox: deque[tuple[str, Any]] = deque()
        self._publish: dict[str, Callable[[Any], None]] = {}
        self._periodic: dict[str, str] = {}
        self._listened: list[str] = []
        self._stamp_ns = 0
        self._due_s = self._repeat_due_s = 0.0
        self.is_silent = self.is_invalid = self._was_busy = False
        self.has_supply, self.intruder = True, tuple[float, ...]()
        self.spoil: Callable[[str, Any], Any] = lambda _, message: message
        self._open()

    def _open(self) -> None:
        for topic in ARM:
            name = f"/{self.arm.name}/{named(topic, self._options.version)}"
            if topic.publisher == "client":
                hear = partial(self._hear, topic.name)
                self._transport.subscribe(name, topic.message, hear)
                continue
            publish = self._transport.publisher(name, topic.message, topic.is_latched)
            self._publish[topic.name] = publish
            if topic.is_periodic:
                self._periodic[topic.name] = name
        teleoperation = self._transport.publisher(following(self.arm.name), Bool, True)
        self._publish["following"] = teleoperation
        self.follow(False)

    def follow(self, is_following: bool) -> None:
        """Says whether a teleoperation sends commands to this arm."""
        self._publish["following"](Bool(is_following))

    def poll(self) -> None:
        """Acts on what has been heard, in its order, and says what comes of it."""
        while self._inbox:
            self._act(*self._inbox.popleft())

    def tick(self, dt_s: float, measured: ArmState, has_supply: bool) -> JointSetpoint:
        """A moment passes for the arm; what its drives hold it at."""
        self.poll()
        if self.intruder:
            self.arm.servo_jp(JointState(position=self.intruder))
        return self.arm.tick(dt_s, measured, has_supply and self.has_supply)

    def press_clutch(self, is_pressed: bool) -> None:
        """The button on the arm."""
        self.arm.clutch(is_pressed)
        header = Header(Time.of_ns(self._transport.stamp_ns()))
        self._publish["IO/arm_clutch"](Joy(header, (), (int(is_pressed),)))

    def speak(self, state: ArmState, now: float) -> None:
        """Says what the arm has to say, and what is due.

        Args:
            state: its joints as measured.
            now: the clock that `state` is stamped by.
        """
        if now >= self._repeat_due_s:
            self._repeat_due_s = now + REPEAT_S
            self._listened = [
                topic for topic, name in self._periodic.items() if self._transport.peers(name)
            ]
            self.arm.tell_state(must=True)
        stamp_ns = self._transport.stamp_ns() - round((now - state.stamp_s) * NANO)
        for event in self.arm.take_events():
            if event[0] == "operating_state":
                if self._was_busy and not event[1].is_busy:
                    self._read(state, stamp_ns)  # the last setpoint, and then that all is done
                self._was_busy = event[1].is_busy
            self._say(event)
        if now >= self._due_s:
            self._due_s = max(self._due_s + 1.0 / self._options.rate_hz, now)
            self._read(state, stamp_ns)

    def _hear(self, topic: str, message: Any, received_s: float) -> None:
        del received_s
        self._inbox.append((topic, message))
        if topic == "servo_jp":
            self._arrivals.note(message.header.stamp.ns, self._transport.stamp_ns())

    def _act(self, topic: str, message: Any) -> None:
        arm = self.arm
        match topic:
            case "state_command":
                self._command(message)
            case "hold":
                arm.hold()
            case "free":
                arm.free()
            case "servo_jp" | "servo_jr" | "servo_cp" | "move_jp" | "move_jr" | "move_cp":
                getattr(arm, topic)(message)
            case "jaw/servo_jp":
                arm.jaw_servo_jp(message)
            case "jaw/move_jp":
                arm.jaw_move_jp(message)
            case "trajectory_j/set_ratio":
                arm.set_ratio(message)
            case "emulate_tool_present":
                arm.emulate_tool(message.data)
            case "set_tool_type":
                arm.set_tool(message.data)
            case "use_gravity_compensation" | "body/set_cf_orientation_absolute":
                pass  # without effect on a Classic arm that feels no forces
            case _:
                arm.refuse(topic)

    def _command(self, message: StringStamped) -> None:
        word = message.string
        refusal = self._stale.refusal(message.header.stamp.ns, self._transport.stamp_ns())
        if refusal:
            self.arm.warn(f'command "{word}" {refusal}')
            self.arm.tell_state(must=True)
        else:
            self.arm.state_command(word)

    def _say(self, event: Event) -> None:
        topic, what = event
        if isinstance(what, Snapshot):
            self._stamp_ns = max(self._transport.stamp_ns(), self._stamp_ns + 1)
            header = Header(Time.of_ns(self._stamp_ns))
            message: Any = OperatingState(header, what.state, what.is_homed, what.is_busy)
        elif isinstance(what, bool):
            message = Bool(what)
        else:
            message = Float(what) if isinstance(what, float) else String(what)
        self._publish[topic](message)
        self._tell(self.arm.name, event)

    def _read(self, state: ArmState, stamp_ns: int) -> None:
        if self.is_silent:
            return
        stamp = Time() if self.is_invalid else Time.of_ns(stamp_ns)
        reading, says_invalid = Reading(self.arm, state, stamp), self._options.version == "2.4"
        for topic in self._listened:
            if says_invalid or reading.is_valid(topic):
                self._publish[topic](self.spoil(topic, reading.message(topic)))
