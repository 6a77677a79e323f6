"""Plan mode: the whole trajectory is held against the gate before anything moves."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from viskill_deploy.bundle.format import Bundle, load_bundle
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import MotionError, NoSolutionError, SafetyStop
from viskill_deploy.core.types import Scene
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.runtime.moves import axes_of
from viskill_deploy.runtime.planning import LEVER_M, Plan, make_plan
from viskill_deploy.sim.tasks.base import load_task

ROOT = Path(__file__).resolve().parents[3]
CELL = load_cell("bipegtransfer")
TASK = load_task("bipegtransfer")


def made(
    bundle: Bundle, driver: LoopbackDriver, axes: np.ndarray, rng: np.random.Generator
) -> Plan:
    return make_plan(CELL, TASK, bundle, axes, axes, driver.scene(), rng)


@pytest.fixture(scope="module")
def ready() -> Iterator[tuple[Plan, LoopbackDriver]]:
    driver = LoopbackDriver(CELL)
    driver.connect()
    rng = np.random.default_rng(0)
    driver.reset(TASK.sample_layout(rng, "reference"))
    driver.enable()
    driver.home()
    bundle = load_bundle(ROOT / "policies" / "bipegtransfer-viskill")
    plan = made(bundle, driver, axes_of(driver.state()), rng)
    yield plan, driver
    driver.close()


def test_a_plan_starts_where_the_arms_are_and_ends_at_rest(
    ready: tuple[Plan, LoopbackDriver],
) -> None:
    plan, driver = ready
    start = plan.motion.at(0.0)
    for motion, axes in zip(start, axes_of(driver.state()), strict=True):
        np.testing.assert_allclose(motion.p, axes, atol=1e-9)
        assert max(map(abs, motion.v)) < 1e-9
    for motion in plan.motion.at(plan.motion.duration_s):
        assert max(map(abs, motion.v)) < 1e-6


def moved(scene: Scene, name: str, T: np.ndarray) -> Scene:
    things = [replace(o, T_task_object=T) if o.name == name else o for o in scene.objects]
    return replace(scene, objects=tuple(things))


def test_a_plan_knows_how_far_the_thing_is_from_where_it_has_it(
    ready: tuple[Plan, LoopbackDriver],
) -> None:
    plan, _ = ready
    there = plan.scenes["release"]
    assert list(plan.scenes) == ["grasp", "handover", "release"]
    assert plan.off("release", there) == pytest.approx(0.0, abs=1e-9)
    T = there.pose(there.active).copy()
    T[:3, 3] += [0.003, 0.0, -0.004]
    assert plan.off("release", moved(there, there.active, T)) == pytest.approx(0.005)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    T[:3, :3] = T[:3, :3] @ turn
    expected = 0.005 + LEVER_M * np.arccos(0.8)
    assert plan.off("release", moved(there, there.active, T)) == pytest.approx(expected)
    others = [o for o in there.objects if o.name != there.active]
    assert others
    far = moved(there, others[0].name, T)
    assert plan.off("release", far) == pytest.approx(0.0, abs=1e-9), "a bystander"
    assert plan.off("release", replace(there, objects=tuple(others))) == 0.0, "nobody sees it"
    assert replace(plan, scenes={}).off("release", there) == pytest.approx(0.0, abs=1e-9)


def test_a_plan_knows_its_stretch(
    ready: tuple[Plan, LoopbackDriver],
) -> None:
    plan, _ = ready
    assert plan.motion.stretch >= 1.0
    meant = 0.2 * (len(plan.waypoints) - 1)
    assert plan.motion.duration_s == pytest.approx(plan.motion.stretch * meant)


def test_a_sound_plan_passes_and_moves_nothing(ready: tuple[Plan, LoopbackDriver]) -> None:
    plan, driver = ready
    before = driver.state()
    plan.check(CELL, driver.period_s, before)
    assert driver.state().arms[0].measured_jp == before.arms[0].measured_jp


def test_a_plan_that_is_too_fast_is_refused_with_rule_and_arm(
    ready: tuple[Plan, LoopbackDriver],
) -> None:
    plan, driver = ready
    runs, start = [], 0.0
    for run in plan.motion.runs:
        hurried = replace(run, scale=run.scale / 3, start_s=start)
        runs.append(hurried)
        start += hurried.duration_s
    times = tuple(t / 3 for t in plan.motion.waypoint_times)
    fast = replace(plan, motion=replace(plan.motion, runs=tuple(runs), waypoint_times=times))
    with pytest.raises(SafetyStop, match=r"refused at .* S\d\d on PSM\d .*nothing has moved"):
        fast.check(CELL, driver.period_s, driver.state())


def test_a_plan_from_another_start_is_refused(ready: tuple[Plan, LoopbackDriver]) -> None:
    plan, driver = ready
    state = driver.state()
    moved = replace(state.arms[0], setpoint_jp=(0.3, *state.arms[0].setpoint_jp[1:]))
    with pytest.raises(SafetyStop):
        plan.check(CELL, driver.period_s, replace(state, arms=(moved, state.arms[1])))


def test_arms_that_start_inside_their_cannulas_are_a_named_refusal_not_a_motion(
    ready: tuple[Plan, LoopbackDriver],
) -> None:
    _, driver = ready
    axes = axes_of(driver.state())
    axes[0, 2] = 0.02
    bundle = load_bundle(ROOT / "policies" / "bipegtransfer-viskill")
    with pytest.raises((MotionError, NoSolutionError)):
        made(bundle, driver, axes, np.random.default_rng(0))


def test_a_plan_that_fails_in_the_simulator_is_not_streamed(
    untrained_bundle: Path, ready: tuple[Plan, LoopbackDriver]
) -> None:
    _, driver = ready
    axes = axes_of(driver.state())
    with pytest.raises(MotionError, match="does not do the task in the simulator"):
        made(load_bundle(untrained_bundle), driver, axes, np.random.default_rng(0))
