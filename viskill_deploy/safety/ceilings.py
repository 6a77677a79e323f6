"""The loosest values that any file may ask for. Code, not data: no file, flag or option lifts them.

A robot or cell file may be stricter; a looser value is refused when the cell is loaded.
Order of joints: yaw, pitch, insertion, roll, wrist_pitch, wrist_yaw, jaw.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from viskill_deploy.core.errors import DataFileError

MAX_SPEED: Final = (1.57, 1.57, 0.2, 18.8, 18.8, 18.8, 6.0)
"""rad/s, m/s. What dVRK plans its own move_jp with; the jaw's is that of the tasks' jaw ramp."""

MAX_ACCELERATION: Final = (7.85, 7.85, 1.0, 63.0, 63.0, 63.0, 63.0)
"""rad/s^2, m/s^2. Five times dVRK's move_jp, whose 1.57 / 0.2 / 12.6 do not bound its servo_jp."""

MAX_JERK: Final = (157.0, 157.0, 20.0, 1260.0, 1260.0, 1260.0, 1260.0)
"""rad/s^3, m/s^3. Acceleration reached in no less than 50 ms."""

CLASSIC_RANGE: Final = ((-1.588, 1.588), (-0.925025, 0.925025), (0.0, 0.24))
"""rad, rad, m. Soft limits of the first three joints in dVRK's file of the Classic arm."""

SI_RANGE: Final = ((-2.964, 2.964), (-1.265, 1.301), (0.0, 0.29))
"""rad, rad, m. The same for the Si arm."""

OWN_RANGE: Final = (2.0 * math.pi, 1.0)
"""rad, m, either way, of an arm of a lab's own; its file has the true range."""

OWN_RATES: Final = ((1.57, 0.2), (7.85, 1.0), (157.0, 20.0))
"""Speed, acceleration and jerk of its joints, rad and m, s: those of a PSM's first three."""

OWN_FIRST_COMMAND: Final = (0.001, 0.001)
"""rad, m. Its joints are up to a metre from the tip."""

OWN_TRACKING: Final = (0.006, 0.003, 0.006)
"""rad, m, rad for its last three joints: 6 mm at the tip of an arm that is a metre long."""

OWN_PORT_M: Final = 2.0
"""Farthest port from its base on each axis."""

OWN_TIP_M: Final = 0.7
"""Farthest tip from its flange on each axis, and the longest shaft: the longest instruments of
laparoscopy are 0.45 m."""

SI_SHAFT_OFFSET_M: Final = -0.4826
"""Insertion offset by which an Si arm is known; any other arm has to fit the Classic range."""

TOOL_RANGE: Final = ((-4.54, 4.54), (-1.5708, 1.5708), (-1.5708, 1.5708), (-0.7, 1.3963))
"""rad: roll 260 deg, wrist 90 deg, jaw -40..80 deg. The widest of all instrument definitions."""

MEASURED_SLACK: Final = 0.0087
"""rad or m beyond a hard limit (half a degree), as ros2_control tolerates."""

FIRST_COMMAND: Final = (0.02, 0.001)
"""rad, m. A first setpoint farther from the driver's own would be felt as a jerk at start."""

MIN_POSITION_MARGIN: Final = (0.01, 0.001)
"""rad, m. A stop from a crawl fits into it."""

MIN_PAST_RCM_M: Final = 0.047
"""dVRK refuses Cartesian motion with the wrist under 45 mm past the remote centre; 2 mm more."""

MAX_FEEDBACK_PERIOD_S: Final = 0.02
"""Feedback slower than 50 Hz would let ten missed samples pass for 200 ms."""

TRACKING: Final = (0.05, 0.003, 0.1)
"""rad for yaw and pitch, m, rad for roll and wrist. About 8, 3 and 1 mm at the tip."""

TRACKING_S: Final = 0.05
"""A bump against a block is over sooner; at the run's speed a tip is 2.5 mm farther by then."""

