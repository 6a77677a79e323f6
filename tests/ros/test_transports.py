"""Every transport between two processes, over the real middleware and nothing but the loopback."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import crtk_samples
import pytest
from crtk_domain import DOMAIN
from crtk_peer import LATCHED, peer, strays

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.cdr import encoder
from viskill_deploy.drivers.crtk.messages import Bool, Header, JointState, String, Time
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.drivers.crtk.transport import Transport

DISCOVERY_S = 30.0

TRANSPORTS = (
    "dds",
    pytest.param("ros1", marks=pytest.mark.ros1),
    pytest.param("ros2", marks=pytest.mark.ros2),
)
pytestmark = pytest.mark.parametrize("name", TRANSPORTS)


@pytest.fixture
def node(name: str, request: pytest.FixtureRequest) -> Iterator[Transport]:
    """A node of this process."""
    if name == "ros1":
        request.getfixturevalue("ros_master")
    node = open_transport(name, Network(DOMAIN, LOOPBACK))
    yield node
    assert strays() == []
    node.close()


class Ear:
    """Hears, and can be waited for."""

    def __init__(self) -> None:
        self.words: list[Any] = []
        self.times: list[float] = []
        self._news = threading.Condition()

    def __call__(self, word: Any, received_s: float) -> None:
        with self._news:
            self.words.append(word)
            self.times.append(received_s)
            self._news.notify_all()

    def wait_for(self, count: int, seconds: float = DISCOVERY_S) -> list[Any]:
        """All that was heard, at least so many."""
        with self._news:
            assert self._news.wait_for(lambda: len(self.words) >= count, seconds), self.words
            return list(self.words)


def wait_until(holds: Callable[[], bool], seconds: float = DISCOVERY_S) -> None:
    """Waits for what the network decides when to do."""
    last = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < last
        time.sleep(0.01)


def test_every_message_comes_back_bit_for_bit(node: Transport, name: str) -> None:
    with peer(name, "echo", DOMAIN):
        there_and_back(node)


def there_and_back(node: Transport) -> None:
    """Sends every message to a peer that echoes, and compares what comes back."""
    for topic in crtk_samples.TOPICS:
        there = node.publisher(f"/there/{topic.name}", topic.message)
        ear, bits = Ear(), encoder(topic.message)
        node.subscribe(f"/back/{topic.name}", topic.message, ear)
        sent = [crtk_samples.sample(topic.message, seed) for seed in range(5)]
        knock(lambda there=there, sent=sent: there(sent[0]), ear)
        for word in sent[1:]:
            before = len(ear.words)
            there(word)
            ear.wait_for(before + 1)
        heard = ear.words[-len(sent) :]
        assert [bits(word) for word in heard] == [bits(word) for word in sent]


def knock(say: Callable[[], None], ear: Ear) -> None:
    """Says it until it is heard: a node can know of another that does not know of it yet."""
    while not ear.words:
        say()
        time.sleep(0.1)
    while ear.times[-1] > time.monotonic() - 0.3:
        time.sleep(0.1)  # what was said too often has come too


def test_who_comes_late_hears_the_last_of_what_is_latched(node: Transport, name: str) -> None:
    with peer(name, "latch", DOMAIN):
        ear = Ear()
        node.subscribe("/PSM1/status", String, ear, is_latched=True)
        wait_until(lambda: bool(ear.words) and ear.words[-1] == String(LATCHED[-1]))


def test_words_in_quick_succession_are_all_heard_when_they_are_latched(
    node: Transport, name: str
) -> None:
    other = open_transport(name, Network(DOMAIN, LOOPBACK))
    publish, ear = node.publisher("/PSM1/warning", String, is_latched=True), Ear()
    other.subscribe("/PSM1/warning", String, ear, is_latched=True)
    wait_until(lambda: node.peers("/PSM1/warning") == 1)
    for number in range(50):
        publish(String(str(number)))
    assert [word.data for word in ear.wait_for(50)] == [str(number) for number in range(50)]
    other.close()


def test_what_comes_to_a_busy_ear_waits_as_far_as_it_is_kept(node: Transport, name: str) -> None:
    other = open_transport(name, Network(DOMAIN, LOOPBACK))
    publish, go, heard = node.publisher("/PSM1/servo_jp", JointState), threading.Event(), []

    def busy(word: JointState, received_s: float) -> None:
        heard.append(word.position)
        go.wait(DISCOVERY_S)

    other.subscribe("/PSM1/servo_jp", JointState, busy, kept=8)
    wait_until(lambda: node.peers("/PSM1/servo_jp") == 1)
    words = [(float(number),) for number in range(6)]
    publish(JointState(position=words[0]))
    wait_until(lambda: len(heard) == 1)
    for position in words[1:]:
        publish(JointState(position=position))
        time.sleep(0.02)
    assert len(heard) == 1
    go.set()
    wait_until(lambda: len(heard) == len(words))
    assert heard == words
    other.close()


def test_peers_counts_who_is_there_and_forgets_who_has_left(node: Transport, name: str) -> None:
    topic = crtk_samples.TOPICS[0]
    there = f"/there/{topic.name}"
    node.publisher(there, topic.message)
    assert node.peers(there) == 0
    assert node.peers("/never/opened") == 0
    with peer(name, "echo", DOMAIN):
        wait_until(lambda: node.peers(there) == 1)
    wait_until(lambda: node.peers(there) == 0)


@pytest.mark.parametrize("is_latched", [False, True])
def test_a_listener_that_hangs_holds_nobody_up(
    node: Transport, name: str, is_latched: bool
) -> None:
    topic = crtk_samples.TOPICS[1]
    word = crtk_samples.sample(topic.message, 1)
    publish = node.publisher(f"/there/{topic.name}", topic.message, is_latched)
    with peer(name, "echo", DOMAIN) as (process, _):
        wait_until(lambda: node.peers(f"/there/{topic.name}") == 1)
        process.send_signal(signal.SIGSTOP)
        before = time.monotonic()
        for _ in range(500):
            publish(word)
        assert time.monotonic() - before < 5.0
        process.send_signal(signal.SIGCONT)


def test_the_time_of_arrival_is_the_monotonic_clock(node: Transport, name: str) -> None:
    other = open_transport(name, Network(DOMAIN, LOOPBACK))
    publish, ear = node.publisher("/PSM1/measured_js", JointState), Ear()
    other.subscribe("/PSM1/measured_js", JointState, ear)
    wait_until(lambda: node.peers("/PSM1/measured_js") == 1)
    before = time.monotonic()
    publish(JointState(Header(Time.of_ns(node.stamp_ns()))))
    ear.wait_for(1)
    assert before <= ear.times[0] <= time.monotonic()
    assert abs(node.stamp_ns() - time.time_ns()) < 10**9
    other.close()


def test_an_ear_that_raises_does_not_deafen_the_others(node: Transport, name: str) -> None:
    def raising(word: Bool, received_s: float) -> None:
        raise RuntimeError(word, received_s)

    other = open_transport(name, Network(DOMAIN, LOOPBACK))
    publish, ear = node.publisher("/PSM1/goal_reached", Bool, is_latched=True), Ear()
    other.subscribe("/PSM1/goal_reached", Bool, raising, is_latched=True)
    other.subscribe("/PSM1/goal_reached", Bool, ear, is_latched=True)
    publish(Bool(True))
    ear.wait_for(1)
    publish(Bool(False))
    assert ear.wait_for(2) == [Bool(True), Bool(False)]
    other.close()


def test_a_topic_carries_one_kind_of_message(node: Transport) -> None:
    publish = node.publisher("/PSM1/error", String)
    with pytest.raises(DriverError, match="/PSM1/error carries String"):
        publish(Bool())  # type: ignore[arg-type]
    with pytest.raises(DriverError, match="/PSM1/error carries String"):
        node.subscribe("/PSM1/error", Bool, Ear())


def test_nothing_goes_through_a_closed_node(node: Transport) -> None:
    publish = node.publisher("/PSM1/error", String)
    node.close()
    node.close()
    assert node.peers("/PSM1/error") == 0
    with pytest.raises(DriverError, match="closed"):
        publish(String())
    with pytest.raises(DriverError, match="closed"):
        node.publisher("/PSM1/warning", String)
    with pytest.raises(DriverError, match="closed"):
        node.subscribe("/PSM1/warning", String, Ear())
