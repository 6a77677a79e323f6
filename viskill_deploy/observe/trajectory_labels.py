"""What a file of waypoints says of its own numbers, as texts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from viskill_deploy.core.errors import MotionError
from viskill_deploy.motion.frames import CONTROL_POINTS, FRAMES, Label

LABEL_KEYS = ("frame", "control_point", "length_scale")


def label_texts(label: Label | None) -> dict[str, str]:
    """A label as texts by key."""
    if label is None:
        return {}
    texts = {"frame": str(label.frame), "control_point": str(label.control_point)}
    return (
        texts if label.length_scale is None else texts | {"length_scale": f"{label.length_scale!r}"}
    )


def label_of(texts: Mapping[str, str], path: Path) -> Label | None:
    """What a file says of its numbers; None where it says nothing.

    Raises:
        MotionError: it says what is unknown, or only a part.
    """
    said = [key for key in LABEL_KEYS if key in texts]
    if not said:
        return None
    if not {"frame", "control_point"} <= texts.keys():
        raise MotionError(
            f"{path}: says {' and '.join(said)} alone; let it say frame and control_point, too"
        )
    frame, point = texts["frame"], texts["control_point"]
    if frame not in FRAMES or point not in CONTROL_POINTS:
        raise MotionError(
            f"{path}: says frame {frame!r} and control point {point!r}; known are "
            f"{', '.join(FRAMES)} and {', '.join(CONTROL_POINTS)}"
        )
    try:
        scale = float(texts["length_scale"]) if "length_scale" in texts else None
    except ValueError:
        scale = np.nan
    if scale is not None and not 0.0 < scale < np.inf:
        raise MotionError(f"{path}: says length_scale {texts['length_scale']!r}; give a number > 0")
    return Label(frame, point, scale)
