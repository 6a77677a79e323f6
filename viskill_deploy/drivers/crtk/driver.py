"""The CRTK driver: dVRK arms, as one client among those that may command them.

A dVRK takes whatever it is sent, from anybody, and holds the last of it for ever. So everything
that must hold before and during motion is looked at here at every reading: operating state,
instrument, teleoperation, clutch, other programs, samples without a valid stamp.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from viskill_deploy.core.clock import Clock, MonotonicClock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ActiveObject, CellState, Scene
from viskill_deploy.drivers.base import ENABLED, Capabilities, accepted
from viskill_deploy.drivers.crtk.arm import ArmClient
from viskill_deploy.drivers.crtk.console import Console
from viskill_deploy.drivers.crtk.doubts import Doubts, first, refuse
from viskill_deploy.drivers.crtk.messages import Time
from viskill_deploy.drivers.crtk.on_the_way import Ages
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.drivers.crtk.wishes import DISABLE, ENABLE, HOME, PAUSE, RECOVER, Wish
from viskill_deploy.drivers.watch import Watch
from viskill_deploy.safety.checked import CheckedSetpoint

CONNECT_S: Final = 10.0
"""Discovery over ROS 2 takes up to a few seconds."""

SAMPLE_S: Final = 0.5
"""How long an arm that is there gets to say where it is."""

CONSOLE: Final = "console"
"""dVRK's name for the console of a system that has one."""

TOOL_S: Final = 1.0
"""How long after homing an arm's word on its instrument may take."""


@dataclass(frozen=True, slots=True)
class CrtkOptions:
    """How a cell is driven over CRTK.

    Attributes:
        period_s: control period; 200 Hz.
        console: name of the console whose operator agrees to motion.
        source: how the gate calls that operator.
    """

    period_s: float = 0.005
    console: str = CONSOLE
    source: str = "operator_present"


def nothing() -> None:
    """Nobody looks on."""


