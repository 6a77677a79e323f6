"""A runtime is killed, stopped and loses its watchdog while arms move on the served loopback."""

import signal
import time
from pathlib import Path

import numpy as np
import pytest
from runtime_to_kill import RuntimeToKill

from viskill_deploy.core import realtime
from viskill_deploy.core.types import Mode
from viskill_deploy.drivers.base import DISABLED, PAUSED
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.safety.watchdog import DISABLE_S, LOST_S

pytestmark = [pytest.mark.quiet, pytest.mark.timeout(900)]
PERIOD_S = 0.004
HELD_WITHIN_S = 0.1
BEAT_AGE_S = 0.03
"""How old a heartbeat may be when its runtime is killed: a cycle, and what a busy machine adds."""
REST_RAD_S = 0.02
"""Measured speed of a joint that rests: what is left of a drive that settles."""


def assert_held_in_time(run: RuntimeToKill, since: float) -> None:
    """The arms were held within 100 ms where the system permits promptness, disabled later."""
    late = run.stopped_s["hold"] - since
    assert late > 0.0
    if not realtime.refusals():
        assert late <= HELD_WITHIN_S
    assert run.stopped_s["disable"] - since > DISABLE_S - BEAT_AGE_S


@pytest.mark.parametrize("trial", range(3))
@pytest.mark.invariant("S25", "S32")
def test_a_killed_runtime_leaves_held_arms_and_a_complete_recording(tmp_path: Path, trial: int):
    with RuntimeToKill(tmp_path) as run:
        time.sleep(0.13 * trial)  # another place of the motion
        before = run.look()
        killed = run.kill()
        run.look_until("hold")
        held = run.look()
        run.look_until("disable")
        assert run.look().arms[0].operating_state == DISABLED
        assert_held_in_time(run, killed)
        for arm, then, last in zip(before.arms, held.arms, run.state.arms, strict=True):
            assert max(map(abs, arm.measured_jv)) > 1e-2, "it did not move; kill it elsewhere"
            assert then.operating_state in {PAUSED, DISABLED}
            assert last.setpoint_jp == then.setpoint_jp
            assert max(map(abs, last.measured_jv)) < 1e-3
        run.await_end("watchdog")
        run.await_end("recorder")
    assert_recorded_until(run, killed)


def assert_recorded_until(run: RuntimeToKill, killed: float) -> None:
    """The recording opens, is closed properly, and lacks at most the cycle under way."""
    data = read_recording(run.recording)
    assert data.complete
    monotonic_to_date = time.time() - time.monotonic()
    for arm in run.state.arms:
        sent = data.joints[f"/{arm.name}/setpoint_js"]
        to_kill = killed - (data.origin_ns * 1e-9 + sent.time_s - monotonic_to_date)
        # what the robot holds is what was recorded last, or was sent while the kill was under way
        behind = np.abs(sent.position - arm.setpoint_jp).max(axis=1)
        assert behind[-1] == 0.0 or to_kill[-1] < 2 * PERIOD_S
        assert behind[-1] <= np.abs(np.diff(sent.position, axis=0)).max() * 1.5
        assert to_kill[-1] < 0.05


def test_s25_a_runtime_that_was_stopped_for_a_second_finds_its_arms_held_and_moves_nothing(
    tmp_path: Path,
):
    with RuntimeToKill(tmp_path) as run:
        stopped = run.kill(what=signal.SIGSTOP)
        run.look_until("disable")
        assert_held_in_time(run, stopped)
        assert run.stopped_s["hold"] - stopped > LOST_S - BEAT_AGE_S
        held = run.look()
        time.sleep(max(0.0, stopped + 1.0 - time.monotonic()))
        run.kill(what=signal.SIGCONT)
        told = run.told()
        run.look_to_the_end()
        assert run.process.wait(10.0) == 5
        run.await_end("recorder")
    assert (told["cause"], told["mode"]) == ("S25", Mode.ESTOPPED.value)
    for then, last in zip(held.arms, run.state.arms, strict=True):
        assert last.setpoint_jp == then.setpoint_jp
        assert last.operating_state == DISABLED
        np.testing.assert_allclose(last.measured_jp, then.measured_jp, atol=1e-4)
    data = read_recording(run.recording)
    assert data.complete
    assert "S25" in {verdict.rule for verdict in data.verdicts}


def test_s26_a_killed_watchdog_ends_the_run_within_50_ms(tmp_path: Path):
    with RuntimeToKill(tmp_path) as run:
        killed = run.kill("watchdog")
        told = run.told()
        run.look_to_the_end()
        assert run.process.wait(10.0) == 5
        run.await_end("recorder")
    assert (told["cause"], told["mode"]) == ("S26", Mode.HOLDING.value)
    assert run.stopped_s == {}, "the gate's own stop, not the watchdog's"
    data = read_recording(run.recording)
    for arm in ("PSM1", "PSM2"):  # the last cycle that was recorded: a look may come too late
        sent = data.joints[f"/{arm}/setpoint_js"].position[-2:]
        assert abs(sent[1] - sent[0]).max() < 1e-6
        assert abs(data.joints[f"/{arm}/measured_js"].velocity[-1]).max() < REST_RAD_S
    first = next(verdict for verdict in data.verdicts if verdict.rule == "S26")
    assert first.value > first.limit == LOST_S
    date = data.origin_ns * 1e-9 + first.time_s
    late = date - (killed + time.time() - time.monotonic())
    assert late > LOST_S - BEAT_AGE_S
    if not realtime.refusals():
        assert late <= HELD_WITHIN_S
