"""Doors to the QP solvers: minimise x'Hx/2 + f'x with lb <= x <= ub and lo <= A x <= hi.

What a solver says about itself is not believed. daqp and quadprog report success with NaN for NaN
input, osqp reports success with its old bounds when new ones cross, proxqp returns the previous
answer or hangs: callers check the input before and the answer after.
"""

from __future__ import annotations

import warnings
from operator import le
from typing import Any, Protocol

import daqp
import eigenpy  # type: ignore[import-untyped] # comes with pinocchio
import numpy as np

from viskill_deploy.core.errors import IkError, KinematicsError
from viskill_deploy.core.types import FloatArray

ITERATION_LIMIT = 500
"""Bounds daqp's work whatever the clock does; six boxed joints take fewer than 20."""

OPTIONS: dict[str, dict[str, Any]] = {
    "osqp": {"eps_abs": 1e-10, "eps_rel": 1e-10, "max_iter": 4000, "raise_error": False},
    "proxqp": {"eps_abs": 1e-10, "max_iter": 500},
}
"""What a solver of qpsolvers needs to be exact enough and bounded; the rest run on defaults.

No polishing for osqp: it prints to standard output."""


class QpSolver(Protocol):
    """Solves one QP after another of the same size."""

    def solve(
        self,
        H: FloatArray,
        f: FloatArray,
        lb: list[float],
        ub: list[float],
        rows: tuple[FloatArray, FloatArray, FloatArray] | None,
    ) -> tuple[FloatArray, FloatArray | None]:
        """The minimiser (n,) and the multipliers (m,) of the rows, positive at their upper bound.

        Args:
            H: positive definite, (n, n).
            f: linear term, (n,).
            lb: lower bounds, n of them.
            ub: upper bounds, n of them.
            rows: A (m, n), lo (m,), hi (m,), or None.

        Raises:
            IkError: "infeasible", or "time" when a bound on work was hit.
        """
        ...


class Daqp:
    """daqp with its workspace kept: an active-set solver, exact and the fastest for our sizes.

    The empty active set is tried first, by Cholesky: where no bound is in the way the minimiser
    without bounds is the answer, and daqp's own workspace need not be filled.

    Args:
        joints: number of variables.
        rows: number of general rows.
        time_limit_s: wall-clock bound of one solve, s; 0 for none. The iteration limit bounds the
            work anyway and is the same on a busy machine.
    """

    def __init__(self, joints: int, rows: int, time_limit_s: float = 0.0) -> None:
        self._n = joints
        self._cholesky = eigenpy.LLT(joints)
        self._model = daqp.Model()
        self._model.setup(
            np.eye(joints),
            np.zeros(joints),
            np.zeros((rows, joints)),
            np.ones(joints + rows),
            -np.ones(joints + rows),
        )
        self._model.settings = self._model.settings | {
            "primal_tol": 1e-10,
            "iter_limit": ITERATION_LIMIT,
            "time_limit": time_limit_s,
        }

    def solve(
        self,
        H: FloatArray,
        f: FloatArray,
        lb: list[float],
        ub: list[float],
        rows: tuple[FloatArray, FloatArray, FloatArray] | None,
    ) -> tuple[FloatArray, FloatArray | None]:
        """See `QpSolver.solve`."""
        if rows is None:
            self._cholesky.compute(H)
            x = -self._cholesky.solve(f)
            free = x.tolist()
            if all(map(le, lb, free)) and all(map(le, free, ub)):
                return x, None
            self._model.update(H, f, None, np.array(ub), np.array(lb))
        else:
            A, low, high = rows
            self._model.update(
                H, f, A, np.array([*ub, *high.tolist()]), np.array([*lb, *low.tolist()])
            )
        x, _, flag, info = self._model.solve()
        if flag <= 0:
            cause = {-1: "infeasible", -4: "time", -7: "time"}.get(flag, "residual")
            raise IkError(cause, f"daqp stopped with flag {flag}; hold and check bounds and port")
        return x, None if rows is None else info["lam"][self._n :]


