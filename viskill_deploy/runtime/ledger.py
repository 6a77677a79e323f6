"""What a run adds up: margins, speeds, interventions. Numbers only; `observe` makes sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import Action, Boundary, FloatArray, JointSetpoint, SkillStart
from viskill_deploy.kinematics.model import forward_batch, port_distances

BROKEN = -1.0
"""Margin of a rule that could not even be asked."""


@dataclass
class SkillResult:
    """How one skill of one episode went.

    Attributes:
        start: what was decided at its first step.
        success: whether it reached its subgoal; None where nobody can tell.
        stretch_max: largest time of a step over the time that the policy meant.
    """

    start: SkillStart
    steps: int = 0
    success: bool | None = None
    stretch_max: float = 1.0


@dataclass
class EpisodeResult:
    """How one episode went.

    Attributes:
        stopped_by: id of the rule for which the gate stepped in; "" if it did not.
        reason: what the driver complained of, or why the line had nothing to ask the gate for, in
            words; "" if neither.
        refused: why nothing was moved at all; "" if it was.
        retries: how often a skill was tried again.
        boundaries: what was decided between the skills, in order.
        resumed: ids of the rules that held the arms, where the operator let the run go on.
        off_plan: where the thing was not where the plan had it, and what was done, in words.
    """

    episode: int
    success: bool = False
    stopped_by: str = ""
    reason: str = ""
    refused: str = ""
    simulated_s: float = 0.0
    skills: list[SkillResult] = field(default_factory=list)
    retries: int = 0
    boundaries: list[Boundary] = field(default_factory=list)
    resumed: list[str] = field(default_factory=list)
    off_plan: list[str] = field(default_factory=list)

    def skill(self, start: SkillStart) -> tuple[SkillResult, bool]:
        """The entry of the running skill, and whether it was made for this: the skill begins."""
        begins = not self.skills or self.skills[-1].start is not start
        if begins:
            self.skills.append(SkillResult(start))
        return self.skills[-1], begins


class Ledger:
    """Adds up a run.

    Args:
        cell: the arms in their places.
        period_s: control period.
        rules: ids of the gate's rules, in the order of its margins.
    """

    def __init__(self, cell: CellDescription, period_s: float, rules: Sequence[str]) -> None:
        self._cell, self._period_s, self._rules = cell, period_s, tuple(rules)
        self._margins: list[float] = []
        self._sent: list[tuple[JointSetpoint, ...]] = []
        self.setpoints = 0
        self.interventions = 0
        self.worst = Action.PASS
        self._figures = {"rcm": 0.0, "margin": 1.0, "tip": 0.0}
        self.episodes: list[EpisodeResult] = []

    @property
    def last_sent(self) -> tuple[JointSetpoint, ...]:
        """What went out last in this episode."""
        return self._sent[-1] if self._sent else ()

    def cycle(
        self,
        sent: tuple[JointSetpoint, ...],
        action: Action,
        margins: Sequence[float],
    ) -> None:
        """Adds one control cycle."""
        self._sent.append(sent)
        before = self._margins or [1.0] * len(self._rules)
        # a margin that is no number counts as broken, or it would be forgotten
        self._margins = [
            (a if a <= b else b) if b <= 1.0 else BROKEN
            for a, b in zip(before, margins, strict=True)
        ]
        self.worst = max(self.worst, action)

    def end_episode(self, result: EpisodeResult) -> None:
        """Closes an episode: its setpoints go into the figures."""
        self.episodes.append(result)
        self.interventions += 1 if result.stopped_by else 0
        rows = [row for row in self._sent if row]
        self.setpoints += len(rows) * len(self._cell.arms)
        self._sent = []
        if rows:
            q = np.array([[s.jp for s in row] for row in rows])
            for index in range(len(self._cell.arms)):
                self._add_arm(index, q[:, index])

    def _add_arm(self, index: int, q: FloatArray) -> None:
        entry = self._cell.arms[index]
        arm = entry.arm
        tips = forward_batch(arm, q)[:, :3, 3]
        speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / self._period_s
        low, high = np.array(arm.limit(0)), np.array(arm.limit(1))
        room = np.minimum(q - low, high - q) / (high - low)
        distances = port_distances(arm, q, entry.port_in_base)
        figures = self._figures
        figures["tip"] = max(figures["tip"], float(speeds.max(initial=0.0)))
        figures["margin"] = min(figures["margin"], float(room.min()))
        figures["rcm"] = max(figures["rcm"], float(distances.max()))

    def summary(self) -> dict[str, Any]:
        """The run's figures.

        `joint_margin_min` is the smallest distance of any sent joint position to its limit, as a
        part of that joint's range; `margins` are the gate's, 1 far away and 0 at the threshold.
        Of a run without a setpoint there are none: None, and no margins without a control cycle.
        """
        done = self.episodes
        figures: dict[str, float | None] = dict.fromkeys(self._figures)
        figures |= self._figures if self.setpoints else {}
        return {
            "episodes": len(done),
            "success_rate": sum(e.success for e in done) / max(len(done), 1),
            "interventions": self.interventions,
            "refused": sum(bool(e.refused) for e in done),
            "retries": sum(e.retries for e in done),
            "rcm_error_max_m": figures["rcm"],
            "joint_margin_min": figures["margin"],
            "tip_speed_max_m_s": figures["tip"],
            "setpoints": self.setpoints,
            "simulated_s": sum(e.simulated_s for e in done),
            "worst_action": self.worst.name,
            "margins": dict(zip(self._rules, self._margins, strict=False)),
            "episode_results": [_episode(e) for e in done],
        }


def _episode(result: EpisodeResult) -> dict[str, Any]:
    return {
        "episode": result.episode,
        "success": result.success,
        "stopped_by": result.stopped_by,
        "reason": result.reason,
        "refused": result.refused,
        "simulated_s": result.simulated_s,
        "skills": [
            {
                "name": skill.start.skill,
                "steps": skill.steps,
                "success": skill.success,
                "stretch_max": skill.stretch_max,
                "subgoal": skill.start.subgoal.tolist(),
                "subgoal_source": skill.start.source,
                "value": skill.start.value,
            }
            for skill in result.skills
        ],
        "retries": result.retries,
        "resumed": list(result.resumed),
        "off_plan": list(result.off_plan),
        "boundaries": [asdict(boundary) for boundary in result.boundaries],
    }
