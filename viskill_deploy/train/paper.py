"""What the ViSkill paper reports: T. Huang et al., IROS 2023, Tables I and II, five seeds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Published:
    """Figures of a method on a task; None where the paper gives none.

    Attributes:
        success: success rate and its standard deviation, %.
        subtasks: subtasks completed.
        length: rollout length and its standard deviation, policy steps.
    """

    success: tuple[float, float | None]
    subtasks: float | None = None
    length: tuple[float, float] | None = None


TITLES = {
    "viskill": "ViSkill",
    "tstar": "T-STAR",
    "dex": "DEX",
    "gcbc": "GCBC",
    "viskill_dm": "ViSkill-DM",
    "viskill_ldm": "ViSkill-LDM",
    "viskill_sr": "ViSkill-SR",
    "self_imitation": "self-imitation only",
    "planned": "scripted subgoals",
}
"""What the paper calls our methods; it has no names for the last two."""

MAIN = "viskill"
"""The paper's method: what the others are held against, and whose value is a probability."""

BASELINES = ("viskill", "tstar", "dex", "gcbc")
ABLATIONS = ("viskill", "viskill_dm", "viskill_ldm", "viskill_sr", "self_imitation", "planned")

TASKS = {
    "bipegtransfer": "BiPegTransfer",
    "bipegboard": "BiPegBoard",
    "matchboardpanel": "MatchBoardPanel",
}

PUBLISHED = {
    "bipegtransfer": {
        "viskill": Published((85.24, 8.42), 2.73, (69.19, 5.72)),
        "tstar": Published((67.73, None)),
        "dex": Published((14.03, None)),
        "gcbc": Published((11.27, None)),
        "viskill_dm": Published((66.23, None)),
        "viskill_ldm": Published((76.20, None)),
        "viskill_sr": Published((61.42, None)),
    },
    "bipegboard": {
        "viskill": Published((81.76, 4.08), 2.67, (61.21, 5.22)),
        "tstar": Published((65.25, None)),
        "dex": Published((2.60, None)),
        "gcbc": Published((8.26, None)),
        "viskill_dm": Published((64.13, None)),
        "viskill_ldm": Published((77.50, None)),
        "viskill_sr": Published((60.25, None)),
    },
    "matchboardpanel": {
        "viskill": Published((57.09, 5.68), 3.07, (100.39, 3.66)),
        "tstar": Published((45.42, None)),
        "dex": Published((0.0, None)),
        "gcbc": Published((5.50, None)),
    },
}

CORE_HOURS = {"bipegtransfer": 147.0}
"""One seed of ViSkill with the official code on one core, extrapolated from measured rates: grasp
17.4 h, handover 33.9 h, release 76.3 h, chaining 19.7 h."""
