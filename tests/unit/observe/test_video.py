from __future__ import annotations

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
import synthetic_run as synthetic

from viskill_deploy.core.description import load_cell
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.records import PoseTrack, RunData, Track
from viskill_deploy.observe.video import render_video
from viskill_deploy.observe.video_process import FPS, HEIGHT, WIDTH, frame_positions
from viskill_deploy.sim.scene import build_model


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "bag"
    synthetic.record(path, cycles=250)
    return path


def test_the_model_is_put_where_the_recording_says(bag):
    cell = load_cell("bipegtransfer")
    data, model = read_recording(bag), build_model(cell)
    c = synthetic.cycle(cell, 100)
    qpos = frame_positions(model, data, np.array([100 * synthetic.PERIOD_S]))[0]
    for arm in c.state.arms:
        for joint, value in zip(arm.joint_names, arm.measured_jp, strict=True):
            found = qpos[model.joint(f"{arm.name}/{joint}").qposadr[0]]
            assert found == pytest.approx(value, abs=1e-9)
        finger = qpos[model.joint(f"{arm.name}/jaw_left").qposadr[0]]
        assert finger == pytest.approx(arm.jaw_measured_jp / 2, abs=1e-9)
    state = mujoco.MjData(model)
    state.qpos[:] = qpos
    mujoco.mj_kinematics(model, state)
    # the scene was recorded in this very cycle: its period divides 100
    np.testing.assert_allclose(state.body("block0").xpos, c.tip_poses[0][:3, 3], atol=1e-6)
    rotation = state.body("block0").xmat.reshape(3, 3)
    np.testing.assert_allclose(rotation, c.tip_poses[0][:3, :3], atol=1e-9)
    assert state.body("block3").xpos[2] < -1.0  # unknown things are out of sight


def test_a_recording_becomes_a_video_of_its_length_or_a_note(bag, tmp_path):
    video = render_video(bag, tmp_path / "v.mp4")
    if video.path is None:
        assert "apt-get install" in video.note
        pytest.skip("no graphics library on this machine")
    reader = imageio_ffmpeg.read_frames(str(video.path))
    about = next(reader)
    assert about["size"] == (WIDTH, HEIGHT)
    frames = [np.frombuffer(frame, np.uint8).astype(int) for frame in reader]
    assert len(frames) == pytest.approx(249 * synthetic.PERIOD_S * FPS, abs=1.5)
    assert frames[0].std() > 10  # something is to be seen
    assert np.abs(frames[-1] - frames[0]).max() > 30  # and it moves


@pytest.mark.parametrize("backend", ["nonsense", "disable"])
def test_without_a_graphics_library_the_note_says_what_to_install(bag, tmp_path, backend):
    video = render_video(bag, tmp_path / "v.mp4", backends=(backend,))
    assert video.path is None
    assert "no graphics library works" in video.note
    assert "apt-get install libosmesa6, or libegl1 libgl1-mesa-dri" in video.note
    assert not (tmp_path / "v.mp4").exists()


def test_a_wrong_recording_is_told_apart_from_a_missing_library(bag, tmp_path):
    video = render_video(tmp_path, tmp_path / "v.mp4")
    if "apt-get install" in video.note:
        pytest.skip("no graphics library on this machine")
    assert "holds no .mcap file" in video.note


def test_rendering_gives_up_in_time(bag, tmp_path):
    video = render_video(bag, tmp_path / "v.mp4", timeout_s=0.01)
    assert "render a shorter episode" in video.note


def test_doors_are_shown_as_far_open_as_they_were_recorded():
    model = build_model(load_cell("matchboardpanel"))
    times = np.array([0.0, 0.5, 1.0])
    place = np.column_stack([np.full(3, 0.025), [0.0, 0.03, 0.075], np.full(3, 0.0086)])
    poses = {"/scene/door2": PoseTrack(times, place, np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)))}
    rest = np.zeros((3, 6))
    joints = {
        "/PSM1/measured_js": Track(times, rest, rest),
        "/PSM1/jaw/measured_js": Track(times, rest[:, :1], rest[:, :1]),
    }
    data = RunData({"arms": ["PSM1"]}, 0, joints, poses)
    qpos = frame_positions(model, data, times)
    assert qpos[:, model.joint("door2").qposadr[0]].tolist() == pytest.approx([0.0, 0.03, 0.075])
    assert qpos[:, model.joint("door0").qposadr[0]].tolist() == [0.0, 0.0, 0.0]