class Osqp:
    """osqp with its workspace kept: only the numbers of a problem change from tick to tick.

    Ten times faster than the same solver through qpsolvers, which sets it up anew. The step size
    of its iteration is adapted after a fixed count, not after a measured time: the same problem has
    the same answer on a busy machine.

    Args:
        joints: number of variables.
        rows: number of general rows.
        time_limit_s: wall-clock bound of one solve, s; 0 for none.
    """

    def __init__(self, joints: int, rows: int, time_limit_s: float = 0.0) -> None:
        row, column = np.triu_indices(joints)
        by_column = np.lexsort((row, column))
        self._upper = row[by_column], column[by_column]
        self._n, self._m, self._time_limit_s = joints, rows, time_limit_s
        self._set_up()

    def _set_up(self) -> None:
        import osqp  # noqa: PLC0415 - half a second that the default solver does not need
        from scipy import sparse  # type: ignore[import-untyped] # noqa: PLC0415 - likewise

        n, m = self._n, self._m
        options = OPTIONS["osqp"] | {"verbose": False, "adaptive_rho_interval": 25}
        del options["raise_error"]
        if self._time_limit_s:
            options["time_limit"] = self._time_limit_s
        self._solver = osqp.OSQP()
        self._solver.setup(
            sparse.csc_matrix(np.triu(np.ones((n, n)))),
            np.zeros(n),
            sparse.csc_matrix(np.vstack([np.ones((m, n)), np.eye(n)])),
            -np.ones(m + n),
            np.ones(m + n),
            check_termination=5,
            **options,
        )

    def solve(
        self,
        H: FloatArray,
        f: FloatArray,
        lb: list[float],
        ub: list[float],
        rows: tuple[FloatArray, FloatArray, FloatArray] | None,
    ) -> tuple[FloatArray, FloatArray | None]:
        """See `QpSolver.solve`."""
        A, low, high = rows if rows is not None else (np.zeros((0, self._n)), (), ())
        self._solver.update(
            q=f,
            l=np.array([*low, *lb]),
            u=np.array([*high, *ub]),
            Px=H[self._upper],
            Ax=np.vstack([A, np.ones(self._n)]).T.ravel(),
        )
        result = self._solver.solve(raise_error=False)
        if result.info.status_val != 1:
            self._set_up()  # a failed solve may leave its numbers behind
            cause = "time" if "time" in result.info.status else "infeasible"
            raise IkError(cause, f"osqp: {result.info.status}; hold and check limits")
        return result.x, None if rows is None else result.y[: self._m]


class QpsolversDoor:
    """Any solver of qpsolvers by name. Built anew each time: 10 to 100 times slower.

    Args:
        name: as qpsolvers knows it.
        time_limit_s: wall-clock bound of one solve for the solvers that have one; 0 for none.

    Raises:
        KinematicsError: not installed; names those that are.
    """

    def __init__(self, name: str, time_limit_s: float = 0.0) -> None:
        import qpsolvers  # noqa: PLC0415 - half a second that the default solver does not need
        from scipy import sparse  # noqa: PLC0415 - likewise

        if name not in qpsolvers.available_solvers:
            have = ", ".join(qpsolvers.available_solvers)
            raise KinematicsError(f"no QP solver {name!r}; install it or choose one of {have}")
        self._name, self._qpsolvers = name, qpsolvers
        self._convert = np.asarray if name in qpsolvers.dense_solvers else sparse.csc_matrix
        self._options = dict(OPTIONS.get(name, {}))
        if time_limit_s and name in {"osqp", "clarabel", "highs", "scs"}:
            self._options["time_limit"] = time_limit_s

    def solve(
        self,
        H: FloatArray,
        f: FloatArray,
        lb: list[float],
        ub: list[float],
        rows: tuple[FloatArray, FloatArray, FloatArray] | None,
    ) -> tuple[FloatArray, FloatArray | None]:
        """See `QpSolver.solve`."""
        G, h = (None, None)
        if rows is not None:
            A, lo, hi = rows
            G, h = self._convert(np.vstack([A, -A])), np.concatenate([hi, -lo])
        problem = self._qpsolvers.Problem(
            self._convert(H), f, G, h, None, None, np.array(lb), np.array(ub)
        )
        try:
            with warnings.catch_warnings():
                # What it warns of (no solution, changes to come) ends as an IkError or not at all.
                warnings.simplefilter("ignore")
                solution = self._qpsolvers.solve_problem(problem, self._name, **self._options)
        except self._qpsolvers.exceptions.QPError as error:
            raise IkError("infeasible", f"{self._name}: {error}; hold and check limits") from error
        if not solution.found or solution.x is None:
            raise IkError("infeasible", f"{self._name} found no solution; hold and check limits")
        if rows is None:
            return solution.x, None
        count = len(rows[1])
        return solution.x, solution.z[:count] - solution.z[count:]


def make_solver(name: str, joints: int, rows: int, time_limit_s: float) -> QpSolver:
    """The solver called `name`: daqp and osqp keep their workspace, others go through qpsolvers."""
    if name == "daqp":
        return Daqp(joints, rows, time_limit_s)
    if name == "osqp":
        return Osqp(joints, rows, time_limit_s)
    return QpsolversDoor(name, time_limit_s)
