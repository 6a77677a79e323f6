"""What a result says, as rows of words: shared by the terminal's tables and the report.

A result is the dict that a run prints as JSON. Keys that are missing leave their row out.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from viskill_deploy.observe.boundaries import boundary_of, place
from viskill_deploy.observe.labels import rule_label
from viskill_deploy.observe.starts import Result, is_low


@dataclass(frozen=True, slots=True)
class Fact:
    """One figure of the run: its name, the words for it, and whether it is good news."""

    name: str
    text: str
    good: bool | None = None


@dataclass(frozen=True, slots=True)
class SkillRow:
    """One skill over all episodes.

    Attributes:
        runs: how often it ran; judged: how often somebody could tell whether it succeeded.
        steps_median: policy steps of a run; steps_max: of the longest.
        stretch_max: largest time of a step over the time that the policy meant.
        source: who gave its subgoals; "" where nobody says.
        values: P(the whole task succeeds) as seen at its start, of every run where that was told.
        values_low: how many of them lie below the bundle's threshold.
    """

    name: str
    runs: int
    judged: int
    successes: int
    steps_median: float
    steps_max: int
    stretch_max: float | None
    source: str = ""
    values: tuple[float, ...] = ()
    values_low: int = 0

    @property
    def value(self) -> str:
        """The value at its start, or lowest to highest; a dash where nothing told it."""
        if not self.values:
            return "–"
        ends = [f"{end:.2f}" for end in (min(self.values), max(self.values))]
        return "–".join(dict.fromkeys(ends))

    @property
    def result(self) -> str:
        """Done or failed, or how many of how many; a dash where nobody could tell."""
        if not self.judged:
            return "–"
        if self.runs == 1:
            return "done" if self.successes else "failed"
        return f"{self.successes} of {self.judged}"

    @property
    def good(self) -> bool:
        """Whether no run is known to have failed."""
        return self.successes == self.judged

    @property
    def steps(self) -> str:
        """Steps of one run, or median and largest of several."""
        if self.steps_median == self.steps_max:
            return str(self.steps_max)
        return f"{self.steps_median:.0f} (at most {self.steps_max})"

    @property
    def stretch(self) -> str:
        """How far time was stretched at most."""
        return "–" if self.stretch_max is None else f"{self.stretch_max:.2f}×"


@dataclass(frozen=True, slots=True)
class MarginRow:
    """Smallest distance to one rule's limit over the run, as part of the limit; below 0 is over."""

    rule: str
    label: str
    margin: float
    where: str

    @property
    def text(self) -> str:
        """Percent of the limit that was left."""
        return f"{100 * self.margin:.1f} %" if self.margin >= 0 else "over the limit"


def facts(result: Result) -> list[Fact]:
    """The figures of the run, most wanted first."""
    rows: list[Fact | None] = [
        Fact("Stage", str(result["stage"]), None) if result.get("stage") else None,
        Fact("Hidden robot", _truth(result["truth"])) if result.get("truth") else None,
        _success(result),
        _fact(result, "interventions", "Interventions", "{:d}", lambda v: v == 0),
        _fact(result, "realtime_factor", "Real-time factor", "{:.1f}×"),
        _fact(result, "rcm_error_max_m", "Remote centre", "{:.3f} mm", scale=1e3),
        _fact(result, "joint_margin_min", "Joint margin", "{:.1f} % of range", scale=100),
        _fact(result, "tip_speed_max_m_s", "Tip speed", "{:.1f} mm/s", scale=1e3),
        _fact(result, "setpoints", "Setpoints", "{:,d}"),
        _fact(result, "refused", "Refused", "{:d}", lambda v: v == 0),
        _fact(result, "retries", "Retries", "{:d}") if result.get("retries") else None,
        _fact(result, "overruns", "Overruns", "{:d}") if result.get("real_time") else None,
        *_way(result.get("on_the_way") or {}),
    ]
    return [row for row in rows if row is not None]


def _truth(about: Mapping[str, Any]) -> str:
    """Where a hidden robot came from."""
    if "seed" in about:
        return f"drawn from seed {about['seed']}"
    return f"{about['file']}, {about['sha256'][:12]}"


