"""One arm as a guard offers it to other people's programs: what they ask of it, what it answers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import Any, Final

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.types import ArmState, Joints, JointSetpoint
from viskill_deploy.drivers.crtk.arm_cartesian import Cartesian, pose_of
from viskill_deploy.drivers.crtk.arm_on_wire import StaleCheck
from viskill_deploy.drivers.crtk.instruments import tool_type
from viskill_deploy.drivers.crtk.messages import (
    NANO,
    Empty,
    Header,
    JointState,
    OperatingState,
    PoseStamped,
    String,
    StringStamped,
    Time,
)
from viskill_deploy.drivers.crtk.topics import ARM, topic
from viskill_deploy.drivers.crtk.transport import Transport

REST: Final[Joints] = (0.0,) * 6
STILL: Final[Joints] = (0.0,)
MOST: Final = 32
"""Setpoints that may wait: more than a tenth of a second's are no stream any more."""

POSES: Final = ("measured", "setpoint")
REPEAT_S: Final = 0.1
READ_S: Final = 0.01
ERROR_S: Final = 2.0
"""What is refused again and again is told this often."""

BUSY_S: Final = 0.1
"""Between any two errors, however many differ."""

SAID_S: Final = 0.5
"""A client that hovers at a limit would be told of it with every other setpoint."""

HEARD: Final = ("state_command", "hold", "servo_jp", "servo_cp", "jaw/servo_jp")
REFUSED: Final = tuple(t.name for t in ARM if t.publisher == "client" and t.name not in HEARD)
"""All else that dVRK's client may send: it wants somebody at the other end of each."""

SAID: Final = tuple(t.name for t in ARM if t.publisher == "server")
"""All that dVRK's client listens to, for the same reason. What the guard does not know better than
the robot (forces, twists, Jacobians, its clutch) is never said: ask the robot for it."""


@dataclass(frozen=True, slots=True)
class Condition:
    """What operating_state says to the client."""

    state: str
    is_homed: bool
    is_busy: bool


@dataclass(frozen=True, slots=True)
class Asked:
    """What a client asks of an arm in one setpoint; velocities are () where it gives none.

    Attributes:
        lost: how many setpoints are missing before it, going by the stamps; 0 without stamps.
    """

    jp: Joints
    jv: Joints
    jaw: float
    jaw_v: Joints
    lost: int

    def setpoint(self, last: JointSetpoint, time_s: float) -> JointSetpoint:
        """With the mean velocities since the last setpoint where the client gives none."""
        speeds = self.jv or tuple([(b - a) / time_s for a, b in zip(last.jp, self.jp, strict=True)])
        speed = self.jaw_v[0] if self.jaw_v else (self.jaw - last.jaw) / time_s
        return JointSetpoint(self.jp, speeds, self.jaw, speed)


