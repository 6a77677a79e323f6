"""The distances of a cell's file: complete, sensible, and never less than the gate accepts."""

import math
from dataclasses import replace

import numpy as np
import pytest
from gate_rig import PERIOD

from viskill_deploy.core.cell_files import Clearance, Distances, KeepOut
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.robot_files import validated
from viskill_deploy.safety import ceilings
from viskill_deploy.safety.clearances import Apart, clearances, standing
from viskill_deploy.safety.envelope import CellEnvelope

CELLS = ["bipegtransfer", "bipegboard", "matchboardpanel"]
CELL = load_cell("bipegtransfer")
GIVEN = CELL.file.distances


def with_distances(cell: CellDescription = CELL, **changes) -> CellDescription:
    distances = cell.file.distances.model_copy(update=changes)
    return replace(cell, file=cell.file.model_copy(update={"distances": distances}))


def with_pair(pair: str, **changes) -> CellDescription:
    apart = GIVEN.apart | {pair: GIVEN.apart[pair].model_copy(update=changes)}
    return with_distances(apart=apart)


def refused(cell: CellDescription) -> str:
    with pytest.raises(DataFileError) as error:
        CellEnvelope.of(cell, PERIOD)
    return error.value.key


def names(cell: CellDescription) -> set[str]:
    return {apart.pair for apart in clearances(cell)}


@pytest.mark.parametrize("name", CELLS)
def test_a_cell_holds_apart_what_its_file_names(name):
    cell = load_cell(name)
    assert names(cell) == set(cell.file.distances.apart)
    for apart in clearances(cell):
        given = cell.file.distances.apart[apart.pair]
        assert (apart.slow, apart.stop, apart.spare) == (given.slow_m, given.stop_m, given.spare_m)
        arm, other = apart.arms
        assert 0 <= arm < len(cell.arms)
        assert other == -1 or arm != other
        assert apart.radius > 0.0


@pytest.mark.parametrize(
    ("opening", "widest"), [(-0.2, 0.0), (0.5, 0.5), (math.pi, math.pi), (4.0, math.pi)]
)
def test_a_jaw_is_as_thick_as_it_can_open(opening, widest):
    first = CELL.arms[0]
    jaw = first.arm.jaw.model_copy(update={"upper_rad": opening})
    arms = (replace(first, arm=replace(first.arm, jaw=jaw)), CELL.arms[1])
    box = KeepOut(name="lamp", lower_m=(0.1, 0.1, 0.1), upper_m=(0.2, 0.2, 0.2))
    wide = Clearance(slow_m=0.004, stop_m=0.002)
    apart = GIVEN.apart | {f"{part}_keep_out": wide for part in ("shaft", "wrist", "jaw")}
    found = clearances(with_distances(replace(CELL, arms=arms), apart=apart, keep_out=(box,)))
    (radius,) = {a.radius for a in found if a.pair == "jaw_keep_out" and a.arms[0] == 0}
    assert radius == pytest.approx(0.0017 + 0.0102 * math.sin(widest / 2))


def sampled_gap(apart: Apart, ports: np.ndarray, points: np.ndarray) -> float:
    """The distance of two surfaces from 400 points of each core line, and no code of the gate's."""

    def core(arm: int, part: int) -> np.ndarray:
        tip, jaw_end, wrist, shaft_end = points[arm]
        ends = {0: (ports[arm], shaft_end), 1: (wrist, tip), 2: (tip, jaw_end)}[part]
        return np.array(ends)

    def along(ends: np.ndarray) -> np.ndarray:
        return ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])

    own = core(apart.arms[0], apart.parts[0])
    length = np.linalg.norm(own[1] - own[0])
    own[1] += (own[0] - own[1]) * min(apart.spare / length, 1.0)
    line = along(own)
    if apart.pair.split("_", 1)[1] in ("shaft", "wrist", "jaw"):
        away = line[:, None] - along(core(apart.arms[1], apart.parts[1]))[None]
    else:
        away = line - np.clip(line, *np.array(apart.box))
    return float(np.linalg.norm(away, axis=-1).min()) - apart.radius


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.invariant("S14")
def test_the_distance_of_every_pair_is_that_of_its_surfaces(name):
    rng, cell = np.random.default_rng(0), load_cell(name)
    found = clearances(cell)
    for _ in range(20):
        ports = rng.uniform(-0.02, 0.02, (len(cell.arms), 3))
        ports += np.array((0.0, 0.0, 0.1))
        points = rng.uniform(-0.05, 0.05, (len(cell.arms), 4, 3))
        own = [[tuple(point) for point in arm] for arm in points.tolist()]
        for apart in found:
            gap = apart.gap(tuple(map(tuple, ports.tolist())), own)
            assert gap == pytest.approx(sampled_gap(apart, ports, points), abs=3e-4)


