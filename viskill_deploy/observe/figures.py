"""The report's plots, as Plotly figures in plain data: {"data": [...], "layout": {...}}."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.types import PSM_JOINTS, Action, FloatArray
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.observe.labels import action_label, joint_label, rule_label, shown_joint
from viskill_deploy.observe.plotting import (
    POINTS,
    Figure,
    axis,
    base_layout,
    line,
    numbers,
    skill_shading,
    thinned,
)
from viskill_deploy.observe.records import RunData, Track, VerdictRow

ARM_COLOURS = ("#2563eb", "#ea580c", "#059669", "#7c3aed")
BLOCK_COLOUR = "#94a3b8"
LIMIT_COLOUR = "#dc2626"
SUBGOAL_COLOUR = "#0f172a"
ACTION_COLOURS = {
    Action.WARN: "#facc15",
    Action.SCALE: "#f59e0b",
    Action.HOLD: "#f97316",
    Action.STOP: "#ef4444",
    Action.FAULT: "#b91c1c",
    Action.ESTOP: "#7f1d1d",
}


def joint_figure(data: RunData, arm: CellArm, colour: str) -> Figure:
    """One arm's joints and jaw against their limits, a small plot each."""
    body = data.joints[f"/{arm.name}/measured_js"]
    jaw = data.joints[f"/{arm.name}/jaw/measured_js"]
    limits = [*zip(arm.arm.limit(0), arm.arm.limit(1), strict=True)]
    limits.append((arm.arm.jaw.lower_rad, arm.arm.jaw.upper_rad))
    layout = base_layout(440, showlegend=False, hovermode="closest")
    layout |= {
        "grid": {
            "rows": math.ceil(arm.arm.axes / 4),
            "columns": 4,
            "pattern": "independent",
            "ygap": 0.34,
        }
    }
    layout |= {"annotations": [], "shapes": [], "margin": {"l": 48, "r": 16, "t": 34, "b": 44}}
    traces, names = [], arm.arm.joint_names
    slides = [*(joint.type == "prismatic" for joint in arm.arm.joints), False]
    for index in range(arm.arm.axes):
        track = body.position[:, index] if index < len(names) else jaw.position[:, 0]
        low, high = (shown_joint(slides[index], limit)[0] for limit in limits[index])
        factor, unit = shown_joint(slides[index], 1.0)
        number, name = "" if index == 0 else str(index + 1), joint_label(index, names)
        x, y = thinned(body.time_s, track * factor)
        traces.append(line(x, y, name, colour, xaxis=f"x{number}", yaxis=f"y{number}"))
        pad = 0.08 * (high - low)
        layout[f"yaxis{number}"] = axis(range=[low - pad, high + pad], nticks=5)
        bottom = index >= arm.arm.axes - 4
        layout[f"xaxis{number}"] = axis("s" if bottom else "", nticks=5)
        layout["annotations"].append(_panel_title(f"{name}, {unit}", number))
        layout["shapes"] += [_limit_line(value, number) for value in (low, high)]
    return {"data": traces, "layout": layout}


def _panel_title(text: str, number: str) -> Figure:
    return {
        "text": f"<b>{text}</b>", "x": 0, "y": 1.03, "xref": f"x{number} domain",
        "yref": f"y{number} domain", "xanchor": "left", "yanchor": "bottom", "showarrow": False,
        "font": {"size": 12, "color": "#475569"},
    }  # fmt: skip


def _limit_line(value: float, number: str) -> Figure:
    return {
        "type": "line", "xref": f"x{number} domain", "yref": f"y{number}", "x0": 0, "x1": 1,
        "y0": value, "y1": value, "line": {"color": LIMIT_COLOUR, "width": 1, "dash": "dot"},
    }  # fmt: skip


def path_figure(data: RunData, cell: CellDescription) -> Figure:
    """Where the tips and the things on the board went, in the task frame, mm."""
    traces = []
    for arm, colour in zip(cell.arms, _colours(cell.arms), strict=True):
        track = data.poses.get(f"/{arm.name}/measured_cp")
        if track is not None:
            traces += _path(track.position, f"{arm.name} tip", colour, 4)
    for topic, track in data.poses.items():
        moved = np.ptp(track.position, axis=0).max() if len(track.position) else 0.0
        if topic.startswith("/scene/") and moved > 1e-3:
            traces += _path(track.position, topic.removeprefix("/scene/"), BLOCK_COLOUR, 6)
    traces += [*_pegs(cell), *_subgoals(data)]
    wall: Figure = {"backgroundcolor": "#f8fafc", "gridcolor": "#e2e8f0", "showbackground": True}
    wall["zerolinecolor"] = "#cbd5e1"
    scene: Figure = {
        f"{name}axis": {**wall, "title": {"text": f"{name}, mm"}, "nticks": 6} for name in "xyz"
    }
    scene |= {
        "aspectmode": "data",
        "camera": {"eye": {"x": 1.45, "y": 0.85, "z": 0.85}, "center": {"z": -0.26}},
    }
    layout = base_layout(560, scene=scene, hovermode="closest")
    return {"data": traces, "layout": layout | {"margin": {"l": 0, "r": 0, "t": 36, "b": 0}}}


