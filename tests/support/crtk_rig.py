"""A simulated dVRK and a plain CRTK client, in one process, on a clock that is stepped."""

from __future__ import annotations

from typing import Any

from viskill_deploy.core.clock import SteppedClock
from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.crtk.inproc import Exchange, Inproc
from viskill_deploy.drivers.crtk.messages import (
    Empty,
    Header,
    JointState,
    OperatingState,
    Pose,
    PoseStamped,
    StringStamped,
    Time,
)
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated_cell import CrtkCell
from viskill_deploy.drivers.crtk.topics import ARM, CONSOLE, named
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.sim.world import World, WorldOptions

PERIOD_S = 0.004


class Client:
    """A client of one arm that hears everything and remembers it.

    Attributes:
        state: the newest operating state, also after `forget`.
    """

    state: OperatingState

    def __init__(self, exchange: Exchange, arm: str = "PSM1", version: Any = "2.4") -> None:
        self.node, self.heard = Inproc(exchange), list[tuple[str, Any]]()
        self._arm, self._out = arm, {}
        for topic in ARM:
            name = f"/{arm}/{named(topic, version)}"
            if topic.publisher == "client":
                self._out[topic.name] = self.node.publisher(name, topic.message)
            else:
                self._listen(topic.name, name, topic.message)

    def _listen(self, key: str, name: str, message: type) -> None:
        def hear(word: Any, received_s: float) -> None:
            del received_s
            self.heard.append((key, word))
            if key == "operating_state":
                self.state = word

        self.node.subscribe(name, message, hear, True)

    def send(self, topic: str, message: Any) -> None:
        """Publishes a command."""
        self._out[topic](message)

    def joints(self, topic: str, *position: float, v: tuple[float, ...] = ()) -> None:
        """Publishes a JointState."""
        self.send(topic, JointState(position=position, velocity=v))

    def pose(self, topic: str, pose: Pose) -> None:
        """Publishes a PoseStamped."""
        self.send(topic, PoseStamped(pose=pose))

    def empty(self, topic: str) -> None:
        """Publishes an Empty."""
        self.send(topic, Empty())

    def command(self, word: str, age_s: float = 0.0, stamped: bool = True) -> None:
        """Publishes a state command that was stamped `age_s` ago."""
        stamp = Time.of_ns(self.node.stamp_ns() - round(age_s * 1e9)) if stamped else Time()
        self.send("state_command", StringStamped(Header(stamp), word))

    def all(self, topic: str) -> list[Any]:
        """What was heard on a topic since `forget`."""
        return [message for key, message in self.heard if key == topic]

    def last(self, topic: str) -> Any:
        """The newest message of a topic."""
        return self.all(topic)[-1]

    def texts(self, kind: str) -> list[str]:
        """Errors, warnings or statuses."""
        return [message.data for message in self.all(kind)]

    def forget(self) -> None:
        """Begins to listen afresh."""
        self.heard.clear()

    @property
    def summary(self) -> tuple[str, bool, bool]:
        """State, is_homed, is_busy."""
        return self.state.state, self.state.is_homed, self.state.is_busy


class Rig:
    """The simulated arms of BiPegTransfer with a client of PSM1."""

    def __init__(
        self,
        options: ServerOptions | None = None,
        world: WorldOptions | None = None,
        exchange: Exchange | None = None,
    ) -> None:
        self.clock = exchange.clock if exchange else SteppedClock()
        self.exchange = exchange or Exchange(self.clock)
        self.options = options or ServerOptions(homing="stay")
        self.cell = LoopbackCell(World(load_cell("bipegtransfer"), world))
        self.cell.reset(self.cell.scene(0.0))
        self.told: list[tuple[str, Any]] = []
        self.server = CrtkCell(
            self.cell,
            Inproc(self.exchange),
            self.options,
            lambda arm, event: self.told.append((arm, event)),
        )
        self.client = Client(self.exchange, version=self.options.version)
        self.run(0.2)

    def run(self, duration_s: float) -> None:
        """Lets time pass."""
        for _ in range(round(duration_s / PERIOD_S)):
            self.clock.advance(PERIOD_S)
            self.server.advance(self.clock.now())

    def until_idle(self, client: Client | None = None, limit_s: float = 10.0) -> float:
        """Lets time pass until the arm is not busy; returns how long that took."""
        client, start = client or self.client, self.clock.now()
        self.run(PERIOD_S)
        while client.state.is_busy:
            assert self.clock.now() - start < limit_s, "the arm stays busy"
            self.run(PERIOD_S)
        return self.clock.now() - start

    def make_ready(self, client: Client | None = None) -> None:
        """Enables and homes an arm."""
        client = client or self.client
        for word in ("enable", "home"):
            client.command(word)
            self.until_idle(client)
        assert client.summary == ("ENABLED", True, False)

    def measured(self, arm: int = 0) -> tuple[float, ...]:
        """Where the joints of an arm really are, (7,), jaw last."""
        reading = self.cell.world.measured(arm)
        return (*reading.jp, reading.jaw)


TOPICS = {topic.name: topic for topic in (*ARM, *CONSOLE)}
