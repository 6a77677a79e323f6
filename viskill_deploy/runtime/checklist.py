"""The lines of a preflight: what was looked at, what was found, and what was left of the limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar

from viskill_deploy.core.errors import ViskillError

Status = Literal["pass", "warn", "fail"]

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Line:
    """One line.

    Attributes:
        name: what was looked at.
        rule: id of the invariant that it stands for; "" for none.
        status: a warning does not keep the cell from being armed.
        margin: part of the limit that is left, 1.0 far away and 0.0 at it; None where there is no
            number.
        text: what was found; of a failure, the sentence with what to do.
    """

    name: str
    rule: str
    status: Status
    margin: float | None
    text: str

    def facts(self) -> dict[str, Any]:
        """The same for JSON."""
        return {
            "name": self.name,
            "rule": self.rule,
            "status": self.status,
            "margin": self.margin,
            "text": self.text,
        }


@dataclass(frozen=True, slots=True)
class Found(Generic[T]):
    """What a look came to: a value for the looks that follow, and its line.

    Attributes:
        error: what is wrong, where there is a margin to it all the same.
    """

    value: T
    text: str
    margin: float | None = None
    warns: bool = False
    error: ViskillError | None = None


@dataclass
class Checklist:
    """Lines in the order in which things were looked at.

    Attributes:
        error: what the first failure raised; None while nothing has failed.
    """

    lines: list[Line] = field(default_factory=list)
    error: ViskillError | None = None

    def look(self, name: str, rule: str, at: Callable[[], Found[T]]) -> T | None:
        """Adds a line; returns the value that was found, None after a failure."""
        try:
            found = at()
        except ViskillError as error:
            self.lines.append(Line(name, rule, "fail", None, str(error)))
            self.error = self.error or error
            return None
        status: Status = "fail" if found.error else "warn" if found.warns else "pass"
        self.lines.append(Line(name, rule, status, found.margin, found.text))
        self.error = self.error or found.error
        return found.value

    def insist(self) -> None:
        """Raises what the first failure raised."""
        if self.error is not None:
            raise self.error
