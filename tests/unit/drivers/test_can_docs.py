"""docs/can.md says what the code does."""

import re
from pathlib import Path

import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.can.config import INPUT_PERIOD_S, load_can
from viskill_deploy.drivers.can.inputs import SILENT_S, pack_input
from viskill_deploy.drivers.can.load import BusTraffic, check_load
from viskill_deploy.drivers.can.objects import axis_objects, final
from viskill_deploy.runtime.small_motion import SIZES

TEXT = (Path(__file__).resolve().parents[3] / "docs" / "can.md").read_text()
FILE = load_can("bipegtransfer", load_cell("bipegtransfer"))


def rows(*, after: str) -> list[list[str]]:
    """Cells of the first table after a heading or sentence, without its head."""
    table = re.search(r"(?:^\|.*\n)+", TEXT[TEXT.index(after) :], re.MULTILINE)
    assert table is not None
    lines = table[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_table_of_objects_is_what_a_drive_is_given() -> None:
    told = final(axis_objects(FILE, FILE.bus[0].axis[0], 1.0 / FILE.cycle_hz))
    said = [[o.key, o.name, o.value, o.is_safety] for o in told]
    read = [
        [key, name, int(value, 0), safety == "yes"]
        for key, name, value, safety in rows(after="## Objects that every drive")
    ]
    assert read == said


def test_the_bus_loads_are_those_of_the_code() -> None:
    table = rows(after="Bus loads, at worst-case")
    assert len(table) == 7
    for axes, rate, rate_bit, fast, said in table:
        data_rate = None if fast == "–" else round(float(fast) * 1e6)
        bitrate = round(float(rate_bit) * 1e6)
        beats_s = FILE.heartbeat_s / (int(axes) + 2)
        traffic = BusTraffic(
            int(axes), 1 / float(rate), beats_s, INPUT_PERIOD_S, bitrate, data_rate
        )
        assert said.startswith(f"{traffic.load * 100:.1f} %")
        if said.endswith("refused"):
            with pytest.raises(DriverError):
                check_load("PSM1", traffic)
        else:
            check_load("PSM1", traffic)


def test_the_input_nodes_word_and_the_sizes_of_small_motions_are_those_of_the_code() -> None:
    assert pack_input(True, False, 0x0102) == bytes([0b01, 0xFE, 0x02, 0x01])
    assert pack_input(False, True, 0)[0] == 0b10
    assert (INPUT_PERIOD_S, SILENT_S) == (0.02, 0.1)
    assert "every 20 ms" in TEXT
    assert "0.1 s without a word" in TEXT
    assert SIZES == (0.05, 0.05, 0.005, 0.2, 0.2, 0.2, 0.2)
    assert "by 3°\n(5 mm, 11° at the wrist)" in TEXT
