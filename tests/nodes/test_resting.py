"""A node that rests between two looks hears everything, in order, and its timers and services go on."""

from __future__ import annotations

import time

import pytest
import rclpy
from nodes.processes import fresh_domain
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.resting import RestingExecutor
from modcal_nodes.ros.running import SENSOR
from modcal_nodes.ros.subscriptions import MonitoredSubscription

pytestmark = pytest.mark.dds
REST, PERIOD, COUNT = 0.01, 0.02, 600


class Resting(GuardedNode):
    """Hears joint states, ticks and answers."""

    def __init__(self) -> None:
        super().__init__("resting")
        self.heard: list[tuple[float, ...]] = []
        self.ticks: list[float] = []
        self.joints = MonitoredSubscription(self, JointState, "joint_states", self._take, SENSOR)
        self.create_timer(PERIOD, lambda: self.ticks.append(time.monotonic()))
        self.create_service(Trigger, "ask", self._answer)

    def _take(self, message: JointState) -> None:
        if message.position[0] == 13.0:
            raise ValueError("an unlucky message")
        self.heard.append(tuple(message.position))

    def _answer(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response


def test_hears_everything_while_it_ticks_and_answers() -> None:
    rclpy.init(domain_id=fresh_domain())
    node, partner = Resting(), rclpy.create_node("partner")
    executor, other = RestingExecutor(node, REST), SingleThreadedExecutor()
    executor.add_node(node)
    other.add_node(partner)
    try:
        publisher = partner.create_publisher(JointState, "joint_states", SENSOR)
        client = partner.create_client(Trigger, "ask")
        end = time.monotonic() + 30.0
        while not (client.service_is_ready() and publisher.get_subscription_count() and node.joints.publishers):
            assert time.monotonic() < end
            executor.spin_once()
            other.spin_once(0.001)
        answer, begun = client.call_async(Trigger.Request()), time.monotonic()
        for k in range(COUNT):
            publisher.publish(JointState(name=["a", "b"], position=[float(k), -float(k)]))
            if k % 10 == 9:
                executor.spin_once()
                other.spin_once(0.0)
        while len(node.heard) < COUNT - 1 or not answer.done():
            assert time.monotonic() < end
            executor.spin_once()
            other.spin_once(0.001)
        took = time.monotonic() - begun
    finally:
        executor.shutdown()
        other.shutdown()
        partner.destroy_node()
        node.destroy_node()
        rclpy.try_shutdown()
    assert node.heard == [(float(k), -float(k)) for k in range(COUNT) if k != 13]
    assert node.faults.counts == {"joint_states": 1}, "one message that fails costs that message only"
    assert answer.result().success
    # as many ticks as there were periods, but for those that a busy machine held up: one may be lost to each
    assert len([t for t in node.ticks if begun <= t <= begun + took]) >= 0.5 * took / PERIOD - 2
