"""The values that travel down the line, frozen.

Wire values (joint positions, velocities) are tuples of Python floats: immutable, and faster than
small arrays in the control loop. Matrices are read-only float64 arrays, shape-checked once.
Joint order is yaw, pitch, insertion, roll, wrist_pitch, wrist_yaw; the jaw is apart. Units: rad
for revolute joints, m for the insertion, s for time. Arms stand in the order of the cell's file.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Joints = tuple[float, ...]

PSM_JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")


def frozen_array(values: npt.ArrayLike, shape: tuple[int, ...], name: str) -> FloatArray:
    """A read-only float64 copy of `values`.

    Raises:
        ValueError: another shape, or a number that is not finite.
    """
    array = np.array(values, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds a number that is not finite")
    array.flags.writeable = False
    return array


@dataclass(frozen=True, slots=True)
class ArmState:
    """One arm as its driver reports it (CRTK: measured_js, setpoint_js, operating_state).

    Attributes:
        name: the arm, such as "PSM1".
        stamp_s: driver's clock at the newest measurement.
        valid: the driver vouches for this sample.
        operating_state: "DISABLED", "ENABLED", "PAUSED" or "FAULT".
        measured_jp: joint positions, (6,).
        measured_jv: joint velocities, (6,).
        jaw_measured_jp: jaw opening angle, rad.
        jaw_measured_jv: jaw speed, rad/s.
        setpoint_jp: the setpoint that the driver holds, (6,).
        jaw_setpoint_jp: the jaw setpoint that the driver holds, rad.
        joint_names: names in the order of the positions.
        tool: instrument in the arm, as named in robots/tools.
    """

    name: str
    stamp_s: float
    valid: bool
    operating_state: str
    is_homed: bool
    is_busy: bool
    measured_jp: Joints
    measured_jv: Joints
    jaw_measured_jp: float
    jaw_measured_jv: float
    setpoint_jp: Joints
    jaw_setpoint_jp: float
    joint_names: tuple[str, ...]
    tool: str


@dataclass(frozen=True, slots=True)
class Inputs:
    """What people and other safety devices say to the cell.

    Attributes:
        consent: the operator agrees to motion.
        consent_stamp_s: driver's clock of the newest word on it.
        consent_source: who says so; "simulated" on the loopback, never accepted by a real run.
        estop: an emergency stop is pressed or its line is lost.
        watchdog_stamp_s: driver's clock at which the watchdog last looked. Bad until shown good.
        watchdog_stepped_in: it has held the arms, because the runtime was not heard of.
        consent_is_streamed: the source repeats its word, many times a second. If not, it speaks at
            changes only, such as the edges of a pedal.
        consent_alive_s: for such a source, driver's clock at its last sign of life.
    """

    consent: bool
    consent_stamp_s: float
    consent_source: str
    estop: bool
    watchdog_stamp_s: float = -math.inf
    watchdog_stepped_in: bool = False
    consent_is_streamed: bool = True
    consent_alive_s: float = math.nan


@dataclass(frozen=True, slots=True)
class CellState:
    """All arms and inputs at one reading of the driver's clock."""

    arms: tuple[ArmState, ...]
    inputs: Inputs


@dataclass(frozen=True, slots=True)
class JointSetpoint:
    """Where one arm is asked to be at the next cycle.

    Attributes:
        jp: joint positions, (6,).
        jv: joint velocities, (6,), sent as CRTK's velocity field.
        jaw: jaw opening angle, rad.
        jaw_v: jaw speed, rad/s.
    """

    jp: Joints
    jv: Joints
    jaw: float
    jaw_v: float


