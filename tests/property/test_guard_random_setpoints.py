"""Random setpoints of a client at the guard: safe ones pass bit for bit, unsafe ones never do.

Client, guard, driver and arms are in one process; the arms do at once what they are told.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scripted_arms import Room
from silent_recorder import SilentRecorder

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import PSM_JOINTS, Action, Mode
from viskill_deploy.drivers.crtk.doubts import STREAM_S
from viskill_deploy.drivers.crtk.driver import CrtkDriver, CrtkOptions
from viskill_deploy.drivers.crtk.inproc import Inproc
from viskill_deploy.drivers.crtk.messages import (
    Header,
    JointState,
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    StringStamped,
    Time,
)
from viskill_deploy.drivers.watch import OwnTime
from viskill_deploy.runtime.air import start_axes
from viskill_deploy.runtime.guard import Guard

CELL = load_cell("bipegtransfer")
ARMS = tuple(arm.name for arm in CELL.arms)
PERIOD_S = 0.005
GOING = (Mode.ARMED, Mode.RUNNING)
AXES = len(PSM_JOINTS) + 1
BAD = (nan, inf, -inf)

SWING = np.array([0.03, 0.03, 0.004, 0.4, 0.25, 0.25, 0.2])
"""rad or m from the start pose; the jaw only opens."""

SPEED = np.array([0.1, 0.1, 0.012, 1.0, 0.5, 0.5, 0.6])
"""rad/s or m/s: in sum no tip comes near 50 mm/s."""

WALK = 250
"""Cycles of one random motion, from rest to rest."""

Rows = npt.NDArray[np.float64]


@dataclass
class Bench:
    """Client, guard and robot."""

    room: Room = field(default_factory=Room)

    def __post_init__(self) -> None:
        self.start = start_axes(CELL, np.array(self.held()))
        self.place()
        self.driver = CrtkDriver(CELL, self.room.node, CrtkOptions(PERIOD_S), OwnTime)
        self.driver.clock = self.room.clock
        self.driver.connect()
        node, self.client = Inproc(self.room.exchange), Inproc(self.room.exchange)
        self.guard = Guard(CELL, self.driver, node, SilentRecorder())
        self.say = {
            f"{arm}/{name}": self.client.publisher(f"/guarded/{arm}/{name}", kind)
            for arm in ARMS
            for name, kind in (
                ("servo_jp", JointState),
                ("jaw/servo_jp", JointState),
                ("servo_cp", PoseStamped),
                ("state_command", StringStamped),
            )
        }

    def place(self) -> None:
        """Puts the arms into their start pose."""
        for arm, axes in zip(self.room.arms, self.start.tolist(), strict=True):
            arm.jp, arm.jaw = tuple(axes[:6]), axes[6]

    def held(self) -> list[list[float]]:
        """Where the arms are, jaws last, (arms, 7)."""
        return [[*arm.jp, arm.jaw] for arm in self.room.arms]

    def turn(self) -> None:
        """The guard looks, and a period passes."""
        clock = self.room.clock
        self.guard.turn(clock.now())
        clock.sleep_until(clock.now() + PERIOD_S)

    def wait(self, seconds: float) -> None:
        """Time passes, and nobody looks."""
        self.room.clock.sleep_until(self.room.clock.now() + seconds)

    def until(self, so: Callable[[], bool]) -> None:
        for _ in range(200):
            if so():
                return
            self.turn()
        raise AssertionError(f"the guard stays {self.guard.gate.mode}")

    def head(self) -> Header:
        return Header(Time.of_ns(self.client.stamp_ns()))

    def make_ready(self) -> None:
        for word in ("enable", "home"):
            for arm in ARMS:
                self.say[f"{arm}/state_command"](StringStamped(self.head(), word))
            self.turn()
        self.agree()

    def agree(self) -> None:
        """The operator lets go of the pedal, and presses it."""
        for button in (0, 1):
            self.room.present(button)
            self.turn()
            self.turn()  # one may come a rounding error before the guard's look
        self.until(lambda: self.guard.gate.mode in GOING)

    def clear(self) -> None:
        """A person clears what has stopped the arms, once they are at rest."""

        def is_clear() -> bool:
            self.guard.is_reset_wanted = True
            return self.guard.gate.latched is Action.PASS

        self.until(is_clear)
        if self.held() != self.start.tolist():
            self.wait(STREAM_S)
            self.place()
            self.wait(0.02)  # until they have said so
        self.agree()

    def ask(self, arm: int, q: Sequence[float], v: Sequence[float] = ()) -> None:
        """Joints (7,) of an arm, jaw last, with or without velocities."""
        name = ARMS[arm]
        joints = JointState(self.head(), PSM_JOINTS, tuple(q[:6]), tuple(v[:6]))
        jaw = JointState(self.head(), ("jaw",), tuple(q[6:]), tuple(v[6:]))
        self.say[f"{name}/servo_jp"](joints)
        self.say[f"{name}/jaw/servo_jp"](jaw)

    def sent(self) -> list[tuple[int, tuple[float, ...], tuple[float, ...]]]:
        """All that has reached the robot since the last call: arm, positions, velocities."""
        found = []
        for index, arm in enumerate(self.room.arms):
            for words in (arm.sent, arm.sent_jaw):
                found += [(index, tuple(w.position), tuple(w.velocity)) for w in words]
                words.clear()
        return found


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    made.make_ready()
    yield made
    made.guard.close()


def walk(rng: np.random.Generator, start: Rows) -> tuple[Rows, Rows]:
    """A random smooth motion of all axes, there and back: positions, velocities (n, arms, 7)."""
    t = PERIOD_S * np.arange(1, WALK + 1)
    x = np.minimum(np.minimum(t, t[-1] - t) / 0.4, 1.0)
    slope = np.where(x < 1.0, np.where(t < 0.5 * t[-1], 1.0, -1.0) / 0.4, 0.0)
    ease = x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)
    d_ease = 140.0 * x**3 * (1.0 - x) ** 3 * slope
    shape, most = (3, *start.shape), SPEED / SWING
    rate = rng.uniform(0.1, 1.0, shape) * most
    angle = rate * t[:, None, None, None] + rng.uniform(-np.pi, np.pi, shape)
    size = rng.uniform(0.0, 1.0, shape) * SWING / 3.0
    way, speed = (size * np.sin(angle)).sum(axis=1), (size * rate * np.cos(angle)).sum(axis=1)
    way[..., 6] += SWING[6]
    e, d = ease[:, None, None], d_ease[:, None, None]
    return start + e * way, e * speed + d * way


MANY = pytest.param(10_000, marks=pytest.mark.slow)


@pytest.mark.parametrize("count", [2_000, MANY])
def test_random_safe_setpoints_pass_bit_for_bit(bench: Bench, count: int) -> None:
    """Motions of both arms, with and without velocities.

    They come one by one: stamps are real here and periods are not, so of two at once, on a slow
    machine, one would seem to be lost on the way.
    """
    rng, passed = np.random.default_rng(0), 0
    bench.sent()
    for number in range(-(-count // (len(ARMS) * WALK))):
        rows, speeds = walk(rng, bench.start)
        has_speeds = number % 2 == 0
        asked = []
        for k in range(WALK):
            for arm in range(len(ARMS)):
                q, v = rows[k, arm].tolist(), speeds[k, arm].tolist()
                bench.ask(arm, q, v if has_speeds else ())
                asked += [
                    (arm, tuple(part), tuple(w)) for part, w in ((q[:6], v[:6]), (q[6:], v[6:]))
                ]
            bench.turn()
        got = bench.sent()
        assert len(got) == len(asked)
        if has_speeds:
            assert sorted(got) == sorted(asked)
        else:
            assert sorted(a[:2] for a in got) == sorted(a[:2] for a in asked)
        passed += len(ARMS) * WALK
    assert passed >= count
    assert (bench.guard.counts.stopped, bench.guard.counts.filled) == (0, 0)


def looks(bench: Bench, seconds: float) -> None:
    """Time passes, and the guard looks whenever it wants to."""
    clock = bench.room.clock
    end = clock.now() + seconds
    due = bench.guard.turn(clock.now())
    while due < end:
        clock.sleep_until(max(due, clock.now() + 1e-5))
        due = bench.guard.turn(clock.now())
    clock.sleep_until(end)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("drift", [-0.001, 0.0, 0.001])
def test_arms_of_programs_that_keep_no_step_are_moved_together(
    bench: Bench, seed: int, drift: float
) -> None:
    """Two programs, each with an arm and a clock of its own, which drifts against the other's."""
    rng = np.random.default_rng(seed)
    rows, speeds = walk(rng, bench.start)
    began, phase = bench.room.clock.now() + 0.001, float(rng.uniform(0.0, PERIOD_S))
    due = [(began + k * PERIOD_S, k, 0) for k in range(WALK)]
    due += [(began + phase + k * PERIOD_S * (1.0 + drift), k, 1) for k in range(WALK)]
    bench.sent()
    for at, k, arm in sorted(due):
        looks(bench, at - bench.room.clock.now())
        bench.ask(arm, rows[k, arm].tolist(), speeds[k, arm].tolist())
    looks(bench, 0.1)
    assert bench.guard.counts.stopped == 0
    got = {(arm, q) for arm, q, _ in bench.sent()}
    assert all((arm, tuple(rows[k, arm, :6])) in got for k in range(WALK) for arm in (0, 1))