def _way(way: Mapping[str, Any]) -> Iterator[Fact]:
    """How setpoints fared on their way to the arms, as far as anybody can tell."""
    for key, name in (("age", "Setpoint age at arrival"), ("echo_age", "Setpoint age when held")):
        p50, p99 = way.get(f"{key}_p50_ms"), way.get(f"{key}_p99_ms")
        if p50 is not None and p99 is not None:
            yield Fact(name, f"{p50:.1f} ms, p99 {p99:.1f} ms")
    if "lost" in way:
        yield Fact("Lost on the way", f"{way['lost']:,d} of {way['sent']:,d}")


def _success(result: Result) -> Fact | None:
    """Whether the task was done; of a run on real arms, or of one without things, nobody knows."""
    if result.get("judged") is False:
        return Fact("Success", "not judged: only a simulator can tell", None)
    return _fact(result, "success_rate", "Success", _success_text(result), lambda v: v >= 0.9)


def _success_text(result: Result) -> str:
    """As many decimals as it takes to tell one failure from none."""
    episodes = result.get("episodes")
    if not isinstance(episodes, int):
        return "{:.0%}"
    return f"{{:.{max(len(str(episodes - 1)) - 2, 0)}%}}"


def _fact(
    result: Result, key: str, name: str, form: str, judge: Any = None, scale: float = 1
) -> Fact | None:
    value = result.get(key)
    if not isinstance(value, int | float):
        return None
    scaled = value if scale == 1 else value * scale
    return Fact(name, form.format(scaled), None if judge is None else bool(judge(value)))


def skill_rows(result: Result, episode: int | None = None) -> list[SkillRow]:
    """Every skill in the order in which it first ran, over all episodes or in one."""
    entries: dict[str, list[Mapping[str, Any]]] = {}
    for outcome in result.get("episode_results") or ():
        if episode in {None, outcome.get("episode")}:
            for skill in outcome.get("skills") or ():
                entries.setdefault(str(skill.get("name", "")), []).append(skill)
    threshold = result.get("value_threshold")
    return [_skill_row(name, runs, threshold) for name, runs in entries.items()]


def _skill_row(name: str, runs: Sequence[Mapping[str, Any]], threshold: float | None) -> SkillRow:
    steps = [int(run.get("steps", 0)) for run in runs]
    stretches = [float(run["stretch_max"]) for run in runs if run.get("stretch_max") is not None]
    values = tuple(float(run["value"]) for run in runs if run.get("value") is not None)
    return SkillRow(
        name=name,
        runs=len(runs),
        judged=sum(run.get("success") is not None for run in runs),
        successes=sum(bool(run.get("success")) for run in runs),
        steps_median=statistics.median(steps),
        steps_max=max(steps),
        stretch_max=max(stretches, default=None),
        source=str(runs[0].get("subgoal_source", "")),
        values=values,
        values_low=sum(is_low(value, threshold) for value in values),
    )


def outcome(episode: Mapping[str, Any]) -> str:
    """How an episode ended: success, failed, or stopped and by what."""
    if episode.get("stopped_by"):
        return f"stopped by {rule_label(str(episode['stopped_by']))}"
    boundaries = episode.get("boundaries") or ()
    if boundaries and boundaries[-1]["course"] != "go on":
        where = place(boundary_of(boundaries[-1]))
        return f"stopped {where}, arms in their start pose"
    return "success" if episode.get("success") else "failed"


def margin_rows(result: Result) -> list[MarginRow]:
    """Smallest margin to every limit, tightest first. An entry is a number or a table of facts."""
    rows = []
    for rule, entry in (result.get("margins") or {}).items():
        table = entry if isinstance(entry, Mapping) else {"margin": entry}
        margin = table.get("margin", table.get("min"))
        if isinstance(margin, int | float):
            where = " ".join(str(table[key]) for key in ("arm", "joint") if key in table)
            rows.append(MarginRow(rule, rule_label(rule), float(margin), where))
    return sorted(rows, key=lambda row: row.margin)
