"""A subscription that knows when something is wrong with it: nobody speaks, QoS does not match, two speak at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import JointState

from modcal_msgs_py import seconds
from modcal_nodes.ros.guarded import CallbackFaults, GuardedNode, Refusals, is_latched, waiting

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
_PERIOD = 1.0  # s


@dataclass(frozen=True)
class Status:
    """One line of a node's health. part: what of the node it is about. values: facts behind the message, by name."""

    part: str
    level: bytes
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class Health:
    """Publishes a node's statuses. ``report`` is asked for them."""

    def __init__(self, node: GuardedNode, report: Callable[[], Iterable[Status]]) -> None:
        self._node, self._of = node, report
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._levels: tuple[bytes, ...] = ()
        node.every(_PERIOD, self.publish)

    def _report(self) -> list[Status]:
        """What the node says, and what went wrong inside of it; a fault of the telling itself is told too."""
        statuses: list[Status] = []
        try:
            statuses.extend(self._of())
        except Exception as error:
            if not self._node.context.ok():
                raise
            self._node.faults.note("report", error)
        if said := self._node.parameters_without_effect:
            statuses.append(Status("parameters", WARN, said))
        return [*statuses, faults_status(self._node.faults)]

    def publish(self) -> None:
        """Publish all statuses now."""
        statuses = self._report()
        message = DiagnosticArray(status=[self._converted(status) for status in statuses])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._levels = tuple(status.level for status in statuses)
        self._publisher.publish(message)

    def publish_last(self, seconds: float = 1.0) -> None:
        """Publish all statuses before the node ends, and give them time to arrive."""
        self.publish()
        self._publisher.wait_for_all_acked(Duration(seconds=seconds))

    def publish_if_changed(self) -> None:
        """Publish now if the level of any status has changed since the last time."""
        if tuple(status.level for status in self._report()) != self._levels:
            self.publish()

    def _converted(self, status: Status) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=status.level,
            name=f"{self._node.get_fully_qualified_name()}: {status.part}",
            hardware_id="modcal",
            message=status.message,
            values=[KeyValue(key=key, value=str(value)) for key, value in status.values.items()],
        )


def faults_status(faults: CallbackFaults) -> Status:
    """The exceptions that callbacks have raised: an error for a while, a warning ever after."""
    total = faults.counts.total()
    if not total:
        return Status("faults", OK, "no callback has failed")
    recent = faults.recent()
    text = f"{total} callbacks have failed, each dropped its message; the last: {faults.last}"
    return Status("faults", ERROR if recent else WARN, text, {f"faults of {k}": n for k, n in faults.counts.items()})


_LESS = {
    QoSPolicyKind.RELIABILITY: "received with best effort; on a busy network some messages will be lost",
    QoSPolicyKind.DURABILITY: "received, but messages published before are missed; it should be transient local",
}


