"""Hidden robots: errors of the sizes that the literature reports, drawn from a seed."""

from __future__ import annotations

import math

import numpy as np

from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.cables import Cables

BASE_M, BASE_RAD = 0.004, math.radians(1.0)
"""Standard deviations, an axis, of a base that was registered by hand; a set-up joint's
potentiometers alone are good to a centimetre."""

PITCH_RAD, WRIST_RAD = math.radians(0.5), math.radians(1.5)
"""Standard deviations of joint 2's and the wrist's zeros."""

INSERTION_M = 0.010
"""Joint 3 reads wrong by up to this, either way."""

BACKLASH_RAD, COUPLING = 0.02, 0.02
"""Play of a wrist joint, at most; stretch per angle, standard deviation: together a few mm of tip
error, as tendon-driven instruments have uncalibrated."""

DELAY_S = 0.04
"""Oldest that a tracker's point is when it gets its stamp."""


def draw_truth(rng: np.random.Generator) -> ArmErrors:
    """What one arm might really be.

    Joint 1's offset is part of the base's rotation, and a longer shaft part of joint 3's offset:
    no tip position tells them apart, so they are not drawn.
    """
    wrist = rng.normal(0.0, WRIST_RAD, 3).tolist()
    insertion = float(rng.uniform(-INSERTION_M, INSERTION_M))
    return ArmErrors(
        base_rotation_rad=tuple(rng.normal(0.0, BASE_RAD, 3).tolist()),
        base_translation_m=tuple(rng.normal(0.0, BASE_M, 3).tolist()),
        joint_offset=(0.0, float(rng.normal(0.0, PITCH_RAD)), insertion, *wrist),
        cables=Cables(
            tuple(rng.uniform(0.0, BACKLASH_RAD, 3).tolist()),
            tuple(tuple(row) for row in rng.normal(0.0, COUPLING, (3, 3)).tolist()),
        ),
        delay_s=float(rng.uniform(0.0, DELAY_S)),
    )