@dataclass(frozen=True, slots=True)
class ObservationRange:
    """Smallest and largest value of every entry of a policy's observation in its training."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Request:
    """What the line asks the gate for in one cycle.

    Attributes:
        setpoints: one an arm, or None when the line found no solution in this cycle.
        failure: why there are none; "" otherwise.
        waypoint_due_s: driver's clock at which the next waypoint is needed; inf when the motion
            ends at rest by itself.
        may_open_jaw: per arm, whether the running skill may open the jaw while it holds something.
        holding: per arm, whether the line believes that the jaw holds something.
        observation: what the policy saw when it asked for this; empty where no policy is asked.
        tips: where the setpoints are meant to bring the control points, one an arm, task frame, m;
            empty where the joints themselves are what is wanted.
    """

    setpoints: tuple[JointSetpoint, ...] | None
    failure: str = ""
    waypoint_due_s: float = math.inf
    may_open_jaw: tuple[bool, ...] = ()
    holding: tuple[bool, ...] = ()
    observation: tuple[float, ...] = ()
    tips: tuple[Joints, ...] = ()


class Action(enum.IntEnum):
    """What the gate does about a cycle, ordered: the worst one wins."""

    PASS = 0
    WARN = 1
    SCALE = 2
    HOLD = 3
    STOP = 4
    FAULT = 5
    ESTOP = 6


class Mode(enum.Enum):
    """Mode of the supervisor."""

    OFF = "off"
    CONNECTED = "connected"
    HOMED = "homed"
    READY = "ready"
    ARMED = "armed"
    RUNNING = "running"
    HOLDING = "holding"
    FAULT = "fault"
    ESTOPPED = "estopped"


@dataclass(frozen=True, slots=True)
class Verdict:
    """One rule's word on one cycle. Numbers and ids only: sentences live in `observe`.

    Attributes:
        rule: invariant's id, such as "S05".
        action: what the rule asks for.
        arm: index of the arm, -1 for the cell.
        joint: index of the joint (6 = jaw), -1 for the whole arm.
        value: the number judged; limit: what it was held against.
    """

    rule: str
    action: Action
    arm: int = -1
    joint: int = -1
    value: float = math.nan
    limit: float = math.nan


@dataclass(frozen=True, slots=True)
class ObjectPose:
    """Pose of one thing on the board, in the task frame."""

    name: str
    T_task_object: FloatArray = field()

    def __post_init__(self) -> None:
        pose = frozen_array(self.T_task_object, (4, 4), "T_task_object")
        object.__setattr__(self, "T_task_object", pose)


@dataclass(frozen=True, slots=True)
class Scene:
    """What is known of the things on the board.

    Attributes:
        stamp_s: driver's clock at which they were seen.
        objects: blocks, rings, letters, doors.
        active: name of the object to manipulate.
        goal: where it has to go, task frame, (3,) m.
    """

    stamp_s: float
    objects: tuple[ObjectPose, ...]
    active: str
    goal: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "goal", frozen_array(self.goal, (3,), "goal"))

    def pose(self, name: str) -> FloatArray:
        """Pose of the object called `name`, task frame, (4, 4)."""
        for thing in self.objects:
            if thing.name == name:
                return thing.T_task_object
        held = [thing.name for thing in self.objects]
        raise KeyError(f"no object {name!r} in the scene; it holds {held}")


@dataclass(frozen=True, slots=True)
class ActiveObject:
    """What counts for success about the object that is to be moved.

    Attributes:
        T_task_object: pose, (4, 4).
        speed_m_s: speed of its centre.
        touched: per arm, whether any part of it touches the object.
        door_touched: whether a wrist touches the sliding door over the goal; False where there is
            no door.
    """

    T_task_object: FloatArray
    speed_m_s: float
    touched: tuple[bool, ...]
    door_touched: bool = False


@dataclass(frozen=True, slots=True)
class SkillStart:
    """What was decided at the first step of a skill.

    Attributes:
        skill: its name.
        subgoal: what it has to reach, laid out as its task says; m, task frame; (n,).
        source: who gave the subgoal: the "scripted" plan, the "chaining" policy, or the "task",
            which gives the last skill's.
        value: probability, as seen then, that the whole task succeeds, or what else the bundle's
            manifest says of it; None when nothing tells it.
    """

    skill: str
    subgoal: FloatArray
    source: Literal["scripted", "chaining", "task"]
    value: float | None = None

    def __post_init__(self) -> None:
        subgoal = frozen_array(self.subgoal, np.shape(self.subgoal), "subgoal")
        object.__setattr__(self, "subgoal", subgoal)


@dataclass(frozen=True, slots=True)
class GraspTest:
    """One jaw that has to hold something when a skill has ended.

    Attributes:
        arm: name of the arm.
        angle_rad: how far the jaw is open, measured.
        empty_rad: how far it was open when it closed on nothing, measured before the run.
        limit_rad: how much farther than empty a jaw is kept open by what it holds, at least.
        is_closed: the jaw is told to close.
    """

    arm: str
    angle_rad: float
    empty_rad: float
    limit_rad: float
    is_closed: bool

    @property
    def holds(self) -> bool:
        """Whether something keeps the closed jaw open; False for a number that is none."""
        return self.is_closed and self.angle_rad - self.empty_rad > self.limit_rad


Course = Literal["go on", "retry", "safe pose"]
"""What the runtime does where one skill ends and the next one begins."""


@dataclass(frozen=True, slots=True)
class Boundary:
    """What was seen and decided where a skill has ended and the next one may begin.

    A jaw that loses its hold within a skill is told of in the same way: `after` and `before` are
    that skill then.

    Attributes:
        after: the skill that has ended; "" before the first one.
        before: the skill that may begin.
        grasps: the jaws that have to hold something there; () where none has.
        value: P(the whole task succeeds) as seen there; None where nothing tells it.
        threshold: value below which the runtime does not go on; None without a value.
        course: what is done.
        skill: the skill that runs next; "" when none does.
    """

    after: str
    before: str
    grasps: tuple[GraspTest, ...]
    value: float | None
    threshold: float | None
    course: Course
    skill: str

    @property
    def lost(self) -> tuple[GraspTest, ...]:
        """The jaws that do not hold what they should."""
        return tuple(grasp for grasp in self.grasps if not grasp.holds)

    @property
    def is_value_low(self) -> bool:
        """Whether success is less likely than the threshold asks for."""
        if self.value is None or self.threshold is None:
            return False
        return not self.value >= self.threshold


@dataclass(frozen=True, slots=True)
class Waypoint:
    """Where every arm's tip shall be at the end of one policy step.

    Attributes:
        T_task_tip: one 4x4 pose an arm, task frame, m.
        jaw: one opening angle an arm, rad.
        step_s: the time that the policy means it to take, s.
        skill: name of the skill that asked for it.
        may_open_jaw: whether that skill may open a jaw that holds something, per arm.
        observation: what the policy saw when it asked for this; empty where no policy did.
    """

    T_task_tip: tuple[FloatArray, ...]
    jaw: tuple[float, ...]
    step_s: float
    skill: str = ""
    may_open_jaw: tuple[bool, ...] = ()
    observation: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        poses = tuple(frozen_array(T, (4, 4), "T_task_tip") for T in self.T_task_tip)
        object.__setattr__(self, "T_task_tip", poses)
        if len(self.jaw) != len(poses):
            raise ValueError(f"{len(self.jaw)} jaw angles for {len(poses)} arms")
        if not all(map(math.isfinite, (*self.jaw, self.step_s))) or self.step_s <= 0:
            raise ValueError("jaw angles must be finite and step_s positive")
