from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import synthetic_run as synthetic
from rosbags.rosbag2 import Reader

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import RecordingError
from viskill_deploy.observe import recorder_process, recording, video_process
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.recorder_process import Intake, serve

CYCLES = 40


class Ended:
    """Stands in for the recorder's process where the test plays its part."""

    returncode = 0

    def poll(self) -> None:
        return None

    def wait(self) -> int:
        return self.returncode


@pytest.fixture
def stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[bytes, Path]:
    """What the runtime writes to the pipe for a short run, and a folder for the bag."""
    reader, writer = os.pipe()
    monkeypatch.setattr(recording, "_start", lambda folder: (Ended(), writer))
    cell = load_cell("bipegtransfer")
    with recording.Recorder(tmp_path / "unused", cell, synthetic.PERIOD_S) as recorder:
        synthetic.feed(recorder, cell, range(CYCLES))
    with os.fdopen(reader, "rb") as pipe:
        data = pipe.read()
    (tmp_path / "bag").mkdir()
    return data, tmp_path / "bag"


def assert_whole(folder: Path) -> None:
    data, cell = read_recording(folder), load_cell("bipegtransfer")
    assert data.complete
    assert len(data.verdicts) == CYCLES
    expected = [synthetic.cycle(cell, i).state.arms[1].measured_jp for i in range(CYCLES)]
    np.testing.assert_array_equal(data.joints["/PSM2/measured_js"].position, expected)
    with Reader(folder) as reader:
        assert reader.message_count == len(list(reader.messages()))


def test_frames_may_be_cut_anywhere(stream):
    data, folder = stream
    intake = Intake(folder)
    for at in range(0, len(data), 333):
        intake.feed(data[at : at + 333])
    intake.bag.finish()
    assert_whole(folder)


def test_chunks_may_fall_anywhere(stream):
    data, folder = stream
    intake = Intake(folder)
    for at in range(0, len(data), 5000):
        intake.feed(data[at : at + 5000])
        intake.bag.write()
    intake.bag.write()  # nothing waits: no empty chunk
    intake.bag.finish()
    assert_whole(folder)


@pytest.mark.parametrize("chunk_bytes", [1, 1 << 20])
def test_the_end_of_the_pipe_closes_the_bag(stream, monkeypatch, chunk_bytes):
    data, folder = stream
    monkeypatch.setattr(recorder_process, "CHUNK_BYTES", chunk_bytes)
    monkeypatch.setattr(recorder_process, "NAP_S", 0.0)
    reader, writer = os.pipe()
    os.write(writer, data)
    os.close(writer)
    serve(reader, folder)
    os.close(reader)
    assert_whole(folder)


def test_a_runtime_that_dies_in_the_middle_of_a_frame_loses_that_frame_alone(stream):
    data, folder = stream
    intake = Intake(folder)
    intake.feed(data[: len(data) // 2])
    intake.bag.finish()
    kept = len(read_recording(folder).joints["/PSM1/measured_js"].time_s)
    assert CYCLES // 2 - 3 <= kept <= CYCLES // 2 + 1


def test_a_bag_that_was_never_written_to_opens(stream):
    data, folder = stream
    intake = Intake(folder)
    intake.feed(data[:2000])
    kept = read_recording(folder)
    assert not kept.complete
    assert kept.about["cell"] == "bipegtransfer"
    intake.bag.finish()


def test_a_recorder_is_open_before_anything_moves(tmp_path):
    with recording.Recorder(tmp_path / "bag", load_cell("bipegtransfer"), 0.004) as recorder:
        recorder.wait_until_open()
        assert not read_recording(tmp_path / "bag").complete


def test_a_recorder_that_ended_before_it_could_open_its_file_says_so(tmp_path, monkeypatch):
    reader, writer = os.pipe()
    monkeypatch.setattr(Ended, "poll", lambda self: 1)
    monkeypatch.setattr(recording, "_start", lambda folder: (Ended(), writer))
    recorder = recording.Recorder(tmp_path / "bag", load_cell("bipegtransfer"), 0.004)
    with pytest.raises(RecordingError, match="free disk space"):
        recorder.wait_until_open()
    recorder.close()
    os.close(reader)


def test_a_pipe_without_a_word_leaves_no_bag(tmp_path):
    reader, writer = os.pipe()
    os.close(writer)
    serve(reader, tmp_path)
    os.close(reader)
    assert not list(tmp_path.iterdir())


def test_a_recorder_that_ends_with_an_error_is_told_at_the_end(tmp_path, monkeypatch):
    reader, writer = os.pipe()
    monkeypatch.setattr(Ended, "returncode", 1)
    monkeypatch.setattr(recording, "_start", lambda folder: (Ended(), writer))
    cell = load_cell("bipegtransfer")
    recorder = recording.Recorder(tmp_path / "bag", cell, synthetic.PERIOD_S)
    with pytest.raises(RecordingError, match="exit code 1"):
        recorder.close()
    recorder.close()  # a second time says nothing more
    os.close(reader)


def test_the_first_error_of_a_run_is_the_one_that_is_told(tmp_path):
    def run() -> None:
        with recording.Recorder(tmp_path / "bag", load_cell("bipegtransfer"), 0.004) as recorder:
            recorder._process.kill()
            raise KeyError("the run's own trouble")

    with pytest.raises(KeyError, match="own trouble"):
        run()


def test_pictures_become_an_mp4(tmp_path):
    shade = np.zeros((video_process.HEIGHT, video_process.WIDTH, 3), np.uint8)
    video_process.write_mp4(tmp_path / "v.mp4", iter([shade, shade + 80, shade + 160]))
    assert (tmp_path / "v.mp4").read_bytes()[4:8] == b"ftyp"
