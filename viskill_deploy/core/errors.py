"""Every error that the project raises on purpose.

ViskillError
├── DataFileError         a robot, tool, cell or scene file is wrong        (exit 3)
├── BundleError           a policy bundle is wrong or was tampered with     (exit 3)
├── CalibrationError      a calibration file is missing, wrong or too old   (exit 3)
├── KinematicsError                                                         (exit 3)
│   ├── NoSolutionError   a pose is out of reach: names the joint and by how much
│   └── IkError           the QP gave no usable solution: names why
├── MotionError           a plan cannot be made inside the limits           (exit 3)
├── DriverError           the robot or its connection failed                (exit 4)
├── SafetyStop            the gate ended the run                            (exit 5)
├── MissingExtraError     an optional dependency is not installed           (exit 6)
├── MissingRosError       a ROS is not installed, or not in this environment  (exit 6)
├── RecordingError        a recording cannot be written or read     (exit 3)
├── TrainingError         learning or export failed                         (exit 3)
└── Interrupted           a person ended the run                            (exit 130)

Each message ends with what to do next; the facts are attributes, so that a caller can act on them.
"""

from __future__ import annotations

from pathlib import Path


class ViskillError(Exception):
    """Anything that went wrong in a way the project foresaw."""

    exit_code = 70


class DataFileError(ViskillError, ValueError):
    """A data file was refused.

    Attributes:
        path: the file.
        key: dotted key of the entry at fault, "" for the whole file.
        reason: what is wrong with it and what to do.
    """

    exit_code = 3

    def __init__(self, path: Path | str, key: str, reason: str) -> None:
        self.path, self.key, self.reason = Path(path), key, reason
        where = f"{self.path}: {key}" if key else str(self.path)
        super().__init__(f"{where}: {reason}")


class BundleError(ViskillError, ValueError):
    """A policy bundle was refused.

    Attributes:
        path: the bundle or the file in it.
        reason: what is wrong with it and what to do.
    """

    exit_code = 3

    def __init__(self, path: Path | str, reason: str) -> None:
        self.path, self.reason = Path(path), reason
        super().__init__(f"{self.path}: {reason}")


class CalibrationError(ViskillError, ValueError):
    """A calibration is missing, wrong or too old."""

    exit_code = 3


class KinematicsError(ViskillError, ValueError):
    """A kinematic question has no answer."""

    exit_code = 3


class NoSolutionError(KinematicsError):
    """A pose is out of reach.

    Attributes:
        joint: index of the joint that would leave its limits, -1 when the pose is degenerate.
        name: the joint's name.
        value: the value that the pose asks for, rad or m.
        excess: by how much it is outside, rad or m (NaN when degenerate).
    """

    def __init__(self, joint: int, name: str, value: float, excess: float, reason: str) -> None:
        self.joint, self.name, self.value, self.excess = joint, name, value, excess
        super().__init__(reason)


class IkError(KinematicsError):
    """The QP gave no usable solution.

    Attributes:
        cause: one of "not-finite", "bad-bounds", "infeasible", "outside-box", "residual", "time".
    """

    def __init__(self, cause: str, reason: str) -> None:
        self.cause = cause
        super().__init__(reason)


class MotionError(ViskillError, ValueError):
    """A plan cannot be made inside the limits, or a policy asks for no motion that there is."""

    exit_code = 3


class DriverError(ViskillError, ConnectionError):
    """The robot or its connection failed."""

    exit_code = 4


class SafetyStop(ViskillError):  # noqa: N818 - the field says "safety stop"
    """The gate ended the run."""

    exit_code = 5


def extra_advice(extra: str) -> str:
    """What brings an optional part. No index has this package: it is installed from a clone."""
    return f"in your clone of viskill_deploy: pip install -e '.[{extra}]'"


class MissingExtraError(ViskillError, ImportError):
    """An optional dependency is not installed.

    Attributes:
        extra: the extra of the package that brings it.
    """

    exit_code = 6

    def __init__(self, extra: str, what: str) -> None:
        self.extra = extra
        super().__init__(f"{what} needs an optional part; {extra_advice(extra)}")


class MissingRosError(ViskillError, ImportError):
    """A ROS is not installed, or this Python does not see it."""

    exit_code = 6


class RecordingError(ViskillError, OSError):
    """A recording cannot be written or read."""

    exit_code = 3


class TrainingError(ViskillError, RuntimeError):
    """Learning or export failed."""

    exit_code = 3


class Interrupted(ViskillError):  # noqa: N818 - what shells call it
    """A person ended the run; the arms were brought to rest."""

    exit_code = 130
