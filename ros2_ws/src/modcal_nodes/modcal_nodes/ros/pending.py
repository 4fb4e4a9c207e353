"""Messages that wait behind the one a callback was given."""

from __future__ import annotations

from typing import Any

from rclpy.subscription import Subscription


def waiting(subscription: Subscription, most: int, raw: bool = False) -> list[tuple[Any, dict[str, Any]]]:
    """(message, info) of at most so many messages that have arrived; raw: as CDR bytes.

    By way of the executor each message costs ten times as much, and a kilohertz would be more than it can bring. The
    limit lets other topics, timers and services have their turn.
    """
    out = list[tuple[Any, dict[str, Any]]]()
    handle, kind = subscription.handle, subscription.msg_type
    with handle:
        while len(out) < most and (taken := handle.take_message(kind, raw)) is not None:
            out.append(taken)
    return out