class CrtkDriver:
    """dVRK arms over CRTK.

    `connect`, `enable`, `home` and `recover` wait for the arms, with the patience of `wishes`;
    all other calls return at once.

    Args:
        cell: the arms.
        transport: the way to them, which the driver closes.
        options: period and console.
        start_watch: starts the watchdog; called in `connect`.

    Attributes:
        arms: what is known of each.
        meanwhile: called every period while arms are waited for; ends that by a DriverError.
    """

    capabilities = Capabilities(simulated=False, stepped=False, resettable=False, sees_scene=False)

    def __init__(
        self,
        cell: CellDescription,
        transport: Transport,
        options: CrtkOptions,
        start_watch: Callable[[], Watch],
    ) -> None:
        self.clock: Clock = MonotonicClock()
        self.period_s, self.arms = options.period_s, list[ArmClient]()
        self.meanwhile: Callable[[], None] = nothing
        self._cell, self._transport, self._options = cell, transport, options
        self._start_watch = start_watch
        self._watch: Watch | None = None
        self._wish: Wish | None = None  # what arms are told until it is so
        self._is_ready = False  # enabled and homed, at our wish
        self._is_ours = False  # whether they were ever enabled from here
        self._doubts = Doubts(())

    @property
    def watch(self) -> Watch:
        """The watchdog; there is no connection without one."""
        if self._watch is None:
            raise DriverError("the arms over CRTK are not connected; call connect() first")
        return self._watch

    @property
    def fault(self) -> str:
        """Why a person has to look at the arms before they are enabled; "" when nobody has to."""
        return self._doubts.look_for_faults()

    @property
    def node(self) -> Transport:
        """Its node on the robot's network, for who listens there too."""
        return self._transport

    def connect(self) -> None:
        """Subscribes, and waits until every arm is heard; arms stay as they are.

        Raises:
            DriverError: an arm is not heard, or is not the cell's; names it and its topic.
        """
        try:
            self._console = Console(self._transport, self._options.console, self._options.source)
            self.arms = [ArmClient(arm, self._transport) for arm in self._cell.arms]
            self._doubts = Doubts(self.arms)
            self._until(lambda: not self._unheard(), CONNECT_S, self._unheard)
            with contextlib.suppress(DriverError):  # without power it may not know where it is
                self._until(lambda: all(arm.is_heard for arm in self.arms), SAMPLE_S, str)
            refuse(self._doubts.fit())
            self._watch = self._start_watch()
        except DriverError:
            self.close()
            raise

    def enable(self) -> None:
        """Switches every arm on.

        Raises:
            DriverError: an arm does not follow, or must not be moved; names it and why.
        """
        self._connected()
        refuse(self._doubts.look_for_faults())
        self._is_ready, self._is_ours = False, True
        self._doubts.end_stream()
        self._doubts.trouble = ""
        self._reach(ENABLE)

    def home(self) -> None:
        """Homes every enabled arm that is not homed.

        Raises:
            DriverError: an arm is not enabled, does not home, or must not be moved.
        """
        self._connected()
        for arm in self.arms:
            if arm.condition.state != ENABLED:
                raise DriverError(
                    f"home is not possible while {arm.name} is {arm.condition.state}; "
                    "enable the arms first"
                )
        self._reach(HOME)
        standing = self._doubts.standing
        self._until(lambda: all(arm.tool is not None for arm in self.arms), TOOL_S, standing)
        refuse(standing())
        self._is_ready = True

    def hold(self) -> None:
        """Every arm stays at the setpoint that it holds."""
        self._connected()
        for arm in self.arms:
            arm.hold()

    def disable(self) -> None:
        """Takes power from every arm that has it; readings say so again until it is so."""
        self._connected()
        self._is_ready = False
        self._doubts.end_stream()
        self._wish = DISABLE
        self._press()

    def recover(self) -> None:
        """What a person asks for after having looked at a fault: the arms are DISABLED and good.

        Nothing else clears a fault, and nothing calls this by itself.

        Raises:
            DriverError: an arm stays in FAULT.
        """
        self._connected()
        self._is_ready = False
        self._reach(RECOVER)
        self._doubts.forgive()

    def close(self) -> None:
        """Holds and disables arms that were enabled from here, and closes; may be called twice."""
        if self.arms and self._is_ours:
            for arm in self.arms:
                with contextlib.suppress(DriverError):  # what cannot be reached holds by itself
                    arm.hold()
            doubts = self._doubts
            doubt = doubts.fault or doubts.trouble or doubts.silence(self.clock.now())
            for wish in (PAUSE, DISABLE) if doubt else (DISABLE,):
                with contextlib.suppress(DriverError):
                    self._reach(wish)
        self.arms, self._is_ready, self._is_ours = [], False, False
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        self._transport.close()

    def state(self) -> CellState:
        """The newest measurement of every arm.

        Raises:
            DriverError: somebody else commands an arm, or it is not as the cell says.
        """
        self._connected()
        self._press()
        refuse(self._doubts.fit())
        found = self._found()
        if not self._doubts.fault:  # arms in FAULT say so by themselves
            refuse(found)
        arms = tuple([arm.state() for arm in self.arms])
        alive_s = min([arm.stamp_s for arm in arms])
        inputs = self._console.inputs(alive_s, any(arm.has_lost_power for arm in self.arms))
        return CellState(arms, self.watch.told(inputs, self.clock.now()))

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        """Sends one checked setpoint an arm.

        Raises:
            DriverError: arms are not ready, must not be moved, or cannot be reached.
        """
        wanted = accepted(setpoints)
        self._connected()
        refuse(self._found())
        idle = [arm for arm in self.arms if not arm.is_ready]
        if idle or not self._is_ready:
            states = ", ".join(f"{arm.name} {arm.condition.state}" for arm in idle or self.arms)
            raise DriverError(f"servo_jp: arms not ready ({states}); enable and home them")
        if len(wanted) != len(self.arms):
            raise DriverError(f"servo_jp: {len(wanted)} setpoints for {len(self.arms)} arms")
        now = self.clock.now()
        if not self._doubts.is_streaming(now):
            self._doubts.end_stream()
        stamp = Time.of_ns(self._transport.stamp_ns())
        for arm, setpoint in zip(self.arms, wanted, strict=True):
            arm.send(setpoint, stamp, now)
        for arm, setpoint in zip(self.arms, wanted, strict=True):
            arm.send_jaw(setpoint, stamp)

    def on_the_way(self) -> dict[str, Any]:
        """How setpoints fare on their way; {} before any was sent.

        `echo_age`: how old the setpoint is of which an arm says that it holds it. `heard`, of which
        `lost` is what is missing, and `age` at the arrival: only arms that count can tell.
        """
        ages, sent = Ages(), sum(arm.sent.count for arm in self.arms)
        for arm in self.arms:
            ages.add(arm.ages)
        return {"sent": sent, **ages.facts("echo_age")} if sent else {}

    def scene(self) -> Scene | None:
        """Arms see no objects."""
        return None

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """Only a person agrees to motion here."""
        raise DriverError("a dVRK has no simulated operator; use the pedal at its console")

    def break_drive(self, joint: str, kind: str) -> None:
        """Only simulated drives can be broken."""
        raise DriverError("only a simulated drive can be broken on purpose")

    def active_object(self) -> ActiveObject:
        """Arms see no objects."""
        raise DriverError("a dVRK does not know the truth about objects; use the loopback")

    def reset(self, layout: Scene) -> None:
        """Nobody puts real objects in place."""
        raise DriverError("a real cell is not reset; put the objects in place by hand")

    def _connected(self) -> None:
        if self._watch is None:
            raise DriverError("the arms over CRTK are not connected; call connect() first")

    def _unheard(self) -> str:
        """Which topic is awaited, and what to do about it; "" when all arms are heard."""
        topic = first(arm.missing() for arm in self.arms)
        if not topic:
            return ""
        return (
            f"nothing is heard on {topic} over {self._transport.name} in {CONNECT_S:g} s; see that "
            "the robot's program runs, with the same names, ROS domain or master, and network"
        )

    def _found(self) -> str:
        """What is against motion now; "" for nothing, and for arms that are not ready anyway."""
        doubts = self._doubts
        found = doubts.found(self.clock.now()) if self._is_ready else doubts.look_for_faults()
        self._is_ready = self._is_ready and not doubts.fault
        return found

    def _press(self) -> None:
        """Says what was wished once more, as long as it is not so."""
        if self._wish is None:
            return
        now = self.clock.now()
        are_met = [self._wish.press(arm, now) for arm in self.arms]
        if all(are_met):
            self._wish = None

    def _reach(self, wish: Wish) -> None:
        """Waits until all arms are as wished.

        Raises:
            DriverError: an arm does not become so in time, or must not.
        """
        self._wish = wish
        try:
            self._until(lambda: self._is_reached(wish), wish.patience_s, lambda: self._late(wish))
        finally:
            self._wish = None

    def _is_reached(self, wish: Wish) -> bool:
        if not wish.is_stop:
            refuse(self._doubts.look_for_faults(), self._doubts.rivals())
        self._press()
        return self._wish is None

    def _late(self, wish: Wish) -> str:
        late = [arm for arm in self.arms if not wish.is_met(arm)]
        arm = (late or self.arms)[0]
        state = arm.condition.state + (", busy" if arm.condition.is_busy else "")
        return (
            f'{arm.name} is {state} and does not follow "{wish.name}" within {wish.patience_s:g} s '
            f'(its last error: "{arm.error}"); look at its console'
        )

    def _until(self, done: Callable[[], bool], patience_s: float, why: Callable[[], str]) -> None:
        deadline = self.clock.now() + patience_s
        while not done():
            if self.clock.now() > deadline:
                raise DriverError(why())
            self.meanwhile()
            self.clock.sleep_until(self.clock.now() + self.period_s)
