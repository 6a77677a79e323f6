"""What lies between a driver and a perfect world acts as its option says, and is off by default."""

import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError, ViskillError
from viskill_deploy.core.types import FloatArray, JointSetpoint, Scene
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.sim.imperfections import Imperfections, WorldOptions
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.world import World

CELL = load_cell("bipegtransfer")
TASK = load_task("bipegtransfer")
SCENE: Scene = TASK.sample_layout(np.random.default_rng(0), "reference")


def made(seed: int = 0, **options: object) -> World:
    world = World(CELL, WorldOptions(**options), seed)  # type: ignore[arg-type]
    world.reset(SCENE)
    return world


def setpoints(axes: FloatArray) -> list[JointSetpoint]:
    return [JointSetpoint(tuple(row[:6]), (0.0,) * 6, float(row[6]), 0.0) for row in axes.tolist()]


def turned(world: World, joint: int, by: float, periods: int) -> FloatArray:
    """Measured joints of PSM1 while its setpoint of one joint is displaced, (periods, 6)."""
    axes = world.home.copy()
    axes[0, joint] += by
    rows = []
    for _ in range(periods):
        world.step(setpoints(axes))
        rows.append(world.measured(0).jp)
    return np.array(rows)


def tip(world: World, arm: int = 0) -> FloatArray:
    return world.data.site(f"{CELL.arms[arm].name}/tip").xpos.copy()


@pytest.mark.parametrize(
    "options",
    [
        {"lag_s": -0.1},
        {"joint_offset_rad": -1.0},
        {"base_error_m": float("nan")},
        {"jitter_s": -1e-3},
        {"drop_rate": 1.0},
        {"drop_rate": float("nan")},
    ],
)
def test_options_without_sense_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must"):
        WorldOptions(**options)  # type: ignore[arg-type]


def test_all_imperfections_are_off_by_default() -> None:
    nothing = Imperfections(WorldOptions(), 2, seed=0)
    row = np.arange(28.0)
    assert nothing.felt(row) is row
    assert nothing.measured(0, row[:7]) is not None
    assert not nothing.loses()
    assert nothing.lateness_s() == 0.0
    assert WorldOptions(delay_periods=3, joint_friction=True).is_plain
    assert not WorldOptions(lag_s=0.1).is_plain


def test_lag_lets_an_arm_follow_with_its_time_constant() -> None:
    quick, lagging = made(), made(lag_s=0.1)
    sharp, slow = (turned(w, 0, 0.02, 75)[:, 0] - w.home[0, 0] for w in (quick, lagging))
    arrived = [int(np.argmax(way > 0.02 * 0.632)) * 0.004 for way in (sharp, slow)]
    assert arrived[1] - arrived[0] == pytest.approx(0.1, abs=0.012)


def test_an_encoder_offset_moves_the_tip_and_not_what_is_measured() -> None:
    plain, wrong = made(), made(joint_offset_rad=0.01, joint_offset_m=1e-3)
    for world in (plain, wrong):
        turned(world, 0, 0.0, 100)
    assert wrong.measured(0).jp == pytest.approx(plain.measured(0).jp, abs=1e-4)
    assert 1e-3 < np.linalg.norm(tip(wrong) - tip(plain)) < 0.02
    other = made(seed=1, joint_offset_rad=0.01, joint_offset_m=1e-3)
    assert np.linalg.norm(tip(other) - tip(wrong)) > 1e-4


def test_a_base_that_stands_elsewhere_moves_the_tip_with_it() -> None:
    plain, moved, turned_ = made(), made(base_error_m=0.002), made(base_error_rad=0.01)
    assert 5e-4 < np.linalg.norm(tip(moved) - tip(plain)) < 0.01
    assert 5e-4 < np.linalg.norm(tip(turned_) - tip(plain)) < 0.01
    assert moved.measured(0).jp == pytest.approx(plain.measured(0).jp, abs=1e-4)


def test_a_stuck_joint_stays_and_the_others_move() -> None:
    world = made(stuck="PSM1/yaw")
    before = world.measured(0).jp
    after = turned(world, 0, 0.1, 100)[-1]
    assert after[0] == pytest.approx(before[0], abs=1e-5)
    assert turned(world, 1, 0.1, 100)[-1][1] == pytest.approx(world.home[0, 1] + 0.1, abs=1e-3)


def test_a_joint_that_slips_does_not_follow_until_it_is_mended() -> None:
    world = made()
    world.drives.slip("PSM1/pitch")
    assert turned(world, 1, 0.1, 100)[-1][1] == pytest.approx(world.home[0, 1], abs=1e-3)
    world.drives.mend()
    assert turned(world, 1, 0.1, 200)[-1][1] == pytest.approx(world.home[0, 1] + 0.1, abs=1e-3)


def test_a_joint_that_is_not_there_cannot_be_stuck() -> None:
    with pytest.raises(ViskillError, match=r"no joint 'PSM3/yaw'.*PSM1/yaw"):
        World(CELL, WorldOptions(stuck="PSM3/yaw"))


def test_a_driver_breaks_drives_and_refuses_what_it_does_not_know() -> None:
    driver = LoopbackDriver(CELL)
    driver.connect()
    driver.break_drive("PSM1/yaw", "stuck")
    driver.break_drive("", "mended")
    with pytest.raises(DriverError, match="not 'melted'"):
        driver.break_drive("PSM1/yaw", "melted")
    with pytest.raises(DriverError, match="no joint"):
        driver.break_drive("PSM1/elbow", "slip")


def test_one_message_in_five_is_lost_each_way() -> None:
    driver = LoopbackDriver(CELL, WorldOptions(drop_rate=0.2), seed=1)
    driver.connect()
    driver.enable()
    driver.home()
    stamps, held = [], []
    for k in range(400):
        driver.clock.sleep_until(driver.clock.now() + driver.period_s)
        stamps.append(driver.state().arms[0].stamp_s)
        driver.cell.servo_jp(setpoints(driver.world.home + 1e-6 * k))
        held.append(driver.cell._setpoints[0].jp[0])
    assert 40 < sum(np.diff(stamps) == 0.0) < 120
    assert 40 < sum(np.diff(held) == 0.0) < 120


def test_the_loop_wakes_late_by_up_to_the_jitter_and_the_world_keeps_its_time() -> None:
    driver = LoopbackDriver(CELL, WorldOptions(jitter_s=0.003), seed=2)
    driver.connect()
    start = deadline = driver.clock.now()
    late = []
    for _ in range(100):
        deadline += driver.period_s
        late.append(driver.clock.sleep_until(deadline) - deadline)
        assert driver.clock.now() - driver.state().arms[0].stamp_s < 0.008
    assert min(late) >= 0.0
    assert 0.002 < max(late) <= 0.003 + 1e-12
    assert driver.world.time_s == pytest.approx(deadline - start, abs=0.0041)
