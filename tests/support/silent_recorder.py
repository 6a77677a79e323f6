"""A recorder for runs whose record nobody reads."""

from typing import Any


class SilentRecorder:
    alive = True

    def cycle(self, *args: Any) -> None:
        pass

    def scene(self, *args: Any) -> None:
        pass

    def mark(self, *args: Any, **named: Any) -> None:
        pass
