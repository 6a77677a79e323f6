"""ROS 2 beside plain DDS: each hears the other, and rclpy alone hears both."""

import pytest
from crtk_domain import DOMAIN
from crtk_peer import peer
from test_transports import there_and_back, wait_until

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk import messages
from viskill_deploy.drivers.crtk.conversion import from_native
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport

pytestmark = pytest.mark.ros2


@pytest.mark.parametrize(("ours", "theirs"), [("dds", "rclpy"), ("ros2", "rclpy"), ("ros2", "dds")])
def test_one_middleware_hears_the_other_bit_for_bit(ours: str, theirs: str) -> None:
    node = open_transport(ours, Network(DOMAIN, LOOPBACK))
    with peer(theirs, "echo", DOMAIN):
        there_and_back(node)
    node.close()


@pytest.mark.parametrize(("ours", "theirs"), [("dds", "ros2"), ("ros2", "dds")])
def test_what_one_middleware_latches_the_other_hears_late(ours: str, theirs: str) -> None:
    node, words = open_transport(ours, Network(DOMAIN, LOOPBACK)), []
    with peer(theirs, "latch", DOMAIN):
        node.subscribe(
            "/PSM1/status",
            messages.String,
            lambda word, _: words.append(word.data),
            is_latched=True,
        )
        wait_until(lambda: words[-1:] == ["last"])
        assert node.peers("/PSM1/status") == 1
    node.close()


def test_services_answer_another_process() -> None:
    import rclpy
    from crtk_msgs.srv import QueryForwardKinematics, QueryInverseKinematics
    from rclpy.executors import SingleThreadedExecutor

    from viskill_deploy.drivers.crtk.interfaces import ros2_environment

    context = rclpy.Context()
    with ros2_environment(LOOPBACK):
        rclpy.init(args=[], context=context, domain_id=DOMAIN)
        asker = rclpy.create_node("asker", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(asker)

    def ask(kind: object, name: str, question: object) -> object:
        client = asker.create_client(kind, name)
        assert client.wait_for_service(30.0)
        answer = client.call_async(question)
        executor.spin_until_future_complete(answer, timeout_sec=30.0)
        return answer.result()

    with peer("ros2", "serve", DOMAIN):
        question = QueryInverseKinematics.Request(jp=[0.5, -1.0])
        question.cp.position.z = 0.1
        answer = ask(QueryInverseKinematics, "/PSM1/inverse_kinematics", question)
        assert from_native(messages.InverseKinematicsResponse)(answer) == (
            messages.InverseKinematicsResponse((1.0, -2.0, 0.0, 0.0, 0.1), True, "as foretold")
        )
        question = QueryForwardKinematics.Request(jp=[0.1, 0.2, 0.3])
        answer = ask(QueryForwardKinematics, "/PSM1/forward_kinematics", question)
        assert from_native(messages.ForwardKinematicsResponse)(answer) == (
            messages.ForwardKinematicsResponse(
                messages.Pose(messages.Point(0.1, 0.2, 0.3)), False, "no such arm"
            )
        )
    executor.shutdown()
    rclpy.shutdown(context=context)


def test_a_closed_node_serves_nothing() -> None:
    node = open_transport("ros2", Network(DOMAIN, LOOPBACK))
    node.close()
    with pytest.raises(DriverError, match="closed"):
        node.serve(
            "/PSM1/forward_kinematics",
            messages.ForwardKinematicsRequest,
            messages.ForwardKinematicsResponse,
            lambda request: messages.ForwardKinematicsResponse(),
        )


def test_it_is_taken_by_itself_where_ros2_is() -> None:
    node = open_transport("auto", Network(DOMAIN, LOOPBACK))
    assert node.name == "ros2"
    node.close()
