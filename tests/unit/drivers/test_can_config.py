"""Table of axes, coupling, bus load and export; no bus is opened."""

import math
import tomllib
from pathlib import Path

import canopen
import cantools
import numpy as np
import pytest
from typer.testing import CliRunner

from viskill_deploy.cli.export import app
from viskill_deploy.core import data
from viskill_deploy.core.description import load_cell, load_robot
from viskill_deploy.core.errors import DataFileError, DriverError
from viskill_deploy.core.robot_files import ToolFile, read_toml, validated
from viskill_deploy.drivers.can.codec import Cia402Codec, Control, Drive, drive_state
from viskill_deploy.drivers.can.config import AXES, Bus, CanFile, load_can
from viskill_deploy.drivers.can.coupling import Gearing, actuator_ranges
from viskill_deploy.drivers.can.load import BusTraffic, check_load, classic_bits
from viskill_deploy.drivers.can.objects import axis_objects, final

CELL = load_cell("bipegtransfer")
FILE = load_can("bipegtransfer", CELL)
PATH = data.find("robots/can/bipegtransfer.toml")
CONTENT = tomllib.loads(PATH.read_text())


def changed(**entries: object) -> CanFile:
    return validated(PATH, CanFile, CONTENT | entries)


def with_axis(number: int, **entries: object) -> dict:
    axes = list(CONTENT["bus"][0]["axis"])
    axes[number] = axes[number] | entries
    return {"bus": [CONTENT["bus"][0] | {"axis": axes}, CONTENT["bus"][1]]}


@pytest.mark.parametrize("tool", data.names("robots/tools"))
def test_actuators_and_joints_of_every_instrument_give_each_other_back(tool: str) -> None:
    generation = read_toml(data.find(f"robots/tools/{tool}.toml"), ToolFile).generation
    arm = load_robot(f"psm_{generation.lower()}", tool)
    gearing = Gearing(arm, FILE.bus[0])
    rng = np.random.default_rng(0)
    for _ in range(50):
        joints = rng.uniform(-2.0, 2.0, 7).tolist()
        np.testing.assert_allclose(gearing.joints(gearing.actuators(joints)), joints, atol=1e-12)
        actuators = rng.uniform(-2.0, 2.0, 7).tolist()
        back = gearing.actuators(gearing.joints(actuators))
        np.testing.assert_allclose(back, actuators, atol=1e-12)


def test_the_wrist_moves_as_the_instruments_matrix_says() -> None:
    arm = CELL.arms[0].arm
    joints = Gearing(arm, FILE.bus[0]).joints([0.1, 0.2, 0.03, 0.4, 0.5, 0.6, 0.7])
    assert joints[:3] == [0.1, 0.2, 0.03]
    np.testing.assert_allclose(joints[3:], arm.actuator_to_joint @ [0.4, 0.5, 0.6, 0.7])


def test_counts_have_sign_offset_and_scale_and_lose_less_than_one_count() -> None:
    gearing = Gearing(CELL.arms[0].arm, FILE.bus[0])
    joints = [0.5, -0.25, 0.12, 0.3, 0.2, -0.1, 0.4]
    counts = gearing.counts(joints)
    assert counts[0] == round(0.5 * 1_048_576)
    assert counts[1] == round(0.25 * 1_048_576)  # its sign is -1
    assert counts[2] == round((0.12 - 0.05) * 20_000_000)
    np.testing.assert_allclose(gearing.joints_of_counts(counts), joints, atol=5e-6)


def test_the_limits_of_actuators_cover_every_corner_of_the_joints() -> None:
    arm = CELL.arms[0].arm
    ranges = actuator_ranges(arm)
    corners = [*arm.limit(1), arm.jaw.upper_rad]
    for (low, high), x in zip(ranges, Gearing(arm, FILE.bus[0]).actuators(corners), strict=True):
        assert low - 1e-12 <= x <= high + 1e-12
    assert ranges[0] == pytest.approx((arm.limit(0)[0], arm.limit(1)[0]))


def test_the_load_is_that_of_worst_case_stuffing() -> None:
    assert [classic_bits(n) for n in (0, 1, 6, 8)] == [55, 65, 115, 135]
    seven = BusTraffic(7, 1 / 250, math.inf, None, 1_000_000, None)
    assert seven.load == pytest.approx(1665e-6 * 250)
    fast = BusTraffic(7, 1 / 500, math.inf, None, 1_000_000, 5_000_000)
    assert 0.3 < fast.load < 0.45


def test_500_hz_on_a_classic_bus_is_refused_and_the_load_named() -> None:
    with pytest.raises(DataFileError, match=r"84\.9%.*70%.*data_bitrate_bit_s"):
        changed(cycle_hz=500)
    with pytest.raises(DriverError, match=r"PSM2.*84"):
        check_load("PSM2", FILE.traffic(FILE.bus[1], 1 / 500))
    fd = [bus | {"data_bitrate_bit_s": 5_000_000} for bus in CONTENT["bus"]]
    assert changed(cycle_hz=500, bus=fd).cycle_hz == 500
    assert changed(cycle_hz=400).cycle_hz == 400
    with pytest.raises(DriverError, match="CAN FD"):
        check_load("PSM1", BusTraffic(14, 1 / 1000, 0.05, 0.02, 1_000_000, 5_000_000))


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"bus": CONTENT["bus"][:1] * 2}, "channel"),
        (with_axis(1, node_id=1), "node id 1 is used twice"),
        (with_axis(1, node_id=126), "node id 126 is used twice"),
        (with_axis(1, node_id=64), "node id 64 is used twice"),
        (with_axis(1, node_id=128), "less than or equal to 127"),
        (with_axis(1, joint="yaw"), "in this order"),
        (with_axis(1, lower_rad=2.0), "below the upper"),
        (with_axis(1, counts_per_rad=1e12), "32 bits"),
        (with_axis(1, sign=2), "1 or -1"),
        (with_axis(1, offset=0.0), "unknown key"),
        (with_axis(1, offset_rad=math.nan), "finite"),
        ({"input": {"bus": "PSM3", "node_id": 64}}, "PSM3"),
        ({"watchdog_s": 1.0}, "less than or equal to 0.05"),
        ({"interface": "serial"}, "virtual"),
    ],
)
def test_a_wrong_table_is_refused_with_its_reason(entries: dict, reason: str) -> None:
    with pytest.raises(DataFileError, match=reason):
        changed(**entries)