SINGULAR_VALUE_M: Final = (0.025, 0.015)
"""Smallest singular value of the Jacobian (m, rad) that slows, and that holds: its inverse is what
a joint turns for a metre of the tip. The tasks' own scripted motions stay above 0.031."""

IK_RESIDUAL_M: Final = 0.001
"""Between where a tip is meant to be and where its setpoint brings it."""

CONSENT_S: Final = (0.2, 2.0)
"""Silence of an operator that holds, and that ends the run. A person lets go of a pedal within
200 ms of being startled; a word that is older says nothing about now."""

TIP_SPEED_M_S: Final = 0.05
"""Speed of the control point in a run: the tasks' own scripted motions stay under it."""

TIP_SPEED_CEILING_M_S: Final = 0.25
"""ISO 10218-1, reduced speed in manual mode."""

MIN_FLOOR_M: Final = -0.002
"""Deepest floor of any task: a letter's grasp lies 2 mm under the table's top."""

MAX_WORKSPACE_SIDE_M: Final = 0.3
"""No side of the workspace is longer than an instrument's insertion range."""

MAX_FINGER_M: Final = 0.05
"""The longest jaw of any instrument is shorter."""

MIN_RADIUS_M: Final = (0.0042, 0.0025, 0.0017)
"""Shaft, wrist and closed jaw of an 8 mm instrument; a thinner one would be let nearer."""

MAX_RADIUS_M: Final = 0.01
"""No instrument goes through a port that is wider."""

PORT: Final = (0.001, 0.002)
"""m off the shaft's axis that are warned of and that end a run."""

MAX_PORT_OFFSET_M: Final = 0.01
"""A port registered farther from the arm's remote centre is a wrong registration."""

MAY_TOUCH: Final = frozenset(
    {"shaft_jaw", "wrist_jaw", "jaw_jaw", "jaw_peg", "jaw_plate", "jaw_door"}
    | {"wrist_peg", "wrist_door"}
)
"""Jaws work on all there is; a wrist goes between pegs and pushes doors."""

LEAST_APART: Final = {
    "shaft_shaft": (0.004, 0.002),
    "shaft_wrist": (0.002, 0.001),
    "wrist_wrist": (0.0001, 0.00005),
    "shaft_peg": (0.003, 0.0015),
    "shaft_plate": (0.004, 0.002),
    "wrist_plate": (0.002, 0.001),
    "shaft_door": (0.004, 0.002),
    "shaft_keep_out": (0.004, 0.002),
    "wrist_keep_out": (0.004, 0.002),
    "jaw_keep_out": (0.004, 0.002),
}
"""m, slow and stop, of any task: what tracking and calibration leave of a distance. Wrists that
hand over a block stand beside each other."""

MAX_SPARE_M: Final = 0.012
"""Longest end of a shaft that is not held against the other's wrist: where they hand over."""

MAX_APART_M: Final = 0.05
"""A larger distance would leave no room to work; it was meant in another unit."""

PERIOD_S: Final = (0.001, 0.01)
"""1 kHz to 100 Hz: what the smoothing and this gate's differences were tested with."""

MAX_CALIBRATION_AGE_S: Final = 30 * 86400.0
"""30 days: cables stretch and set-up joints are moved."""

MAX_CALIBRATION_RESIDUAL_M: Final = 0.0015
"""Root mean square: 1.9 mm is published for a Classic arm with calibrated joint offsets, 0.65 to
1.3 mm with its cables modelled too, and the tasks tolerate 5 mm in all."""


def check(path: Path, key: str, value: float, low: float, high: float) -> None:
    """Refuses a value outside its bounds, and NaN.

    Raises:
        DataFileError: names file, key, value and bounds.
    """
    if not (low <= value <= high and math.isfinite(value)):
        raise DataFileError(
            path,
            key,
            f"{value!r} is outside [{low:.6g}, {high:.6g}], the widest that the gate accepts; "
            "a file may only be stricter",
        )