@pytest.mark.parametrize(
    ("pair", "radius", "count"),
    [
        ("shaft_shaft", 0.0084, 1),
        ("shaft_wrist", 0.0067, 2),
        ("wrist_wrist", 0.005, 1),
        ("shaft_peg", 0.0057, 24),
        ("shaft_plate", 0.0042, 2),
        ("wrist_plate", 0.0025, 2),
    ],
)
def test_pairs_of_the_peg_cell_have_the_radii_of_their_parts(pair, radius, count):
    found = [apart for apart in clearances(CELL) if apart.pair == pair]
    assert [apart.radius for apart in found] == pytest.approx([radius] * count)
    if pair == "shaft_wrist":  # each shaft with the other's wrist, the shaft first
        assert sorted(apart.arms for apart in found) == [(0, 1), (1, 0)]
        assert {apart.parts for apart in found} == {(0, 1)}


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("bipegtransfer", {"plate": 1, "peg": 12}),
        ("bipegboard", {"plate": 2, "peg": 14}),
        ("matchboardpanel", {"plate": 2, "door": 2}),
    ],
)
def test_what_stands_in_a_cell_comes_from_its_own_tables(name, kinds):
    boxes = list(standing(load_cell(name).file))
    found = [kind for kind, *_ in boxes]
    assert {kind: found.count(kind) for kind in set(found)} == kinds
    assert all(a <= b for _, low, high, _ in boxes for a, b in zip(low, high, strict=True))


def test_pegs_wall_and_doors_stand_where_the_files_put_them():
    (peg, *_) = [box for box in standing(CELL.file) if box[0] == "peg"]
    assert peg == ("peg", (-0.03, 0.043, 0.0), (-0.03, 0.043, 0.0235), 0.0015)
    boxes = list(standing(load_cell("bipegboard").file))
    wall = [box for box in boxes if box[0] == "plate"][1]
    assert wall[1] == pytest.approx((-0.0897, -0.092, -0.0078))
    assert wall[2] == pytest.approx((-0.0819, 0.092, 0.158))
    hook = [box for box in boxes if box[0] == "peg"][2]
    assert hook[1] == (-0.0819, -0.06475, 0.0701)
    assert hook[2] == pytest.approx((-0.0819 + 0.0232 - 0.0026, -0.06475, 0.0701))
    assert hook[3] == 0.0026
    panel = list(standing(load_cell("matchboardpanel").file))
    assert panel[1][1] == pytest.approx((-0.0375, -0.0375, 0.0))
    assert panel[1][2] == pytest.approx((0.0375, 0.0375, 0.00235))
    door, handle = panel[2:]
    assert door[1] == pytest.approx((-0.03725, -0.0375, 0.0))
    assert door[2] == pytest.approx((0.03725, 0.1175, 0.00985))
    assert handle[1] == pytest.approx((-0.025, 0.03625, 0.0))
    assert handle[2] == pytest.approx((0.025, 0.11625, 0.0136))
    assert handle[3] == 0.00125


@pytest.mark.parametrize("pair", sorted(GIVEN.apart))
@pytest.mark.parametrize("key", ["slow_m", "stop_m"])
@pytest.mark.parametrize("factor", [0.95, 0.0, -1.0, 1000.0, math.nan, math.inf, -math.inf])
@pytest.mark.invariant("S14")
def test_no_distance_gets_looser_or_nonsense(pair, key, factor):
    if key == "stop_m" and factor == 1000.0:
        factor = 100.0
    value = getattr(GIVEN.apart[pair], key) * factor
    with pytest.raises(DataFileError) as error:
        CellEnvelope.of(with_pair(pair, **{key: value}), PERIOD)
    assert error.value.key == f"distances.apart.{pair}.{key}"
    assert error.value.path == CELL.files[0]


def test_things_that_may_touch_may_be_held_apart_by_any_distance_but_none():
    contact = tuple(name for name in GIVEN.contact if name != "jaw_jaw")

    def held_apart(slow: float, stop: float) -> CellDescription:
        apart = GIVEN.apart | {"jaw_jaw": Clearance.model_construct(slow_m=slow, stop_m=stop)}
        return with_distances(apart=apart, contact=contact)

    assert CellEnvelope.of(held_apart(2e-320, 1e-320), PERIOD)
    assert refused(held_apart(0.0, 0.0)) == "distances.apart.jaw_jaw.slow_m"
    assert refused(held_apart(1e-320, 0.0)) == "distances.apart.jaw_jaw.stop_m"


