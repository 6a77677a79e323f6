"""Who touches whom in the cell, how contacts answer, and what things look like."""

from __future__ import annotations

import enum

import mujoco

CONTACT_SOLREF = (0.004, 1.0)
CONTACT_SOLIMP = (0.9, 0.99, 0.0005, 0.5, 2.0)
FRICTION = (1.0, 0.005, 0.0001)

COLOURS = {
    "steel": (0.78, 0.80, 0.83, 1.0),
    "shaft": (0.16, 0.17, 0.19, 1.0),
    "port": (0.20, 0.55, 0.95, 0.35),
    "board": (0.74, 0.72, 0.67, 1.0),
    "peg": (0.36, 0.40, 0.46, 1.0),
    "wall": (0.80, 0.78, 0.72, 1.0),
    "goal_peg": (0.16, 0.62, 0.36, 1.0),
    "plate": (0.80, 0.78, 0.72, 1.0),
    "goal_plate": (0.16, 0.62, 0.36, 1.0),
    "door": (0.55, 0.74, 0.90, 0.40),
    "rail": (0.66, 0.68, 0.71, 1.0),
    "table": (0.30, 0.36, 0.42, 1.0),
    "thing": (0.27, 0.45, 0.68, 1.0),
    "active_thing": (0.85, 0.16, 0.14, 1.0),
}


class Touch(enum.Enum):
    """Kinds of surface. The second number names the kinds that a surface itself looks out for."""

    NOTHING = (0, 0)
    PEG = (1, 4 | 16)
    BOARD = (2, 8 | 16)
    WALL = (4, 4 | 16 | 32)
    FOOT = (8, 0)
    PLATE = (1, 4 | 16 | 32)
    FINGER = (16, 16)
    WRIST = (32, 0)
    DOOR = (64, 4 | 8 | 16 | 32)

    @property
    def bits(self) -> dict[str, int]:
        """MuJoCo's contype and conaffinity."""
        return {"contype": self.value[0], "conaffinity": self.value[1]}


def add_materials(spec: mujoco.MjSpec) -> None:
    """Adds every material of the cell to a model under construction."""
    for name, rgba in COLOURS.items():
        shiny = name in ("steel", "shaft", "peg", "goal_peg")
        spec.add_material(
            name=name, rgba=rgba, specular=0.6 if shiny else 0.2, shininess=0.6 if shiny else 0.1
        )
