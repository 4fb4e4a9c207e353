"""Messages that wait behind the one a callback was given."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.subscription import Subscription


def waiting(subscription: Subscription, most: int, raw: bool = False) -> Iterator[tuple[Any, dict[str, Any]]]:
    """(message, info) of at most so many messages that have arrived; raw: as CDR bytes.

    By way of the executor each message costs ten times as much, and a kilohertz would be more than it can bring. The
    limit lets other topics, timers and services have their turn.
    """
    for _ in range(most):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, raw)
        if taken is None:
            return
        yield taken
