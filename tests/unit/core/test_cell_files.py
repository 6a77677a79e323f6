import pytest

from viskill_deploy.core.cell_files import CellArmEntry
from viskill_deploy.core.description import load_cell

ENTRY = load_cell("bipegboard").file.arm


def test_the_start_angle_that_is_given_says_which_angle_policies_command() -> None:
    assert [entry.rotation for entry in ENTRY] == ["pitch", "yaw"]
    assert [entry.rotation for entry in load_cell("bipegtransfer").file.arm] == ["yaw", "yaw"]
    assert ENTRY[0].model_copy(update={"start_pitch_rad": 0.3}).start_angle_rad == 0.3


@pytest.mark.parametrize("angles", [{}, {"start_yaw_rad": 0.0, "start_pitch_rad": 0.0}])
def test_an_arm_starts_with_exactly_one_angle(angles: dict[str, float]) -> None:
    content = ENTRY[0].model_dump(exclude={"start_yaw_rad", "start_pitch_rad"})
    with pytest.raises(ValueError, match="give one of start_yaw_rad and start_pitch_rad"):
        CellArmEntry.model_validate(content | angles)
