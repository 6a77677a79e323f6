"""An arm to ask kinematic questions of: `load_arm(name, tool=...)`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from viskill_deploy.core.description import ArmDescription
from viskill_deploy.core.errors import IkError, KinematicsError, NoSolutionError
from viskill_deploy.core.types import FloatArray, Joints, frozen_array
from viskill_deploy.kinematics import closed_form
from viskill_deploy.kinematics.dvrk_json import describe_arm
from viskill_deploy.kinematics.model import (
    ROLL,
    SHAFT_FRAME,
    TIP_FRAME,
    build_model,
    forward_batch,
)
from viskill_deploy.kinematics.pose import Pose, checked_poses, split


def load_arm(name: str | Path, tool: str | Path = "large_needle_driver_400006") -> Arm:
    """A robot with an instrument in it.

    Args:
        name: a robot of `robots/`, such as "psm_classic", or the path of a `.toml` file of ours or
            of a `.json` arm file of the dVRK.
        tool: an instrument of `robots/tools/`, or a path likewise.

    Raises:
        DataFileError: a file is missing or refused; names file, key and reason.
        KinematicsError: the chain is not a PSM's.
    """
    return Arm(describe_arm(name, tool))


class Arm:
    """Kinematics of one arm: joints (n,) rad and m, poses of the tip in the base's frame, m.

    A PSM has six joints, its base is its remote centre, and its inverse has a closed form. What
    asks for that of another arm is refused; `straight.StraightArm` has an inverse of its own.

    Not safe to share between threads: the model's workspace is kept between calls.

    Attributes:
        description: the numbers that it was made from.
        model: Pinocchio's model, with the frames "tip" and "shaft".
        lower: joint limits, (n,), read-only.
        upper: joint limits, (n,), read-only.
    """

    def __init__(self, description: ArmDescription) -> None:
        self.description = description
        self.model = build_model(description)
        self._count = (len(description.joints),)
        self.lower: FloatArray = frozen_array(description.limit(0), self._count, "lower")
        self.upper: FloatArray = frozen_array(description.limit(1), self._count, "upper")
        self._psm = (
            closed_form.PsmGeometry.of(description) if description.has_remote_centre else None
        )
        self._data = self.model.createData()
        self._tip = self.model.getFrameId(TIP_FRAME)
        self._shaft = self.model.getFrameId(SHAFT_FRAME)
        rows = description.tip_rotation.tolist()
        self._to_frame6: tuple[Joints, Joints] = (tuple(rows[0]), tuple(rows[2]))

    def forward(self, q: npt.ArrayLike) -> pin.SE3:
        """Pose of the tip in the base frame.

        Raises:
            KinematicsError: not as many finite numbers as joints.
        """
        return pin.SE3(self._placed(q))

    def pose(self, q: npt.ArrayLike) -> FloatArray:
        """`forward` as a new array, (4, 4). Raises as it does."""
        T: FloatArray = self._placed(q).homogeneous
        return T

    def _placed(self, q: npt.ArrayLike) -> pin.SE3:
        """The tip's pose in the workspace: it changes with the next call."""
        pin.forwardKinematics(self.model, self._data, self._joints(q))
        return pin.updateFramePlacement(self.model, self._data, self._tip)

    def joint_frame(self, q: npt.ArrayLike, joint: int) -> pin.SE3:
        """Frame of one joint in the base frame.

        Args:
            q: joints, (n,); those behind `joint` do not matter.
            joint: 1 to n; 0 is the base itself.

        Raises:
            KinematicsError: not as many finite numbers as joints.
        """
        pin.forwardKinematics(self.model, self._data, self._joints(q))
        return pin.SE3(self._data.oMi[joint])

    def jacobian(self, q: npt.ArrayLike) -> FloatArray:
        """Geometric Jacobian at the tip, (6, n): rows vx vy vz wx wy wz, base axes.

        Raises:
            KinematicsError: not as many finite numbers as joints.
        """
        J = pin.computeFrameJacobian(
            self.model, self._data, self._joints(q), self._tip, pin.LOCAL_WORLD_ALIGNED
        )
        return np.array(J)

    def inverse(self, T_base_tip: Pose, q_seed: npt.ArrayLike) -> FloatArray:
        """The joints that bring the tip to a pose: the one solution inside the limits, (6,).

        Of the whole turns of roll that the limits leave open, the nearest to the seed's is taken.

        Raises:
            NoSolutionError: out of reach; names the joint and by how much.
            KinematicsError: no rigid pose, or a seed that is not as many finite numbers as joints.
        """
        rotation, p = split(T_base_tip)
        seed_roll = float(self._joints(q_seed)[ROLL])
        # Frame 6 = tip turned back: column k of R tip_rotation^T is R times row k.
        (ax, ay, az), (bx, by, bz) = self._to_frame6
        x = tuple(r[0] * ax + r[1] * ay + r[2] * az for r in rotation)
        z = tuple(r[0] * bx + r[1] * by + r[2] * bz for r in rotation)
        return np.array(closed_form.inverse(self._geometry(), x, z, p, seed_roll))

    def forward_batch(self, q: FloatArray) -> FloatArray:
        """Tip poses (N, 4, 4) of configurations (N, 6). Raises as `model.forward_batch`."""
        return forward_batch(self.description, q)

    def inverse_batch(
        self, T_base_tip: FloatArray, seed: FloatArray
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Joints (N, 6) and whether each is inside the limits. See `closed_form.inverse_batch`."""
        self._geometry()
        return closed_form.inverse_batch(self.description, T_base_tip, seed)

    def resolve(self, T_base_tip: FloatArray, q0: npt.ArrayLike) -> FloatArray:
        """The joints along a path of poses, roll continuous from `q0` on.

        Args:
            T_base_tip: poses in order, (N, 4, 4), m.
            q0: configuration before the first of them, (6,).

        Returns:
            Joints, (N, 6), all inside the limits.

        Raises:
            NoSolutionError: a pose is out of reach, or the roll's limits break the path; names
                joint, excess and the pose's index.
        """
        poses, start = checked_poses(T_base_tip, "T_base_tip"), self._joints(q0)
        q, ok = self.inverse_batch(poses, start)
        # The turn nearest to the start may be clipped by the limits: unwrap only what is inside.
        previous = float(start[ROLL])
        for i, roll in enumerate(q[:, ROLL].tolist()):
            if not ok[i]:
                cause = closed_form.no_solution(self._geometry(), tuple(q[i].tolist()))
                raise _at_index(cause, i)
            step = math.remainder(roll - previous, closed_form.TURN)
            previous += step
            excess = max(self.lower[ROLL] - previous, previous - self.upper[ROLL])
            if excess > closed_form.LIMIT_TOLERANCE:
                name = self._geometry().names[ROLL]
                raise NoSolutionError(
                    ROLL,
                    name,
                    previous,
                    float(excess),
                    f"pose {i}: following the path takes {name} {excess:.3g} rad outside its "
                    "limits; start with another turn of roll",
                )
            q[i, ROLL] = min(max(previous, self.lower[ROLL]), self.upper[ROLL])
        return q

    def rcm_error(self, q: npt.ArrayLike, port: npt.ArrayLike) -> float:
        """Distance of the shaft's axis from the registered port, m.

        Args:
            q: joints, (n,).
            port: where the trocar is, base frame, (3,) m. A PSM's shaft passes through the origin
                by mechanism, so a port there gives 0 whatever the joints.

        Raises:
            KinematicsError: not n, not three, or not finite numbers.
        """
        place = np.asarray(port, dtype=np.float64)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise KinematicsError(f"port is {port!r}; give three finite numbers in m")
        pin.forwardKinematics(self.model, self._data, self._joints(q))
        shaft = pin.updateFramePlacement(self.model, self._data, self._shaft)
        x, y, _ = shaft.actInv(place).tolist()
        return math.hypot(x, y)

    def _geometry(self) -> closed_form.PsmGeometry:
        if self._psm is None:
            raise KinematicsError(
                f"{self.description.robot} has no closed form; use IkSolver for this arm"
            )
        return self._psm

    def _joints(self, q: Any) -> FloatArray:
        """Finite float64 numbers, one a joint, or a `KinematicsError`."""
        joints = np.asarray(q, dtype=np.float64)
        if joints.shape != self._count:
            (count,) = self._count
            number = "six" if count == 6 else count
            raise KinematicsError(f"joints have shape {joints.shape}; give {number} numbers")
        if not math.isfinite(sum(q if q.__class__ is tuple else joints.tolist())):
            raise IkError("not-finite", f"joints {joints.tolist()} are not all finite; check them")
        return joints


def _at_index(error: NoSolutionError, index: int) -> NoSolutionError:
    """The same refusal, saying which pose of a path it is about."""
    return NoSolutionError(
        error.joint, error.name, error.value, error.excess, f"pose {index}: {error}"
    )
