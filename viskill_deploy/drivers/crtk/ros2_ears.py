"""Waits for what comes on the topics of a ROS 2 node, in a thread of its own.

An executor of rclpy makes its list of what to wait for anew for every message, in Python. With two
arms at 100 Hz that takes half of a core, and the interpreter that the control loop needs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation as rclpy_core

FOR_EVER = -1


@dataclass(frozen=True, slots=True)
class _Ear:
    """One subscription, and who is told of what comes."""

    handle: Any
    kind: type[Any]
    arrive: Callable[[bytes], None]


class Ears:
    """All subscriptions of a node.

    Args:
        context: rclpy's.
    """

    def __init__(self, context: Any) -> None:
        self._context, self._is_open = context, True
        self._bell = GuardCondition(None, None, context=context)
        self._ears: tuple[_Ear, ...] = ()
        self._thread = threading.Thread(target=self._listen, name="crtk-ros2", daemon=True)
        self._thread.start()

    def add(self, subscription: Any, kind: type[Any], arrive: Callable[[bytes], None]) -> None:
        """Listens to one more; `arrive` gets the bytes of each message, from this thread."""
        self._ears = (*self._ears, _Ear(subscription.handle, kind, arrive))
        self._bell.trigger()

    def close(self) -> None:
        """Listens no more; called before the subscriptions end."""
        self._is_open = False
        self._bell.trigger()
        if threading.current_thread() is not self._thread:
            self._thread.join()
        self._bell.destroy()

    def _listen(self) -> None:
        known: tuple[_Ear, ...] = ()
        waiting = self._waiting(known)
        while self._is_open:
            if known is not self._ears:
                known = self._ears
                waiting = self._waiting(known)
            waiting.clear_entities()
            for ear in known:
                waiting.add_subscription(ear.handle)
            waiting.add_guard_condition(self._bell.handle)
            waiting.wait(FOR_EVER)
            ready = set(waiting.get_ready_entities("subscription"))
            for ear in known:
                if self._is_open and ear.handle.pointer in ready:
                    _drain(ear)

    def _waiting(self, ears: tuple[_Ear, ...]) -> Any:
        return rclpy_core.WaitSet(len(ears), 1, 0, 0, 0, 0, self._context.handle)


def _drain(ear: _Ear) -> None:
    """Hands over all that has come."""
    while (taken := ear.handle.take_message(ear.kind, True)) is not None:
        ear.arrive(taken[0])
