"""What a node has refused: said in the log, counted, and told on ``/diagnostics`` for a while."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from modcal_core.errors import ModcalError

_SAID_FOR = 5.0  # s that diagnostics go on telling of a refusal
_THROTTLE = 2.0  # s between two lines in the log


class Refusals:
    """What was refused of late, by part: the topic it came on, or what of the node it is about."""

    def __init__(self, node: Node, news: Callable[[], None] = lambda: None) -> None:
        """news: called when a part refuses something that had refused nothing of late."""
        self._node, self._news = node, news
        self._said: dict[str, tuple[float, str]] = {}
        self._logged = -math.inf
        self.counts: Counter[str] = Counter()

    def guarded(self, part: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """The callback, with what it refuses said and counted."""

        def guarded(message: Any) -> None:
            try:
                callback(message)
            except ModcalError as error:
                self.refuse(part, str(error))

        return guarded

    def refuse(self, part: str, said: str) -> None:
        """Say and count a refusal."""
        self.counts[part] += 1
        news, now = not self.recent(part), time.monotonic()
        self._said[part] = now, said
        # rclpy's own throttle looks up the caller first, which takes a millisecond: one that refuses everything would
        # fall behind, and refuse what it hears for being late
        if now - self._logged >= _THROTTLE:
            self._logged = now
            self._node.get_logger().warning(said)
        if news:
            self._news()

    def recent(self, *parts: str) -> str:
        """What was refused of late of these parts, or of all; nothing if nothing was."""
        since = time.monotonic() - _SAID_FOR
        return "; ".join(said for part, (at, said) in self._said.items() if at >= since and part in (parts or [part]))