@pytest.mark.parametrize(("times", "is_fine"), [(1.04, True), (1.1, False), (4.0, False)])
def test_a_client_that_is_faster_than_its_rate_is_stopped(
    bench: Bench, times: float, is_fine: bool
) -> None:
    """What is slow enough for its period is not, when it comes in a shorter one."""
    rows, _ = walk(np.random.default_rng(0), bench.start)
    for k in range(WALK):
        for arm in range(len(ARMS)):
            bench.ask(arm, rows[k, arm].tolist())
        looks(bench, PERIOD_S / times)
        if bench.guard.gate.mode not in GOING:
            break
    assert is_fine == (bench.guard.counts.stopped == 0)
    assert is_fine or k < (20 if times > 2.0 else 150)


@pytest.mark.parametrize("count", [500, MANY])
def test_random_unsafe_setpoints_are_every_one_stopped(bench: Bench, count: int) -> None:
    """Each at an armed gate, at rest or in mid-motion."""
    rng = np.random.default_rng(1)
    envelope = bench.guard.gate.envelope.arms[0]
    for number in range(count):
        q = bench.start.tolist()
        if number % 20 == 0:
            rows, speeds = walk(rng, bench.start)
            for k in range(int(rng.integers(20, 100))):
                for arm in range(len(ARMS)):
                    bench.ask(arm, rows[k, arm].tolist(), speeds[k, arm].tolist())
                bench.turn()
            q = rows[k + 1].tolist()
        assert bench.guard.gate.mode in GOING, number
        stopped, arm = bench.guard.counts.stopped, int(rng.integers(len(ARMS)))
        bench.sent()
        unsafe = ask_for_something_unsafe(bench, rng, envelope, arm, q)
        bench.turn()
        bench.turn()
        bench.guard.turn(bench.room.clock.now())  # what came alone is judged by now
        assert bench.guard.counts.stopped == stopped + 1, (number, unsafe)
        assert bench.guard.gate.mode not in GOING
        bench.clear()
        for index, position, velocity in bench.sent():
            assert np.isfinite([*position, *velocity]).all()
            assert (index, position, velocity) != unsafe


