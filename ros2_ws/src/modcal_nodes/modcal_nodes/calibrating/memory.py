"""What the calibrator remembers of what it heard: recent messages as they came, older ones as samples."""

from __future__ import annotations

import math
from typing import Any

from modcal_core.measurements.recording import Recording
from modcal_core.measurements.samples import Samples
from modcal_core.resolve import Heard
from modcal_msgs_py.messages import RecordingBuilder
from modcal_msgs_py.stamps import seconds
from modcal_msgs_py.topics import JOINT_STATES

_JUMP = 1.0  # s


class Memory:
    """Messages in pieces: a new piece begins when the clock is set back, or the last one has grown long."""

    def __init__(self, longest: float) -> None:
        """longest: seconds of messages that one piece holds."""
        self._longest = longest
        self.samples: Samples | None = None
        self.forgotten = -1  # how often everything was forgotten, beginning with nothing
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.forgotten += 1
        self._pieces: list[Recording] = []
        self._builder = RecordingBuilder("live")
        self._first = self._last = math.nan
        self.samples = None
        self._names: frozenset[str] = frozenset()

    def add(self, topic: str, type_name: str, message: Any, received: float) -> None:
        """Take one message. Raises BadRecording for one that contradicts itself."""
        if topic.endswith(JOINT_STATES):
            stamp = seconds(message.header.stamp)
            if stamp < self._last - _JUMP or stamp - self._first > self._longest:
                self._close_piece()
            self._first = stamp if math.isnan(self._first) else self._first
            self._last = stamp
            if not self._names.issuperset(message.name):
                self._names |= set(message.name)
        self._builder.add(topic, type_name, message, received)

    def _close_piece(self) -> None:
        self._pieces.append(self._builder.recording())
        self._builder = RecordingBuilder("live")
        self._first = self._last = math.nan

    @property
    def full(self) -> bool:
        """Whether there are finished pieces that could be made into samples."""
        return bool(self._pieces)

    def heard(self) -> Heard:
        """Everything remembered."""
        now = self._builder.recording()
        pieces = (*self._pieces, now) if now.joints else tuple(self._pieces)
        return Heard(pieces, self.samples)

    def finished(self) -> Heard:
        """Everything but the present piece."""
        return Heard(tuple(self._pieces), self.samples)

    def condensed(self, pieces: int, samples: Samples | None) -> None:
        """From now on these samples stand for what was remembered before and for so many of the oldest pieces."""
        self.samples = samples
        del self._pieces[:pieces]

    def keep(self, pieces: int) -> None:
        """Forget all but so many of the newest finished pieces."""
        del self._pieces[: max(len(self._pieces) - pieces, 0)]

    @property
    def pieces(self) -> int:
        """How many finished pieces there are."""
        return len(self._pieces)

    def joint_names(self) -> frozenset[str]:
        """Names of all joints heard."""
        return self._names
