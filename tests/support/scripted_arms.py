"""dVRK arms that say and do what a test tells them, at the other end of an `inproc` network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from viskill_deploy.core.clock import SteppedClock
from viskill_deploy.core.types import PSM_JOINTS
from viskill_deploy.drivers.crtk import topics
from viskill_deploy.drivers.crtk.inproc import START_NS, Exchange, Inproc
from viskill_deploy.drivers.crtk.messages import (
    Bool,
    Empty,
    Header,
    JointState,
    Joy,
    OperatingState,
    String,
    StringStamped,
    Time,
)

PERIOD_S = 0.01
PLACE = (0.1, -0.2, 0.12, 0.3, -0.1, 0.2)


class PeerClock(SteppedClock):
    """Time that lets peers speak while it passes."""

    def __init__(self) -> None:
        super().__init__(100.0)
        self.peers: list[Peer] = []

    def sleep_until(self, deadline_s: float) -> float:
        while self.now() < deadline_s - 1e-9:
            self.advance(min(0.001, deadline_s - self.now()))
            for peer in self.peers:
                peer.live(self.now())
        return self.now()


@dataclass
class Peer:
    """One arm.

    Attributes:
        heard: all state commands, with when they came.
        holds: when it was told to hold.
        sent: setpoints of its joints and of its jaw, as they came.
        is_obedient: state commands have their usual effect, at once.
        is_silent: periodic topics say nothing.
        skew_ns: by how much its clock is ahead.
        spoil: what becomes of a message of joints before it goes out.
    """

    name: str
    exchange: Exchange
    state: str = "DISABLED"
    is_homed: bool = False
    is_busy: bool = False
    tool: str = "LARGE_NEEDLE_DRIVER:400006"
    is_obedient: bool = True
    is_silent: bool = False
    skew_ns: int = 0
    jp: tuple[float, ...] = PLACE
    jaw: float = 0.2
    heard: list[tuple[float, str]] = field(default_factory=list)
    holds: list[float] = field(default_factory=list)
    sent: list[JointState] = field(default_factory=list)
    sent_jaw: list[JointState] = field(default_factory=list)
    spoil: Callable[[str, JointState], JointState] = lambda topic, message: message

    def __post_init__(self) -> None:
        self.node = Inproc(self.exchange)
        self._due_s = 0.0
        names = ("operating_state", "tool_type", "error", "IO/arm_clutch", "manip_clutch")
        kinds = {"manip_clutch": Joy} | {n: topics.topic(n).message for n in names[:4]}
        self._mouths = {n: self.node.publisher(self.topic(n), kinds[n], True) for n in names}
        for name in ("measured_js", "setpoint_js", "jaw/measured_js", "jaw/setpoint_js"):
            self._mouths[name] = self.node.publisher(self.topic(name), JointState)
        self.node.subscribe(self.topic("state_command"), StringStamped, self._obey)
        self.node.subscribe(self.topic("hold"), Empty, lambda word, now: self.holds.append(now))
        self.node.subscribe(self.topic("servo_jp"), JointState, self._servo)
        self.node.subscribe(self.topic("jaw/servo_jp"), JointState, self._servo_jaw)
        self.say("tool_type", String(self.tool))
        self.tell()

    @property
    def words(self) -> list[str]:
        """The state commands that were heard."""
        return [word for _, word in self.heard]

    def topic(self, name: str) -> str:
        return f"/{self.name}/{name}"

    def say(self, name: str, message: Any) -> None:
        """Publishes on one of its topics."""
        self._mouths[name](message)

    def head(self) -> Header:
        return Header(Time.of_ns(self.node.stamp_ns() + self.skew_ns))

    def tell(self, header: Header | None = None) -> None:
        """Publishes its operating state."""
        word = OperatingState(header or self.head(), self.state, self.is_homed, self.is_busy)
        self.say("operating_state", word)

    def become(self, state: str, is_homed: bool = False, is_busy: bool = False) -> None:
        """Changes its operating state, and says so."""
        self.state, self.is_homed, self.is_busy = state, is_homed, is_busy
        self.tell()

    def live(self, now: float) -> None:
        """Says where it is, when that is due."""
        if now < self._due_s - 1e-9 or self.is_silent:
            return
        self._due_s = now + PERIOD_S
        self.speak()

    def speak(self) -> None:
        """Says where it is."""
        rows = (("", PSM_JOINTS, self.jp), ("jaw/", ("jaw",), (self.jaw,)))
        for prefix, names, q in rows:
            for kind, velocity in (("measured_js", (0.0,) * len(q)), ("setpoint_js", ())):
                message = JointState(self.head(), names, q, velocity)
                self.say(prefix + kind, self.spoil(prefix + kind, message))

    def _obey(self, command: StringStamped, now: float) -> None:
        assert command.header.stamp.ns == START_NS + round(now * 1e9), "a stale stamp"
        self.heard.append((now, command.string))
        if self.is_obedient:
            states = {"enable": "ENABLED", "resume": "ENABLED", "disable": "DISABLED"}
            self.state = states.get(command.string, self.state)
            self.state = "PAUSED" if command.string == "pause" else self.state
            self.is_homed = self.state != "DISABLED" and (self.is_homed or command.string == "home")
            self.tell()

    def _servo(self, message: JointState, now: float) -> None:
        self.sent.append(message)
        self.jp = message.position

    def _servo_jaw(self, message: JointState, now: float) -> None:
        self.sent_jaw.append(message)
        self.jaw = message.position[0]


class Room:
    """Two arms and a console on one network, and a place on it for a driver."""

    def __init__(self) -> None:
        self.clock = PeerClock()
        self.exchange = Exchange(self.clock)
        self.arms = [Peer(name, self.exchange) for name in ("PSM1", "PSM2")]
        self.clock.peers = self.arms
        self.console = Inproc(self.exchange)
        self._present = self.console.publisher("/console/operator_present", Joy, True)
        self.node = Inproc(self.exchange)

    def present(self, button: int) -> None:
        """The operator's pedal: 1 pressed, 0 released, 2 clicked."""
        self._present(Joy(Header(Time.of_ns(self.node.stamp_ns())), (), (button,)))

    def teleoperate(self, topic: str) -> Callable[[bool], None]:
        """A teleoperation; returns what says whether it commands."""
        say = Inproc(self.exchange).publisher(topic, Bool, True)
        return lambda follows: say(Bool(follows))


def stamped(message: JointState, ns: int) -> JointState:
    """The same message with another stamp."""
    return replace(message, header=Header(Time.of_ns(ns)))
