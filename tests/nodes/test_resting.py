"""A node that rests between two looks hears everything in order; a solve yields to the nodes beside it."""

from __future__ import annotations

import os
import time
from threading import Thread
from typing import Any

import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from nodes.processes import fresh_domain
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from modcal_nodes.calibrating.worker import SolveWorker
from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.running import FRESH, SENSOR, RestingExecutor
from modcal_nodes.ros.subscriptions import MonitoredSubscription, _needed, always

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


def ended(executors: tuple[Executor, ...], *nodes: Node) -> None:
    """Takes executors and nodes down, and ROS with them."""
    for executor in executors:
        executor.shutdown()
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.dds
def test_hears_everything_while_it_ticks_and_answers() -> None:
    rclpy.init(domain_id=fresh_domain())
    node, partner = Resting(), rclpy.create_node("partner")
    executor, other = RestingExecutor(node, REST), SingleThreadedExecutor()
    executor.add_node(node)
    other.add_node(partner)
    missed = list[float]()

    def look() -> None:
        """A look; a timer whose period has passed when it begins must have been run when it ends."""
        begun, before = time.monotonic(), len(node.ticks)
        executor.spin_once()
        if before and begun > node.ticks[before - 1] + PERIOD and len(node.ticks) == before:
            missed.append(begun - node.ticks[-1])

    try:
        publisher = partner.create_publisher(JointState, "joint_states", SENSOR)
        client = partner.create_client(Trigger, "ask")
        end = time.monotonic() + 30.0
        while not (client.service_is_ready() and publisher.get_subscription_count() and node.joints.publishers):
            assert time.monotonic() < end
            look()
            other.spin_once(0.001)
        answer = client.call_async(Trigger.Request())
        for k in range(COUNT):
            publisher.publish(JointState(name=["a", "b"], position=[float(k), -float(k)]))
            if k % 10 == 9:
                look()
                other.spin_once(0.0)
        while len(node.heard) < COUNT - 1 or not answer.done():
            assert time.monotonic() < end
            look()
            other.spin_once(0.001)
    finally:
        ended((executor, other), partner, node)
    assert node.heard == [(float(k), -float(k)) for k in range(COUNT) if k != 13]
    assert node.faults.counts == {"joint_states": 1}, "one message that fails costs that message only"
    assert answer.result().success
    assert not missed, "a tick that is due waits for no second look, however busy the machine is"
    assert len(node.ticks) > 10


class Newest(GuardedNode):
    """Wants of joint states the newest."""

    def __init__(self) -> None:
        super().__init__("newest")
        self.heard: list[float] = []
        self.joints = MonitoredSubscription(
            self, JointState, "joint_states", lambda m: self.heard.append(m.position[0]), SENSOR, replaced=always
        )


@pytest.mark.dds
def test_of_what_waited_together_the_newest_is_handed_on_and_all_are_counted() -> None:
    rclpy.init(domain_id=fresh_domain())
    node, partner = Newest(), rclpy.create_node("partner")
    executor = RestingExecutor(node, REST)
    executor.add_node(node)
    try:
        publisher = partner.create_publisher(JointState, "joint_states", SENSOR)
        end = time.monotonic() + 30.0
        while not (publisher.get_subscription_count() and node.joints.publishers):
            assert time.monotonic() < end
            executor.spin_once()
        for k in range(COUNT):
            publisher.publish(JointState(name=["a"], position=[float(k)]))
        while node.joints.count < COUNT:
            assert time.monotonic() < end
            executor.spin_once()
    finally:
        ended((executor,), partner, node)
    assert node.joints.count == COUNT
    assert node.heard[-1] == COUNT - 1
    assert node.heard == sorted(set(node.heard))
    assert len(node.heard) < COUNT // 2


def test_what_a_later_message_of_the_same_joints_replaces() -> None:
    """The newest of each set of joints is handled, and whatever is not said to be replaced, in the order they came."""

    def told(names: list[str], stamp: float, count: int = 2) -> JointState:
        message = JointState(name=names, position=[stamp] * count)
        message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1.0 * 1e9)
        return message

    arm, hand = ["ab", "cd"], ["ab", "ce"]
    came = [told(arm, 1.0), told(hand, 1.25), told(arm, 1.5), told(arm, 1.6, 1), told(hand, 1.75), told(arm, 2.0)]
    assert _needed(came, lambda _: True) == came[3:], "one without all positions is refused by itself"
    assert _needed(came, lambda stamp: stamp > 1.25) == [*came[:2], *came[3:]]
    assert _needed(came, lambda _: False) == came
    assert _needed([], lambda _: True) == []


