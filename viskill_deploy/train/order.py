"""Whether methods stand in the paper's order, and whether that can be told at all."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

from scipy import stats  # type: ignore[import-untyped]

from viskill_deploy.train.paper import PUBLISHED, TITLES
from viskill_deploy.train.results import Result

SURE = 0.95
"""Two success rates differ where zero is outside this interval of their difference."""

LEAST_SEEDS = 2
"""Of one seed nobody knows what another would have given."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two methods on a task, over the seeds that both have run.

    Attributes:
        first, second: the methods, in the paper's order.
        rates: their success rates.
        difference: of the first's over the second's.
        width: by how much it may be off, half of its confidence interval; infinite for one seed.
    """

    first: str
    second: str
    rates: tuple[float, float]
    difference: float
    width: float

    @property
    def verdict(self) -> str:
        """`kept`, `reversed`, `open` where the difference may be chance, `alone` for one seed."""
        if math.isinf(self.width):
            return "alone"
        if abs(self.difference) <= self.width:
            return "open"
        return "kept" if self.difference > 0.0 else "reversed"

    @property
    def told(self) -> str:
        """Both methods with their rates."""
        first, second = (f"{100.0 * rate:.1f}" for rate in self.rates)
        return f"{TITLES[self.first]} and {TITLES[self.second]} ({first} and {second} %)"


def compare(
    first: str,
    second: str,
    one: Sequence[Result],
    other: Sequence[Result],
    distribution: str = "reference",
) -> Pair | None:
    """Two methods on layouts of a distribution over their common seeds; None if they have none.

    Methods of a seed share demonstrations, skills and layouts, so that differences are taken seed
    by seed. The interval is that of these differences (Student's t) or that of the episodes counted
    (normal), whichever is wider; the latter takes (k + 1) / (n + 2) for a rate, so that 100 % of
    100 is not held to be certain.
    """
    ours, theirs = (
        {r.unit.seed: r.scores[distribution] for r in runs if distribution in r.scores}
        for runs in (one, other)
    )
    seeds = sorted(ours.keys() & theirs.keys())
    if not seeds:
        return None
    rates = [(ours[s].success_rate, theirs[s].success_rate) for s in seeds]
    differences = [a - b for a, b in rates]
    counted = 0.0
    for figures in (ours, theirs):
        n = sum(figures[s].episodes for s in seeds)
        k = sum(figures[s].success_rate * figures[s].episodes for s in seeds)
        likely = (k + 1.0) / (n + 2.0)
        counted += likely * (1.0 - likely) / n
    if len(seeds) < LEAST_SEEDS:
        width = math.inf
    else:
        error = statistics.stdev(differences) / math.sqrt(len(seeds))
        width = max(
            float(stats.t.ppf(0.5 + SURE / 2, len(seeds) - 1)) * error,
            float(stats.norm.ppf(0.5 + SURE / 2)) * math.sqrt(counted),
        )
    return Pair(
        first,
        second,
        (statistics.fmean(a for a, _ in rates), statistics.fmean(b for _, b in rates)),
        statistics.fmean(differences),
        width,
    )


def told_order(
    task: str, runs: Mapping[str, Sequence[Result]], distribution: str = "reference"
) -> str:
    """What there is to say about the paper's order on a task.

    Args:
        task: its name.
        runs: the results of each method.
        distribution: of the layouts whose success is compared.
    """
    published = PUBLISHED[task]
    ranked = sorted(published, key=lambda method: -published[method].success[0])
    ran = [method for method in ranked if runs.get(method)]
    pairs = [
        pair
        for a, b in combinations(ran, 2)
        if (pair := compare(a, b, runs[a], runs[b], distribution)) is not None
    ]
    missing = [TITLES[method] for method in ranked if method not in ran]
    unknown = f" Not run: {', '.join(missing)}." if missing else ""
    if not pairs:
        return f"cannot be said.{unknown}"
    verdicts = ("kept", "reversed", "open", "alone")
    groups = {v: [p for p in pairs if p.verdict == v] for v in verdicts}
    turned = "; ".join(p.told for p in groups["reversed"])
    alike: dict[str, list[str]] = {}
    for p in groups["open"]:
        alike.setdefault(TITLES[p.first], []).append(TITLES[p.second])
    chance = "; ".join(f"{first} from {', '.join(others)}" for first, others in alike.items())
    holds = "no pair" if not groups["kept"] else str(len(groups["kept"]))
    return (
        f"of {len(pairs)} pairs {holds} as in the paper, {len(groups['reversed'])} reversed, "
        f"{len(groups['open'])} too close to tell"
        + (f", {len(groups['alone'])} of one seed alone." if groups["alone"] else ".")
        + (f" Reversed: {turned}." if turned else "")
        + (f" Cannot be told apart: {chance}." if chance else "")
        + unknown
    )
