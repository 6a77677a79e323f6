"""How long a joint command takes from one process to another, over a transport of CRTK.

One process publishes, the other listens; both read the machine's monotonic clock, and the stamp in
the message carries the sender's. `--busy` opens the topics of two whole arms beside it. ROS 1 needs
a master: `rosmaster --core -p PORT`, with ROS_MASTER_URI saying where.
"""

import argparse
import json
import subprocess
import sys
import time

import numpy as np

from viskill_deploy.drivers.crtk.messages import Header, JointState, Time
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.drivers.crtk.topics import ARM

TOPIC = "/PSM1/servo_jp"
JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transport", default="dds", choices=("dds", "ros1", "ros2"))
    parser.add_argument("--rate", type=float, default=200.0, help="Hz")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--domain", type=int, default=99)
    parser.add_argument("--busy", action="store_true", help="the other topics of two arms too")
    parser.add_argument("--listen", action="store_true", help="the other process; started by this")
    args = parser.parse_args()
    if args.listen:
        listen(args)
        return
    command = [sys.executable, __file__, *sys.argv[1:], "--listen"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        speak(args)
        told, _ = other.communicate("")
    print(told, end="")


def speak(args: argparse.Namespace) -> None:
    node = open_transport(args.transport, Network(args.domain, LOOPBACK, "speaker"))
    publish = node.publisher(TOPIC, JointState)
    others = [node.publisher(*each) for each in beside(args, "server")]
    while node.peers(TOPIC) < 1:
        time.sleep(0.05)
    time.sleep(1.0)
    begin, used = time.monotonic(), time.process_time()
    for tick in range(int(args.rate * args.seconds)):
        time.sleep(max(begin + tick / args.rate - time.monotonic(), 0.0))
        stamp = Header(Time.of_ns(time.monotonic_ns()))
        publish(JointState(stamp, JOINTS, (0.1,) * 6, (0.01,) * 6))
        if others and tick % 2 == 0:
            for other, (_, message) in zip(others, beside(args, "server"), strict=True):
                other(message())
    share = (time.process_time() - used) / (time.monotonic() - begin)
    print(f"{args.transport}: the sender takes {share:.0%} of a core", file=sys.stderr)
    time.sleep(0.5)
    node.close()


def listen(args: argparse.Namespace) -> None:
    node, delays = open_transport(args.transport, Network(args.domain, LOOPBACK, "listener")), []

    def hear(word: JointState, received_s: float) -> None:
        delays.append(received_s - word.header.stamp.ns * 1e-9)

    node.subscribe(TOPIC, JointState, hear)
    for topic, message in beside(args, "server"):
        node.subscribe(topic, message, lambda word, received_s: None)
    used, begin = time.process_time(), time.monotonic()
    sys.stdin.read()
    share = (time.process_time() - used) / (time.monotonic() - begin)
    node.close()
    half, most, worst = np.percentile(delays, [50, 99, 100]) * 1e3
    figures = {
        "transport": args.transport,
        "rate_hz": args.rate,
        "busy": args.busy,
        "heard": len(delays),
        "sent": int(args.rate * args.seconds),
        "p50_ms": round(half, 3),
        "p99_ms": round(most, 3),
        "max_ms": round(worst, 3),
        "listener_core": round(share, 2),
    }
    print(json.dumps(figures))


def beside(args: argparse.Namespace, publisher: str) -> list[tuple[str, type]]:
    """The other topics of two arms."""
    arms = ("PSM1", "PSM2") if args.busy else ()
    return [
        (f"/{arm}/{t.name}", t.message) for arm in arms for t in ARM if t.publisher == publisher
    ]


if __name__ == "__main__":
    main()
