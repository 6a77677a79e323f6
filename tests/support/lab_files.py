"""Files that a lab has: where its things are, and its cell with serial numbers of its arms."""

from viskill_deploy.core.description import load_cell

SCENE = """
schema = 1
cell = "bipegtransfer"
active = "block1"
goal_m = [0.01, 0.043, 0.00725]
[[object]]
name = "block1"
position_m = [0.013, -0.027, 0.00725]
sigma_position_m = [0.0005, 0.0005, 0.0002]
sigma_rotation_rad = [0.0, 0.0, 0.03]
"""


def with_serials(cell: str) -> str:
    """The text of a packaged cell's file, as of real arms numbered 100000, 100001 and so on."""
    described = load_cell(cell)
    text = described.files[0].read_text(encoding="utf-8")
    for number, arm in enumerate(described.arms, 100000):
        name = f'name = "{arm.name}"'
        text = text.replace(name, f'{name}\nserial = "{number}"')
    return text
