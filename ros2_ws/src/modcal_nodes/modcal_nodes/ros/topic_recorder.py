"""One topic on its way into a bag: every publisher is received, whatever its QoS, and every message is kept once.

A subscription hears a publisher only if it asks for no more than that offers. One that asks for little hears everybody,
but then a reliable publisher does not repeat what got lost, and a latched one does not tell what it said before. So
there is one subscription for each kind of QoS that is offered; what comes twice is known by the stamp that its
publisher gave it.
"""

from __future__ import annotations

import os
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

from modcal_msgs_py import READINGS, TYPES, learn, qos_profile
from modcal_nodes.ros.guarded import GuardedNode, waiting
from modcal_nodes.ros.subscriptions import ERROR, WARN

N = TypeVar("N", bound=Node)
MUTUAL = 0.5  # s: who was just found may not have found the finder, and what is sent then is lost


@contextmanager
def joined(make: Callable[[Context], N], domain: int | None = None) -> Iterator[tuple[N, Callable[[float], None]]]:
    """A node, and what spins it once for so many seconds at most. domain: in place of ROS_DOMAIN_ID."""
    context = Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    node = make(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor.spin_once
    finally:
        executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def passing(context: Context) -> Node:
    """A bare node of a name that no other has."""
    name = f"modcal_{os.getpid()}"
    return Node(name, context=context, enable_rosout=False, start_parameter_services=False)


@contextmanager
def stopped_by(stop: Callable[[], None]) -> Iterator[None]:
    """SIGINT and SIGTERM call this while the block lasts."""
    before = {number: signal.signal(number, lambda *_: stop()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def interrupt() -> None:
    """Raise what Ctrl-C raises."""
    raise KeyboardInterrupt


def type_of(name: str) -> Any:
    """The class of a type such as ``std_srvs/srv/Trigger``; None where it is not installed."""
    module, _, kind = name.rpartition("/")
    try:
        return getattr(import_module(module.replace("/", ".")), kind, None)
    except (ImportError, ValueError):
        return None


# Five seconds of a fast driver may wait while this process gets no time.
_DEPTH = 5000
# After a process was killed, a publisher may take seconds to learn of the one that subscribes in its place, for the
# middleware holds on to the dead one. To subscribe once more is announced anew, and often shortens that.
_AGAIN = (0.5, 1.0, 2.0, 3.5)  # s without a first message
_SETTLES = 1.0  # s from the first message, after which one of several subscriptions is kept
_UNHEARD = 0.8  # s without a first message, after which it is said of topics that speak fast
UNHEARD = "unheard"  # kind of that complaint
_FAST = tuple(f"/{role}" for role in (*READINGS, "joint_states", "wrench"))


class Offer(NamedTuple):
    """The kind of QoS that a publisher offers, as far as it decides who hears it."""

    reliable: bool
    latched: bool


class Taken(NamedTuple):
    """A message as it came: CDR bytes, and when it was published and received by the system's clock [ns]."""

    topic: str
    cdr: bytes
    published_ns: int
    received_ns: int


class Complaint(NamedTuple):
    """What is wrong with a topic. kind: stays the same while the text counts on."""

    level: bytes
    kind: str
    text: str


class TopicRecorder:
    """One wanted topic. ``needed``: whether it is a fault when nobody publishes it."""

    def __init__(
        self, node: GuardedNode, topic: str, take: Callable[[Taken], None], needed: bool, patience: float
    ) -> None:
        """Begin to wait for publishers. take: gets every message. patience: seconds of silence that are accepted."""
        self.topic, self.needed = topic, needed
        self.type_name: str | None = None
        self.count = self.bytes = self.publishers = 0
        self.rate = 0.0
        self.kept: deque[Taken] = deque()
        self._node, self._take, self.patience = node, take, patience
        self._keep = node.guarded(topic, self._keep_one)  # each message of a burst is guarded by itself
        self._inputs: dict[Offer, Subscription] = {}
        node.pollers.append(self.poll)
        self._types: set[str] = set()
        self._seen: set[tuple[int, int]] = set()
        self._order: deque[tuple[int, int]] = deque()
        self._number: int | None = None
        self._gaps = self._suspected = self._told_lost = 0
        self._last = time.monotonic()
        self._rated = (self._last, 0)
        self._subscribed = self._last
        self._again = 0
        self._spares: list[tuple[Offer, Subscription]] = []
        self._heard: Counter[int] = Counter()  # messages by subscription since the last look, while there are spares
        self.waited: float | None = None  # s from the subscription to the first message
        self._first_at: float | None = None

    def look(self) -> bool:
        """Subscribe to what is offered now; whether that was something new."""
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        if len(publishers) != self.publishers:
            self.publishers, self._number = len(publishers), None
        else:
            self._gaps += self._suspected
        self._suspected = 0
        self._types = {publisher.topic_type for publisher in publishers}
        if self.type_name is None:
            self.type_name = self._recordable()
        if self.type_name is None:
            return False
        offers = {
            Offer(
                publisher.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
                publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            )
            for publisher in publishers
            if publisher.topic_type == self.type_name
        }
        if self._inputs and not self.count and self.publishers:
            self._insist()
        elif self._spares and self._first_at is not None and time.monotonic() - self._first_at > _SETTLES:
            self._settle()
        self._heard.clear()
        new = offers - set(self._inputs)
        for offer in new:
            self._inputs[offer] = self._subscribe(offer)
            self._subscribed = self._last = time.monotonic()
        return bool(new)

    def _insist(self) -> None:
        """Subscribe once more to who has not been heard yet. The others stay: one of them may be heard any moment."""
        if self._again < len(_AGAIN) and time.monotonic() - self._subscribed > _AGAIN[self._again]:
            self._again += 1
            self._spares += [(offer, self._subscribe(offer)) for offer in self._inputs]

    def _settle(self) -> None:
        """Keep the subscription of each kind that receives most.

        The one that was received first may have got a single message of those that the publisher keeps, and be matched
        seconds later.
        """
        for offer, own in list(self._inputs.items()):
            mine = [own, *(spare for its, spare in self._spares if its == offer)]
            kept = max(mine, key=lambda subscription: self._heard[id(subscription)])
            if not self._heard[id(kept)]:
                continue  # nothing has come since the last look
            for subscription in mine:
                if subscription is not kept:
                    self._node.destroy_subscription(subscription)
            self._inputs[offer] = kept
            self._spares = [(its, spare) for its, spare in self._spares if its != offer]

    def profiles(self) -> list[dict[str, Any]]:
        """The QoS that was offered so far, as a bag holds it."""
        return [qos_profile(offer.latched, offer.reliable) for offer in sorted(self._inputs)]

    @property
    def lost(self) -> int:
        """Messages that the middleware says, or the publisher's numbering shows, to have been lost."""
        return max(self._gaps, self._told_lost)

    def measure(self) -> None:
        """Renew ``rate`` [Hz]; to be called about once a second."""
        now, (then, count) = time.monotonic(), self._rated
        self.rate = (self.count - count) / max(now - then, 1e-3)
        self._rated = (now, self.count)

    def complaint(self) -> Complaint | None:
        """What is wrong, or None."""
        others = self._types - {self.type_name}
        if self.type_name is None and self._types:
            text = f"{self.topic}: {', '.join(sorted(self._types))} cannot be recorded: its definition is not known"
            return Complaint(ERROR, "type", text)
        if others:
            text = f"{self.topic}: only {self.type_name} is recorded, not {', '.join(sorted(others))}: remap one"
            return Complaint(ERROR, "types", text)
        if not self.count and self._inputs and self.publishers and self.topic.endswith(_FAST):
            since = time.monotonic() - self._subscribed
            if since > _UNHEARD:
                text = f"{self.topic}: subscribed for {since:.1f} s and no message yet, of {self.publishers} publishers"
                return Complaint(WARN, UNHEARD, f"{text}: nothing is recorded until one arrives")
        silence = time.monotonic() - self._last
        if silence > self.patience and self.publishers == 0 and self.needed:
            text = f"{self.topic}: no node publishes it: start the driver, or remap the topic"
            return Complaint(WARN, "nobody", text)
        if silence > self.patience and self.publishers and not any(offer.latched for offer in self._inputs):
            text = f"{self.topic}: silent for {silence:.0f} s: check that its publisher is alive"
            return Complaint(WARN, "silent", text)
        if self.lost:
            text = f"{self.topic}: {self.lost} messages lost: this machine or the network is too busy"
            return Complaint(WARN, "lost", text)
        return None

    def _recordable(self) -> str | None:
        """The type to record, of those that are published now: the contract's, else the first that is known here."""
        expected = {type_name for role, type_name in TYPES.items() if self.topic.endswith("/" + role)}
        known = [name for name in sorted(self._types) if learn(name, type_of)]
        return next((name for name in known if name in expected), known[0] if known else None)

    def _subscribe(self, offer: Offer) -> Subscription:
        qos = QoSProfile(
            depth=_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if offer.reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if offer.latched else DurabilityPolicy.VOLATILE,
        )
        assert self.type_name is not None
        hear = partial(self._hear, offer, box := list[Subscription]())
        make = partial(self._node.create_subscription, type_of(self.type_name), self.topic, hear, qos, raw=True)
        try:
            box.append(make(event_callbacks=SubscriptionEventCallbacks(message_lost=self._count_lost)))
        except UnsupportedEventTypeError:
            box.append(make())
        return box[0]

    def _hear(self, offer: Offer, box: list[Subscription], cdr: bytes, info: dict[str, Any]) -> None:
        self._keep(offer, cdr, info)
        self._take_behind(offer, box[0], 1)

    def poll(self) -> int:
        """Take what has arrived, without an executor; how many messages that were."""
        return sum(
            self._take_behind(offer, subscription) for offer, subscription in [*self._inputs.items(), *self._spares]
        )

    def _take_behind(self, offer: Offer, subscription: Subscription, more: int = 0) -> int:
        for behind in waiting(subscription, self._node.most_at_once, raw=True):
            self._keep(offer, *behind)
            more += 1
        if self._spares:
            self._heard[id(subscription)] += more
        return more

    def _keep_one(self, offer: Offer, cdr: bytes, info: dict[str, Any]) -> None:
        published = info["source_timestamp"]
        self._last = time.monotonic()
        if published and self._known(published, cdr):
            return
        self._count_gaps(info.get("publication_sequence_number"))
        if not self.count:
            self.waited, self._first_at = self._last - self._subscribed, self._last
        self.count += 1
        self.bytes += len(cdr)
        taken = Taken(self.topic, cdr, published, info["received_timestamp"])
        if offer.latched:
            self.kept.append(taken)
            while len(self.kept) > max(self.publishers, 1):
                self.kept.popleft()
        self._take(taken)

    def _known(self, published: int, cdr: bytes) -> bool:
        key = (published, hash(cdr))
        if key in self._seen:
            return True
        self._seen.add(key)
        self._order.append(key)
        if len(self._order) > 2 * _DEPTH:
            self._seen.discard(self._order.popleft())
        return False

    def _count_gaps(self, number: int | None) -> None:
        # several publishers number their messages alike, and nothing tells them apart
        if number is None or self.publishers != 1 or len(self._inputs) != 1:
            return
        if self._number is not None and number > self._number + 1:
            # or another publisher has come, which the next look will show
            self._suspected += number - self._number - 1
        self._number = number

    def _count_lost(self, event: QoSMessageLostInfo) -> None:
        self._told_lost += event.total_count_change
