"""What the calibrator remembers of what it heard: recent messages as they came, older ones as samples."""

from __future__ import annotations

import math
from typing import Any

from modcal_core.errors import BadRecording
from modcal_core.measurements import DAY, ELSEWHEN, UNUSABLE, Dropped, Recording, Samples, together
from modcal_core.recalibrate import SampleMemory
from modcal_msgs_py import JOINT_STATES, RecordingBuilder, seconds, why_left_out

_JUMP = 1.0  # s
_OVERTAKEN = 500  # messages by which one topic may be ahead of another


class _MessageBlock:
    """Messages of one stretch of time. joints_from, joints_to: stamps of joint states [s]. last: of every source."""

    def __init__(self) -> None:
        self.joints_from = self.joints_to = math.nan
        self.last: dict[tuple[str, str], float] = {}
        self.count = 0
        self._builder = RecordingBuilder("live")

    def add(self, source: tuple[str, str], stamp: float, message: tuple[str, str, Any, float]) -> None:
        """Take a message. Raises BadRecording for one that contradicts itself, and counts it."""
        self.keep(message)
        self.last[source] = stamp
        self.count += 1

    def keep(self, message: tuple[str, str, Any, float]) -> None:
        """Take a message without following its stamp."""
        try:
            self._builder.add(*message)
        except BadRecording as error:
            self._builder.lose(message[0], why_left_out(error))
            raise

    def awaits(self, source: tuple[str, str], stamp: float, newer: _MessageBlock) -> bool:
        """Whether a reading that comes when a newer piece has begun is of this piece's time."""
        if newer.joints_from > self.joints_from:
            return self.joints_from <= stamp < newer.joints_from
        return source not in newer.last and stamp >= self.last.get(source, self.joints_from) - _JUMP

    def recording(self) -> Recording:
        """What was taken so far."""
        return self._builder.recording()


class Buffer:
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
        self._before: _MessageBlock | None = None
        self._now = _MessageBlock()
        self._early: list[tuple[tuple[str, str], float, tuple[str, str, Any, float]]] = []
        self.samples = None
        self.dropped: Dropped = ()  # of what is remembered as samples only
        self._stamps: dict[tuple[str, str], float] = {}
        self._odd: dict[tuple[str, str], float] = {}
        self._names: frozenset[str] = frozenset()

    def add(self, topic: str, type_name: str, message: Any, received: float) -> None:
        """Take one message. Raises BadRecording for one that contradicts itself, or is stamped at another time."""
        stamp = seconds(message.header.stamp) or received
        source = (topic, str(message.header.frame_id))
        if self._elsewhen(source, stamp):
            self._now.keep((topic, type_name, message, received))  # which counts it when samples are made
            raise BadRecording(topic, f"a message is {ELSEWHEN}, at {stamp:.3f} s", "synchronise the clocks")
        if topic.endswith(JOINT_STATES):
            self._follow_clock(stamp)
            if not self._names.issuperset(message.name):
                self._names |= set(message.name)
        elif self._before is not None and self._before.awaits(source, stamp, self._now):
            self._before.add(source, stamp, (topic, type_name, message, received))
            return
        elif stamp < self._now.last.get(source, stamp) - _JUMP:
            self._early.append((source, stamp, (topic, type_name, message, received)))
            if len(self._early) > _OVERTAKEN:  # the clock of the joint states was not set back
                self._take_early()
            return
        self._now.add(source, stamp, (topic, type_name, message, received))
        if self._before is not None and self._now.count > _OVERTAKEN:
            self._finish(self._before)
            self._before = None

    def _elsewhen(self, source: tuple[str, str], stamp: float) -> bool:
        """Whether a stamp is of another day than the one before, and the first such: a clock that is set goes on."""
        before = self._stamps.get(source, stamp)
        if abs(stamp - before) > DAY and not abs(stamp - self._odd.get(source, math.inf)) <= _JUMP:
            self._odd[source] = stamp
            return True
        self._stamps[source] = stamp
        return False

    def _follow_clock(self, stamp: float) -> None:
        """Begin a new piece where a joint state's stamp asks for one."""
        set_back = stamp < self._now.joints_to - _JUMP
        if set_back or stamp - self._now.joints_from > self._longest:
            if self._before is not None:
                self._finish(self._before)
            # Each topic is taken in one go: its messages come up to a hundred before, or after, those of another. So
            # readings of the piece that ends may come yet; where the clock was set back, some since may have come.
            self._before, self._now = self._now, _MessageBlock()
            if set_back:
                self._take_early()
        self._now.joints_from = stamp if math.isnan(self._now.joints_from) else self._now.joints_from
        self._now.joints_to = stamp

    def _take_early(self) -> None:
        for early in self._early:
            self._now.add(*early)
        self._early.clear()

    def _finish(self, piece: _MessageBlock) -> None:
        self._pieces.append(piece.recording())

    @property
    def full(self) -> bool:
        """Whether there are finished pieces that could be made into samples."""
        return bool(self._pieces)

    def collected(self) -> SampleMemory:
        """Everything remembered."""
        self._take_early()
        open_pieces = [piece.recording() for piece in (self._before, self._now) if piece is not None]
        return SampleMemory(
            (*self._pieces, *(piece for piece in open_pieces if piece.joints)), self.samples, self.dropped
        )

    def finished(self) -> SampleMemory:
        """Everything but the present piece."""
        return SampleMemory(tuple(self._pieces), self.samples, self.dropped)

    def condensed(self, pieces: int, samples: Samples | None, dropped: Dropped = ()) -> None:
        """From now on these samples stand for what was remembered before and for so many of the oldest pieces.

        dropped: what was left out of all that, by reason.
        """
        self.samples, self.dropped = samples, dropped
        del self._pieces[:pieces]

    def left_out(self, pieces: int) -> None:
        """Forget so many of the oldest pieces, which hold no station."""
        lost = sum(len(track.stamps) for piece in self._pieces[:pieces] for track in piece.readings)
        self.condensed(pieces, self.samples, together([self.dropped, ((UNUSABLE, lost),)] if lost else [self.dropped]))

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
