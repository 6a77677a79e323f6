"""Poses of touched things, ports of shafts: honest, and refused where the data say nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from measured_arm import rotation

from viskill_deploy.calibrate.landmarks import block_landmarks, board_landmarks
from viskill_deploy.calibrate.port import port_of, register_port
from viskill_deploy.calibrate.pose_fit import TOUCH_M, fit_corners, fit_pose
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.motion.resolve import task_poses

CELL = load_cell("bipegtransfer")
BOARD = np.array([mark.position for mark in board_landmarks(CELL)])
CORNERS = np.array([mark.position for mark in block_landmarks(CELL)])


def pose(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(np.array(turn)), shift
    return T


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def test_a_board_is_found_and_its_covariance_is_honest() -> None:
    T, scores = pose((0.01, -0.02, 0.05), (0.004, -0.003, 0.001)), []
    for seed in range(15):
        noise = np.random.default_rng(seed).normal(0.0, TOUCH_M, BOARD.shape)
        fit = fit_pose(BOARD, moved(T, BOARD) + noise)
        off = fit.T[:3, 3] - T[:3, 3]
        turn = fit.T[:3, :3] @ T[:3, :3].T
        small = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
        x = np.concatenate([off, small])
        scores.append(x @ np.linalg.solve(fit.covariance, x))
    assert np.mean(scores) == pytest.approx(6.0, rel=0.45)  # chi square of six
    assert fit.turn_rad == pytest.approx(np.linalg.norm([0.01, -0.02, 0.05]), abs=0.01)
    assert 0.3 * TOUCH_M < np.nanmedian(fit.held_out_m) < 4 * TOUCH_M


def test_what_the_arm_gets_wrong_is_not_averaged_away() -> None:
    plain, coarse = (fit_pose(BOARD, BOARD, arm_m) for arm_m in (0.0, 0.001))
    np.testing.assert_allclose(
        np.diag(coarse.covariance)[:3] - np.diag(plain.covariance)[:3], 1e-6, rtol=1e-9
    )


def test_one_wrong_touch_is_left_out_and_shows() -> None:
    seen = BOARD.copy()
    seen[4] += [0.0, 0.02, 0.0]
    fit = fit_pose(BOARD, seen)
    assert np.flatnonzero(~fit.is_inlier).tolist() == [4]
    np.testing.assert_allclose(fit.T, np.eye(4), atol=1e-9)
    assert fit.held_out_m[4] == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 2, 0], [2, 1, 0], [0, 2, 1]])
def test_a_block_is_found_whichever_corner_was_touched_first(order: list[int]) -> None:
    T = pose((0.0, 0.0, 0.4), (0.013, -0.027, 0.00725))
    fit = fit_corners(CORNERS, moved(T, CORNERS)[order], 0.0003)
    np.testing.assert_allclose(fit.T, T, atol=1e-9)
    assert np.isnan(fit.held_out_m).all()
    sigma = np.sqrt(np.diag(fit.covariance))
    assert 2e-4 < sigma[0] < 6e-4
    assert 0.02 < sigma[5] < 0.08


@pytest.mark.parametrize(
    ("points", "seen", "words"),
    [
        (CORNERS[:2], CORNERS[:2], "at least 3"),
        (BOARD[4:7], BOARD[4:7], "one line"),
        (CORNERS, np.full((3, 3), np.nan), "not finite"),
        (CORNERS, CORNERS * 1e3, "no pose brings"),
        (CORNERS, CORNERS * [1.0, 1.4, 1.0], "no pose brings"),
        (BOARD, BOARD[::-1], "no pose brings"),
        (BOARD, np.tile(BOARD[0], (len(BOARD), 1)), "one line"),
    ],
)
def test_points_that_fix_no_pose_are_refused(
    points: np.ndarray, seen: np.ndarray, words: str
) -> None:
    with pytest.raises(CalibrationError, match=words):
        fit_pose(points, seen)


def test_a_block_on_its_side_is_refused() -> None:
    with pytest.raises(CalibrationError, match="on its side"):
        fit_corners(CORNERS, moved(pose((np.pi / 2, 0.0, 0.0), (0.0, 0.0, 0.0)), CORNERS))


def lines(n: int, seed: int, noise_m: float, spread: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Shafts through (0.01, -0.02, 0.15), each seen at some depth."""
    rng = np.random.default_rng(seed)
    u = np.column_stack([rng.uniform(-spread, spread, (n, 2)), -np.ones(n)])
    depth = rng.uniform(0.03, 0.1, (n, 1))
    return np.array([0.01, -0.02, 0.15]) + depth * u + rng.normal(0.0, noise_m, (n, 3)), u