@pytest.mark.parametrize("pair", sorted(GIVEN.apart))
def test_distances_may_be_larger(pair):
    given = GIVEN.apart[pair]
    wide = with_pair(pair, slow_m=1.05 * given.slow_m, stop_m=1.05 * given.stop_m)
    assert CellEnvelope.of(wide, PERIOD)


@pytest.mark.parametrize("pair", sorted(GIVEN.apart))
def test_a_stop_distance_is_below_the_slow_one(pair):
    given = GIVEN.apart[pair]
    swapped = {"slow_m": given.stop_m, "stop_m": given.slow_m}
    assert refused(with_pair(pair, **swapped)).startswith(f"distances.apart.{pair}")
    table = {"apart": {pair: swapped}, "contact": []}
    with pytest.raises(DataFileError, match="must be below slow_m"):
        validated(CELL.files[0], Distances, table)


@pytest.mark.parametrize("value", [0.0126, 12.0, -0.001, math.nan])
def test_no_more_of_a_shaft_is_left_out_than_a_hand_over_needs(value):
    assert refused(with_pair("shaft_wrist", spare_m=value)).endswith("spare_m")


@pytest.mark.parametrize("pair", sorted(set(GIVEN.apart) - {"shaft_wrist"}))
def test_only_a_shaft_beside_a_wrist_may_leave_an_end_out(pair):
    assert refused(with_pair(pair, spare_m=0.001)) == f"distances.apart.{pair}.spare_m"


@pytest.mark.parametrize("pair", sorted(ceilings.LEAST_APART))
@pytest.mark.invariant("S14")
def test_what_must_stay_apart_cannot_be_named_as_touching(pair):
    apart = {name: value for name, value in GIVEN.apart.items() if name != pair}
    cell = with_distances(apart=apart, contact=(*GIVEN.contact, pair))
    assert refused(cell) == f"distances: {pair}"


@pytest.mark.parametrize("pair", sorted({*GIVEN.apart, *GIVEN.contact}))
@pytest.mark.invariant("S14")
def test_no_pair_of_the_cell_can_be_forgotten(pair):
    apart = {name: value for name, value in GIVEN.apart.items() if name != pair}
    contact = tuple(name for name in GIVEN.contact if name != pair)
    assert refused(with_distances(apart=apart, contact=contact)) == f"distances: {pair}"


@pytest.mark.parametrize("pair", sorted(GIVEN.contact))
def test_what_may_touch_may_also_be_kept_apart_but_not_both(pair):
    clearance = Clearance(slow_m=1e-4, stop_m=1e-5)
    apart = GIVEN.apart | {pair: clearance}
    assert refused(with_distances(apart=apart)) == f"distances: {pair}"
    contact = tuple(name for name in GIVEN.contact if name != pair)
    assert pair in names(with_distances(apart=apart, contact=contact))
    less = GIVEN.apart | {pair: clearance.model_copy(update={"stop_m": 0.0})}
    assert refused(with_distances(apart=less, contact=contact)).endswith("stop_m")


def test_every_pair_is_either_one_that_may_touch_or_has_a_least_distance():
    everything = set(ceilings.LEAST_APART) | ceilings.MAY_TOUCH
    assert not set(ceilings.LEAST_APART) & ceilings.MAY_TOUCH
    assert everything == {
        *("shaft_shaft", "shaft_wrist", "shaft_jaw", "wrist_wrist", "wrist_jaw", "jaw_jaw"),
        *(
            f"{p}_{k}"
            for p in ("shaft", "wrist", "jaw")
            for k in ("peg", "plate", "door", "keep_out")
        ),
    }
    for slow, stop in ceilings.LEAST_APART.values():
        assert 0.0 < stop < slow < ceilings.MAX_APART_M


