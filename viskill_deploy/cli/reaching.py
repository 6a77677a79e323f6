"""The options that say how a robot is reached; all commands that reach one have the same."""

from __future__ import annotations

import enum
from typing import Annotated

import typer

from viskill_deploy.runtime.robots import RobotName


class RobotChoice(enum.Enum):
    """What the robot is reached by."""

    LOOPBACK = "loopback"
    CAN = "can"
    CRTK = "crtk"

    value: RobotName


class TransportChoice(enum.StrEnum):
    """What carries CRTK."""

    AUTO = "auto"
    ROS1 = "ros1"
    ROS2 = "ros2"
    DDS = "dds"


Reached = Annotated[
    RobotChoice, typer.Option(help="What the robot is reached by; loopback: simulated.")
]
Carrier = Annotated[
    TransportChoice, typer.Option(help="What carries CRTK, and what a tracker sees.")
]
Domain = Annotated[
    int | None,
    typer.Option(min=0, max=232, help="ROS 2 domain of the robot; by default ROS_DOMAIN_ID, or 0."),
]
Interface = Annotated[
    str,
    typer.Option(
        help="Address of this machine on the robot's network, if it needs one; 127.0.0.1 for a "
        "robot of viskill serve crtk."
    ),
]
Pedal = Annotated[
    str,
    typer.Option(
        "--console", help="Console of CRTK whose pedal counts: /NAME/operator_present is heard."
    ),
]
CanFile = Annotated[
    str, typer.Option(help="CAN file, by name or path; that of the cell's name by default.")
]
Yes = Annotated[
    bool,
    typer.Option(
        "--yes",
        help="Do not ask for the name: switch on and home at once. The pedal is still needed.",
    ),
]
