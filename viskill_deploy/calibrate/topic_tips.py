"""Tips that a tracker sees and publishes on topics, PoseStamped in the task frame."""

from __future__ import annotations

from collections.abc import Mapping

from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.runtime.robots import await_poses
from viskill_deploy.runtime.topic_poses import TopicPoses

ARM = "{arm}"
"""Stands for the name of an arm in a template of topics."""


class TopicTips:
    """The newest point of every arm's tip; it is a `PointSource`.

    Args:
        transport: a node; the one who opened it closes it.
        topics: topic of every arm.
        point_m: how far beyond the jaw pivot, along the tip, what the tracker sees is.
    """

    def __init__(
        self, transport: Transport, topics: Mapping[str, str], point_m: float = 0.0
    ) -> None:
        self._topics, self.point_m = dict(topics), point_m
        self._poses = TopicPoses(transport, topics, dict.fromkeys(topics, 0.0))

    def insist(self) -> None:
        """Waits until every tip was seen.

        Raises:
            CalibrationError: one was not; names its topic.
        """
        await_poses(self._poses, list(self._topics))
        for arm, topic in self._topics.items():
            if self._poses.newest(arm) is None:
                raise CalibrationError(
                    f"nothing is heard of {arm}'s tip on {topic}; see that the tracker runs and "
                    'publishes PoseStamped in the frame "task", or name its topics with --tracker'
                )

    def look(self, now: float) -> None:
        """Topics keep up by themselves."""

    def points(self, now: float) -> dict[str, tuple[float, FloatArray]]:
        """When each tip was seen last, driver's clock, and where, (3,) m."""
        del now
        seen = {arm: self._poses.newest(arm) for arm in self._topics}
        return {arm: (s.seen_s, s.T_task_object[:3, 3]) for arm, s in seen.items() if s}


def topics_of(template: str, arms: list[str]) -> dict[str, str]:
    """The topic of every arm.

    Raises:
        CalibrationError: the template has no place for its name.
    """
    if ARM not in template:
        raise CalibrationError(
            f"--tracker {template!r} needs {ARM} where the name of an arm stands"
        )
    return {arm: template.replace(ARM, arm) for arm in arms}