def ask_for_something_unsafe(
    bench: Bench, rng: np.random.Generator, envelope: Any, arm: int, q: list[list[float]]
) -> tuple[int, tuple[float, ...], tuple[float, ...]]:
    """One random axis of one arm: no number, a leap, a speed that is too high, or no pose."""
    axis, sign = int(rng.integers(AXES)), float(rng.choice([-1.0, 1.0]))
    wish, speed = list(q[arm]), [0.0] * AXES
    far = float(10.0 ** rng.uniform(0.5, 6.0))
    match int(rng.integers(5)):
        case 0:
            wish[axis] = float(rng.choice(BAD))
        case 1:
            speed[axis] = float(rng.choice(BAD))
        case 2:
            wish[axis] += sign * far * envelope.max_jerk[axis] * PERIOD_S**3
        case 3:
            speed[axis] = sign * far * envelope.max_speed[axis]
        case _:
            point = Point(*[float(x) for x in rng.choice([*BAD, far, -far], 3)])
            turned = Quaternion(*rng.normal(size=4).tolist())
            bench.say[f"{ARMS[arm]}/servo_cp"](PoseStamped(bench.head(), Pose(point, turned)))
            return (arm, (), ())
    bench.ask(arm, wish, speed)
    part = slice(6, 7) if axis == 6 else slice(0, 6)
    return (arm, tuple(wish[part]), tuple(speed[part]))
