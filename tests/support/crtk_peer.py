"""A node of CRTK in a process of its own, for the tests of transports; ends when its input does.

What it does is its second argument: "echo" sends back what comes, "latch" has said three words,
"flood" says a number at 200 Hz.
"""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import crtk_samples

from viskill_deploy.drivers.crtk.messages import String
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


def strays() -> list[str]:
    """Sockets of this process that others than this machine's loopback could reach."""
    found = []
    for handle in Path("/proc/self/fd").iterdir():
        try:
            if not str(handle.readlink()).startswith("socket:"):
                continue
            one = socket.socket(fileno=os.dup(int(handle.name)))
        except FileNotFoundError:
            continue
        with one:
            if one.family in {socket.AF_INET, socket.AF_INET6}:
                address, device = (
                    one.getsockname()[0],
                    one.getsockopt(1, socket.SO_BINDTODEVICE, 16),
                )
                is_local = address.startswith("127.") or address == "::1"
                is_bound = bool(one.getsockname()[1])
                if is_bound and not is_local and device.rstrip(b"\0") != b"lo":
                    found.append(f"{address}:{one.getsockname()[1]}")
    return found


@contextmanager
def peer(name: str, work: str, domain: int) -> Iterator[IO[str]]:
    """That process; its output after "ready"."""
    command = [sys.executable, __file__, name, work, str(domain)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin
        assert process.stdout
        try:
            assert process.stdout.readline() == "ready\n"
            yield process.stdout
            process.stdin.close()
            assert json.loads(process.stdout.readline()) == []
            assert process.wait(20) == 0
        finally:
            process.kill()


def main() -> None:
    """Works until the input ends, then tells its stray sockets."""
    name, work, domain = sys.argv[1:]
    node = open_transport(name, Network(int(domain), LOOPBACK, "peer"))
    {"echo": echo, "latch": latch}[work](node)
    print("ready", flush=True)
    sys.stdin.read()
    print(json.dumps(strays()), flush=True)
    node.close()


if __name__ == "__main__":
    main()
