"""Differential inverse kinematics as a QP, one solve a tick, for any serial arm.

Over one step of length dt the joint velocities v minimise, in velocity units,

    |W (J v - gain log6(T^-1 T_target) / dt - feedforward)|^2 + damping |v|^2 (+ port rows)

inside a box that keeps position, speed and acceleration limits (`limits.velocity_box`). J and the
error are those of the tip in its own axes: a constant body twist log6/dt for dt leads exactly to
the target (Lynch and Park, Modern Robotics, section 6.2). Whatever solver is used, its answer is
taken only if it is finite, inside the box, and fulfils the optimality conditions.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from viskill_deploy.core.errors import IkError, KinematicsError, NoSolutionError
from viskill_deploy.core.types import FloatArray, Joints
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.kinematics.limits import JointLimits
from viskill_deploy.kinematics.model import TIP_FRAME
from viskill_deploy.kinematics.optimality import (
    RESIDUAL_TOLERANCE,
    check_rows,
    is_free_minimum,
    onto_box,
    optimality,
)
from viskill_deploy.kinematics.port import PortConstraint, PortRows
from viskill_deploy.kinematics.pose import Pose, as_se3, checked_poses
from viskill_deploy.kinematics.qp import make_solver

LEAST_DAMPING = 1e-11
"""Of the heaviest soft row's square: further apart, double precision runs out of digits."""

CONVERGED = 1e-9
"""`solve` ends when no joint moves more than this in an iteration, rad or m."""

NEWTON_STEP_S = 0.2
"""An iteration of `solve` moves each joint by no more than its speed limit does in this time."""


class IkSolution(NamedTuple):
    """Where the joints go, and how it came about.

    Attributes:
        q: positions at the end of the step, (n,) rad and m.
        v: velocities that lead there, (n,).
        residual: largest violation of the optimality conditions, relative; near 0 when solved.
        active: per joint 1 where its upper bound holds it back from the task, -1 where its lower
            one does, 0 where neither does.
        iterations: solves that it took.
    """

    q: Joints
    v: Joints
    residual: float
    active: tuple[int, ...]
    iterations: int = 1

    @property
    def is_limited(self) -> bool:
        """Whether a bound kept the arm from what the task asked for."""
        return any(self.active)


