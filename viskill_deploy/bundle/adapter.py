"""What stands between a task's numbers and a policy that was trained in another world's.

The runtime works in metres in the task frame. A policy of another simulator may want its positions
in that world's frame and scale; the manifest's `adapter` says how, and the graphs stay as trained.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from viskill_deploy.bundle.graphs import Affine
from viskill_deploy.core.robot_files import Positive, Table, Vector3

POSITION, DIFFERENCE = "_position", "_from_"
"""What names of stretches say: a position in the frame, a difference of two positions."""


class AdapterEntry(Table):
    """Positions of the policy are `length_scale * (position in the task frame + task_origin_m)`.

    Attributes:
        frame: the policy's; its axes are parallel to the task's.
        length_scale: lengths of the policy over metres.
        task_origin_m: origin of the task frame in the policy's frame, m before scaling.
        control_point: the point of the tool that positions are about. The jaw pivot is the origin
            of the wrist-yaw frame ("EEF"), 10.2 mm before the end of the jaws of a needle driver.
    """

    frame: Literal["world"]
    length_scale: Positive
    task_origin_m: Vector3
    control_point: Literal["jaw_pivot"]

    def affine(self, layout: Sequence[tuple[str, int]]) -> Affine:
        """From the task's vector to the policy's, stretch by stretch.

        Positions are moved and scaled, differences (`object_from_psm1`) scaled; angles, jaws and
        contacts stay. Frames are parallel, so angles need no turning.
        """
        scale: list[float] = []
        offset: list[float] = []
        for name, size in layout:
            is_position = name.endswith(POSITION)
            factor = self.length_scale if is_position or DIFFERENCE in name else 1.0
            scale += [factor] * size
            offset += [factor * x for x in self.task_origin_m] if is_position else [0.0] * size
        return Affine(np.array(scale), np.array(offset))


def adapters(
    entry: AdapterEntry,
    observation: Sequence[tuple[str, int]],
    goal: Sequence[tuple[str, int]],
    chosen: int,
) -> Mapping[str, Affine]:
    """The adapter of every input of a bundle's graphs by its name, and of a chosen subgoal.

    Args:
        entry: of the manifest.
        observation: the task's layout.
        goal: that of its subgoals.
        chosen: how many leading numbers of a subgoal a chaining policy chooses.
    """
    whole = entry.affine(goal)
    return {
        "obs": entry.affine(observation),
        "goal": whole,
        "subgoal": whole,
        "task_goal": entry.affine([("task_goal_position", 3)]),
        "chosen": Affine(whole.scale[:chosen], whole.offset[:chosen]),
    }
