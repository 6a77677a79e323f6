"""One simulated dVRK arm: what it does about each CRTK command, and what it says. No transport."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import ArmState, Joints, JointSetpoint
from viskill_deploy.drivers.crtk.arm_cartesian import Cartesian
from viskill_deploy.drivers.crtk.arm_motion import ArmMotion
from viskill_deploy.drivers.crtk.instruments import tool_type
from viskill_deploy.drivers.crtk.messages import Float, JointState, PoseStamped
from viskill_deploy.drivers.crtk.operating import Operating
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.tracking import TrackingCheck

HOME: Joints = (0.0, 0.0, 0.12, 0.0, 0.0, 0.0)
"""Where dVRK's kinematic simulation goes when it is homed; rad and m."""

WARN_EVERY_S = 2.0
"""Refusals of an arm that is not ready are told this often, with their number."""

WARN_EVERY = 1000
"""Of so many refusals near the cannula one is told."""

DESIRED = {"enable": "ENABLED", "disable": "DISABLED", "home": "HOMED", "pause": "PAUSED"}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What operating_state says."""

    state: str
    is_homed: bool
    is_busy: bool


Event = tuple[str, Any]
"""A topic's name and what is to be said on it: text, yes or no, a number, or a `Snapshot`."""


class SimulatedArm:
    """An arm with its states, motions and refusals. Methods are named after their topics.

    Args:
        arm: the arm in its place.
        setpoint: where it stands.
        options: version and homing.

    Attributes:
        operating: its state machine.
        motion: what it is told to hold.
        tool: instrument's name as dVRK writes it; "" without one.
        is_clutched: somebody moves it by hand.
        events: what it has said and nobody has taken yet.
    """

    def __init__(self, arm: CellArm, setpoint: JointSetpoint, options: ServerOptions) -> None:
        self.name, self.cartesian = arm.name, Cartesian(arm)
        self.operating, self.motion = Operating(), ArmMotion(arm.arm, setpoint)
        self._tracking = TrackingCheck(arm.arm, options.version)
        self._goes_home, self._proper_tool = options.homing == "dvrk", tool_type(arm.arm.tool)
        self.tool, self.is_clutched = self._proper_tool, False
        self._measured: Joints = (*setpoint.jp, setpoint.jaw)
        self._time_s = self._warning_due_s = 0.0
        self._refused = self._refused_cartesian = 0
        self._told = Snapshot("", False, False)
        self.events: list[Event] = [("tool_type", self.tool), ("trajectory_j/ratio", 1.0)]
        self.tell_state()

    @property
    def snapshot(self) -> Snapshot:
        """Its operating state now."""
        operating = self.operating
        is_busy = operating.phase != "idle" or self.is_clutched or self.motion.is_moving
        return Snapshot(operating.state, operating.is_homed, is_busy)

    def actuators(self, joints: Sequence[float]) -> Joints:
        """Actuators (7,) for joints (7,), jaw last."""
        return self._tracking.actuators(joints)

    def take_events(self) -> list[Event]:
        """What it has said since the last call."""
        events, self.events = self.events, []
        return events

    def tell_state(self, must: bool = False) -> None:
        """Says its operating state when it has changed, or when it `must`."""
        now = self.snapshot
        if now != self._told:
            more = [", homed" * now.is_homed, ", busy" * now.is_busy]
            self._say("status", f"{now.state}{''.join(more)}")
        if must or now != self._told:
            self.events.append(("operating_state", now))
        self._told = now

    def tick(self, dt_s: float, measured: ArmState, has_supply: bool) -> JointSetpoint:
        """A moment passes.

        Args:
            dt_s: how long.
            measured: the arm's joints at its beginning.
            has_supply: its amplifiers can have power.

        Returns:
            What the drives, or the brakes, hold it at.
        """
        self._time_s += dt_s
        self._measured = (*measured.measured_jp, measured.jaw_measured_jp)
        had_power = self.operating.has_power
        wrong = self.operating.pass_time(dt_s, has_supply)
        self.motion.tick(dt_s, self._measured)
        if self.operating.phase == "homing" and not self.motion.is_moving:
            self.operating.arrive()
        if self.operating.has_power and not self.is_clutched:
            mask = self._tracking.too_far(self.motion.p, self._measured)
            if mask:
                wrong = self.operating.fail(f"tracking error, mask {[int(x) for x in mask]}")
        if wrong:
            self._say("error", wrong)
        if had_power and not self.operating.has_power:
            self._brake()
        self._tell_motion()
        return self.motion.setpoint

    def state_command(self, word: str) -> None:
        """enable, disable, home, unhome, pause or resume."""
        had_power = self.operating.has_power
        refusal = self.operating.command(word)
        if refusal:
            self._say("warning", refusal)
        else:
            self.events.append(("desired_state", DESIRED.get(word, self.operating.state)))
            self._follow_state(word, had_power)
        self._tell_motion()
        self.tell_state(must=True)

    def servo_jp(self, message: JointState) -> None:
        """Joints to be at now."""
        q = self._joints("servo_jp", message.position, message.velocity)
        if q and self._is_ready("servo_jp"):
            self.motion.servo(q, message.velocity[:6])
            self._tell_motion()

    def servo_jr(self, message: JointState) -> None:
        """Joints to be at now, relative to the setpoint."""
        step = self._joints("servo_jr", message.position, message.velocity)
        if step and self._is_ready("servo_jr"):
            self.motion.servo(_sum(self.motion.p, step), message.velocity[:6])
            self._tell_motion()

    def servo_cp(self, message: PoseStamped) -> None:
        """Pose of the tip to be at now; the setpoint stays when there are no joints for it."""
        q = self._cartesian_goal("servo_cp", message)
        if q:
            self.motion.servo(q, (0.0,) * 6)
            self._tell_motion()

    def move_jp(self, message: JointState) -> None:
        """Joints to go to."""
        q = self._joints("move_jp", message.position)
        if q and self._is_ready("move_jp"):
            self._move(q)

    def move_jr(self, message: JointState) -> None:
        """Joints to go to, relative to where it goes already."""
        step = self._joints("move_jr", message.position)
        if step and self._is_ready("move_jr"):
            self._move(_sum(self.motion.goal, step))

    def move_cp(self, message: PoseStamped) -> None:
        """Pose to go to; the tip's way there is no straight line."""
        q = self._cartesian_goal("move_cp", message)
        if q:
            self._move(q)

    def jaw_servo_jp(self, message: JointState) -> None:
        """The jaw's angle to be at now; its velocity is not used."""
        angle = self._numbers("jaw/servo_jp", message.position, 1)
        if angle and self._is_ready("jaw/servo_jp"):
            self.motion.servo_jaw(angle[0])
            self._tell_motion()

    def jaw_move_jp(self, message: JointState) -> None:
        """The jaw's angle to go to."""
        angle = self._numbers("jaw/move_jp", message.position, 1)
        if angle and self._is_ready("jaw/move_jp"):
            self.motion.move_jaw(angle[0])
            self._tell_motion()

    def hold(self) -> None:
        """Stays at the setpoint."""
        if self._is_ready("hold"):
            self.motion.hold()
            self._tell_motion()

    def free(self) -> None:
        """Lets go: no drive holds the arm."""
        if self._is_ready("free"):
            self.motion.free()
            self._tell_motion()

    def set_ratio(self, message: Float) -> None:
        """Part of speed and acceleration that trajectories use."""
        if 0.0 < message.data <= 1.0:
            self.motion.ratio = message.data
            self.events.append(("trajectory_j/ratio", message.data))
        else:
            self._say("warning", f"trajectory_j/set_ratio: {message.data} is not in ]0, 1]")

    def refuse(self, verb: str) -> None:
        """A command that this simulation does not know how to follow."""
        self._say("error", f"{verb} is not simulated")

    def warn(self, text: str) -> None:
        """Says a warning."""
        self._say("warning", text)

    def set_tool(self, tool: str) -> None:
        """An instrument is put in, "" for taken out; the arm stays where it is."""
        was_there, self.tool = bool(self.tool), tool
        self.motion.hold()
        if tool and not was_there:
            self.operating.engage()
        self.events.append(("tool_type", tool))
        self._tell_motion()

    def emulate_tool(self, is_there: bool) -> None:
        """The instrument of the cell's file is put in or taken out."""
        self.set_tool(self._proper_tool if is_there else "")

    def clutch(self, is_pressed: bool) -> None:
        """The button on the arm: while it is pressed, somebody's hand moves the arm."""
        self.is_clutched = is_pressed
        if is_pressed and self.operating.has_power:
            self.motion.free()
        elif self.operating.has_power:
            self._brake()
        self._tell_motion()

    def place(self, setpoint: JointSetpoint) -> None:
        """Somebody has put the arm elsewhere; it holds there."""
        self.motion.place(setpoint)
        self._measured = (*setpoint.jp, setpoint.jaw)
        self._tell_motion()

    def fail(self, why: str) -> None:
        """Goes to FAULT, without power."""
        self._say("error", self.operating.fail(why))
        self._brake()
        self._tell_motion()

    def _follow_state(self, word: str, had_power: bool) -> None:
        if had_power and not self.operating.has_power:
            self._brake()
        elif word in {"pause", "unhome"} and had_power:
            self.motion.hold()
        elif word == "home" and self.operating.phase == "homing" and not self.motion.is_moving:
            goes = self._goes_home and not self.operating.has_reference
            self.motion.move(HOME if goes else self.motion.p[:6])
            self.motion.move_jaw(0.0 if goes else self.motion.p[6])

    def _brake(self) -> None:
        *jp, jaw = self._measured
        self.motion.place(JointSetpoint(tuple(jp), (0.0,) * 6, jaw, 0.0))

    def _move(self, q: Sequence[float]) -> None:
        self.motion.move(q)
        self._tell_motion()

    def _tell_motion(self) -> None:
        for is_reached in self.motion.reached:
            self.events.append(("goal_reached", is_reached))
        self.motion.reached.clear()
        self.tell_state()

    def _cartesian_goal(self, verb: str, message: PoseStamped) -> Joints:
        """Joints for a goal in Cartesian space; () when it is refused."""
        if not self._is_ready(verb):
            return ()
        if not self.cartesian.is_past_cannula(self._measured):
            if self._refused_cartesian % WARN_EVERY == 0:
                where = "needs to be inserted past the cannula to switch to cartesian space"
                self._say("warning", f"tool/endoscope {where}")
            self._refused_cartesian += 1
            return ()
        try:
            return self.cartesian.goal(message.pose, self._measured[:6])
        except KinematicsError as error:
            self._say("error", f"unable to solve inverse kinematics ({error})")
            if verb == "move_cp":
                self.events.append(("goal_reached", False))
            return ()

    def _joints(self, verb: str, values: Joints, velocities: Joints = ()) -> Joints:
        """The first six of `values`; () when they cannot be used."""
        if not all(map(math.isfinite, velocities)):
            self._say("error", f"{verb}: a velocity is not finite; nothing is done")
            return ()
        return self._numbers(verb, values, 6)[:6]

    def _numbers(self, verb: str, values: Joints, count: int) -> Joints:
        """`values`, or () when they are too few, or are no numbers."""
        if len(values) < count or (count == 1 and len(values) > 1):
            self._say("error", f"{verb}: {len(values)} positions for {count} joints")
            return ()
        if not all(map(math.isfinite, values)):
            self._say("error", f"{verb}: a position is not finite; nothing is done")
            return ()
        return values

    def _is_ready(self, verb: str) -> bool:
        if self.operating.is_ready and self.tool and not self.is_clutched:
            return True
        self._refused += 1
        if self._time_s >= self._warning_due_s:
            self._say("warning", f"{verb}, arm not ready ({self._refused} errors)")
            self._warning_due_s, self._refused = self._time_s + WARN_EVERY_S, 0
        return False

    def _say(self, kind: str, text: str) -> None:
        self.events.append((kind, f"{self.name}: {text}"))


def _sum(a: Sequence[float], b: Sequence[float]) -> list[float]:
    return [x + y for x, y in zip(a, b, strict=False)]