def test_a_port_is_found_through_wrong_lines_and_its_covariance_is_honest() -> None:
    scores = []
    for seed in range(15):
        points, u = lines(20, seed, 3e-4)
        points[:3] += 0.01
        port = register_port(points, u)
        assert not port.is_inlier[:3].any()
        off = port.position - [0.01, -0.02, 0.15]
        scores.append(off @ np.linalg.solve(port.covariance, off))
    assert np.mean(scores) == pytest.approx(3.0, rel=0.6)  # chi square of three
    assert port.rms_m == pytest.approx(3e-4 * np.sqrt(2.0), rel=0.4)


def test_lines_that_fix_no_port_are_refused() -> None:
    points, u = lines(20, 0, 0.0)
    with pytest.raises(CalibrationError, match="at least 4"):
        register_port(points[:3], u[:3])
    with pytest.raises(CalibrationError, match="one direction"):
        register_port(*lines(20, 0, 0.0, spread=0.03))
    with pytest.raises(CalibrationError, match="look like mm"):
        register_port(points * 1e3, u)
    with pytest.raises(CalibrationError, match="not finite"):
        register_port(points, np.full_like(u, np.nan))
    with pytest.raises(CalibrationError, match="no length"):
        register_port(points, np.vstack([u[:19], np.zeros((1, 3))]))
    rng = np.random.default_rng(0)
    with pytest.raises(CalibrationError, match="no point in common"):
        register_port(points + rng.normal(0.0, 0.01, points.shape), u)
    with pytest.raises(CalibrationError, match="one direction"):
        register_port(np.tile(points[:1], (20, 1)), np.tile(u[:1], (20, 1)))  # one pose, repeated


def test_a_psms_port_is_its_remote_centre_and_far_from_it_another_arms(tmp_path: Path) -> None:
    arm, other = CELL.arms
    u = lines(12, 1, 0.0)[1]
    points = arm.T_task_base[:3, 3] + 0.05 * u
    path = tmp_path / "PSM1_shaft.csv"
    rows = [",".join(map(repr, row)) for row in np.hstack([points, u]).tolist()]
    path.write_text("\n".join(["x_m,y_m,z_m,ux,uy,uz", *rows]) + "\n")
    np.testing.assert_allclose(port_of(arm, path).position, 0.0, atol=1e-9)
    with pytest.raises(CalibrationError, match="mm from PSM2's remote centre"):
        port_of(other, path)
    path.write_text("x_m,y_m,z_m\n0,0,0\n")
    with pytest.raises(CalibrationError, match="needs numbers in the columns x_m"):
        port_of(arm, path)
    with pytest.raises(CalibrationError, match="cannot be read"):
        port_of(arm, tmp_path / "none.csv")


def test_an_own_arms_port_is_found_from_its_joints(tmp_path: Path) -> None:
    cell = load_cell("bodytrainer")
    (arm,) = cell.arms
    rng, goal = np.random.default_rng(0), arm.T_task_base[:3, :3] @ arm.port_in_base
    port = arm.T_task_base[:3, 3] + goal
    rows = []
    for _ in range(12):  # joints whose shaft goes through the port, by Newton on two of them
        q = np.array(arm.entry.start_joints_si) + rng.normal(0.0, 0.15, 7)
        for _ in range(8):
            base = _across(cell, q, port)
            J = np.column_stack(
                [(_across(cell, q + 1e-6 * e, port) - base) / 1e-6 for e in np.eye(7)]
            )
            q -= np.linalg.lstsq(J, base, rcond=None)[0]
        rows.append(",".join(map(repr, q.tolist())))
    path = tmp_path / "ARM1_shaft.csv"
    path.write_text("\n".join([",".join(f"q{i}_rad" for i in range(1, 8)), *rows]) + "\n")
    np.testing.assert_allclose(port_of(arm, path).position, arm.entry.port_in_base_m, atol=1e-6)


def _across(cell: object, q: np.ndarray, port: np.ndarray) -> np.ndarray:
    T = task_poses(cell, 0, q[None])[0]  # type: ignore[arg-type]
    return np.asarray((T[:3, :3].T @ (port - T[:3, 3]))[:2])
