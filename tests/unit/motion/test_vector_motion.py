import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import KinematicsError, MotionError
from viskill_deploy.core.types import FloatArray, Waypoint
from viskill_deploy.kinematics.model import forward_batch, tip_positions
from viskill_deploy.motion.links import CellLinks
from viskill_deploy.motion.resolve import resolve
from viskill_deploy.motion.smoothing import AxisMotion, SegmentPlanner
from viskill_deploy.motion.vector_paths import Motions
from viskill_deploy.motion.vector_smoothing import VectorPlanner
from viskill_deploy.motion.vector_waypoints import Waypoints, apply_actions, targets, tips
from viskill_deploy.motion.waypoints import ActionSpec, apply_action, start_waypoint

CELL = load_cell("bipegtransfer")
HOME = resolve(CELL, [start_waypoint(CELL)], [(0.0,) * 7] * 2)[1]
PERIOD_S = 0.004


def near_home(rng: np.random.Generator, count: int, scale: float = 1.0) -> FloatArray:
    spread = scale * np.array([0.05, 0.05, 0.01, 0.4, 0.2, 0.2, 0.2])
    axes = HOME + spread * rng.normal(size=(count, 2, 7))
    axes[..., 6] = np.abs(axes[..., 6])
    return axes


def test_tip_positions_are_the_origins_of_tip_poses() -> None:
    q = near_home(np.random.default_rng(0), 50)[:, 0, :6]
    arm = CELL.arms[0].arm
    assert tip_positions(arm, q) == pytest.approx(forward_batch(arm, q)[:, :3, 3], abs=1e-15)


@pytest.mark.parametrize("spec", [ActionSpec(), ActionSpec(rotation=("yaw", "pitch"))])
@pytest.mark.parametrize("reference", ["setpoint", "measured"])
def test_actions_ask_for_the_same_waypoints_side_by_side_as_alone(
    spec: ActionSpec, reference: str
) -> None:
    rng = np.random.default_rng(1)
    spec = ActionSpec(reference=reference, rotation=spec.rotation)  # type: ignore[arg-type]
    last = tips(CELL, near_home(rng, 60, 0.3)[..., :6])
    measured = tips(CELL, near_home(rng, 60, 0.3)[..., :6])
    measured[:20] = last[:20]
    actions = rng.uniform(-1.5, 1.5, (60, 10))
    asked = apply_actions(Waypoints(last, np.zeros((60, 2))), actions, measured, CELL, spec)
    for index, action in enumerate(actions):
        before = Waypoint(tuple(last[index]), (0.0, 0.0), 0.2)
        alone = apply_action(before, action, list(measured[index]), CELL, spec)
        assert asked.T_task_tip[index] == pytest.approx(np.array(alone.T_task_tip), abs=1e-14)
        assert tuple(asked.jaw[index]) == alone.jaw


def test_targets_are_those_of_each_cell_alone_and_say_what_is_out_of_reach() -> None:
    rng = np.random.default_rng(2)
    links, now = CellLinks(CELL), near_home(rng, 40)
    poses = tips(CELL, near_home(rng, 40)[..., :6])
    poses[::8, 1, 2, 3] -= 0.4
    found, reached = targets(CELL, Waypoints(poses, np.zeros((40, 2))), now)
    assert (~reached).sum() == 5
    for index in range(40):
        waypoint = Waypoint(tuple(poses[index]), (0.0, 0.0), 0.2)
        start = [AxisMotion.at_rest(row) for row in now[index].tolist()]
        if reached[index]:
            alone = np.array(links.targets(waypoint, start))
            assert found[index] == pytest.approx(alone, abs=1e-12)
        else:
            with pytest.raises(KinematicsError):
                links.targets(waypoint, start)


def test_segments_are_decided_and_shaped_as_each_cell_alone_would() -> None:
    """Chains of steps from gentle to impossible: stretches, retries and refusals included."""
    rng, count = np.random.default_rng(3), 24
    planner, alone = VectorPlanner(CELL, PERIOD_S), SegmentPlanner(CELL, PERIOD_S)
    motion = Motions.at_rest(np.repeat(HOME[None], count, axis=0))
    size = np.array([0.03, 0.03, 0.004, 0.2, 0.1, 0.1, 0.2])
    refused = stretched = 0
    for _ in range(6):
        how = rng.choice([0.3, 1.0, 3.0], size=(count, 1, 1))
        goal = motion.p + how * size * rng.normal(size=(count, 2, 7))
        wish = (goal - motion.p) / 0.2
        segments = planner.plan(motion, goal, wish, 0.2)
        end = segments.paths.end()
        for index in range(count):
            try:
                segment = alone.plan(
                    state(motion, index), goal[index].tolist(), wish[index].tolist(), 0.2
                )
            except MotionError:
                assert not segments.planned[index]
                refused += 1
                continue
            assert segments.planned[index]
            assert segments.periods[index] == round(segment.duration_s / PERIOD_S)
            assert segments.stretch[index] == pytest.approx(segment.stretch, abs=1e-12)
            stretched += segment.stretch > 1.0
            p, v = segment.table(PERIOD_S)
            times = np.arange(1, len(p) + 1) * PERIOD_S
            row = segments.paths.rows(np.array([index]))
            mine = [x[:, 0] for x in row.sampled(times)]
            assert mine[0] == pytest.approx(p, abs=1e-12)
            assert mine[1] == pytest.approx(v, abs=1e-11)
            last = segment.at(segment.duration_s)
            for field in "pva":
                values = np.array([getattr(m, field) for m in last])
                assert getattr(end, field)[index] == pytest.approx(values, abs=1e-10)
        keep = segments.planned[:, None, None]
        motion = Motions(*(np.where(keep, getattr(end, f), getattr(motion, f)) for f in "pva"))
    assert refused > 5
    assert stretched > 20


def state(motion: Motions, index: int) -> list[AxisMotion]:
    rows = (motion.p[index], motion.v[index], motion.a[index])
    return [AxisMotion(*(tuple(row[arm].tolist()) for row in rows)) for arm in range(2)]
