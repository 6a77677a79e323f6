"""The watch that the watchdog's process stands, with a robot that notes what it is told."""

import os
from collections.abc import Callable, Iterator

import pytest

from viskill_deploy.core.clock import SteppedClock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import Inputs
from viskill_deploy.drivers.watch import LAST_WORDS_S, LOOK_S, OwnTime, WatchProcess, stand_watch
from viskill_deploy.safety.watchdog import DISABLE_S, LOST_S, RELEASED, Heartbeat

pytestmark = pytest.mark.invariant("S25", "S26")


class LookClock(SteppedClock):
    """A clock that goes on by one look each time it is read; `acts` are done at their time."""

    def __init__(self) -> None:
        super().__init__(start_s=100.0)
        self.acts: list[tuple[float, Callable[[], None]]] = []
        self.at_every_look: Callable[[float], None] = lambda now: None

    def now(self) -> float:
        self.advance(LOOK_S)
        now = super().now()
        while self.acts and self.acts[0][0] <= now:
            self.acts.pop(0)[1]()
        self.at_every_look(now)
        return now

    def read(self) -> float:
        return super().now()


class Robot:
    """Notes what the watchdog tells it, and when."""

    def __init__(self, clock: LookClock) -> None:
        self.clock, self.told = clock, list[tuple[str, float]]()
        self.is_gone = False

    def hold(self) -> None:
        self._note("hold")

    def disable(self) -> None:
        self._note("disable")

    def check(self) -> None:
        self._note("check")

    def first(self, word: str) -> float:
        return next(at for what, at in self.told if what == word)

    def _note(self, word: str) -> None:
        if self.is_gone:
            raise DriverError("gone")
        self.told.append((word, self.clock.read()))


class Post:
    """A watchdog's place: a page, a pipe to the runtime, a robot and a clock."""

    def __init__(self) -> None:
        page = os.memfd_create("test")
        os.ftruncate(page, Heartbeat.SIZE)
        self.heartbeat = Heartbeat(page)
        os.close(page)
        self.reader, self.writer = os.pipe()
        self.clock = LookClock()
        self.robot = Robot(self.clock)

    def dies(self) -> None:
        """The runtime's end of the pipe goes, as when it is killed."""
        os.close(self.writer)
        self.writer = -1

    def watch(self) -> None:
        stand_watch(self.heartbeat, self.robot, self.reader, self.clock)

    def close(self) -> None:
        self.heartbeat.close()
        os.close(self.reader)
        if self.writer >= 0:
            os.close(self.writer)


@pytest.fixture
def post() -> Iterator[Post]:
    made = Post()
    yield made
    made.close()


def test_a_runtime_that_dies_is_held_at_the_next_look_then_disabled_and_the_watch_ends(post):
    post.clock.acts = [(100.1, post.dies)]
    post.watch()
    assert post.robot.first("hold") == pytest.approx(100.1, abs=2.1 * LOOK_S)
    assert post.robot.first("disable") - post.robot.first("hold") == pytest.approx(
        DISABLE_S - LOST_S, abs=2.1 * LOOK_S
    )
    assert post.heartbeat.has_stepped_in
    said = [at for word, at in post.robot.told if word == "disable"]
    assert len(said) > 10, "one could get lost"
    assert said[-1] - said[0] == pytest.approx(LAST_WORDS_S, abs=3 * LOOK_S)


def test_a_runtime_that_hangs_is_held_after_50_ms_and_disabled_after_500(post):
    post.heartbeat.beat_s = 100.0
    post.clock.acts = [(100.7, post.dies)]  # it ends at last
    post.watch()
    assert post.robot.first("hold") == pytest.approx(100.0 + LOST_S, abs=1.1 * LOOK_S)
    assert post.robot.first("disable") == pytest.approx(100.0 + DISABLE_S, abs=2.1 * LOOK_S)


def test_a_runtime_that_comes_back_is_disabled_all_the_same(post):
    post.heartbeat.beat_s = 100.0

    def comes_back() -> None:
        post.clock.at_every_look = lambda now: setattr(post.heartbeat, "beat_s", now)

    post.clock.acts = [(100.1, comes_back), (100.7, post.dies)]
    post.watch()
    words = [word for word, _ in post.robot.told]
    assert "check" not in words[words.index("hold") :]
    assert post.robot.first("disable") == pytest.approx(100.0 + DISABLE_S, abs=2.1 * LOOK_S)


def test_a_beating_runtime_is_left_alone_and_the_watchdog_says_that_it_looks(post):
    ages: list[float] = []

    def beats(now: float) -> None:
        ages.append(now - post.heartbeat.watched_s)
        post.heartbeat.beat_s = now - 0.004

    post.clock.at_every_look = beats
    post.clock.acts = [(101.0, post.dies)]
    post.watch()
    assert max(ages[2:240]) <= LOOK_S + 1e-9
    assert post.robot.first("hold") > 101.0
    assert not [at for word, at in post.robot.told if word == "disable" and at < 101.4]


def test_a_runtime_at_rest_may_be_silent(post):
    post.heartbeat.beat_s = RELEASED
    post.clock.acts = [(101.0, post.dies)]
    post.watch()
    assert post.robot.first("hold") > 101.0


@pytest.mark.parametrize("beat", [RELEASED, 100.0])
def test_a_watchdog_that_cannot_reach_the_robot_ends_so_that_the_gate_notices(post, beat):
    post.heartbeat.beat_s = beat
    post.clock.acts = [(100.08, lambda: setattr(post.robot, "is_gone", True))]
    with pytest.raises(DriverError):
        post.watch()
    assert post.heartbeat.watched_s == pytest.approx(100.08, abs=LOOK_S)


def test_a_watchdog_that_does_not_start_is_an_error():
    with pytest.raises(DriverError, match="does not watch"):
        WatchProcess("viskill_deploy.no_such_watchdog", [])


def test_a_cell_that_stands_still_without_this_process_is_always_watched():
    watch, inputs = OwnTime(), Inputs(True, 1.0, "simulated", False)
    watch.beat(1.0)
    watch.release()
    told = watch.told(inputs, 5.0)
    watch.close()
    assert (told.watchdog_stamp_s, told.watchdog_stepped_in) == (5.0, False)
    assert (told.consent, told.consent_source, told.estop) == (True, "simulated", False)
