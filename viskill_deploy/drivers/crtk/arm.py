"""One dVRK arm as its client: what is heard of it, and the few words that are said to it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from operator import is_
from typing import Any, Final

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.types import ArmState, Joints, JointSetpoint
from viskill_deploy.drivers.base import DISABLED, ENABLED
from viskill_deploy.drivers.crtk import topics
from viskill_deploy.drivers.crtk.contention import Sent
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
from viskill_deploy.drivers.crtk.on_the_way import Ages
from viskill_deploy.drivers.crtk.stream import JointStream, Sample
from viskill_deploy.drivers.crtk.transport import Transport

FAULT: Final = "FAULT"
JAW: Final = "jaw"
PRESSED: Final = 1
POWER_LOSS: Final = "power loss"
"""Part of what an arm says in words when its amplifiers or brakes have lost their power."""

RESEND_S: Final = 0.5
"""A state command that shows no effect is said again: it may have come before anybody listened."""

SILENT_S: Final = 0.5
"""A topic that was not heard for this long is lost: by then the gate has the arms at rest."""


class ArmClient:
    """One arm.

    Args:
        arm: the arm as the cell has it.
        transport: the way to it.

    Attributes:
        name: its name, which stands in front of its topics.
        condition: its newest operating state; with state "" before the first.
        tool: instrument that it says it has, as in robots/tools; None before it says so.
        error: its newest word on `error`; "" before any. `errors` counts them.
        sent: what was sent to it lately.
        ages: of setpoints, when it says that it holds them.
    """

    def __init__(self, arm: CellArm, transport: Transport) -> None:
        self.name, self._transport, self._wanted_tool = arm.name, transport, arm.arm.tool
        self.joint_names = tuple(joint.name for joint in arm.arm.joints)
        self.condition = OperatingState()
        self.tool: str | None = None
        self.error, self.errors, self.sent, self.ages = "", 0, Sent(), Ages()
        self._echo_s = 0.0
        self._ours: tuple[Sample, Sample] | None = None  # the last that were seen to be so
        self._restarts, self._said, self._said_s = 0, "", 0.0
        self._masters = set[str]()  # topics of the teleoperations that command this arm
        self._clutches = set[str]()
        self.measured = self._stream("measured_js", self.joint_names, True)
        self.held = self._stream("setpoint_js", self.joint_names, False)
        self.jaw_measured = self._stream("jaw/measured_js", (JAW,), True)
        self.jaw_held = self._stream("jaw/setpoint_js", (JAW,), False)
        self.streams = (self.measured, self.held, self.jaw_measured, self.jaw_held)
        self._listen()
        self._state_command: Callable[[StringStamped], None] = self._publisher("state_command")
        self._hold: Callable[[Empty], None] = self._publisher("hold")
        self._servo_jp: Callable[[JointState], None] = self._publisher("servo_jp")
        self._jaw_servo_jp: Callable[[JointState], None] = self._publisher("jaw/servo_jp")

    @property
    def is_ready(self) -> bool:
        """It takes setpoints."""
        condition = self.condition
        return condition.state == ENABLED and condition.is_homed and not condition.is_busy

    @property
    def is_heard(self) -> bool:
        """All its periodic topics were heard, whatever they said."""
        return all(stream.is_heard for stream in self.streams)

    @property
    def is_known(self) -> bool:
        """It says where it is and is to be, and vouches for it."""
        return all(stream.newest.is_valid for stream in self.streams)

    @property
    def stamp_s(self) -> float:
        """Driver's clock at the oldest thing that is known of where it is and is to be."""
        return min([stream.newest.stamp_s for stream in self.streams])

    @property
    def has_lost_power(self) -> bool:
        """It says in words that it has no power: somebody pressed the emergency stop."""
        return self.condition.state == FAULT and POWER_LOSS in self.error.lower()

    def state(self) -> ArmState:
        """What is known of it now."""
        measured, held = self.measured.newest, self.held.newest
        jaw, jaw_held = self.jaw_measured.newest, self.jaw_held.newest
        condition = self.condition
        return ArmState(
            name=self.name,
            stamp_s=self.stamp_s,
            valid=self.is_known,
            operating_state=condition.state or DISABLED,
            is_homed=condition.is_homed,
            is_busy=condition.is_busy,
            measured_jp=measured.position,
            measured_jv=measured.velocity,
            jaw_measured_jp=jaw.position[0],
            jaw_measured_jv=jaw.velocity[0],
            setpoint_jp=held.position,
            jaw_setpoint_jp=jaw_held.position[0],
            joint_names=self.joint_names,
            tool=self.tool or "",
        )

    def missing(self) -> str:
        """The first topic that has to be heard and was not; "" when all are.

        An arm that is not homed may not know where it is: it is enough that somebody would say so.
        """
        if not self.condition.state:
            return self._topic("operating_state")
        for stream in self.streams:
            is_offered = not self.condition.is_homed and self._transport.peers(stream.topic) > 0
            if not stream.is_heard and not is_offered:
                return stream.topic
        return ""

    def misfit(self) -> str:
        """What of its topics does not fit the cell, in words; "" when all does."""
        return next(filter(None, [stream.newest.misfit for stream in self.streams]), "")

    def rival(self) -> str:
        """Who else moves it: a teleoperation, or a hand at its clutch; "" for nobody."""
        masters = [topic for topic in tuple(self._masters) if self._transport.peers(topic) > 0]
        if masters:
            return f"a teleoperation commands {self.name} ({masters[0]}); end it, then start again"
        if self._clutches:
            return f"somebody presses {self.name}'s clutch; let go of the arm, then start again"
        return ""

    def strange_tool(self) -> str:
        """What is wrong with the instrument that it says it has; "" when it is the cell's."""
        if self.tool is None:
            topic = self._topic("tool_type")
            return f"{topic} is silent: nobody knows {self.name}'s instrument; set its tool type"
        if self.tool != self._wanted_tool:
            has = self.tool or "no instrument"
            return f"{self.name} has {has} and not {self._wanted_tool}; change it"
        return ""

    def intrusion(self) -> str:
        """What shows, while we send setpoints, that somebody else moves it too; or ""."""
        if self.condition.is_busy:
            return f"{self.name} is busy with a motion of somebody else; end it, then start again"
        newest = self.held.newest, self.jaw_held.newest
        if self._ours is not None and all(map(is_, newest, self._ours)):
            return ""  # it does not become a stranger's by what was sent since then
        joint = self.sent.stranger(self._setpoint(), self.held.newest.stamp_s)
        if joint is None:
            self._ours = newest
            return ""
        which = (*self.joint_names, JAW)[joint]
        return (
            f"{self.name} holds a setpoint for {which} that was not sent from here: another "
            "program commands it; end that program, then start again"
        )

    def silence(self, now: float) -> str:
        """Which of its topics is lost, in words; "" when all are heard."""
        for stream in self.streams:
            if now - stream.newest.stamp_s > SILENT_S:
                return f"{stream.topic} is silent; look at the robot's program and the network"
        return ""

    def fault(self) -> str:
        """Why a person has to look at it; "" when nobody has to."""
        if self.condition.state != FAULT:
            return ""
        said = self.error or "without a word on why"
        return f"{self.name} is in FAULT ({said})"

    def send(self, setpoint: JointSetpoint, stamp: Time, now: float) -> None:
        """Sends joints, position and velocity always: an arm keeps an old velocity.

        `send_jaw` has to follow: the joints of all arms go out before any jaw.
        """
        self.sent.note(setpoint, now, self._setpoint())
        self._servo_jp(JointState(Header(stamp), self.joint_names, setpoint.jp, setpoint.jv))

    def send_jaw(self, setpoint: JointSetpoint, stamp: Time) -> None:
        """The other half of a setpoint."""
        jaw = (setpoint.jaw,), (setpoint.jaw_v,)
        self._jaw_servo_jp(JointState(Header(stamp), (JAW,), *jaw))
        self._note_echo()

    def hold(self) -> None:
        """Asks it to stay at its setpoint."""
        self._hold(Empty())

    def command(self, word: str, now: float) -> None:
        """Says a state command; again only after a while."""
        if word != self._said or now - self._said_s >= RESEND_S:
            self._said, self._said_s = word, now
            stamp = Time.of_ns(self._transport.stamp_ns())
            self._state_command(StringStamped(Header(stamp), word))

    def _note_echo(self) -> None:
        """How old what it holds is, once for each time that it says so."""
        held = self.held.newest
        if held.stamp_s > self._echo_s:
            self._echo_s = held.stamp_s
            age_s = self.sent.age_s(held.position, held.stamp_s)
            if age_s is not None:
                self.ages.note(age_s)

    def _setpoint(self) -> Joints:
        return (*self.held.newest.position, *self.jaw_held.newest.position)

    def _topic(self, name: str) -> str:
        return f"/{self.name}/{name}"

    def _stream(self, name: str, joints: tuple[str, ...], has_velocity: bool) -> JointStream:
        stream = JointStream(self._topic(name), joints, has_velocity)
        self._transport.subscribe(stream.topic, JointState, stream.hear)
        return stream

    def _publisher(self, name: str) -> Callable[[Any], None]:
        return self._transport.publisher(self._topic(name), topics.topic(name).message)

    def _listen(self) -> None:
        """Subscribes to what comes at changes only."""
        hear = partial(self._transport.subscribe, is_latched=True)
        hear(self._topic("operating_state"), OperatingState, self._hear_condition)
        hear(self._topic("tool_type"), String, self._hear_tool)
        hear(self._topic("error"), String, self._hear_error)
        clutch = topics.topic("IO/arm_clutch")
        for name in (clutch.name, clutch.old_name):
            hear(self._topic(name), Joy, partial(self._hear_clutch, name))
        for topic in topics.followings(self.name):
            hear(topic, Bool, partial(self._hear_following, topic))

    def _hear_condition(self, word: OperatingState, received_s: float) -> None:
        """The newest stamp counts: who listens late hears what was so long ago as well.

        A robot whose clock was set back, as its samples show, begins anew.
        """
        del received_s
        restarts = sum(stream.clock.restarts for stream in self.streams)
        is_news = word.header.stamp.ns >= self.condition.header.stamp.ns
        if is_news or restarts > self._restarts:
            self.condition, self._restarts = word, restarts

    def _hear_tool(self, word: String, received_s: float) -> None:
        del received_s
        self.tool = word.data.lower().replace(":", "_")

    def _hear_error(self, word: String, received_s: float) -> None:
        del received_s
        self.error, self.errors = word.data, self.errors + 1

    def _hear_clutch(self, name: str, word: Joy, received_s: float) -> None:
        del received_s
        is_pressed = bool(word.buttons) and word.buttons[0] == PRESSED
        (self._clutches.add if is_pressed else self._clutches.discard)(name)

    def _hear_following(self, topic: str, word: Bool, received_s: float) -> None:
        del received_s
        (self._masters.add if word.data else self._masters.discard)(topic)
