"""From the runtime's frames to a rosbag2 bag: one column of messages a topic and batch."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.observe import frames, layout
from viskill_deploy.observe.frames import Kind
from viskill_deploy.observe.layout import Column, Layout
from viskill_deploy.observe.mcap_file import McapFile, write_metadata
from viskill_deploy.observe.messages import JOINT_STATE, POSE_STAMPED, STRING, VERDICT, MessageType

TRACKS = (("measured", "measured_js"), ("sent", "setpoint_js"), ("asked", "requested_js"))
"""Parts of a cycle's frame and the topics that they become."""


class Bag:
    """A bag that is being written.

    Attributes:
        waiting_bytes: size of the frames taken since the last chunk.
    """

    def __init__(self, folder: Path, hello: dict[str, Any]) -> None:
        self.waiting_bytes = 0
        self._folder = folder
        self._name = f"{folder.name}_0.mcap"
        self._file = McapFile(folder / self._name, {"hello": json.dumps(hello)})
        self._arms: list[str] = hello["arms"]
        self._joints: list[str] = hello["joints"]
        self._dtype = frames.cycle_dtype(len(self._arms), len(self._joints))
        self._ids: dict[str, int] = {}
        self._columns: dict[tuple[str, ...], Column] = {}
        self._origin_ns = 0
        self._waiting: dict[Kind, list[bytes]] = {kind: [] for kind in Kind}

    def take(self, kind: Kind, payload: bytes) -> None:
        """Takes a frame; `write` puts it on disk."""
        if kind is Kind.ORIGIN:
            wall_ns, now = frames.ORIGIN.unpack(payload)
            self._origin_ns = wall_ns - round(now * 1e9)
            return
        self._waiting[kind].append(payload)
        self.waiting_bytes += len(payload)

    def write(self) -> None:
        """Writes all frames taken as one chunk."""
        if self._waiting[Kind.CYCLE]:
            self._write_cycles(np.frombuffer(b"".join(self._waiting[Kind.CYCLE]), self._dtype))
        for payload in self._waiting[Kind.VERDICT]:
            self._write_verdict(payload)
        self._write_poses(self._waiting[Kind.POSE])
        for kind, topic in ((Kind.SKILL, "/skill"), (Kind.FAILURE, "/request/failure")):
            for payload in self._waiting[kind]:
                self._write_text(topic, payload)
        self._file.flush()
        for waiting in self._waiting.values():
            waiting.clear()
        self.waiting_bytes = 0

    def finish(self) -> None:
        """Writes what waits, closes the file and adds `metadata.yaml`."""
        self.write()
        self._file.finish()
        write_metadata(self._folder, self._file, self._name)

    def _stamps(self, now_s: np.ndarray) -> np.ndarray:
        """Wall-clock nanoseconds of driver's-clock seconds, (n,); an invalid stamp becomes 0."""
        valid = np.isfinite(now_s)
        ns = np.rint(np.where(valid, now_s, 0.0) * 1e9).astype(np.int64) + self._origin_ns
        return np.maximum(np.where(valid, ns, 0), 0)

    def _column(
        self, topic: str, kind: MessageType, build: Callable[[], Layout], *variant: str
    ) -> Column:
        key = (topic, *variant)
        if key not in self._columns:
            if topic not in self._ids:
                self._ids[topic] = self._file.channel(topic, kind)
            self._columns[key] = build().column(self._ids[topic])
        return self._columns[key]

    def _write_cycles(self, cycles: np.ndarray) -> None:
        log = self._stamps(cycles["now"])
        flags = cycles["flags"]
        for index, arm in enumerate(self._arms):
            part = cycles["arm"][:, index]
            for track, topic in TRACKS:
                stamps = self._stamps(part["stamp"]) if track == "measured" else log
                keep = slice(None) if track != "asked" else (flags & frames.ASKED) > 0
                self._write_joints(f"/{arm}", topic, part[track][keep], log[keep], stamps[keep])
            posed = (flags & frames.POSED) > 0
            if posed.any():
                self._write_pose(f"/{arm}/measured_cp", cycles["pose"][posed, index], log[posed])
        self._write_quiet(cycles, log)

    def _write_joints(
        self, arm: str, topic: str, values: np.ndarray, log: np.ndarray, stamps: np.ndarray
    ) -> None:
        if not len(values):
            return
        column = self._column(
            f"{arm}/{topic}", JOINT_STATE, lambda: layout.joint_state(self._joints)
        )
        records = column.records(log, stamps)
        records["position"], records["velocity"] = values["q"], values["v"]
        self._file.add(column.channel, records)
        column = self._column(
            f"{arm}/jaw/{topic}", JOINT_STATE, lambda: layout.joint_state(("jaw",))
        )
        records = column.records(log, stamps)
        records["position"], records["velocity"] = values["jaw"], values["jaw_v"]
        self._file.add(column.channel, records)

    def _write_pose(self, topic: str, T: np.ndarray, log: np.ndarray) -> None:
        column = self._column(topic, POSE_STAMPED, lambda: layout.pose_stamped("task"))
        records = column.records(log, log)
        records["position"] = T[:, :3, 3]
        records["orientation"] = layout.quaternions(T)
        self._file.add(column.channel, records)

    def _write_quiet(self, cycles: np.ndarray, log: np.ndarray) -> None:
        """The cycles in which no rule spoke: every cycle leaves a verdict."""
        quiet = (cycles["flags"] & frames.QUIET) > 0
        for index in np.unique(cycles["mode"][quiet]):
            chosen = quiet & (cycles["mode"] == index)
            column = self._verdict_column("", int(index))
            records = column.records(log[chosen], log[chosen])
            records["action"] = cycles["action"][chosen]
            records["arm"] = records["joint"] = -1
            records["value"] = records["limit"] = np.nan
            self._file.add(column.channel, records)

    def _verdict_column(self, rule: str, mode: int) -> Column:
        name = frames.MODES[mode].value
        return self._column(
            "/safety/verdict", VERDICT, lambda: layout.verdict(rule, name), rule, name
        )

    def _write_verdict(self, payload: bytes) -> None:
        now, action, mode, arm, joint, rule, value, limit = frames.VERDICT.unpack(payload)
        column = self._verdict_column(rule.rstrip(b"\0").decode(), mode)
        log = self._stamps(np.array([now]))
        records = column.records(log, log)
        records["action"], records["arm"], records["joint"] = action, arm, joint
        records["value"], records["limit"] = value, limit
        self._file.add(column.channel, records)

    def _write_poses(self, payloads: list[bytes]) -> None:
        by_name: dict[str, list[tuple[float, bytes]]] = {}
        for payload in payloads:
            now, pose = frames.POSE.unpack_from(payload)
            name = payload[frames.POSE.size :].decode()
            by_name.setdefault(name, []).append((now, pose))
        for name, seen in by_name.items():
            T = np.frombuffer(b"".join(pose for _, pose in seen)).reshape(-1, 4, 4)
            self._write_pose(f"/scene/{name}", T, self._stamps(np.array([now for now, _ in seen])))

    def _write_text(self, topic: str, payload: bytes) -> None:
        (now,) = frames.TEXT.unpack_from(payload)
        text = payload[frames.TEXT.size :].decode()
        channel = self._column(topic, STRING, lambda: layout.string("")).channel
        log = self._stamps(np.array([now]))
        self._file.add(channel, layout.string(text).column(channel).records(log, log))
