"""Which transport is taken, and what is said where one cannot be opened."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest
from crtk_domain import DOMAIN
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.core.errors import DriverError, MissingExtraError, MissingRosError
from viskill_deploy.drivers.crtk import readiness as crtk_readiness
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.drivers.crtk.readiness import MODULES, choose, readiness


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """What seems to be installed; the test fills it."""
    names: set[str] = set()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name if name in names else None)
    monkeypatch.setattr(crtk_readiness, "_useless", lambda modules: ())
    monkeypatch.delenv("ROS_VERSION", raising=False)
    return names


def test_ros1_is_taken_where_its_environment_was_sourced(
    installed: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    installed.update(*MODULES.values())
    assert choose().name == "ros2"
    monkeypatch.setenv("ROS_VERSION", "1")
    assert choose().name == "ros1"
    installed.remove("rospy")
    assert choose().name == "ros2"
    monkeypatch.setenv("ROS_VERSION", "2")
    installed.add("rospy")
    assert choose().name == "ros2"


def test_plain_dds_is_taken_where_the_messages_of_crtk_are_missing(installed: set[str]) -> None:
    installed.update(*MODULES.values())
    installed.remove("crtk_msgs")
    assert choose().name == "dds"
    assert "ros2 would need crtk_msgs" in choose().reason


def test_where_there_is_none_the_part_to_install_is_named(installed: set[str]) -> None:
    with pytest.raises(MissingExtraError, match=r"pip install -e .\.\[ros\]"):
        choose()
    installed.add("rospy")
    assert readiness("ros1").missing == ("genpy",)
    assert "python3-rospy" in readiness("ros1").advice
    installed.add("genpy")
    assert readiness("ros1").advice == ""


def test_a_ros_of_another_python_is_found_and_not_taken_for_one_that_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ros_of_old.py").write_text("print('hello')\nimport _made_for_python_3_10\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setitem(MODULES, "ros2", ("json", "ros_of_old"))
    assert readiness("ros2").missing == ("ros_of_old",)
    assert choose().name == "dds"


def test_no_advice_names_the_unrelated_package_crtk() -> None:
    for name in MODULES:
        advice = readiness(name).advice
        assert "pip install crtk" not in advice
        assert "viskill-deploy" not in advice, "no index has it, and a stranger may register it"


@pytest.mark.parametrize("name", ["ros1", "ros2"])
def test_a_ros_that_is_not_here_is_named_with_what_to_do(name: str) -> None:
    assert readiness(name).missing, "this test is for the environment without ROS"
    with pytest.raises(MissingRosError, match=r"cannot be imported .*source"):
        open_transport(name)


def test_a_dds_that_is_not_here_is_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viskill_deploy.drivers.crtk.dds", None)
    with pytest.raises(MissingExtraError, match=r"in your clone.* pip install -e '\.\[ros\]'"):
        open_transport("dds")


def test_a_transport_that_does_not_exist_is_refused() -> None:
    with pytest.raises(DriverError, match="no transport 'ros3'; say auto, ros1, ros2, dds"):
        open_transport("ros3")


def test_what_was_taken_is_told_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        node = open_transport("auto", Network(DOMAIN, LOOPBACK))
    assert node.name == "dds"
    assert "CRTK over dds: cyclonedds is here" in caplog.text
    node.close()


def test_the_doctor_says_what_each_transport_lacks() -> None:
    found = json.loads(CliRunner().invoke(app, ["doctor", "--json"]).stdout)["crtk"]
    assert found["transports"]["dds"] == {"ready": True, "missing": [], "advice": ""}
    assert found["transports"]["ros1"]["missing"] == ["rospy", "genpy"]
    assert found["auto"]["name"] == "dds"
    told = CliRunner().invoke(app, ["doctor"]).stdout
    assert "CRTK over dds: ready" in told
    assert "CRTK over ros1: rospy, genpy missing: on Debian" in told
    assert "CRTK by itself: dds, since cyclonedds is here" in told
