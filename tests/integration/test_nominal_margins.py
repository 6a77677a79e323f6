"""The margins of the tasks: no nominal run comes nearer to any rule or pair than its SCALE value.

`pytest -s` prints the smallest margin per rule and per pair.
"""

import pytest
from nominal import margins_of, table

from viskill_deploy.core.description import load_cell

TASKS = ["bipegtransfer", "bipegboard", "matchboardpanel"]


def keeps_its_distance(name, driver, folder, mode, distribution, episodes):
    figures, pairs = margins_of(name, driver, folder, mode, distribution, episodes)
    print("\n" + table(f"{name}, {driver}, {mode}, {distribution}", figures, pairs))
    assert figures["interventions"] == 0
    assert figures["worst_action"] in {"PASS", "WARN"}  # a layout out of the training range warns
    rules = {rule: margin for rule, margin in figures["margins"].items() if rule != "S29"}
    assert min(rules.values()) >= 0.0
    assert set(pairs) == set(load_cell(name).file.distances.apart)
    assert min(pairs.values()) > 0.0
    return figures


@pytest.mark.no_cover
@pytest.mark.parametrize("name", TASKS)
@pytest.mark.invariant("S33")
def test_a_scripted_run_comes_to_no_threshold(name, tmp_path):
    figures = keeps_its_distance(name, "script", tmp_path, "closed-loop", "reference", 1)
    assert figures["success_rate"] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("distribution", ["reference", "wide"])
@pytest.mark.parametrize("mode", ["closed-loop", "plan"])
@pytest.mark.parametrize("driver", ["script", "policy"])
@pytest.mark.parametrize("name", TASKS)
@pytest.mark.timeout(1200)
@pytest.mark.invariant("S33")
def test_five_runs_of_every_kind_come_to_no_threshold(name, driver, mode, distribution, tmp_path):
    keeps_its_distance(name, driver, tmp_path, mode, distribution, 5)
