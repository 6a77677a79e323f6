"""A scene, measured: the board and the things on it, touched by a calibrated arm or seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from viskill_deploy.calibrate.board import jaw_ends
from viskill_deploy.calibrate.landmarks import (
    Landmark,
    block_landmarks,
    board_landmarks,
    choose_landmarks,
)
from viskill_deploy.calibrate.pose_fit import PoseFit, fit_corners, fit_pose
from viskill_deploy.calibrate.registration import FEWEST
from viskill_deploy.calibrate.touch_book import TouchBook
from viskill_deploy.core.description import CellDescription, rpy_of
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.scene_files import BoardEntry, ObjectEntry, SceneFile
from viskill_deploy.core.types import FloatArray

BOARD = ""
"""Name of the board among the things."""

DIGITS = 12
"""Decimals of covariances: below a square micrometre there is nothing to say."""


def scene_landmarks(
    cell: CellDescription, index: int, things: Sequence[str], count: int
) -> tuple[Landmark, ...]:
    """What an arm has to touch: points of the board, and the corners of every thing.

    Raises:
        CalibrationError: too few are in reach, or the things are none that can be touched.
    """
    board = choose_landmarks(cell, index, board_landmarks(cell), count)
    corners = [mark for thing in things for mark in block_landmarks(cell, thing)]
    return (*board, *corners)


def touched_scene(
    cell: CellDescription, index: int, book: TouchBook, arm_m: float
) -> dict[str, PoseFit]:
    """Where the board ("") and the things are, by name.

    Args:
        cell: calibrated.
        index: of the arm that has touched them.
        book: its touches; names of points of things are `<thing>/<point>`.
        arm_m: what its calibration leaves, standard deviation of a coordinate.

    Raises:
        CalibrationError: a thing has too few touches, or they do not fit it; names it.
    """
    found = dict[str, PoseFit]()
    for thing, rows in _things(book).items():
        points, seen = _pairs(cell, index, book, rows)
        try:
            found[thing] = (fit_corners if thing else fit_pose)(points, seen, arm_m)
        except CalibrationError as error:
            raise CalibrationError(f"{thing or 'the board'}: {error}") from error
    return found


def off_of_things(cell: CellDescription, index: int, book: TouchBook) -> FloatArray:
    """How far each touch is from where the pose of its thing has it, (n,) m.

    Raises:
        CalibrationError: as `touched_scene`.
    """
    off, fits = np.zeros(len(book.touches)), touched_scene(cell, index, book, 0.0)
    for thing, rows in _things(book).items():
        if len(rows) > FEWEST:  # three points do not say which of them is wrong
            off[rows] = fits[thing].distances_m
    return off


def scene_file(
    cell: CellDescription,
    poses: Mapping[str, tuple[FloatArray, FloatArray]],
    active: str,
    goal: FloatArray,
    board: PoseFit | None = None,
) -> SceneFile:
    """What was measured, ready to be written.

    Args:
        cell: in whose task frame it is.
        poses: pose (4, 4) and covariance (6, 6) of every thing, by name.
        active: which is to be moved.
        goal: where to, (3,) m.
        board: where the board was found.

    Raises:
        ValueError: it makes no scene: a board out of its place, an active thing that is not there.
    """
    entry = None
    if board is not None:
        held_out = board.held_out_m[np.isfinite(board.held_out_m)]
        median = float(np.median(held_out)) if len(held_out) else None
        entry = BoardEntry.model_validate(
            _entry(board.T, board.covariance) | {"held_out_m": median}
        )
    things = [
        ObjectEntry.model_validate(_entry(T, covariance) | {"name": name})
        for name, (T, covariance) in poses.items()
    ]
    return SceneFile.model_validate(
        {
            "schema": 1,
            "cell": cell.name,
            "active": active,
            "goal_m": goal.tolist(),
            "board": entry,
            "object": things,
        }
    )


def goal_of(cell: CellDescription, text: str) -> FloatArray:
    """A goal such as "peg2", where a thing of the cell's kind rests, or "x,y,z" in m.

    Raises:
        CalibrationError: it is neither.
    """
    board, block = cell.file.board, cell.file.block
    if text.startswith("peg") and text[3:].isdecimal() and board is not None and block is not None:
        if int(text[3:]) >= len(board.peg_xy_m):
            raise CalibrationError(
                f"the goal {text} is none of peg0 … peg{len(board.peg_xy_m) - 1}"
            )
        return np.array([*board.peg_xy_m[int(text[3:])], block.height_m / 2.0])
    try:
        goal = np.array([float(part) for part in text.split(",")])
    except ValueError:
        goal = np.zeros(0)
    if goal.shape != (3,):
        raise CalibrationError(f"the goal {text!r} is no place; say peg2, or x,y,z in m")
    return goal


def _entry(T: FloatArray, covariance: FloatArray) -> dict[str, object]:
    C = np.round((covariance + covariance.T) / 2.0, DIGITS)
    return {
        "position_m": np.round(T[:3, 3], 7).tolist(),
        "rotation_rpy_rad": [round(angle, 6) for angle in rpy_of(T[:3, :3])],
        "covariance": C.tolist(),
    }


def _things(book: TouchBook) -> dict[str, list[int]]:
    """Rows of the touches of everything that has some, by name of the thing."""
    rows = dict[str, list[int]]()
    for row, name in enumerate(book.touches):
        thing = name.rpartition("/")[0]
        rows.setdefault(thing, []).append(row)
    return rows


def _pairs(
    cell: CellDescription, index: int, book: TouchBook, rows: list[int]
) -> tuple[FloatArray, FloatArray]:
    """Points of a thing in its own frame, and where they were touched, task frame."""
    m = book.measurements().chosen(np.array(rows))
    return m.points, jaw_ends(cell, index, m.joints, m.point_m)