def test_a_rotary_insertion_is_refused() -> None:
    with pytest.raises(DataFileError, match="linear"):
        axis = CONTENT["bus"][0]["axis"][3] | {"joint": "insertion"}
        changed(**with_axis(2, **axis) | {"bus": [_replaced(2, axis), CONTENT["bus"][1]]})


def _replaced(number: int, axis: dict) -> dict:
    axes = list(CONTENT["bus"][0]["axis"])
    axes[number] = axis
    return CONTENT["bus"][0] | {"axis": axes}


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('cell = "bipegtransfer"', 'cell = "bipegboard"', "bipegboard"),
        ('arm = "PSM2"', 'arm = "PSM9"', "one bus for each of PSM1, PSM2"),
        ("upper_rad = 0.9251", "upper_rad = 1.2", "wider than large_needle_driver_400006"),
    ],
)
def test_a_table_that_does_not_fit_the_cell_is_refused(
    old: str, new: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = PATH.read_text()
    assert old in text
    (tmp_path / "robots" / "can").mkdir(parents=True)
    (tmp_path / "robots" / "can" / "mine.toml").write_text(text.replace(old, new, 1))
    monkeypatch.setenv("VISKILL_DATA", str(tmp_path))
    with pytest.raises(DataFileError, match=reason):
        load_can("mine", CELL)


def test_every_state_of_a_drive_is_told_from_its_statusword() -> None:
    words = {
        0x0000: Drive.NOT_READY,
        0x0250: Drive.SWITCH_ON_DISABLED,
        0x0231: Drive.READY_TO_SWITCH_ON,
        0x0233: Drive.SWITCHED_ON,
        0x1637: Drive.OPERATION_ENABLED,
        0x0217: Drive.QUICK_STOP_ACTIVE,
        0x021F: Drive.FAULT_REACTION_ACTIVE,
        0x0218: Drive.FAULT,
        0x0022: None,
    }
    assert {word: drive_state(word) for word in words} == words


def test_the_codec_packs_and_reads_and_refuses_other_lengths() -> None:
    codec = Cia402Codec(5)
    assert (codec.command_id, codec.feedback_id) == (0x205, 0x185)
    assert codec.command(Control.ENABLE_OPERATION, -2).hex() == "0f00feffffff"
    reading = codec.reading(bytes.fromhex("3706feffffff"))
    assert reading is not None
    assert (reading.state, reading.counts) == (Drive.OPERATION_ENABLED, -2)
    assert [codec.reading(bytes(n)) for n in (0, 5, 7, 8)] == [None] * 4


def test_every_safety_object_of_a_drive_is_among_those_written_with_its_value() -> None:
    axis = FILE.bus[0].axis[1]
    values = {entry.key: entry.value for entry in final(axis_objects(FILE, axis, 0.004))}
    assert values["0x1017:00"] == 50
    assert values["0x1016:01"] == 126 << 16 | 150
    assert values["0x1400:05"] == 50
    assert (values["0x1006:00"], values["0x1007:00"]) == (4000, 1000)
    assert (values["0x6007:00"], values["0x605A:00"], values["0x605E:00"]) == (3, 6, 2)
    lower, upper = values["0x607D:01"], values["0x607D:02"]
    assert lower < 0 < upper
    assert upper == round(-axis.limits[0] * axis.scale)  # its sign is -1
    assert values["0x6065:00"] == round(0.1 * 1_048_576)
    safety = {entry.index for entry in axis_objects(FILE, axis, 0.004) if entry.is_safety}
    asked = {0x1017, 0x1016, 0x1400, 0x1006, 0x1007, 0x1029, 0x6007, 0x605A, 0x605E}
    assert safety >= asked | {0x6065, 0x6066, 0x607D, 0x6072}


def test_other_tools_read_the_exported_files(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["can", "bipegtransfer", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert len(done.output.split()) == len(list(tmp_path.iterdir())) == 16
    dictionary = canopen.import_od(str(tmp_path / "PSM1-pitch.dcf"))
    assert dictionary.node_id == 2
    for entry in final(axis_objects(FILE, FILE.bus[0].axis[1], 1 / FILE.cycle_hz)):
        variable = dictionary[entry.index]
        if entry.sub or not isinstance(variable, canopen.objectdictionary.ODVariable):
            variable = variable[entry.sub]
        assert variable.value == entry.value, entry.key
        assert len(variable) == 8 * entry.size
    bus = cantools.database.load_file(tmp_path / "PSM1.dbc")
    data_ = Cia402Codec(2).command(15, 1_048_576)
    assert bus.decode_message(0x202, data_) == {"controlword": 15, "target": -1.0}
    assert bus.decode_message(0x1C0, b"\x01\xfe\x05\x00")["consent"] == 1


def test_axes_of_a_bus_are_the_joints_and_the_jaw() -> None:
    assert AXES[-1] == "jaw"
    assert isinstance(FILE.bus[0], Bus)
    assert tuple(axis.joint for axis in FILE.bus[0].axis) == AXES
