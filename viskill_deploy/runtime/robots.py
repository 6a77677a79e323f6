"""The robots that a bundle is executed on, by driver. Each is imported when it is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.scene_files import SeenScene
from viskill_deploy.drivers.base import Driver
from viskill_deploy.drivers.crtk.driver import CONSOLE, CrtkOptions
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.runtime.driving import simulated_driver, with_inputs
from viskill_deploy.runtime.poses import FILED, FiledPoses, PoseLimits, PoseSource, Things, sigma_of
from viskill_deploy.runtime.recovering import Recoverable
from viskill_deploy.runtime.topic_poses import TopicPoses
from viskill_deploy.sim.world import WorldOptions

RobotName = Literal["loopback", "can", "crtk"]

FIND_S, LOOK_S = 5.0, 0.02
"""Discovery over ROS 2 takes up to a few seconds."""

NAME = "{object}"
"""Stands for the name of a thing in a template of topics."""


@dataclass(frozen=True)
class RobotOptions:
    """Which robot, and the way to it.

    Attributes:
        name: what it is reached by; "loopback" is the simulated cell.
        real_time: the simulated cell runs as a process of its own, against the clock.
        can: name of the CAN file; "" for the cell's.
        seed: of the simulated cell.
        inputs: node whose consent and emergency stop count, such as "can:pedal".
        transport: what carries CRTK.
        network: where the robot of CRTK, or the tracker, is.
        console: name of the console of CRTK whose operator agrees to motion.
        world: what is not perfect about the simulated cell.
    """

    name: RobotName = "loopback"
    real_time: bool = False
    can: str = ""
    seed: int = 0
    inputs: str = ""
    transport: str = "auto"
    network: Network = field(default_factory=Network)
    console: str = CONSOLE
    world: WorldOptions = field(default_factory=WorldOptions)


@dataclass
class Robot:
    """A connected robot.

    Attributes:
        driver: the driver, with the inputs that were asked for.
        node: its node on the network of topics; None where the driver has none.
        is_lent: the driver closes that node.
        arms: who clears a fault of its arms; None where switching on does so.
    """

    driver: Driver
    node: Transport | None = None
    is_lent: bool = False
    arms: Recoverable | None = None

    def close(self) -> None:
        """Holds, disables and closes everything; may be called twice."""
        self.driver.close()
        if self.node is not None and not self.is_lent:
            self.node.close()


def connected(cell: CellDescription, options: RobotOptions) -> Robot:
    """A connected robot; nothing was sent to its arms.

    Raises:
        DriverError: it cannot be connected.
        DataFileError: a file of it is wrong.
        MissingExtraError: it needs a package that is not installed.
    """
    robot = _connected(cell, options)
    robot.driver = with_inputs(robot.driver, options.inputs)
    return robot


def _connected(cell: CellDescription, options: RobotOptions) -> Robot:
    if options.name == "can":
        from viskill_deploy.drivers.can import driver as can  # noqa: PLC0415 - optional
        from viskill_deploy.drivers.can.config import load_can  # noqa: PLC0415 - optional

        return Robot(can.connect(cell, load_can(options.can or cell.name, cell)))
    if options.name == "crtk":
        return _over_crtk(cell, options)
    world, seed = options.world, options.seed
    return Robot(simulated_driver("loopback", cell, world, seed, options.real_time))


def _over_crtk(cell: CellDescription, options: RobotOptions) -> Robot:
    from viskill_deploy.drivers.crtk import robot as crtk  # noqa: PLC0415 - optional

    drive = CrtkOptions(console=options.console)
    driver = crtk.connect(cell, options.transport, options.network, drive)
    return Robot(driver, driver.node, is_lent=True, arms=driver)


def things_of(
    robot: Robot,
    options: RobotOptions,
    seen: SeenScene | None,
    topic: str,
    limits: PoseLimits,
    arms: Sequence[str],
) -> Things | None:
    """Who knows where the things are: a tracker, the scene file alone, or (None) the driver.

    Args:
        robot: connected; opens a node of its own for a tracker where it has none.
        options: how it was connected.
        seen: the scene file, if there is one: which things there are and how well they are known.
        topic: template of the tracker's topics, such as "/scene/{object}/measured_cp"; "" for none.
        limits: what a sighting of the tracker is good for.
        arms: names of the arms.

    Raises:
        DataFileError: a tracker without a scene file, or a topic without a place for the name.
        DriverError, MissingExtraError: there is no way to its topics.
    """
    if not topic and seen is None:
        return None
    if not topic and seen is not None:
        return Things(seen.scene, FiledPoses(seen), FILED, arms)
    if seen is None or NAME not in topic:
        raise DataFileError(
            "--pose-topic",
            "",
            f"{topic!r} needs {NAME} where the name of a thing stands, and a scene file that says "
            "which things there are and which to move where: name it with --scene",
        )
    if robot.node is None:
        robot.node = open_transport(options.transport, options.network)
    names = [thing.name for thing in seen.scene.objects]
    topics = {name: topic.replace(NAME, name) for name in names}
    sigma_m = {name: sigma_of(seen, name) for name in names}
    poses = TopicPoses(robot.node, topics, sigma_m)
    await_poses(poses, names)
    return Things(seen.scene, poses, limits, arms)


def await_poses(poses: PoseSource, names: Sequence[str]) -> None:
    """Gives a tracker the time that it takes to be found."""
    clock = MonotonicClock()
    deadline = clock.now() + FIND_S
    while clock.now() < deadline and any(poses.newest(name) is None for name in names):
        clock.sleep_until(clock.now() + LOOK_S)
