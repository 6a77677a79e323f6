"""The frames that cross the pipe from the runtime to the recorder's process.

A frame is `HEADER` (kind, bytes of payload) and its payload, little endian. The runtime only packs
them; all that costs time (message layout, compression, files) is the recorder's. A cycle's frame is
fixed in size for a given number of arms and joints, so that the recorder can see a run of them as
one table.
"""

from __future__ import annotations

import enum
import struct

import numpy as np

from viskill_deploy.core.types import Mode

HEADER = struct.Struct("<II")

MODES = tuple(Mode)
MODE_INDEX = {mode: index for index, mode in enumerate(MODES)}

ASKED, POSED, QUIET = 1, 2, 4
"""Flags of a cycle: the line asked for setpoints; tip poses are given; no rule spoke."""


class Kind(enum.IntEnum):
    """What a frame holds."""

    HELLO = 1
    """UTF-8 JSON: cell, arms, period. The first frame."""
    ORIGIN = 2
    """Wall clock (ns, int64) and driver's clock (s, float64) at the same moment."""
    CYCLE = 3
    """One control cycle: `cycle_struct` and, per arm, a 4x4 pose."""
    VERDICT = 4
    """One rule's word: `VERDICT`."""
    POSE = 5
    """Pose of one thing in the task frame: `POSE`, then its name."""
    SKILL = 6
    """A mark in the run: driver's clock, then UTF-8 JSON."""
    FAILURE = 7
    """Why the line asked for nothing: driver's clock, then UTF-8 text."""


ORIGIN = struct.Struct("<qd")
VERDICT = struct.Struct("<dBBbb16sdd")
POSE = struct.Struct("<d128s")
TEXT = struct.Struct("<d")


def track_size(joints: int) -> int:
    """Numbers of one track: positions, velocities, jaw, jaw speed."""
    return 2 * joints + 2


def cycle_struct(arms: int, joints: int) -> struct.Struct:
    """Header, clock, action, mode, flags and every arm's stamp and three tracks; poses follow."""
    return struct.Struct(f"<IIdBBB5x{arms * (1 + 3 * track_size(joints))}d")


def cycle_dtype(arms: int, joints: int) -> np.dtype[np.void]:
    """The payload of a `CYCLE` frame as a record: what `cycle_struct` and the poses lay down."""
    track = [("q", "<f8", joints), ("v", "<f8", joints), ("jaw", "<f8"), ("jaw_v", "<f8")]
    arm = [("stamp", "<f8"), ("measured", track), ("sent", track), ("asked", track)]
    head = [("now", "<f8"), ("action", "u1"), ("mode", "u1"), ("flags", "u1"), ("pad", "V5")]
    return np.dtype([*head, ("arm", arm, arms), ("pose", "<f8", (arms, 4, 4))])
