"""The operator at the terminal: told and asked there, answering by lines."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import termios
from collections.abc import Iterator
from typing import TextIO

from rich.console import Console

from viskill_deploy.core.errors import Interrupted


def lines_typed() -> Iterator[str]:
    """Lines of this terminal for a thread to hear; none for a program in the background."""
    signal.signal(signal.SIGTTIN, signal.SIG_IGN)  # reading would stop such a program
    return _lines()


def _lines() -> Iterator[str]:
    with contextlib.suppress(OSError):
        yield from sys.stdin


class Terminal:
    """A person who types lines; it is an `Operator`.

    Args:
        console: where they read.
        patience_s: how long one look for an answer waits, s: nothing while arms count on the loop.
        lines: where they type.
    """

    def __init__(
        self, console: Console, patience_s: float = 0.0, lines: TextIO | None = None
    ) -> None:
        self._console, self._patience_s = console, patience_s
        self._lines, self._typed = lines or sys.stdin, ""

    def tell(self, note: str) -> None:
        """Prints a line."""
        self._console.print(note, markup=False, style="yellow", soft_wrap=True)

    def ask(self, question: str) -> None:
        """Prints a question; what a person has typed ahead of it is thrown away."""
        if self._lines.isatty():
            self._typed = ""
            termios.tcflush(self._lines, termios.TCIFLUSH)
        self._console.print(question, markup=False, style="bold", soft_wrap=True)

    def answer(self) -> str | None:
        """A line, without its end; None while there is none."""
        if "\n" not in self._typed and select.select([self._lines], [], [], self._patience_s)[0]:
            read = os.read(self._lines.fileno(), 4096)  # no line may hide in a buffer
            if not read:
                raise Interrupted("nobody is at the terminal any more; start again at one")
            self._typed += read.decode(errors="replace")
        line, end, rest = self._typed.partition("\n")
        if not end:
            return None
        self._typed = rest
        return line
