"""What the served loopback and its clients say to each other: one JSON object a line.

Python writes floats so that they read back bit-identical, NaN and infinity included.
"""

from __future__ import annotations

import dataclasses
import json
import socket
from typing import Any

import numpy as np

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import (
    ActiveObject,
    ArmState,
    CellState,
    Inputs,
    JointSetpoint,
    ObjectPose,
    Scene,
)

Message = dict[str, Any]
MAX_LINE = 1 << 20


SEND_TIMEOUT_S = 0.1


class LineSocket:
    """A socket that carries whole messages and never blocks on reading."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket, self._pending, self._unsent = connection, b"", b""

    def fileno(self) -> int:
        """For selectors."""
        return self._socket.fileno()

    def send(self, message: Message) -> None:
        """Sends one message.

        Raises:
            DriverError: the other side is gone or does not read.
        """
        self._socket.settimeout(SEND_TIMEOUT_S)
        try:
            self._socket.sendall(_line(message))
        except OSError as error:
            raise DriverError(f"the loopback's other side is gone ({error}); restart it") from error
        finally:
            self._socket.setblocking(False)

    def offer(self, message: Message, must_arrive: bool = False) -> None:
        """Sends one message without ever waiting.

        A reader that is behind misses messages, unless they must arrive: those wait their turn.

        Raises:
            DriverError: the other side is gone.
        """
        if must_arrive or not self._unsent:
            self._unsent += _line(message)
        try:
            self._unsent = self._unsent[self._socket.send(self._unsent) :]
        except (BlockingIOError, InterruptedError):
            pass
        except OSError as error:
            raise DriverError(f"the loopback's other side is gone ({error})") from error

    def receive(self) -> list[Message]:
        """Every message that has arrived; the last words of one who has gone too.

        Raises:
            DriverError: the other side is gone, or sends no messages of ours.
        """
        while True:
            try:
                chunk = self._socket.recv(1 << 16)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as error:
                if b"\n" in self._pending:
                    break  # the next call finds it gone
                raise DriverError(f"the loopback's other side is gone ({error})") from error
            if not chunk:
                if b"\n" in self._pending:
                    break
                raise DriverError("the loopback's other side has closed; restart it")
            self._pending += chunk
        *lines, self._pending = self._pending.split(b"\n")
        if len(self._pending) > MAX_LINE:
            raise DriverError("the loopback's other side sends no messages of ours")
        try:
            messages = [json.loads(line) for line in lines]
        except ValueError as error:
            raise DriverError(f"the loopback's other side sends nonsense ({error})") from error
        if not all(isinstance(message, dict) for message in messages):
            raise DriverError("the loopback's other side sends nonsense")
        return messages

    def close(self) -> None:
        """Closes the connection."""
        self._socket.close()


def _line(message: Message) -> bytes:
    return json.dumps(message, separators=(",", ":")).encode() + b"\n"


def pack_state(state: CellState) -> Message:
    """A cell state as a message."""
    return dataclasses.asdict(state)


def unpack_state(message: Message) -> CellState:
    """The cell state of a message."""
    arms = []
    for arm in message["arms"]:
        lists = {key: tuple(x) for key, x in arm.items() if isinstance(x, list)}
        arms.append(ArmState(**(arm | lists)))
    return CellState(tuple(arms), Inputs(**message["inputs"]))


def pack_scene(scene: Scene) -> Message:
    """A scene as a message."""
    return {
        "stamp_s": scene.stamp_s,
        "objects": [[o.name, o.T_task_object.ravel().tolist()] for o in scene.objects],
        "active": scene.active,
        "goal": scene.goal.tolist(),
    }


def unpack_scene(message: Message) -> Scene:
    """The scene of a message."""
    objects = (ObjectPose(n, np.array(T).reshape(4, 4)) for n, T in message["objects"])
    return Scene(message["stamp_s"], tuple(objects), message["active"], np.array(message["goal"]))


def pack_object(thing: ActiveObject) -> Message:
    """The truth about the active object as a message."""
    return {
        "pose": thing.T_task_object.ravel().tolist(),
        "speed_m_s": thing.speed_m_s,
        "touched": list(thing.touched),
        "door_touched": thing.door_touched,
    }


def unpack_object(message: Message) -> ActiveObject:
    """The truth about the active object."""
    pose = np.array(message["pose"]).reshape(4, 4)
    touched, door_touched = tuple(message["touched"]), message["door_touched"]
    return ActiveObject(pose, message["speed_m_s"], touched, door_touched)


def pack_setpoints(setpoints: list[JointSetpoint]) -> list[Any]:
    """Setpoints as plain lists."""
    return [[s.jp, s.jv, s.jaw, s.jaw_v] for s in setpoints]


def unpack_setpoints(rows: list[Any]) -> list[JointSetpoint]:
    """Setpoints of a message."""
    return [JointSetpoint(tuple(jp), tuple(jv), jaw, jaw_v) for jp, jv, jaw, jaw_v in rows]
