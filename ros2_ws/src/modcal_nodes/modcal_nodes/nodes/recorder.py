"""``recorder``: what is published goes into a bag, as it comes, byte for byte."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from rclpy.clock import Clock, ClockType
from rclpy.logging import get_logger

from modcal_core.errors import BadRecording, ModcalError
from modcal_msgs_py import FLUSH_SECONDS, READINGS, BagWriter
from modcal_nodes import ros

_LOOK_SECONDS = 0.1
_REST = 0.01  # s; the middleware stamps what comes meanwhile, only simulated time is read after it
_MEASURE_SECONDS = 1.0
_FEW_MINUTES = 10.0
_MB = 1e6
_ROOM = "make room on the disk, or lower min_free_mb"


class Recorder(ros.ManagedNode):
    """Subscribes to topics as they appear, with every QoS that their publishers offer. Each activation begins a bag."""

    _bag: BagWriter
    _bags = 0  # begun so far
    _trouble: ModcalError | None = None

    def __init__(self) -> None:
        super().__init__("recorder", ros.RECORDER)

    def _serve(self) -> None:
        self.offer("~/save", self._save)
        self.offer("~/reset", self._reset)

    def _configure(self) -> None:
        chosen = self._chosen
        optional = {self.resolve_topic_name(name) for name in chosen["optional"] if name}
        self._recorders = [
            ros.TopicRecorder(self, topic, self._take, topic not in optional, chosen["patience_s"])
            for topic in dict.fromkeys(self.resolve_topic_name(name) for name in chosen["topics"] if name)
        ]
        self._early: list[ros.Taken] = []
        self._early_since = 0.0
        self._said: dict[str, str] = {}
        self._unheard: set[str] = set()
        self._bytes_per_second = 0.0
        self._base = Path(chosen["out"] or time.strftime("modcal_%Y_%m_%d-%H_%M_%S"))

    def _activate(self) -> None:
        self._free, self._started, self._trouble = _free_bytes(self._base), time.monotonic(), None
        if (shortage := self._shortage()) is not None:
            raise shortage
        self._open(_next_bag(self._base) if self._bags or not self._chosen["out"] else BagWriter(self._base))
        # a simulation that stands still must not keep messages from the disk
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_LOOK_SECONDS, self._tick, clock=steady)
        self.create_timer(_MEASURE_SECONDS, self._measure, clock=steady)

    def _open(self, bag: BagWriter) -> None:
        """Record into this bag from now on; what is latched is true there too."""
        self._bag, self._bags, self._measured = bag, self._bags + 1, (time.monotonic(), 0)
        for recorder in self._recorders:
            if recorder.type_name is not None:
                bag.add_topic(recorder.topic, recorder.type_name, recorder.profiles())
            for taken in recorder.kept:
                self._take(taken._replace(received_ns=self._now()))
        self.get_logger().info(f"recording into {bag.folder}")

    def _take_parameters(self) -> None:
        for recorder in self._recorders:
            recorder.patience = self._chosen["patience_s"]

    def _tick(self) -> None:
        if self._trouble is not None:
            self._end(self._trouble)
        for recorder in self._recorders:
            if recorder.look() and recorder.type_name is not None:
                self._bag.add_topic(recorder.topic, recorder.type_name, recorder.profiles())
                self.get_logger().info(f"recording {recorder.topic} ({recorder.type_name})")
        self._complain()
        try:
            if self._early and (self._now() or time.monotonic() - self._early_since > FLUSH_SECONDS):
                self._write_early()
            self._bag.flush_if_due()
        except ModcalError as error:
            self._end(error)

    def _take(self, taken: ros.Taken) -> None:
        if self._trouble is not None or not self.active:
            return
        try:
            if not self.get_clock().ros_time_is_active:
                # the middleware stamped it on arrival, which does not depend on how busy this process is
                received = taken.received_ns or self._now()
                self._bag.write_raw(taken.topic, taken.cdr, received, taken.published_ns or received)
                return
            if self._early or not self._now():
                self._early_since = self._early_since if self._early else time.monotonic()
                self._early.append(taken)
                return
            self._bag.write_raw(taken.topic, taken.cdr, self._now())
        except ModcalError as error:
            self._end(error)

    def _write_early(self) -> None:
        """Write what came before simulated time began; if that does not begin soon, stamped 0, as that clock reads."""
        for taken in self._early:
            self._bag.write_raw(taken.topic, taken.cdr, self._now())
        self._early = []

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _measure(self) -> None:
        """Renew rates and free space, say what is newly wrong, and end before the disk is full."""
        now, (then, size) = time.monotonic(), self._measured
        self._bytes_per_second = max(self._bag.size - size, 0) / max(now - then, 1e-3)
        self._measured = (now, self._bag.size)
        self._free = _free_bytes(self._bag.folder)
        for recorder in self._recorders:
            recorder.measure()
        if (shortage := self._shortage()) is not None:
            self._end(shortage)
        self._health.publish_if_changed()

    def _complain(self) -> None:
        news = False
        for topic, complaint in self._complaints():
            if self._said.get(topic) != complaint.kind:
                self._said[topic], news = complaint.kind, True
                self._unheard |= {topic} if complaint.kind == ros.UNHEARD else set()
                self.get_logger().warn(complaint.text)
        for recorder in self._recorders:
            if recorder.waited is not None and recorder.topic in self._unheard:
                self._unheard.discard(recorder.topic)
                self._said.pop(recorder.topic, None)
                waited = f"{recorder.waited:.1f} s after subscribing"
                self.get_logger().info(f"{recorder.topic}: the first message came {waited}")
        if news:
            self._health.publish()

    def _shortage(self) -> BadRecording | None:
        least = float(self._chosen["min_free_mb"])
        if self._free >= least * _MB:
            return None
        said = f"{self._free / _MB:.0f} MB free, less than min_free_mb = {least:g}"
        return BadRecording(f"disk of {self._base}", said, _ROOM)

    def _end(self, error: ModcalError) -> None:
        self._trouble = error
        self.get_logger().fatal(str(error))
        self._health.publish_last()
        raise ros.NodeEnds(error)

    def _complaints(self) -> Iterator[tuple[str, ros.Complaint]]:
        for recorder in self._recorders:
            if (complaint := recorder.complaint()) is not None:
                yield recorder.topic, complaint
        trackers = [r for r in self._recorders if r.topic.endswith(tuple("/" + role for role in READINGS))]
        late = time.monotonic() - self._started > float(self._chosen["patience_s"])
        if trackers and late and not any(recorder.count for recorder in trackers):
            names = ", ".join(recorder.topic for recorder in trackers)
            said = f"no message from a tracker ({names}): start it, or remap its topic"
            yield "tracker", ros.Complaint(ros.WARN, "nobody", said)

    def _report(self) -> Iterator[ros.Status]:
        if self._bags:
            yield self._bag_status()
        complaints = [complaint for _, complaint in self._complaints()]
        said = "; ".join(c.text for c in complaints) or "everything that is needed is recorded"
        facts: dict[str, object] = {}
        for recorder in self._recorders:
            facts[f"messages of {recorder.topic}"] = recorder.count
            facts[f"rate of {recorder.topic} [Hz]"] = f"{recorder.rate:.1f}"
            facts[f"bytes of {recorder.topic}"] = recorder.bytes
            facts[f"lost of {recorder.topic}"] = recorder.lost
        yield ros.Status("topics", max((c.level for c in complaints), default=ros.OK), said, facts)

    def _bag_status(self) -> ros.Status:
        minutes = self._free / self._bytes_per_second / 60.0 if self._bytes_per_second else float("inf")
        facts = {
            "folder": self._bag.folder,
            "messages": self._bag.count,
            "bytes": self._bag.size,
            "bytes waiting for the disk": self._bag.waiting,
            "free [MB]": f"{self._free / _MB:.0f}",
            "minutes until full": f"{minutes:.0f}",
        }
        least = float(self._chosen["min_free_mb"])
        if self._trouble is not None:
            return ros.Status("bag", ros.ERROR, str(self._trouble), facts)
        if self._free < 2 * least * _MB or minutes < _FEW_MINUTES:
            text = f"{self._free / _MB:.0f} MB free, {minutes:.0f} minutes at this rate; ends at {least:g} MB: {_ROOM}"
            return ros.Status("bag", ros.WARN, text, facts)
        if self.get_clock().ros_time_is_active and not self._now():
            said = "simulated time has not begun: no node publishes /clock; stamps are 0"
            return ros.Status("bag", ros.WARN, said, facts)
        return ros.Status("bag", ros.OK, f"{self._bag.count} messages in {self._bag.folder}", facts)

    def _save(self) -> tuple[bool, str]:
        try:
            self._write_early()
            return True, f"{self._bag.flush(sync=True)} messages are on the disk in {self._bag.file}"
        except ModcalError as error:
            self._trouble = error  # ends at the next tick, after this answer
            return False, str(error)

    def _reset(self) -> tuple[bool, str]:
        """Close this bag and begin the next."""
        try:
            self._deactivate()
            closed, count = self._bag.folder, self._bag.count
            self._open(_next_bag(self._base))
        except ModcalError as error:
            self._trouble = error
            return False, str(error)
        return True, f"closed {closed} with {count} messages, recording into {self._bag.folder}"

    def _deactivate(self) -> None:
        """Write the bag's index and metadata; nothing, when the disk has refused before."""
        if self._bag.broken:
            return
        self._write_early()
        self._bag.close()
        # not by the node's own logger, which is published, and by now there may be nothing left to publish with
        get_logger("modcal.recorder").info(f"closed {self._bag.folder} with {self._bag.count} messages")


def _next_bag(base: Path) -> BagWriter:
    """A bag named ``base``, or with the first number behind it that is free; two recorders may begin in one second."""
    number = 1
    while True:
        folder = base if number == 1 else base.with_name(f"{base.name}_{number}")
        if not folder.exists():
            try:
                return BagWriter(folder)
            except BadRecording:
                if not folder.exists():
                    raise
        number += 1


def _free_bytes(place: Path) -> int:
    place = place.absolute()
    while not place.exists():
        place = place.parent
    return shutil.disk_usage(place).free


def main() -> None:
    """Entry point of the executable."""
    ros.run(Recorder, rest=_REST)
