"""A node of CRTK in a process of its own, for the tests of transports; ends when its input does.

What it does is its second argument: "echo" sends back what comes, "latch" has said three words,
"serve" answers services. As "rclpy" it echoes without any of our transports.
"""

import ctypes
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import crtk_samples
import rclpy_echo

from viskill_deploy.drivers.crtk.messages import (
    ForwardKinematicsRequest,
    ForwardKinematicsResponse,
    InverseKinematicsRequest,
    InverseKinematicsResponse,
    Point,
    Pose,
    String,
)
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.drivers.crtk.transport import Transport

LATCHED = ("first", "second", "last")


def echo(node: Transport) -> None:
    """Everything of the table: what comes on /there/… goes out on /back/…."""
    for topic in crtk_samples.TOPICS:
        back = node.publisher(f"/back/{topic.name}", topic.message)
        node.subscribe(f"/there/{topic.name}", topic.message, lambda word, _, back=back: back(word))


def latch(node: Transport) -> None:
    """Says what it has to say before anyone listens."""
    publish = node.publisher("/PSM1/status", String, is_latched=True)
    for word in LATCHED:
        publish(String(word))


def serve(node: Transport) -> None:
    """Answers that can be foretold."""
    node.serve(
        "/PSM1/inverse_kinematics", InverseKinematicsRequest, InverseKinematicsResponse, invert
    )
    node.serve(
        "/PSM1/forward_kinematics", ForwardKinematicsRequest, ForwardKinematicsResponse, place
    )


def invert(request: InverseKinematicsRequest) -> InverseKinematicsResponse:
    """The joints doubled, then the position."""
    at = request.cp.position
    joints = (*[2 * joint for joint in request.jp], at.x, at.y, at.z)
    return InverseKinematicsResponse(joints, True, "as foretold")


def place(request: ForwardKinematicsRequest) -> ForwardKinematicsResponse:
    """Three joints as the position."""
    return ForwardKinematicsResponse(Pose(Point(*request.jp[:3])), False, "no such arm")


def strays() -> list[str]:
    """Sockets of this process and its children that others than this machine could reach."""
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    return [text for process in (os.getpid(), *map(int, children)) for text in strays_of(process)]


def strays_of(process: int) -> list[str]:
    """Sockets of one process."""
    handles = {}
    for link in tuple(Path(f"/proc/{process}/fd").iterdir()):
        with suppress(FileNotFoundError):
            handles[str(link.readlink())] = int(link.name)
    found = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{process}/net/{table}").read_text().splitlines()[1:]:
            columns = line.split()
            address, port = columns[1].split(":")
            handle = handles.get(f"socket:[{columns[9]}]")
            if handle is None or address.endswith(LOCAL[len(address)]):
                continue
            if (device(handle) if process == os.getpid() else lent(process, handle)) == b"lo":
                continue
            found.append(f"{table} {address}:{int(port, 16)}")
    return found


LOCAL = {8: "7F", 32: "00000000000000000000000001000000"}
"""How 127.0.0.0/8 and ::1 end in the kernel's tables, by the length of an address."""


PIDFD_GETFD = 438


def lent(process: int, handle: int) -> bytes:
    """The device that another process's socket is tied to."""
    other = os.pidfd_open(process)
    own = ctypes.CDLL(None).syscall(PIDFD_GETFD, other, handle, 0)
    os.close(other)
    assert own >= 0, f"no look at the sockets of process {process}"
    try:
        return device(own)
    finally:
        os.close(own)


def device(handle: int) -> bytes:
    """The device that a socket is tied to; a Python socket for it could change how it blocks."""
    name, size = ctypes.create_string_buffer(16), ctypes.c_uint(16)
    library = ctypes.CDLL(None)
    level, option = socket.SOL_SOCKET, socket.SO_BINDTODEVICE
    assert library.getsockopt(handle, level, option, name, ctypes.byref(size)) == 0
    return name.value


@contextmanager
def peer(name: str, work: str, domain: int) -> Iterator["tuple[subprocess.Popen[str], IO[str]]"]:
    """That process, and its output after "ready"."""
    command = [sys.executable, __file__, name, work, str(domain)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin
        assert process.stdout
        try:
            assert process.stdout.readline() == "ready\n"
            yield process, process.stdout
            process.stdin.close()
            assert json.loads(process.stdout.readline()) == []
            assert process.wait(20) == 0
        finally:
            process.kill()


def main() -> None:
    """Works until the input ends, then tells its stray sockets."""
    name, work, domain = sys.argv[1:]
    if name == "rclpy":
        close = rclpy_echo.start(int(domain))
    else:
        node = open_transport(name, Network(int(domain), LOOPBACK, "peer"))
        {"echo": echo, "latch": latch, "serve": serve}[work](node)
        close = node.close
    print("ready", flush=True)
    sys.stdin.read()
    print(json.dumps(strays()), flush=True)
    close()


if __name__ == "__main__":
    main()