class OfferedArm:
    """An arm's topics towards the client.

    Args:
        arm: the arm.
        transport: where the client is.
        prefix: stands in front of the arm's name, such as "guarded".
        wake: called when something has come.

    Attributes:
        servo: joints or poses that were asked for and not looked at yet, with time of arrival.
        jaw: the same for the jaw.
        commands: state commands, and "hold", in their order.
    """

    def __init__(
        self, arm: CellArm, transport: Transport, prefix: str, wake: Callable[[], None]
    ) -> None:
        self.name, self._wake, self._transport = arm.name, wake, transport
        self._cartesian, self._tool = Cartesian(arm), arm.arm.tool
        self._joints = tuple(joint.name for joint in arm.arm.joints)
        self._root = f"/{prefix}/{arm.name}" if prefix else f"/{arm.name}"
        self._stale = StaleCheck(transport.stamp_ns())
        self.servo: deque[tuple[JointState | PoseStamped, float]] = deque(maxlen=MOST)
        self.jaw: deque[tuple[JointState, float]] = deque(maxlen=MOST)
        self.commands: deque[str] = deque()
        self._refusals: deque[str] = deque(maxlen=MOST)
        self._said_s: dict[str, float] = {}
        self._told, self._heard = Condition("", False, False), set[str]()
        self._stamp_ns = self._last_ns = 0
        self._read_due_s = self._repeat_due_s = 0.0
        self._error, self._error_s = "", -inf
        self._publish = {name: self._publisher(name) for name in SAID}
        self._publish["tool_type"](String(tool_type(self._tool)))
        self._listen()

    @property
    def arrivals(self) -> list[float]:
        """When the oldest that waits in each stream came."""
        return [queue[0][1] for queue in (self.servo, self.jaw) if queue]

    def forget(self) -> None:
        """Drops what waits."""
        self.servo.clear()
        self.jaw.clear()

    def take(self, last: JointSetpoint, period_s: float) -> Asked:
        """The oldest setpoint that waits. What the client did not ask for stays where it was.

        Args:
            last: what the arm was sent last.
            period_s: time between two setpoints of the client.

        Raises:
            KinematicsError: no joints bring the tip to the pose that is asked for.
        """
        q, v, lost = last.jp, REST, 0
        jaw, jaw_v = last.jaw, STILL
        if self.servo:
            message, _ = self.servo.popleft()
            lost = self._lost(message.header.stamp.ns, period_s)
            if isinstance(message, JointState):
                q, v = message.position, message.velocity
            else:
                q, v = self._cartesian.goal(message.pose, last.jp), ()
        if self.jaw:
            word, _ = self.jaw.popleft()
            jaw, jaw_v = word.position[0], word.velocity
        return Asked(q, v, jaw, jaw_v, lost)

    def speak(self, state: ArmState, condition: Condition, now: float) -> None:
        """Says where the arm is, and in what condition; what was refused too.

        Args:
            state: of the robot's arm.
            condition: what the client is told of it.
            now: the clock that `state` is stamped by.
        """
        while self._refusals:
            self.error(self._refusals.popleft(), now)
        if state.tool != self._tool:
            self._tool = state.tool
            self._publish["tool_type"](String(tool_type(self._tool) if self._tool else ""))
        is_time = now >= self._repeat_due_s
        if is_time:
            self._heard = {kind for kind in POSES if self._is_heard(kind)}
        if now >= self._read_due_s:
            self._read_due_s = max(self._read_due_s + READ_S, now)
            stamp_ns = self._transport.stamp_ns() - round((now - state.stamp_s) * NANO)
            self._read(state, Time.of_ns(stamp_ns) if state.valid else Time())
        if is_time or condition != self._told:
            self._told, self._repeat_due_s = condition, now + REPEAT_S
            self._stamp_ns = max(self._transport.stamp_ns(), self._stamp_ns + 1)
            head = Header(Time.of_ns(self._stamp_ns))
            said = (condition.state, condition.is_homed, condition.is_busy)
            self._publish["operating_state"](OperatingState(head, *said))

    def error(self, text: str, now: float) -> None:
        """Says why something was not done; seldom, if it goes on."""
        since_s = now - self._error_s
        if since_s >= (ERROR_S if text == self._error else BUSY_S):
            self._error, self._error_s = text, now
            self._publish["error"](String(f"{self.name}: {text}"))

    def tell(self, text: str, is_warning: bool, now: float) -> None:
        """Says what the gate does, on `warning` or on `status`; the same not again at once."""
        if now < self._said_s.get(text, -inf) + SAID_S:
            return
        self._said_s[text] = now
        self._publish["warning" if is_warning else "status"](String(f"{self.name}: {text}"))

    def _read(self, state: ArmState, stamp: Time) -> None:
        head, names, jaw, say = Header(stamp), self._joints, ("jaw",), self._publish
        angle = (state.jaw_measured_jp,), (state.jaw_measured_jv,)
        say["measured_js"](JointState(head, names, state.measured_jp, state.measured_jv))
        say["setpoint_js"](JointState(head, names, state.setpoint_jp))
        say["jaw/measured_js"](JointState(head, jaw, *angle))
        say["jaw/setpoint_js"](JointState(head, jaw, (state.jaw_setpoint_jp,)))
        local, task = Header(stamp, f"{self.name}_base"), Header(stamp, "task")
        for kind, q in (("measured", state.measured_jp), ("setpoint", state.setpoint_jp)):
            if state.valid and kind in self._heard:
                T = self._cartesian.local(q)
                say[f"local/{kind}_cp"](PoseStamped(local, pose_of(T)))
                T = self._cartesian.T_task_base @ T
                say[f"{kind}_cp"](PoseStamped(task, pose_of(T)))

    def _lost(self, stamp_ns: int, period_s: float) -> int:
        """How many setpoints are missing before one that is stamped so."""
        before, self._last_ns = self._last_ns, stamp_ns
        if not (before and stamp_ns > before):
            return 0
        return max(round((stamp_ns - before) / (period_s * NANO)) - 1, 0)

    def _listen(self) -> None:
        hear = self._transport.subscribe
        hear(self._name("state_command"), StringStamped, self._hear_command)
        hear(self._name("hold"), Empty, self._hear_hold)
        servo = partial(hear, kept=MOST)  # two that come at once are two of the client's periods
        servo(self._name("servo_jp"), JointState, partial(self._hear_joints, self.servo, 6))
        servo(self._name("servo_cp"), PoseStamped, self._hear_pose)
        servo(self._name("jaw/servo_jp"), JointState, partial(self._hear_joints, self.jaw, 1))
        for name in REFUSED:
            hear(self._name(name), topic(name).message, partial(self._hear_refused, name))

    def _hear_command(self, word: StringStamped, received_s: float) -> None:
        del received_s
        refusal = self._stale.refusal(word.header.stamp.ns, self._transport.stamp_ns())
        if refusal:
            self._refusals.append(f'command "{word.string}" {refusal}')
        else:
            self.commands.append(word.string)
        self._repeat_due_s = 0.0  # an answer is awaited
        self._wake()

    def _hear_hold(self, word: Empty, received_s: float) -> None:
        del word, received_s
        self.commands.append("hold")
        self._wake()

    def _hear_joints(
        self, queue: deque[Any], count: int, word: JointState, received_s: float
    ) -> None:
        if len(word.position) != count or len(word.velocity) not in (0, count):
            sizes = f"{len(word.position)} positions and {len(word.velocity)} velocities"
            self._refusals.append(f"a setpoint with {sizes} is refused; send {count} of each")
            return
        queue.append((word, received_s))
        self._wake()

    def _hear_pose(self, word: PoseStamped, received_s: float) -> None:
        self.servo.append((word, received_s))
        self._wake()

    def _hear_refused(self, name: str, word: Any, received_s: float) -> None:
        del word, received_s
        self._refusals.append(f"{name} does not pass the guard; send servo_jp or servo_cp")

    def _publisher(self, name: str) -> Callable[[Any], None]:
        entry = topic(name)
        return self._transport.publisher(self._name(name), entry.message, entry.is_latched)

    def _is_heard(self, kind: str) -> bool:
        """Whether anybody wants to know where the tip is."""
        names = (f"{kind}_cp", f"local/{kind}_cp")
        return any(self._transport.peers(self._name(name)) > 0 for name in names)

    def _name(self, name: str) -> str:
        return f"{self._root}/{name}"
