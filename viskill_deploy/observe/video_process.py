"""The renderer's own process: a recording in, an mp4 out. Started by `video.render_video`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import RecordingError, ViskillError
from viskill_deploy.core.types import PSM_JOINTS, FloatArray
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.records import RunData
from viskill_deploy.observe.video import DATA_AT_FAULT, GL_READY
from viskill_deploy.sim.scene import build_model
from viskill_deploy.sim.things import colour, sliding

WIDTH, HEIGHT, FPS = 640, 480, 15
CAMERA = "overview"
_HIDDEN_M = 10.0
"""Things that the recording does not know are put this far below the board."""


def frame_positions(model: mujoco.MjModel, data: RunData, times_s: FloatArray) -> FloatArray:
    """Generalised positions of the model at each of `times_s`, (n, nq)."""
    qpos = np.tile(model.qpos0, (len(times_s), 1))
    for arm in data.about["arms"]:
        track = data.joints[f"/{arm}/measured_js"]
        for index, joint in enumerate(data.about.get("joints", PSM_JOINTS)):
            column = model.joint(f"{arm}/{joint}").qposadr[0]
            qpos[:, column] = np.interp(times_s, track.time_s, track.position[:, index])
        jaw = data.joints[f"/{arm}/jaw/measured_js"]
        opening = np.interp(times_s, jaw.time_s, jaw.position[:, 0])
        for finger in ("jaw_left", "jaw_right"):
            column = model.joint(f"{arm}/{finger}").qposadr[0]
            qpos[:, column] = np.maximum(opening, 0.0) / 2
    for index in range(model.njnt):
        if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE:
            at = model.jnt_qposadr[index]
            qpos[:, at : at + 7] = _object(data, model.joint(index).name, times_s)
    for name, door in sliding(model).items():
        if f"/scene/{name}" in data.poses:
            qpos[:, door.column] = door.travel(_object(data, name, times_s)[:, :3])
    return qpos


def _object(data: RunData, name: str, times_s: FloatArray) -> FloatArray:
    """Position and quaternion (w first) of a thing at each of `times_s`, (n, 7)."""
    track = data.poses.get(f"/scene/{name}")
    if track is None:
        return np.tile([0.0, 0.0, -_HIDDEN_M, 1.0, 0.0, 0.0, 0.0], (len(times_s), 1))
    nearest = np.clip(np.searchsorted(track.time_s, times_s), 0, len(track.time_s) - 1)
    q = track.orientation[nearest]
    return np.column_stack([track.position[nearest], q[:, 3], q[:, :3]])


def images(
    model: mujoco.MjModel, renderer: mujoco.Renderer, positions: FloatArray
) -> Iterator[npt.NDArray[np.uint8]]:
    """A picture of the model in each of `positions`, (height, width, 3)."""
    data = mujoco.MjData(model)
    for qpos in positions:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mj_tendon(model, data)
        renderer.update_scene(data, camera=CAMERA)
        yield renderer.render()


def write_mp4(path: Path, pictures: Iterator[npt.NDArray[np.uint8]]) -> None:
    """Writes pictures as H.264, small enough to live inside a page."""
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (WIDTH, HEIGHT),
        fps=FPS,
        codec="libx264",
        quality=None,
        macro_block_size=1,
        ffmpeg_log_level="error",
        output_params=["-preset", "veryfast", "-crf", "27", "-movflags", "+faststart"],
    )
    writer.send(None)
    for picture in pictures:
        writer.send(picture.tobytes())
    writer.close()


def main(recording: Path, path: Path, episode: int | None) -> None:
    """Renders one recording.

    Raises:
        RecordingError: it holds no cycle to show.
    """
    data = read_recording(recording, episode)
    if not data.duration_s:
        raise RecordingError(f"{recording}: holds no motion to show; record a run first")
    cell = load_cell(data.about["cell"])
    model = build_model(cell)
    active = next((mark.note for mark in data.marks if mark.note), "")
    goal = data.poses.get("/scene/goal")
    if goal is not None and len(goal.position):
        colour(model, active, goal.position[-1])
    # multisampling and shadows cost a software renderer four fifths of its speed
    model.vis.quality.offsamples = model.vis.quality.shadowsize = 0
    model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        print(GL_READY, flush=True)
        times = np.arange(0.0, data.duration_s + 0.5 / FPS, 1.0 / FPS)
        write_mp4(path, images(model, renderer, frame_positions(model, data, times)))


if __name__ == "__main__":
    which = None if sys.argv[3] == "all" else int(sys.argv[3])
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2]), which)
    except ViskillError as refused:
        print(refused, file=sys.stderr)
        sys.exit(DATA_AT_FAULT)