def _path(position: FloatArray, name: str, colour: str, width: int) -> list[Figure]:
    step = max(1, len(position) // POINTS)
    x, y, z = (numbers(1e3 * position[::step, column]) for column in range(3))
    path: Figure = {"type": "scatter3d", "mode": "lines", "x": x, "y": y, "z": z, "name": name}
    marker = {"color": colour, "size": 5}
    start: Figure = {"type": "scatter3d", "mode": "markers", "x": x[:1], "y": y[:1], "z": z[:1]}
    start |= {"marker": marker, "showlegend": False, "name": f"{name}, start"}
    return [{**path, "line": {"color": colour, "width": width}}, start]


def _pegs(cell: CellDescription) -> list[Figure]:
    board, wall, ends = cell.file.board, cell.file.wall, []
    if board is not None:
        ends += [(x, y, 0.0, x, y, board.peg_height_m) for x, y in board.peg_xy_m]
    if wall is not None:
        front, tip = wall.front_x_m, wall.front_x_m + wall.peg_length_m
        ends += [(front, y, z, tip, y, z) for y, z in wall.peg_yz_m]
    if not ends:
        return []
    x, y, z = (
        [v for end in ends for v in (1e3 * end[i], 1e3 * end[i + 3], None)] for i in (0, 1, 2)
    )
    peg: Figure = {"type": "scatter3d", "mode": "lines", "x": x, "y": y, "z": z, "name": "pegs"}
    return [{**peg, "line": {"color": "#475569", "width": 5}, "hoverinfo": "skip"}]


def _subgoals(data: RunData) -> list[Figure]:
    """The two positions that lead every subgoal; hovering tells the skill."""
    told = [mark for mark in data.marks if mark.subgoal]
    if not told:
        return []
    points = [(mark.skill, mark.subgoal[at : at + 3]) for mark in told for at in (0, 3)]
    x, y, z = ([round(1e3 * point[axis], 3) for _, point in points] for axis in range(3))
    marks: Figure = {"type": "scatter3d", "mode": "markers", "x": x, "y": y, "z": z}
    marks |= {"name": "subgoals", "text": [f"{skill}, subgoal" for skill, _ in points]}
    return [{**marks, "marker": {"symbol": "diamond-open", "color": SUBGOAL_COLOUR, "size": 5}}]


def remote_centre_figure(data: RunData, cell: CellDescription) -> Figure:
    """Distance of each shaft from its registered port over time, mm, from measured joints."""
    traces = []
    for arm, colour in zip(cell.arms, _colours(cell.arms), strict=True):
        track = data.joints[f"/{arm.name}/measured_js"]
        model, port = Arm(arm.arm), arm.port_in_base
        step = max(1, len(track.time_s) // POINTS)
        rows = [(t, q) for t, q in zip(track.time_s[::step], track.position[::step], strict=True)]
        good = [(t, q) for t, q in rows if np.isfinite(q).all()]
        error = np.array([1e3 * model.rcm_error(q, port) for _, q in good])
        x = numbers(np.array([t for t, _ in good]))
        traces.append(line(x, numbers(error), arm.name, colour))
    highest = max((max(t["y"], default=0.0) for t in traces), default=0.0)
    y = axis("shaft to port, mm", range=[0, max(1.15 * highest, 1.1)])
    layout = base_layout(280, xaxis=axis("time, s"), yaxis=y) | skill_shading(data, names=False)
    layout["shapes"].append(_limit_line(1.0, ""))
    return {"data": traces, "layout": layout}


def tracking_figure(data: RunData, cell: CellDescription) -> Figure:
    """Setpoint less measured: the largest revolute joint (mrad) above, the insertion (mm) below."""
    traces = []
    for arm, colour in zip(cell.arms, _colours(cell.arms), strict=True):
        measured = data.joints[f"/{arm.name}/measured_js"]
        error = 1e3 * np.abs(_setpoint_at(data, arm.name, measured) - measured.position)
        slides = np.array([joint.type == "prismatic" for joint in arm.arm.joints])
        x, y = thinned(measured.time_s, error[:, ~slides].max(axis=1))
        traces.append(line(x, y, arm.name, colour, legendgroup=arm.name))
        if not slides.any():
            continue
        x, y = thinned(measured.time_s, error[:, slides].max(axis=1))
        hidden = {"legendgroup": arm.name, "showlegend": False, "xaxis": "x", "yaxis": "y2"}
        traces.append(line(x, y, arm.name, colour, **hidden))
    layout = base_layout(400, xaxis=axis("time, s", anchor="y2"))
    layout |= {"yaxis": axis("joints, mrad", domain=[0.55, 1], rangemode="tozero")}
    layout |= {"yaxis2": axis("insertion, mm", domain=[0, 0.45], rangemode="tozero")}
    return {"data": traces, "layout": layout | skill_shading(data, names=False)}


def _setpoint_at(data: RunData, arm: str, measured: Track) -> FloatArray:
    """Setpoints at the measured times, (n, joints)."""
    setpoint = data.joints[f"/{arm}/setpoint_js"]
    if len(setpoint.time_s) == len(measured.time_s):
        return setpoint.position
    columns = [np.interp(measured.time_s, setpoint.time_s, c) for c in setpoint.position.T]
    return np.column_stack(columns)


def verdict_figure(data: RunData) -> Figure:
    """Which rule spoke when, and what was done; the skills that ran stand above."""
    names = data.about.get("joints", PSM_JOINTS)
    spoken = [row for row in data.verdicts if row.rule]
    rules = sorted({row.rule for row in spoken}, reverse=True)
    traces = [
        _spoken([row for row in spoken if row.action == action], Action(action), names)
        for action in sorted({row.action for row in spoken})
    ]
    y: Figure = axis(
        categoryorder="array", categoryarray=[rule_label(r) for r in rules], automargin=True
    )
    if not spoken:
        y |= {"visible": False, "range": [0, 1]}
        traces.append({"type": "scatter", "x": [0, data.duration_s], "y": [None, None]})
    x = axis("time, s", range=[0, data.duration_s])
    layout = base_layout(max(200, 130 + 34 * len(rules)), xaxis=x, yaxis=y, hovermode="closest")
    layout |= {"legend": {"orientation": "h", "x": 1, "xanchor": "right", "y": -0.25}}
    layout |= {"showlegend": bool(spoken)}
    layout |= skill_shading(data, names=True)
    if not spoken:
        layout["annotations"].append(_quiet(len(data.verdicts)))
    return {"data": traces, "layout": layout}


def _spoken(rows: Sequence[VerdictRow], action: Action, joints: Sequence[str]) -> Figure:
    """One tick a verdict, all of one action."""
    colour = ACTION_COLOURS.get(action, "#64748b")
    marker: Figure = {"color": colour, "size": 10, "symbol": "line-ns"}
    marker["line"] = {"color": colour, "width": 2}
    trace: Figure = {"type": "scatter", "mode": "markers", "name": action_label(action)}
    trace |= {"x": [round(row.time_s, 4) for row in rows], "marker": marker}
    trace["y"] = [rule_label(row.rule) for row in rows]
    trace["text"] = [
        f"{joint_label(row.joint, joints)}: {row.value:.4g} against {row.limit:.4g}" for row in rows
    ]
    return trace


def _quiet(cycles: int) -> Figure:
    return {
        "text": f"No rule spoke in {cycles:,} cycles", "x": 0.5, "y": 0.5, "xref": "paper",
        "yref": "paper", "showarrow": False, "font": {"size": 15, "color": "#059669"},
    }  # fmt: skip


def _colours(arms: Sequence[CellArm]) -> Iterable[str]:
    return [ARM_COLOURS[index % len(ARM_COLOURS)] for index in range(len(arms))]


def all_figures(data: RunData, cell: CellDescription) -> Mapping[str, Figure]:
    """Every plot by the name that the page gives it."""
    joints = {
        f"joints-{arm.name}": joint_figure(data, arm, colour)
        for arm, colour in zip(cell.arms, _colours(cell.arms), strict=True)
    }
    return {
        "paths": path_figure(data, cell),
        "verdicts": verdict_figure(data),
        **joints,
        "tracking": tracking_figure(data, cell),
        "remote-centre": remote_centre_figure(data, cell),
    }
