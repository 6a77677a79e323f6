"""A configuration as files for other tools: a DCF (EDS with values) a drive, a DBC a bus."""

from __future__ import annotations

from pathlib import Path

from viskill_deploy.drivers.can.codec import (
    EMCY_ID,
    HEARTBEAT_ID,
    RPDO_ID,
    SYNC_ID,
    TPDO_ID,
)
from viskill_deploy.drivers.can.config import Bus, CanFile, LinearAxis, RotaryAxis
from viskill_deploy.drivers.can.objects import DriveObject, axis_objects, final

_TYPES = {(1, True): 2, (2, True): 3, (4, True): 4, (1, False): 5, (2, False): 6, (4, False): 7}
"""CANopen's numbers of the types, by size and sign."""

PROCESS_DATA = (
    DriveObject(0x6040, 0, 2, False, 0, "controlword"),
    DriveObject(0x6041, 0, 2, False, 0, "statusword"),
    DriveObject(0x6064, 0, 4, True, 0, "position actual value"),
    DriveObject(0x607A, 0, 4, True, 0, "target position"),
    DriveObject(0x603F, 0, 2, False, 0, "error code"),
    DriveObject(0x6061, 0, 1, True, 0, "mode of operation display"),
)
READ_ONLY = (0x6041, 0x6064, 0x603F, 0x6061)
IDENTITY = (
    DriveObject(0x1000, 0, 4, False, 0x0002_0192, "device type"),
    DriveObject(0x1001, 0, 1, False, 0, "error register"),
    DriveObject(0x1018, 1, 4, False, 0, "vendor id"),
)
MANDATORY = (0x1000, 0x1001, 0x1018)


def export(file: CanFile, folder: Path) -> list[Path]:
    """Writes `<arm>.dbc` for every bus and `<arm>-<joint>.dcf` for every drive; returns them."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for bus in file.bus:
        texts = {f"{bus.arm}.dbc": dbc_text(file, bus)}
        texts |= {f"{bus.arm}-{axis.joint}.dcf": dcf_text(file, bus, axis) for axis in bus.axis}
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="ascii")
            written.append(folder / name)
    return written


def dcf_text(file: CanFile, bus: Bus, axis: RotaryAxis | LinearAxis) -> str:
    """One drive's dictionary with the values that are written at start-up."""
    values = final(axis_objects(file, axis, 1.0 / file.cycle_hz))
    entries: dict[int, list[DriveObject]] = {}
    for entry in sorted((*IDENTITY, *PROCESS_DATA, *values), key=lambda e: (e.index, e.sub)):
        entries.setdefault(entry.index, []).append(entry)
    lines = [
        "[FileInfo]",
        f"FileName={bus.arm}-{axis.joint}.dcf",
        "FileVersion=1",
        "EDSVersion=4.0",
        f"Description={bus.arm} {axis.joint}",
        "[DeviceInfo]",
        "VendorName=any",
        "ProductName=CiA 402 drive",
        f"BaudRate_{bus.bitrate_bit_s // 1000}=1",
        "[DeviceComissioning]",  # the standard spells it so
        f"NodeID=0x{axis.node_id:X}",
        f"Baudrate={bus.bitrate_bit_s // 1000}",
    ]
    lines += _list("MandatoryObjects", [i for i in entries if i in MANDATORY])
    lines += _list("OptionalObjects", [i for i in entries if i not in MANDATORY])
    for index, group in entries.items():
        if group[-1].sub == 0:
            lines += [f"[{index:04X}]", *_variable(group[0])]
            continue
        top = max(entry.sub for entry in group)
        lines += [f"[{index:04X}]", f"ParameterName={_object_name(group)}", "ObjectType=0x9"]
        lines += [f"SubNumber={len({e.sub for e in group} | {0})}"]
        if group[0].sub != 0:
            lines += [f"[{index:04X}sub0]", *_variable(DriveObject(index, 0, 1, False, top, "top"))]
        for entry in group:
            lines += [f"[{index:04X}sub{entry.sub:X}]", *_variable(entry)]
    return "\n".join(lines) + "\n"


def _object_name(group: list[DriveObject]) -> str:
    return group[-1].name.split(",")[0]


def _list(name: str, indices: list[int]) -> list[str]:
    numbered = [f"{n}=0x{index:04X}" for n, index in enumerate(indices, 1)]
    return [f"[{name}]", f"SupportedObjects={len(indices)}", *numbered]


def _variable(entry: DriveObject) -> list[str]:
    is_fixed = entry.index in (*READ_ONLY, *MANDATORY)
    lines = [
        f"ParameterName={entry.name}",
        "ObjectType=0x7",
        f"DataType=0x{_TYPES[entry.size, entry.is_signed]:04X}",
        f"AccessType={'ro' if is_fixed else 'rw'}",
        f"PDOMapping={int(entry in PROCESS_DATA)}",
    ]
    if entry not in PROCESS_DATA and not is_fixed:
        lines += [f"ParameterValue={entry.value}"]
    return lines


def dbc_text(file: CanFile, bus: Bus) -> str:
    """The cyclic frames of one bus, with units, for tools that draw signals."""
    lines = ['VERSION ""', "BS_:", "BU_: master " + " ".join(axis.joint for axis in bus.axis)]
    lines += [f"BO_ {SYNC_ID} SYNC: 0 master"]
    for axis in bus.axis:
        factor, unit = axis.sign / axis.scale, "m" if axis.type == "linear" else "rad"
        position = f"16|32@1- ({factor!r},{axis.offset:.12g}) [0|0]"
        node = axis.node_id
        lines += [
            f"BO_ {RPDO_ID + node} {axis.joint}_command: 6 master",
            f' SG_ controlword : 0|16@1+ (1,0) [0|65535] "" {axis.joint}',
            f' SG_ target : {position} "{unit}" {axis.joint}',
            f"BO_ {TPDO_ID + node} {axis.joint}_feedback: 6 {axis.joint}",
            ' SG_ statusword : 0|16@1+ (1,0) [0|65535] "" master',
            f' SG_ position : {position} "{unit}" master',
            f"BO_ {EMCY_ID + node} {axis.joint}_emergency: 8 {axis.joint}",
            ' SG_ code : 0|16@1+ (1,0) [0|65535] "" master',
            f"BO_ {HEARTBEAT_ID + node} {axis.joint}_heartbeat: 1 {axis.joint}",
            ' SG_ state : 0|7@1+ (1,0) [0|127] "" master',
        ]
    if bus.arm == file.input.bus:
        lines += [
            f"BO_ {TPDO_ID + file.input.node_id} input: 4 Vector__XXX",
            ' SG_ consent : 0|1@1+ (1,0) [0|1] "" master',
            ' SG_ estop : 1|1@1+ (1,0) [0|1] "" master',
            ' SG_ complement : 8|8@1+ (1,0) [0|255] "" master',
            ' SG_ counter : 16|16@1+ (1,0) [0|65535] "" master',
        ]
    return "\n".join(lines) + "\n"
