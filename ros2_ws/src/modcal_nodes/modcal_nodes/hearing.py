"""A subscription that knows when something is wrong with it: nobody speaks, QoS does not match, two speak at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile

from modcal_nodes.health import ERROR, OK, WARN, Status

_REMEDY = {
    QoSPolicyKind.RELIABILITY: "let the publisher be reliable",
    QoSPolicyKind.DURABILITY: "let the publisher be transient local (latched)",
}


class Ear:
    """One subscription, and what to say of it. ``needed``: whether silence is a fault."""

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        needed: bool = False,
        patience: float = 5.0,
        single: bool = False,
        raw: bool = False,
    ) -> None:
        """Subscribe. patience: seconds of silence that are accepted. single: two publishers at once are a fault."""
        self._node, self._callback = node, callback
        self.needed, self._patience, self._single = needed, patience, single
        self.count = 0
        self.incompatible: str | None = None
        self._last = time.monotonic()
        events = SubscriptionEventCallbacks(incompatible_qos=self._mismatch)
        self.subscription = node.create_subscription(kind, topic, self.hear, qos, event_callbacks=events, raw=raw)
        self.topic = self.subscription.topic_name

    def hear(self, message: Any) -> None:
        """Count a message and hand it on; also for one that came another way."""
        self.count += 1
        self._last = time.monotonic()
        self._callback(message)

    def _mismatch(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        try:
            kind = QoSPolicyKind(event.last_policy_kind)
        except ValueError:
            kind = QoSPolicyKind.INVALID
        remedy = _REMEDY.get(kind, "let both ask for the same")
        self.incompatible = f"a publisher's {kind.name.lower()} does not match, its messages do not arrive: {remedy}"
        self._node.get_logger().error(f"{self.topic}: {self.incompatible}")

    @property
    def silence(self) -> float:
        """Seconds since the last message, or since the beginning."""
        return time.monotonic() - self._last

    def complaint(self) -> tuple[bytes, str] | None:
        """(level, what is wrong), or None."""
        publishers = self._node.count_publishers(self.topic)
        if self.incompatible is not None and self.count == 0:
            return ERROR, f"{self.topic}: {self.incompatible}"
        if self._single and publishers > 1:
            return WARN, f"{self.topic}: {publishers} publishers at once: give each robot a namespace, or remap"
        if self.needed and self.silence > self._patience:
            level = ERROR if self.count == 0 else WARN
            if publishers == 0:
                return level, f"{self.topic}: nobody publishes it: start the driver, or remap the topic"
            return level, f"{self.topic}: silent for {self.silence:.0f} s: see that its publisher is alive"
        return None


def hearing_status(ears: Iterable[Ear]) -> Status:
    """What is heard and what is not, as one status."""
    ears = list(ears)
    complaints = [complaint for ear in ears if (complaint := ear.complaint()) is not None]
    level = max((level for level, _ in complaints), default=OK)
    message = "; ".join(text for _, text in complaints) or "everything that is needed is heard"
    return Status("hearing", level, message, {f"messages of {ear.topic}": ear.count for ear in ears})
