"""An arm without a mechanical remote centre that holds a straight instrument through a port.

Position and port leave such an instrument no choice of where it points: its shaft lies on the line
from the port to the tip. Of an orientation that somebody asks for it can follow the turn about the
shaft alone. `aimed` says which pose that is; where it is reached, the shaft is in the port.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from viskill_deploy.core.description import ArmDescription, CellArm
from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.kinematics.ik import IkSolver
from viskill_deploy.kinematics.pose import Pose, as_se3, checked_poses

LEAST_DEPTH_M = 0.005
"""Nearer to the port than this, a tip's place says little about where its shaft points."""

DAMPING = 1e-6
"""Of joint speeds against the task: settles which of all ways an arm with a free elbow takes."""


class StraightArm(Arm):
    """Kinematics of an arm of a lab's own, with its port.

    Args:
        description: the arm with its instrument.
        port_in_base: registered port, (3,) m.

    Attributes:
        port: the same.
    """

    def __init__(self, description: ArmDescription, port_in_base: FloatArray) -> None:
        super().__init__(description)
        self.port: FloatArray = np.array(port_in_base, dtype=np.float64)
        self._solver = IkSolver.for_arm(self, damping=DAMPING)

    def aimed(self, T_base_tip: Pose) -> pin.SE3:
        """The pose at the same place, turned as little as can be, with its shaft in the port.

        Raises:
            KinematicsError: the place is at the port, or the shaft would have to turn right round.
        """
        pose = as_se3(T_base_tip)
        way = pose.translation - self.port
        depth = math.sqrt(way.dot(way))
        z = pose.rotation[:, 2]
        if depth < LEAST_DEPTH_M or way.dot(z) <= 0.0:
            raise KinematicsError(
                f"the tip is {1e3 * depth:.1f} mm from the port or points back at it; ask for a "
                "pose inside the body, z away from the port"
            )
        turn = pin.Quaternion.FromTwoVectors(z, way / depth)
        return pin.SE3(turn.toRotationMatrix() @ pose.rotation, pose.translation)

    def inverse(self, T_base_tip: Pose, q_seed: npt.ArrayLike) -> FloatArray:
        """The joints near a seed that bring the tip to a pose as far as the port allows, (n,).

        Raises:
            IkError: "residual": out of reach from there.
            KinematicsError: as `aimed`, or a seed that is not n finite numbers.
        """
        return np.array(self._solver.solve(self.aimed(T_base_tip), self._joints(q_seed)).q)

    def resolve(self, T_base_tip: FloatArray, q0: npt.ArrayLike) -> FloatArray:
        """The joints along a path of poses, each found from the one before, (N, n).

        Raises:
            KinematicsError: as `inverse`; names the pose's index.
        """
        rows, q = [], self._joints(q0)
        for index, pose in enumerate(checked_poses(T_base_tip, "T_base_tip")):
            try:
                q = self.inverse(pose, q)
            except KinematicsError as error:
                raise KinematicsError(f"pose {index}: {error}") from error
            rows.append(q)
        return np.array(rows).reshape(-1, len(q))


def placed_arm(cell_arm: CellArm) -> Arm:
    """Kinematics of an arm in its cell: a PSM's own, or with the port that it has to keep."""
    if cell_arm.arm.has_remote_centre:
        return Arm(cell_arm.arm)
    return StraightArm(cell_arm.arm, cell_arm.port_in_base)
