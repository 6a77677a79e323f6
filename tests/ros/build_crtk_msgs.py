"""Builds crtk_msgs into an environment of ROS 2 from PyPI, by ROS's own generators and a compiler.

Where dVRK runs, crtk_msgs is built in its workspace; no package index has it.
"""

import logging
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import chdir
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(HERE))

from viskill_deploy.drivers.crtk.definitions import definition  # noqa: E402
from viskill_deploy.drivers.crtk.messages import OperatingState, StringStamped  # noqa: E402
from viskill_deploy.drivers.crtk.topics import SERVICES  # noqa: E402

PREFIX = Path(sys.prefix)
PACKAGE = Path(sysconfig.get_path("purelib")) / "crtk_msgs"
NEEDED = ("std_msgs", "geometry_msgs", "builtin_interfaces", "service_msgs")
MANIFEST = """<package format="3"><name>crtk_msgs</name><version>1.3.0</version>
<description>Messages of CRTK</description>
<maintainer email="nobody@example.org">nobody</maintainer>
<license>MIT</license></package>"""


def write_definitions(folder: Path) -> list[str]:
    """The files of the package; returns their names in it."""
    texts = {
        f"msg/{m.ROS.split('/')[1]}.msg": definition(m, 2) for m in (OperatingState, StringStamped)
    }
    for one in SERVICES:
        name = one.request.ROS.split("/")[1]
        halves = definition(one.request, 2), definition(one.response, 2)
        texts[f"srv/{name}.srv"] = "---\n".join(halves)
    for name, text in texts.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    (folder / "package.xml").write_text(MANIFEST)
    return list(texts)


def generate(folder: Path, files: list[str]) -> None:
    """C and Python of the messages, under folder/out."""
    from rosidl_cli import entry_points

    # The wheels register every generator twice, which is an error unless asked to be lenient.
    strict = entry_points.get_entry_points
    entry_points.get_entry_points = lambda group, *, specs=None, **_: strict(group, specs=specs)
    logging.disable()
    os.environ["AMENT_PREFIX_PATH"] = sys.prefix
    from rosidl_cli.command.generate.api import generate as run

    with chdir(folder):
        run(
            package_name="crtk_msgs",
            interface_files=files,
            include_paths=[str(PREFIX / "share")],
            output_path=Path("out"),
            types=["c", "py"],
            typesupports=["c", "fastrtps_c", "introspection_c"],
        )


def build(out: Path) -> None:
    """The libraries, and the package for Python."""
    headers = out / "include" / "crtk_msgs"
    for part in ("c", "fastrtps_c", "introspection_c"):
        shutil.copytree(out / part, headers, dirs_exist_ok=True)
    link(out, "generator_c", (*out.glob("c/**/*.c"),))
    libraries = {
        "typesupport_fastrtps_c": (*out.glob("fastrtps_c/**/*.cpp"),),
        "typesupport_introspection_c": (*out.glob("introspection_c/**/*.c"),),
        "typesupport_c": (*out.glob("c/**/*__type_support.cpp"),),
        "generator_py": (*out.glob("py/**/*_s.c"),),
    }
    with ThreadPoolExecutor(2) as pool:
        made = [pool.submit(link, out, *one) for one in libraries.items()]
    for one in made:
        one.result()
    shutil.copytree(out / "py", PACKAGE, dirs_exist_ok=True)
    (PACKAGE / "__init__.py").touch()
    module = PACKAGE / "crtk_msgs_s__rosidl_typesupport_c.so"
    ours = [f"-lcrtk_msgs__rosidl_{name}" for name in libraries]
    compile_to(module, out, [out / "py" / "_crtk_msgs_s.ep.rosidl_typesupport_c.c"], ours)


def link(out: Path, name: str, files: tuple[Path, ...]) -> None:
    """One library, with those of the packages that ours build on."""
    folder = PREFIX / "lib"
    wanted = [f"{package}__rosidl_{name}" for package in NEEDED]
    wanted += ["crtk_msgs__rosidl_generator_c", f"rosidl_{name}", "rosidl_runtime_c", "fastcdr"]
    target = folder / f"libcrtk_msgs__rosidl_{name}.so"
    target.unlink(missing_ok=True)
    known = [f"-l{one}" for one in wanted if (folder / f"lib{one}.so").exists()]
    compile_to(target, out, list(files), known)


def compile_to(target: Path, out: Path, files: list[Path], libraries: list[str]) -> None:
    """Runs the compiler."""
    includes = [out / "include", PREFIX / "include", *(PREFIX / "include").iterdir()]
    includes += [Path(np.get_include()), Path(sysconfig.get_path("include"))]
    compiler = ["g++", "-std=c++17"] if files[0].suffix == ".cpp" else ["gcc"]
    command = [
        *compiler,
        "-O0",
        "-w",
        "-fPIC",
        "-shared",
        *[f"-I{one}" for one in includes],
        *files,
    ]
    command += ["-o", target, f"-L{PREFIX / 'lib'}", "-Wl,--no-as-needed", *libraries]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        generate(root, write_definitions(root))
        build(root / "out")