class Slow(GuardedNode):
    """Takes longer over each message than the next takes to come, in simulated time."""

    def __init__(self, partner: Node) -> None:
        simulated = Parameter("use_sim_time", value=True)
        super().__init__("slow", parameter_overrides=[simulated])
        self.partner = partner
        self.clock_topic = partner.create_publisher(Clock, "/clock", 10)
        self.joints_topic = partner.create_publisher(JointState, "joint_states", SENSOR)
        self.most_behind, self.sent = 0, 0
        self.moments = set[int]()  # that messages were handled at
        self.joints = MonitoredSubscription(self, JointState, "joint_states", self._take, FRESH)
        self.wrench = MonitoredSubscription(self, WrenchStamped, "wrench", lambda _: None, FRESH)

    def speak(self) -> None:
        """A millisecond, and joints of that."""
        self.sent += 1
        moment = Time(sec=0, nanosec=1_000_000 * self.sent)
        self.clock_topic.publish(Clock(clock=moment))
        message = JointState(name=["a"], position=[0.0])
        message.header.stamp = moment
        self.joints_topic.publish(message)

    def _take(self, message: JointState) -> None:
        self.speak()
        time.sleep(1e-3)  # until that has come
        now = self.get_clock().now().nanoseconds
        self.moments.add(now)
        self.most_behind = max(self.most_behind, message.header.stamp.nanosec // 1_000_000 - now // 1_000_000)


@pytest.mark.dds
def test_simulated_time_is_no_more_behind_than_messages_wait() -> None:
    """A topic that never runs dry held the time up for a hundred messages, and what came was refused as ahead of it."""
    rclpy.init(domain_id=fresh_domain())
    partner = rclpy.create_node("partner")
    node = Slow(partner)
    executor = RestingExecutor(node, REST)
    executor.add_node(node)
    try:
        end = time.monotonic() + 30.0
        while not (node.joints.publishers and node.joints_topic.get_subscription_count()):
            assert time.monotonic() < end
            executor.spin_once()
        for _ in range(30):
            node.speak()
        while node.joints.count < COUNT:
            assert time.monotonic() < end
            executor.spin_once()
    finally:
        ended((executor,), partner, node)
    assert node.most_behind <= 2 * FRESH.depth
    assert len(node.moments) >= COUNT / (2 * FRESH.depth), "time went on all the while"


@pytest.mark.slow
def test_a_solve_yields_to_the_nodes_beside_it() -> None:
    brought, said = list[Any](), list[str]()
    worker = SolveWorker(said.append)
    try:
        worker.give("asking", os.nice, 0, finish=brought.append, fail=said.append)
        end = time.monotonic() + 60.0
        while worker.poll():
            assert time.monotonic() < end
            time.sleep(0.01)
    finally:
        worker.close()
    assert not said
    assert brought[0] > os.nice(0)


@pytest.mark.slow
def test_a_worker_may_be_ended_while_it_hands_over_a_result_and_its_successor_works() -> None:
    brought, said = list[bytes](), list[str]()
    worker = SolveWorker(said.append)
    try:
        for moment in (0.0, 0.005, 0.02):
            worker.give("warming up", len, b"", finish=lambda _: None, fail=said.append)
            while worker.poll():
                time.sleep(0.01)
            worker.give("a large result", bytes, 30_000_000, finish=brought.append, fail=said.append)
            time.sleep(moment)
            ending = Thread(target=worker.drop, daemon=True)
            ending.start()
            ending.join(60.0)
            assert not ending.is_alive()
        worker.give("a fault", int, "x", finish=brought.append, fail=said.append)
        while worker.poll():
            time.sleep(0.01)
    finally:
        worker.close()
    assert "in _serve" in said[0]
    assert said[1].startswith("internal error: ValueError(")
