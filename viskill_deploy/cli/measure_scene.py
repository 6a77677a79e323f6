"""`viskill calibrate scene`: where the board and the things on it are, touched or seen."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydantic import ValidationError

from viskill_deploy.calibrate.board import arm_error_m
from viskill_deploy.calibrate.pose_fit import PoseFit
from viskill_deploy.calibrate.scene import (
    BOARD,
    goal_of,
    off_of_things,
    scene_file,
    scene_landmarks,
    touched_scene,
)
from viskill_deploy.calibrate.seen_poses import averaged, look_on, read_looks, write_looks
from viskill_deploy.calibrate.touching import touch
from viskill_deploy.calibrate.truths import hidden_robot
from viskill_deploy.cli import touching
from viskill_deploy.cli.poses_found import mean_facts, mean_words, pose_facts, pose_words
from viskill_deploy.cli.reaching import Carrier, Domain, Interface, TransportChoice
from viskill_deploy.cli.sources import Calibration, Cell, Truth
from viskill_deploy.cli.touching import TOUCH_NOISE_M, TouchedBy, TouchedRobot, touched_by
from viskill_deploy.core.calibration_files import calibrated, is_simulated, read_calibration
from viskill_deploy.core.clock import MonotonicClock, wall_time
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.scene_files import write_scene
from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.runtime.robots import NAME, await_poses
from viskill_deploy.runtime.topic_poses import TopicPoses
from viskill_deploy.sim.tasks.base import load_task

EXAMPLE = (
    "Example: viskill calibrate scene runs/scene -o scene.toml --robot lab.toml "
    "--calibration lab.json --driver crtk"
)

FRESH_S = 3600.0
"""Touches older than this are not gone on with."""

LOOKS = "poses.csv"
"""What a tracker said, beside the touches."""


def command(
    folder: Annotated[Path, typer.Argument(help="Where touches and looks are kept.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The scene file to write.")],
    cell: Cell = "bipegtransfer",
    calibration: Calibration = None,
    active: Annotated[str, typer.Option(help="The thing to be moved.")] = "block0",
    goal: Annotated[str, typer.Option(help="Where to: peg2, or x,y,z in m.")] = "peg2",
    things: Annotated[
        str, typer.Option(help="Such as block0,block1; the one to be moved by default.")
    ] = "",
    arm: Annotated[str, typer.Option(help="Who touches; the cell's last arm by default.")] = "",
    points: Annotated[
        int, typer.Option(min=4, help="Points of the board that are touched, of 3 needed.")
    ] = 8,
    pose_topic: Annotated[
        str,
        typer.Option(help="Look instead of touching: topics such as /scene/{object}/measured_cp."),
    ] = "",
    seconds: Annotated[float, typer.Option(min=0.5, help="How long is looked.")] = 3.0,
    poses: Annotated[
        Path | None, typer.Option(help="Or take the looks of this file, CSV, see docs.")
    ] = None,
    accuracy: Annotated[
        float, typer.Option(min=0, help="What a tracker gets wrong at every look alike, m.")
    ] = 0.0005,
    accuracy_rad: Annotated[float, typer.Option(min=0, help="The same of a turn, rad.")] = 0.01,
    driver: touching.Driver = TouchedRobot.LOOPBACK,
    transport: Carrier = TransportChoice.AUTO,
    domain: Domain = None,
    interface: Interface = "",
    truth: Truth = "",
    noise: Annotated[
        float, typer.Option(min=0, help="Noise of a simulated touch, a coordinate, m.")
    ] = TOUCH_NOISE_M,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the simulated scene and its touches.")
    ] = 0,
    json_: Annotated[
        bool, typer.Option("--json", help="Print one JSON object, nothing else.")
    ] = False,
) -> None:
    """Measure a scene and write it, with covariances, for check, dry-run and execute.

    A person touches points of the board and the top corners of every block with one calibrated
    arm; nothing is sent to it. Started again, it goes on where it was.
    """
    names = [name.strip() for name in (things or active).split(",")]
    filed = load_cell(cell)
    described, arm_m = _calibrated(filed, calibration)
    place, network = goal_of(described, goal), Network(domain, interface)
    folder.mkdir(parents=True, exist_ok=True)
    board, errors = None, (accuracy, accuracy_rad)
    if pose_topic or poses is not None:
        path = poses or _watched(folder / LOOKS, pose_topic, names, seconds, transport, network)
        looks = read_looks(path)
        means = {
            name: averaged(name, np.array([T for _, T in looks.get(name, ())]), *errors)
            for name in names
        }
        found = {name: (mean.T, mean.covariance) for name, mean in means.items()}
        facts = {name: mean_facts(mean) for name, mean in means.items()}
        words = {name: mean_words(mean) for name, mean in means.items()}
    else:
        who = TouchedBy(
            driver,
            transport.value,
            network,
            hidden_robot(truth, filed) if truth else None,
            noise,
            0.0,
            seed,
        )
        fits = _touched(described, arm_m, arm, names, points, folder, who)
        board = fits.pop(BOARD)
        found = {name: (fit.T, fit.covariance) for name, fit in fits.items()}
        facts = {name: pose_facts(fit) for name, fit in fits.items()}
        words = {name: pose_words(fit) for name, fit in {"board": board, **fits}.items()}
    try:
        file = scene_file(described, found, active, place, board)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise CalibrationError(f"no scene was written: {reason}") from error
    output.parent.mkdir(parents=True, exist_ok=True)
    write_scene(output, file)
    if json_:
        about = None if board is None else pose_facts(board)
        print(json.dumps({"scene": str(output), "board": about, "things": facts}))
        return
    for name, said in words.items():
        print(f"{name}: {said}")
    print(f"Written: {output}")


def _calibrated(filed: CellDescription, path: Path | None) -> tuple[CellDescription, float]:
    """The cell, and what its calibration leaves, standard deviation of a coordinate, m.

    Raises:
        CalibrationError: it is not this cell's, or real arms have none.
    """
    if path is not None:
        found = read_calibration(path)
        return calibrated(filed, found, path), arm_error_m(found)
    if not is_simulated(filed):
        raise CalibrationError(
            f"{filed.files[0]}: its arms are real; name their calibration with --calibration, or "
            "they do not know what they touch"
        )
    return filed, 0.0


def _watched(
    path: Path,
    topic: str,
    names: list[str],
    seconds: float,
    transport: TransportChoice,
    network: Network,
) -> Path:
    """Looks at things over their topics for a while, and keeps what was seen; returns where."""
    if NAME not in topic:
        raise typer.BadParameter(f"--pose-topic {topic!r} needs {NAME} for the name of a thing")
    node = open_transport(transport.value, network)
    try:
        poses = TopicPoses(
            node,
            {name: topic.replace(NAME, name) for name in names},
            dict.fromkeys(names, 0.0),
        )
        await_poses(poses, names)
        return write_looks(path, look_on(poses, names, MonotonicClock(), seconds))
    finally:
        node.close()


def _touched(
    cell: CellDescription,
    arm_m: float,
    arm: str,
    things: list[str],
    points: int,
    folder: Path,
    who: TouchedBy,
) -> dict[str, PoseFit]:
    """Where board ("") and things are, touched by one arm."""
    arms = [each.name for each in cell.arms]
    if arm not in {"", *arms}:
        raise typer.BadParameter(f"--arm {arm}: this cell has {', '.join(arms)}")
    index = arms.index(arm or arms[-1])
    _insist_on_fresh(folder / f"{arms[index]}.csv")
    marks = scene_landmarks(cell, index, things, points)
    wanted = [marks if i == index else () for i in range(len(arms))]
    simulated = _simulated_things(cell, who.seed) if who.robot is TouchedRobot.LOOPBACK else {}
    with touched_by(cell, who, simulated) as (driver, hand):
        books = touch(cell, driver, hand, wanted, folder, off_of_things, "scene")
    return touched_scene(cell, index, books[arms[index]], arm_m)


def _insist_on_fresh(path: Path) -> None:
    """Refuses to go on with touches of things that may have been moved since.

    Raises:
        CalibrationError: the last touch is too long ago.
    """
    if path.exists() and (ago_s := wall_time() - path.stat().st_mtime) > FRESH_S:
        raise CalibrationError(
            f"{path}: its last point was touched {ago_s / 3600.0:.1f} hours ago, and things may "
            "have moved since; name another folder"
        )


def _simulated_things(cell: CellDescription, seed: int) -> dict[str, FloatArray]:
    """Where the simulated cell's things are, at rest."""
    task = load_task(cell.name, cell)
    layout = task.sample_layout(np.random.default_rng(seed), task.distributions[0])
    places = {thing.name: np.array(thing.T_task_object) for thing in layout.objects}
    if cell.file.block is not None:
        for place in places.values():
            place[2, 3] = cell.file.block.height_m / 2.0
    return places