class IkSolver:
    """Velocity-level IK of one frame of one serial model. Keeps its workspace: one per thread.

    Args:
        model: any serial chain of one-degree joints that Pinocchio can hold.
        frame: name of the frame to lead.
        limits: of the joints.
        port: a shaft that has to pass through a port, or None.
        solver: "daqp", or any solver that qpsolvers knows by name.
        time_limit_s: wall-clock bound of one solve, 0 for none. Work is bounded in any case.
        gain: part of the pose error that one step closes, (0, 1].
        lever_m: how many metres of error weigh as much as one radian.
        orientation_cost: weight of the orientation rows; 0 leads the position alone.
        damping: keeps the problem definite at singularities; take about 1e-6 for redundant arms.

    Raises:
        KinematicsError: the model does not fit, or the solver is not installed.
    """

    def __init__(
        self,
        model: pin.Model,
        frame: str,
        limits: JointLimits,
        *,
        port: PortConstraint | None = None,
        solver: str = "daqp",
        time_limit_s: float = 0.0,
        gain: float = 1.0,
        lever_m: float = 0.05,
        orientation_cost: float = 1.0,
        damping: float = 1e-9,
    ) -> None:
        n = model.nv
        if model.nq != n or len(limits.lower) != n:
            raise KinematicsError(
                f"the model has {model.nq} positions and {n} velocities for {len(limits.lower)} "
                "limits; give a chain of one-degree joints and limits for each"
            )
        if not model.existFrame(frame):
            raise KinematicsError(f"the model has no frame {frame!r}; name one that it has")
        if not (0.0 < gain <= 1.0 and lever_m > 0.0 and orientation_cost >= 0.0 and damping > 0.0):
            raise KinematicsError(
                "gain must lie in (0, 1], lever_m and damping above 0; correct it"
            )
        self.model, self.limits, self.port = model, limits, port
        self._data, self._frame = model.createData(), model.getFrameId(frame)
        self._gain, self._n = gain, n
        self._port = PortRows(model, port) if port else None
        self._soft = port is not None and port.mode == "soft"
        self._solver = make_solver(solver, n, 2 if port and not self._soft else 0, time_limit_s)
        # One stack of weighted rows S and offsets b, |S v + b|^2: task, soft port, damping.
        self._stack, self._rhs = np.zeros((8 + n, n)), np.zeros(8 + n)
        if port and self._soft:
            damping = max(damping, LEAST_DAMPING * port.weight**2)
        self._damping = math.sqrt(damping)
        self._stack[8:] = self._damping * np.eye(n)
        self._task, self._task_rhs = self._stack[:6], self._rhs[:6]
        self._weights = np.array([1 / lever_m] * 3 + [orientation_cost] * 3)
        self._row_weights = np.repeat(self._weights[:, None], n, axis=1)
        self._rate, self._rated_weights = math.nan, self._weights
        self._nothing_active = (0,) * n
        self._arm: Arm | None = None

    @classmethod
    def for_arm(cls, arm: Arm, limits: JointLimits | None = None, **options: Any) -> IkSolver:
        """A solver for the tip of an arm.

        Args:
            arm: the arm.
            limits: to keep; `JointLimits.planning` of the arm when None.
            options: of `IkSolver`.
        """
        chosen = limits or JointLimits.planning(arm.description)
        solver = cls(arm.model, TIP_FRAME, chosen, **options)
        solver._arm = arm if arm.description.has_remote_centre else None
        return solver

    def step(
        self,
        q: npt.ArrayLike,
        v_prev: npt.ArrayLike,
        T_target: Pose,
        dt: float,
        v_feedforward: npt.ArrayLike | None = None,
        v_preferred: npt.ArrayLike | None = None,
    ) -> IkSolution:
        """One tick: the joints at its end, as near to the target as the limits allow.

        Args:
            q: positions now, (n,).
            v_prev: velocities of the tick before, (n,).
            T_target: where the frame shall be at the end of the tick, in the base frame.
            dt: length of the tick, s.
            v_feedforward: twist of the target besides, in the frame's axes, linear first, (6,).
            v_preferred: joint velocities to be near to, as far as the task leaves it open, (n,);
                standing still when None. For arms with more joints than the task needs.

        Raises:
            IkError: "not-finite", "bad-bounds", "infeasible", "outside-box", "residual" or "time";
                nothing is returned that failed a check.
            KinematicsError: wrong shapes, or a target that is no rigid pose.
        """
        if not 0.0 < dt < math.inf:
            raise IkError("not-finite", f"dt is {dt}; give the positive length of the tick in s")
        now, before = self._floats(q, "q"), self._floats(v_prev, "v_prev")
        lower, upper = self.limits.velocity_box(now, before, dt)
        self._place_task(np.array(now), as_se3(T_target), self._gain / dt)
        if v_feedforward is not None:
            twist = np.asarray(v_feedforward, dtype=np.float64)
            if twist.shape != (6,) or not np.isfinite(twist).all():
                raise IkError("not-finite", "v_feedforward must be six finite numbers; check it")
            self._task_rhs -= self._weights * twist
        if v_preferred is not None:
            wish = np.array(self._floats(v_preferred, "v_preferred"))
            np.multiply(-self._damping, wish, out=self._rhs[8:])
        try:
            v, residual, active = self._solve(lower, upper, dt)
        finally:
            if v_preferred is not None:
                self._rhs[8:] = 0.0
        after = tuple([p + speed * dt for p, speed in zip(now, v, strict=True)])
        return IkSolution(after, tuple(v), residual, active)

    def solve(self, T_target: Pose, q_seed: npt.ArrayLike, max_iterations: int = 50) -> IkSolution:
        """The joints that bring the frame to a pose, inside the position limits, from a seed.

        Raises:
            IkError: "residual" when it does not get there; and as `step`.
            KinematicsError: as `step`.
        """
        target = as_se3(T_target)
        now = self._floats(q_seed, "q_seed")
        v: list[float] = []
        for iteration in range(1, max_iterations + 1):
            reach = [NEWTON_STEP_S * speed for speed in self.limits.velocity]
            rows = list(zip(now, self.limits.lower, self.limits.upper, reach, strict=True))
            lower = [min(max(low - p, -step), step) for p, low, _, step in rows]
            upper = [max(min(high - p, step), -step) for p, _, high, step in rows]
            self._place_task(np.array(now), target, 1.0)
            error = float(np.abs(self._task_rhs).max())
            v, residual, active = self._solve(lower, upper, 1.0)
            now = [p + step for p, step in zip(now, v, strict=True)]
            if max(map(abs, v)) < CONVERGED:
                if error > 1e-6 and self.port is None:
                    break
                return IkSolution(tuple(now), (0.0,) * self._n, residual, active, iteration)
        raise IkError(
            "residual",
            f"no configuration found in {max_iterations} iterations from this seed; choose a "
            "reachable pose or a nearer seed",
        )

    def resolve(self, T_base_frame: FloatArray, q0: npt.ArrayLike) -> FloatArray:
        """The joints along a path of poses: a PSM's by closed form, another arm's pose by pose.

        Args:
            T_base_frame: poses in order, (N, 4, 4), m.
            q0: configuration before the first, (n,).

        Returns:
            Joints inside the position limits, (N, n).

        Raises:
            NoSolutionError: a PSM's pose is out of reach of these limits.
            IkError: another arm's is not reached.
        """
        if self._arm is not None and self.port is None:
            return self._within_limits(self._arm.resolve(T_base_frame, q0))
        seed = np.asarray(q0, dtype=np.float64)
        rows = []
        for pose in checked_poses(T_base_frame, "T_base_frame"):
            seed = np.array(self.solve(pose, seed).q)
            rows.append(seed)
        return np.array(rows).reshape(-1, self._n)

    def port_distance(self, q: npt.ArrayLike) -> float:
        """Distance of the shaft from the port at a configuration, m; 0 without a port."""
        if self._port is None:
            return 0.0
        pin.computeJointJacobians(self.model, self._data, np.array(self._floats(q, "q")))
        return math.hypot(*self._port.evaluate(self._data)[0].tolist())

    def _floats(self, values: npt.ArrayLike, name: str) -> list[float]:
        """`values` as plain floats, n of them and finite."""
        floats: list[float] = (
            list(values) if isinstance(values, tuple) else np.asarray(values, np.float64).tolist()
        )
        if not isinstance(floats, list) or len(floats) != self._n:
            raise KinematicsError(f"{name} must be {self._n} numbers; got {values!r}")
        if not math.isfinite(sum(floats)):
            raise IkError("not-finite", f"{name} is {floats}; check where it comes from")
        return floats

    def _place_task(self, q: FloatArray, target: pin.SE3, rate: float) -> None:
        """Writes the task's rows for a configuration, the error to be closed at `rate` per s."""
        pin.computeJointJacobians(self.model, self._data, q)
        tip = pin.updateFramePlacement(self.model, self._data, self._frame)
        J = pin.getFrameJacobian(self.model, self._data, self._frame, pin.LOCAL)
        np.multiply(self._row_weights, J, out=self._task)
        if rate != self._rate:
            self._rate, self._rated_weights = rate, self._weights * -rate
        np.multiply(self._rated_weights, pin.log6(tip.actInv(target)).vector, out=self._task_rhs)

    def _solve(
        self, lower: list[float], upper: list[float], dt: float
    ) -> tuple[list[float], float, tuple[int, ...]]:
        """Solves the QP for the rows in place, and checks the answer."""
        rows = None
        if self._port is not None:
            offset, rate = self._port.evaluate(self._data)
            if self._soft:
                assert self.port is not None
                np.multiply(self.port.weight, rate, out=self._stack[6:8])
                np.multiply(self.port.weight / dt, offset, out=self._rhs[6:8])
            else:
                rows = (rate, *self._port.band(offset, dt))
        H, f = self._stack.T.dot(self._stack), self._rhs.dot(self._stack)
        x, multipliers = self._solver.solve(H, f, lower, upper, rows)
        v, gradient = x.tolist(), H.dot(x) + f
        if rows is not None and multipliers is not None:
            gradient += multipliers.dot(rows[0])
            check_rows(rows, multipliers, x)
        slopes = gradient.tolist()
        if is_free_minimum(v, slopes, lower, upper):
            return v, max(map(abs, slopes)), self._nothing_active
        inside = onto_box(v, lower, upper)
        slopes = (gradient + H.dot(np.array(inside) - x)).tolist()
        residual, active = optimality(inside, slopes, lower, upper)
        residual /= 1.0 + float(np.abs(f).max())
        if not residual <= RESIDUAL_TOLERANCE:
            raise IkError(
                "residual", f"the solver's answer is not optimal ({residual:.2g}); try another"
            )
        return inside, residual, active

    def _within_limits(self, q: FloatArray) -> FloatArray:
        """`q` (N, n) if inside these limits, which may be tighter than the arm's own."""
        lower, upper = np.array(self.limits.lower), np.array(self.limits.upper)
        excess = np.maximum(lower - q, q - upper)
        if len(q) and excess.max() > CONVERGED:
            i, j = map(int, np.unravel_index(int(excess.argmax()), excess.shape))
            name = self.model.names[j + 1]
            raise NoSolutionError(
                j,
                name,
                float(q[i, j]),
                float(excess[i, j]),
                f"pose {i} needs {name} = {q[i, j]:.6g}, {excess[i, j]:.3g} outside the limits "
                f"[{lower[j]:.6g}, {upper[j]:.6g}] of the plan; move the path inwards",
            )
        return q
