"""A video of a recorded episode, rendered by a process of its own.

MuJoCo chooses its graphics library when it is imported, and a graphics library that is missing or
broken can end the process. So a child renders: first with EGL, then with OSMesa. A machine without
either gets a note that says what to install, and the run goes on.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

BACKENDS = ("egl", "osmesa")
GL_READY = "graphics ready"
"""What the child says as soon as it can draw: a failure before it is the graphics library's."""

DATA_AT_FAULT = 3
"""Exit code of the child when the recording, not the machine, is what stands in the way."""

INSTALL = "On Debian or Ubuntu: apt-get install libosmesa6, or libegl1 libgl1-mesa-dri"


@dataclass(frozen=True, slots=True)
class Video:
    """The outcome of a rendering.

    Attributes:
        path: the mp4 file, None when there is none.
        note: why there is none and what to do; "" otherwise.
        backend: the graphics library that drew it.
    """

    path: Path | None
    note: str = ""
    backend: str = ""


def render_video(
    recording: Path,
    path: Path,
    episode: int | None = None,
    timeout_s: float = 300.0,
    backends: Sequence[str] = BACKENDS,
) -> Video:
    """Renders an episode of a recording from measured joints and object poses to an mp4 file.

    Args:
        recording: the bag.
        path: the mp4 to write.
        episode: which one; None for everything.
        timeout_s: longest time for one attempt, s.
        backends: graphics libraries to try, values of MUJOCO_GL; that variable itself, when set,
            is tried first.
    """
    chosen = os.environ.get("MUJOCO_GL", "")
    failures = []
    for backend in dict.fromkeys([*([chosen] if chosen else []), *backends]):
        final, reason = _attempt(recording, path, episode, timeout_s, backend)
        if not reason:
            return Video(path, backend=backend)
        if final:
            return Video(None, f"no video: {reason}")
        failures.append(f"{backend}: {reason}")
    return Video(None, f"no video: no graphics library works ({'; '.join(failures)}). {INSTALL}")


def _attempt(
    recording: Path, path: Path, episode: int | None, timeout_s: float, backend: str
) -> tuple[bool, str]:
    """Whether trying another library is of no use, and why there is no video ("": there is)."""
    command = [sys.executable, "-P", "-m", "viskill_deploy.observe.video_process"]
    command += [str(recording), str(path), "all" if episode is None else str(episode)]
    environment = os.environ | {"MUJOCO_GL": backend, "OPENBLAS_NUM_THREADS": "1"}
    if backend in {"egl", "osmesa"}:
        environment["PYOPENGL_PLATFORM"] = backend
    try:
        child = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        path.unlink(missing_ok=True)
        return True, f"rendering took more than {timeout_s:.0f} s; render a shorter episode"
    if child.returncode == 0 and path.is_file():
        return True, ""
    lines = child.stderr.strip().splitlines()
    reason = lines[-1] if lines else f"the renderer ended with exit code {child.returncode}"
    path.unlink(missing_ok=True)
    return GL_READY in child.stdout or child.returncode == DATA_AT_FAULT, reason
