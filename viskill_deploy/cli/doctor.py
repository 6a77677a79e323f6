"""`viskill doctor`: what this machine has, what it lacks, and what to do about it."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import platform
import sys
from ctypes.util import find_library
from pathlib import Path
from typing import Annotated, Any

import typer

from viskill_deploy.bundle.format import load_bundle
from viskill_deploy.core import data, realtime
from viskill_deploy.core.description import load_cell, load_robot
from viskill_deploy.core.errors import ViskillError, extra_advice
from viskill_deploy.core.robot_files import ToolFile, read_toml
from viskill_deploy.drivers.crtk.readiness import MODULES, choose, readiness

EXAMPLE = "Example: viskill doctor --json"

PARTS = ("pin", "mujoco", "ruckig", "daqp", "osqp", "qpsolvers", "onnxruntime", "numpy", "rosbags")
AGAIN = "in your clone of viskill_deploy: pip install -e ."
EXTRAS = {
    "train": "torch",
    "import": "onnx",
    "ros": "cyclonedds",
    "can": "canopen",
    "view": "viser",
}


def command(
    json_: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Show versions, optional parts, data files and real-time permissions of this machine."""
    found = _examine()
    if json_:
        print(json.dumps(found))
    else:
        _print(found)
    if found["problems"]:
        raise typer.Exit(3)


def _examine() -> dict[str, Any]:
    files, problems = _data_files()
    parts = {part: _version(part) for part in PARTS}
    problems += [f"{part} is missing; {AGAIN}" for part in PARTS if not parts[part]]
    bundles = _bundles()
    for bundle in bundles:
        try:
            load_bundle(Path(bundle))
        except ViskillError as error:
            problems.append(str(error))
    return {
        "viskill_deploy": _version("viskill-deploy"),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}, {os.cpu_count()} cores",
        "parts": parts,
        "extras": {
            extra: importlib.util.find_spec(module) is not None for extra, module in EXTRAS.items()
        },
        "crtk": _crtk(),
        "real_time_refusals": realtime.refusals(),
        "video": {lib: find_library(lib) is not None for lib in ("EGL", "OSMesa")},
        "data_roots": [str(root) for root in data.data_roots() if root.is_dir()],
        "data_roots_to_be": [str(root) for root in data.own_roots() if not root.is_dir()],
        "data_files": files,
        "bundles": bundles,
        "problems": problems,
    }


def _crtk() -> dict[str, Any]:
    """Which transports of CRTK can be opened here, and which one "auto" takes."""
    transports = {
        name: {"ready": not found.missing, "missing": list(found.missing), "advice": found.advice}
        for name in MODULES
        for found in (readiness(name),)
    }
    try:
        auto: dict[str, str] | None = dataclasses.asdict(choose())
    except ViskillError:
        auto = None
    return {"transports": transports, "auto": auto}


def _data_files() -> tuple[dict[str, str], list[str]]:
    """Hash of every robot, tool and cell file, and what is wrong with any of them."""
    hashes, problems = {}, []
    for folder in ("robots", "robots/tools", "robots/cells"):
        for name in data.names(folder):
            path = data.find(f"{folder}/{name}.toml")
            hashes[str(path)] = data.sha256(path)
    for cell in data.names("robots/cells"):
        try:
            load_cell(cell)
        except ViskillError as error:
            problems.append(str(error))
    for tool in data.names("robots/tools"):
        try:
            generation = read_toml(data.find(f"robots/tools/{tool}.toml"), ToolFile).generation
            load_robot(f"psm_{generation.lower()}", tool)
        except ViskillError as error:
            problems.append(str(error))
    return hashes, problems


def _bundles() -> list[str]:
    manifests = (
        p for root in data.data_roots() for p in (root / "policies").glob("*/manifest.json")
    )
    return sorted({str(path.parent) for path in manifests})


def _version(part: str) -> str:
    """Version of an installed part, "" when it is missing."""
    try:
        return importlib.metadata.version(part)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _print(found: dict[str, Any]) -> None:
    print(f"viskill_deploy {found['viskill_deploy']}, Python {found['python']}, {found['system']}")
    print("parts:   " + ", ".join(f"{name} {v}" for name, v in found["parts"].items()))
    for extra, there in found["extras"].items():
        hint = "installed" if there else f"not installed; {extra_advice(extra)}"
        print(f"extra {extra}: {hint}")
    for name, one in found["crtk"]["transports"].items():
        hint = "ready" if one["ready"] else f"{', '.join(one['missing'])} missing: {one['advice']}"
        print(f"CRTK over {name}: {hint}")
    auto = found["crtk"]["auto"]
    print(f"CRTK by itself: {auto['name'] + ', since ' + auto['reason'] if auto else 'none'}")
    for refusal in found["real_time_refusals"] or ["granted, and memory can be locked"]:
        print(f"real-time scheduling: {refusal}")
    drawn = [lib for lib, there in found["video"].items() if there]
    hint = "none; on Debian or Ubuntu: apt-get install libosmesa6, or libegl1 libgl1-mesa-dri"
    print(f"graphics for videos: {', '.join(drawn) or hint}")
    to_be = [f"{root} (not there yet)" for root in found["data_roots_to_be"]]
    print(f"data:    {', '.join([*to_be, *found['data_roots']])}; {len(found['data_files'])} files")
    for bundle in found["bundles"]:
        print(f"bundle:  {Path(bundle)}")
    for problem in found["problems"]:
        print(f"problem: {problem}", file=sys.stderr)
    print("all well" if not found["problems"] else f"{len(found['problems'])} problems")