def test_a_keep_out_box_keeps_out_every_part_of_every_arm():
    box = KeepOut(name="lamp", lower_m=(0.1, 0.1, 0.1), upper_m=(0.2, 0.2, 0.2))
    assert refused(with_distances(keep_out=(box,))) == "distances: jaw_keep_out"
    wide = Clearance(slow_m=0.004, stop_m=0.002)
    apart = GIVEN.apart | {f"{part}_keep_out": wide for part in ("shaft", "wrist", "jaw")}
    found = clearances(with_distances(apart=apart, keep_out=(box,)))
    kept = [a for a in found if a.pair.endswith("keep_out")]
    assert sorted((a.arms[0], a.parts[0]) for a in kept) == [
        (a, p) for a in range(2) for p in range(3)
    ]
    assert {a.box for a in kept} == {((0.1, 0.1, 0.1), (0.2, 0.2, 0.2))}
    jaw = next(a for a in kept if a.parts[0] == 2)
    opening = CELL.arms[0].arm.jaw.upper_rad
    assert jaw.radius == pytest.approx(0.0017 + 0.0102 * math.sin(opening / 2))


@pytest.mark.parametrize("part", ["shaft", "wrist", "jaw"])
@pytest.mark.parametrize("key", ["slow_m", "stop_m"])
@pytest.mark.parametrize("factor", [0.99, 0.0, -1.0, math.nan])
@pytest.mark.invariant("S14")
def test_no_distance_from_a_keep_out_box_gets_looser(part, key, factor):
    box = KeepOut(name="lamp", lower_m=(0.1, 0.1, 0.1), upper_m=(0.2, 0.2, 0.2))
    wide = Clearance(slow_m=0.004, stop_m=0.002)
    apart = GIVEN.apart | {f"{name}_keep_out": wide for name in ("shaft", "wrist", "jaw")}
    near = wide.model_copy(update={key: factor * getattr(wide, key)})
    cell = with_distances(apart=apart | {f"{part}_keep_out": near}, keep_out=(box,))
    assert refused(cell) == f"distances.apart.{part}_keep_out.{key}"


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_no_bound_is_wide_enough_for_what_is_no_number(value):
    with pytest.raises(DataFileError):
        ceilings.check(CELL.files[0], "key", value, -math.inf, math.inf)


@pytest.mark.parametrize("axis", range(3))
def test_a_keep_out_box_has_its_corners_in_order(axis):
    upper = [0.2, 0.2, 0.2]
    upper[axis] = 0.1
    with pytest.raises(ValueError, match="every axis"):
        KeepOut(name="lamp", lower_m=(0.1, 0.1, 0.1), upper_m=tuple(upper))


def test_an_unknown_pair_is_refused_by_name():
    table = {"apart": {"shaft_cable": {"slow_m": 0.004, "stop_m": 0.002}}, "contact": []}
    with pytest.raises(DataFileError, match="shaft_cable"):
        validated(CELL.files[0], Distances, table)


@pytest.mark.parametrize("part", ["shaft", "wrist", "jaw"])
@pytest.mark.parametrize("factor", [0.95, 0.0, -1.0, 1000.0, math.nan])
def test_no_instrument_gets_thinner(part, factor):
    first = CELL.arms[0]
    key = f"{part}_radius_m"
    shape = first.arm.shape.model_copy(update={key: getattr(first.arm.shape, key) * factor})
    cell = replace(CELL, arms=(replace(first, arm=replace(first.arm, shape=shape)), CELL.arms[1]))
    assert refused(cell) == f"shape.{key}"


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("value", [0.0101, -0.0101, math.nan, math.inf])
@pytest.mark.invariant("S12")
def test_a_port_far_from_the_remote_centre_is_refused(axis, value):
    port = tuple(value * (i == axis) if i == axis else 0.0 for i in range(3))
    first = CELL.arms[0]
    entry = first.entry.model_copy(update={"port_in_base_m": port})
    cell = replace(CELL, arms=(replace(first, entry=entry), CELL.arms[1]))
    assert refused(cell) == "arm.PSM1.port_in_base_m"


@pytest.mark.invariant("S12")
def test_the_port_is_taken_into_the_task_frame():
    first = CELL.arms[0]
    entry = first.entry.model_copy(update={"port_in_base_m": (0.001, -0.002, 0.003)})
    cell = replace(CELL, arms=(replace(first, entry=entry), CELL.arms[1]))
    expected = first.T_task_base @ [0.001, -0.002, 0.003, 1.0]
    assert CellEnvelope.of(cell, PERIOD).arms[0].port == pytest.approx(expected[:3], abs=1e-15)


@pytest.mark.invariant("S12")
def test_a_warning_comes_before_a_stop():
    first = CELL.arms[0]
    gate = first.arm.gate.model_copy(update={"port_warn_m": 0.0009, "port_stop_m": 0.0008})
    cell = replace(CELL, arms=(replace(first, arm=replace(first.arm, gate=gate)), CELL.arms[1]))
    assert refused(cell) == "gate.port_stop_m"