class MonitoredSubscription:
    """One subscription, and what to say of it. ``needed``: whether silence is a fault."""

    def __init__(
        self,
        node: GuardedNode,
        kind: type,
        topic: str,
        callback: Callable[[Any], object],
        qos: QoSProfile,
        needed: bool = False,
        patience: float = 5.0,
        single: bool = False,
        replaced: Callable[[float], bool] | None = None,
    ) -> None:
        """Subscribe. patience: seconds of silence that are accepted. single: two publishers at once are a fault.
        replaced: of joint states, whether one of this stamp [s] is not needed where a later one of the same joints has
        come; None: each is handed on.
        """
        # each message of a burst is guarded by itself
        guard = node.guarded_once_more if is_latched(qos) else node.guarded
        self._node, self._callback = node, guard(topic, callback)
        self.part, self.needed, self.patience, self._single = topic, needed, patience, single
        self.count = 0
        self.incompatible: str | None = None
        self._less: Timer | None = None
        self._last = time.monotonic()
        self._kind, self._qos = kind, qos
        self._replaced = replaced if kind is JointState else None
        self._always = is_latched(qos)  # nobody repeats it
        # no more than can have waited: those that come while others are taken must not hold up what comes beside
        self._most = min(node.most_at_once, qos.depth or node.most_at_once)
        self._subscriptions = [self._subscribe(topic, qos)]
        node.pollers.append(self.poll)
        self.topic = self._subscriptions[0].topic_name

    def _subscribe(self, topic: str, qos: QoSProfile) -> Subscription:
        def hear(message: Any) -> None:
            self._take_all([message, *(behind for behind, _ in waiting(subscription, self._most))])

        events = SubscriptionEventCallbacks(incompatible_qos=self._mismatch)
        subscription = self._node.create_subscription(self._kind, topic, hear, qos, event_callbacks=events)
        return subscription

    def poll(self) -> int:
        """Take what has arrived, without an executor; how many messages that were."""
        before = self.count
        for subscription in tuple(self._subscriptions):
            if told := waiting(subscription, self._most):
                self._take_all([message for message, _ in told])
        return self.count - before

    def _take_all(self, told: list[Any]) -> None:
        needed = told if self._replaced is None else _needed(told, self._replaced)
        self.count += len(told) - len(needed)
        for message in needed:
            self.count += 1
            self._last = time.monotonic()
            if self._node.active or self._always:
                self._callback(message)

    def _mismatch(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        try:
            kind = QoSPolicyKind(event.last_policy_kind)
        except ValueError:
            kind = QoSPolicyKind.INVALID
        name = kind.name.lower()
        if self._less is None and kind in _LESS:
            self._node.get_logger().warning(f"{self.topic}: a publisher's {name} does not match: {_LESS[kind]}")
            # not from within its own event: a subscription cannot be taken away while it is being served
            self._less = self._node.every(0.0, partial(self._settle_for_less, kind))
        elif kind not in _LESS:
            self.incompatible = f"a publisher's {name} does not match, nothing arrives: use the same on both sides"
            self._node.get_logger().error(f"{self.topic}: {self.incompatible}")

    def _settle_for_less(self, kind: QoSPolicyKind) -> None:
        assert self._less is not None
        self._less.cancel()
        qos = QoSProfile(
            depth=self._qos.depth, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
        )
        if kind == QoSPolicyKind.RELIABILITY:  # hears every publisher, so the other must go, or some are heard twice
            for subscription in self._subscriptions:
                self._node.destroy_subscription(subscription)
            self._subscriptions.clear()
        self._subscriptions.append(self._subscribe(self.topic, qos))

    @property
    def silence(self) -> float:
        """Seconds since the last message, or since the beginning."""
        return time.monotonic() - self._last

    @property
    def publishers(self) -> int:
        """How many publishers there are."""
        return self._node.count_publishers(self.topic)

    def complaint(self) -> tuple[bytes, str] | None:
        """(level, what is wrong), or None."""
        publishers = self.publishers
        if self.incompatible is not None and self.count == 0:
            return ERROR, f"{self.topic}: {self.incompatible}"
        if self._single and publishers > 1:
            return WARN, f"{self.topic}: {publishers} publishers at once: give each robot a namespace, or remap"
        if self.needed and self.silence > self.patience and not (self._always and self.count):
            level = ERROR if self.count == 0 else WARN
            if publishers == 0:
                return level, f"{self.topic}: no node publishes it: start the driver, or remap the topic"
            return level, f"{self.topic}: silent for {self.silence:.0f} s: check that its publisher is alive"
        return None


def _needed(told: list[Any], replaced: Callable[[float], bool]) -> list[Any]:
    """The joint states to handle, in order: those that are not replaced by a later one of the same joints."""
    out, later = list[Any](), set[tuple[int, tuple[str, ...]]]()
    for message in reversed(told):
        joints = len(message.position), tuple(message.name)
        if joints not in later or not replaced(seconds(message.header.stamp)):
            out.append(message)
        later.add(joints)
    return out[::-1]


def always(_: float) -> bool:
    """Whether a message is replaced by a later one, where the newest is all that counts."""
    return True


def subscription_status(inputs: Iterable[MonitoredSubscription], refusals: Refusals | None = None) -> Status:
    """What is received and what is not, as one status. refusals: of the topics; what is refused is not received."""
    inputs = list(inputs)
    complaints = [complaint for subscription in inputs if (complaint := subscription.complaint()) is not None]
    if refusals is not None:
        refused = (refusals.standing(subscription.part) for subscription in inputs if subscription.needed)
        complaints += [(WARN, said) for said in refused if said]
    level = max((level for level, _ in complaints), default=OK)
    message = "; ".join(text for _, text in complaints) or "everything that is needed is received"
    values = {f"messages of {subscription.topic}": subscription.count for subscription in inputs}
    values |= {f"publishers of {subscription.topic}": subscription.publishers for subscription in inputs}
    return Status("hearing", level, message, values)


def tracker_status(hearing: Status, inputs: Iterable[MonitoredSubscription]) -> Status:
    """The status of all that is received; a warning where no instrument is, whichever it might be."""
    instruments = [subscription for subscription in inputs if "tracker/" in subscription.topic]
    if hearing.level != OK or any(subscription.count for subscription in instruments):
        return hearing
    topics = " and ".join(subscription.topic for subscription in instruments)
    return Status(hearing.part, WARN, f"no message from the tracker on {topics}", hearing.values)
