"""The simulated cell as dVRK arms: operating states, held setpoints, a simulated operator."""

from __future__ import annotations

from collections.abc import Sequence

from viskill_deploy.core.errors import DriverError, ViskillError
from viskill_deploy.core.types import (
    ArmState,
    CellState,
    FloatArray,
    Inputs,
    Joints,
    JointSetpoint,
    Scene,
)
from viskill_deploy.drivers.base import DISABLED, ENABLED, PAUSED
from viskill_deploy.sim.world import World

STREAM_TIMEOUT_S = 0.02
"""The velocity of a setpoint is forgotten when no other has come for this long, as on a dVRK."""


class LoopbackCell:
    """Arms of a `World` with the semantics that CRTK clients meet on a dVRK.

    Setpoints are refused unless every arm is ENABLED and homed. The last setpoint is held for ever,
    with zero velocity once the stream stops. Homing leaves an arm with a tool where it is.

    Args:
        world: the physics.

    Attributes:
        placements: how often somebody has put the arms elsewhere.
    """

    def __init__(self, world: World) -> None:
        self.world, self.placements = world, 0
        self._state, self._homed = DISABLED, False
        self._consent = self._estop = False
        self._setpoints: list[JointSetpoint] = []
        self._silent_s = 0.0
        self._known: CellState | None = None  # the newest state that has arrived
        self._is_lost = False
        self._stay_at_home()

    @property
    def operating_state(self) -> str:
        """Of all arms alike: DISABLED, ENABLED or PAUSED."""
        return self._state

    @property
    def setpoints(self) -> tuple[JointSetpoint, ...]:
        """What every arm holds."""
        return tuple(self._setpoints)

    def reset(self, scene: Scene) -> None:
        """Puts objects where `scene` says and the arms in their start pose, at rest."""
        self.world.reset(scene)
        self._known = None
        self.placements += 1
        self._stay_at_home()

    def restore(self, physics: FloatArray, setpoints: Sequence[JointSetpoint]) -> None:
        """Goes to a state of `World.save` of the same scene, holding setpoints at rest."""
        self.world.restore(physics)
        self._known, self._setpoints = None, list(setpoints)
        self.placements += 1
        self.hold()

    def enable(self) -> None:
        """DISABLED → ENABLED."""
        self._state = ENABLED

    def home(self) -> None:
        """Homes the enabled arms.

        Raises:
            DriverError: they are not enabled.
        """
        if self._state != ENABLED:
            raise DriverError(f"home is not possible in state {self._state}; enable the arms first")
        self._homed = True

    def hold(self) -> None:
        """Stays at the setpoint, at rest."""
        self._setpoints = [_at_rest(s.jp, s.jaw) for s in self._setpoints]

    def pause(self) -> None:
        """Holds, and takes no setpoint until the arms are enabled again: ENABLED → PAUSED."""
        self.hold()
        if self._state == ENABLED:
            self._state = PAUSED

    def disable(self) -> None:
        """Takes power away; the arms keep their joints where the brakes catch them."""
        self.hold()
        self._state = DISABLED

    def break_drive(self, joint: str, kind: str) -> None:
        """A joint's drive breaks: "stuck" or "slip"; "mended" ends it for all joints.

        Raises:
            DriverError: there is no such joint or kind.
        """
        drives = self.world.drives
        try:
            match kind:
                case "stuck":
                    drives.stick(joint)
                case "slip":
                    drives.slip(joint)
                case "mended":
                    drives.mend()
                case _:
                    raise DriverError(f"a drive can be stuck, slip or be mended, not {kind!r}")
        except ViskillError as error:
            raise DriverError(str(error)) from error

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does: agrees to motion, presses the e-stop."""
        self._consent = self._consent if consent is None else consent
        self._estop = self._estop if estop is None else estop

    def servo_jp(self, setpoints: Sequence[JointSetpoint]) -> None:
        """Takes one setpoint an arm.

        Raises:
            DriverError: an arm is not ready, or their number is wrong.
        """
        if self._state != ENABLED or not self._homed:
            raise DriverError(f"servo_jp: arms not ready ({self._state}); enable and home them")
        if len(setpoints) != len(self._setpoints):
            raise DriverError(
                f"servo_jp: {len(setpoints)} setpoints for {len(self._setpoints)} arms"
            )
        if not self.world.imperfections.loses():
            self._setpoints, self._silent_s = list(setpoints), 0.0

    def advance(self) -> None:
        """Lets one control period pass."""
        self._silent_s += self.world.options.period_s
        if self._silent_s > STREAM_TIMEOUT_S:
            self.hold()
        self.world.step(self._setpoints)
        self._is_lost = self.world.imperfections.loses()

    def state(self, now: float) -> CellState:
        """Every arm as measured at `now`; the state before, when this period's was lost."""
        if self._known is None or not self._is_lost:
            self._known = self._measured(now)
        return self._known

    def _measured(self, now: float) -> CellState:
        arms = []
        for index, arm in enumerate(self.world.cell.arms):
            seen, held = self.world.measured(index), self._setpoints[index]
            arms.append(
                ArmState(
                    name=arm.name,
                    stamp_s=now,
                    valid=True,
                    operating_state=self._state,
                    is_homed=self._homed,
                    is_busy=False,
                    measured_jp=seen.jp,
                    measured_jv=seen.jv,
                    jaw_measured_jp=seen.jaw,
                    jaw_measured_jv=seen.jaw_v,
                    setpoint_jp=held.jp,
                    jaw_setpoint_jp=held.jaw,
                    joint_names=arm.arm.joint_names,
                    tool=arm.arm.tool,
                )
            )
        return CellState(tuple(arms), self.inputs(now))

    def inputs(self, now: float) -> Inputs:
        """What the simulated operator does."""
        return Inputs(self._consent, now, "simulated", self._estop)

    def scene(self, now: float) -> Scene:
        """The objects as seen at `now`."""
        seen = self.world.scene()
        return Scene(now, seen.objects, seen.active, seen.goal)

    def _stay_at_home(self) -> None:
        self._setpoints = [_at_rest(tuple(row[:-1]), row[-1]) for row in self.world.home.tolist()]


def _at_rest(jp: Joints, jaw: float) -> JointSetpoint:
    return JointSetpoint(jp, (0.0,) * len(jp), jaw, 0.0)
