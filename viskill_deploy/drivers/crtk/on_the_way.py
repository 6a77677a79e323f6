"""How setpoints fare on their way to the arms: how many arrive, and how old they are by then."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np

from viskill_deploy.drivers.crtk.messages import NANO


class Ages:
    """Times from sending to something else, s."""

    def __init__(self) -> None:
        self._ages_s = array("d")

    def note(self, age_s: float) -> None:
        """One more."""
        self._ages_s.append(age_s)

    def facts(self, what: str) -> dict[str, float | None]:
        """Median, 99th percentile and largest, ms; None where there is none."""
        if not self._ages_s:
            return dict.fromkeys((f"{what}_p50_ms", f"{what}_p99_ms", f"{what}_max_ms"))
        p50, p99, most = (1e3 * np.percentile(self._ages_s, (50, 99, 100))).round(3).tolist()
        return {f"{what}_p50_ms": p50, f"{what}_p99_ms": p99, f"{what}_max_ms": most}

    def add(self, others: Ages) -> None:
        """Takes in those of others."""
        self._ages_s.extend(others._ages_s)


class Arrivals:
    """Setpoints that arms have heard, by their stamps."""

    def __init__(self) -> None:
        self._heard, self._ages = 0, Ages()

    def note(self, stamp_ns: int, now_ns: int) -> None:
        """One more, which its sender has stamped; 0 for not."""
        self._heard += 1
        if stamp_ns:
            self._ages.note((now_ns - stamp_ns) / NANO)

    def facts(self) -> dict[str, Any]:
        """How many there were, and how old."""
        return {"heard": self._heard, **self._ages.facts("age")}
