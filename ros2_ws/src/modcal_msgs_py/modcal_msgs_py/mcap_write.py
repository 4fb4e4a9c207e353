"""Writing a bag as ``ros2 bag record -s mcap`` lays it out: a folder with NAME_0.mcap and metadata.yaml.

Messages come as CDR bytes and go to disk in whole chunks at least once a second, so that a recorder that is killed
loses no more than that: every finished chunk can be read without the index at the end of the file.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from modcal_core.errors import BadRecording
from modcal_msgs_py.topics import LATCHED
from modcal_msgs_py.types import definition, serialise

CHUNK_BYTES = 768 * 1024
FLUSH_SECONDS = 0.5
_LIBRARY = "modcal"
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


def qos_profile(latched: bool = False, reliable: bool = True, depth: int = 10) -> dict[str, Any]:
    """An offered QoS profile as bags hold it."""
    return {
        "history": "keep_last",
        "depth": 1 if latched else depth,
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if latched else "volatile",
        "deadline": _FOREVER,
        "lifespan": _FOREVER,
        "liveliness": "automatic",
        "liveliness_lease_duration": _FOREVER,
        "avoid_ros_namespace_conventions": False,
    }


class _Plain(yaml.SafeDumper):
    """Writes what is equal twice: the readers of bags are not all fond of anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _to_yaml(data: Any) -> str:
    return yaml.dump(data, Dumper=_Plain, sort_keys=False)


@dataclass
class _Topic:
    channel: int
    type_name: str
    type_hash: str
    qos: list[dict[str, Any]]
    count: int = 0


@dataclass
class _Span:
    first: int = field(default=2**63 - 1)
    last: int = 0
    count: int = 0


class BagWriter:
    """Writes one bag; use it as a context manager.

    Raises BadRecording when the folder exists already, or the disk is full (what was written before stays readable).
    """

    def __init__(self, folder: Path) -> None:
        """Make the folder and open the file in it."""
        if folder.exists():
            raise BadRecording(str(folder), "exists already", "give another name, or remove it")
        folder.mkdir(parents=True)
        self.folder = folder
        self.file = folder / f"{folder.name}_0.mcap"
        self._stream = self.file.open("wb")
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library=_LIBRARY)
        self._stream.flush()
        self._schemas: dict[str, tuple[int, str]] = {}
        self._topics: dict[str, _Topic] = {}
        self._span = _Span()
        self._flushed = time.monotonic()
        self._closed = False

    def add_topic(self, topic: str, type_name: str, qos: list[dict[str, Any]] | None = None) -> None:
        """Announce a topic and the QoS its publishers offer; harmless when it is known already."""
        if topic in self._topics:
            return
        if type_name not in self._schemas:
            text, type_hash = definition(type_name)
            self._schemas[type_name] = (self._writer.register_schema(type_name, "ros2msg", text.encode()), type_hash)
        schema, type_hash = self._schemas[type_name]
        if qos is None:
            qos = [qos_profile(latched=any(topic.endswith("/" + role) for role in LATCHED))]
        metadata = {
            "offered_qos_profiles": _to_yaml(qos),
            "topic_type_hash": type_hash,
        }
        channel = self._writer.register_channel(topic, "cdr", schema, metadata)
        self._topics[topic] = _Topic(channel, type_name, type_hash, qos)

    def write_raw(self, topic: str, cdr: bytes, received_ns: int, published_ns: int | None = None) -> None:
        """Write the CDR bytes of one message of an announced topic."""
        known = self._topics[topic]
        known.count += 1
        try:
            self._writer.add_message(known.channel, received_ns, cdr, published_ns or received_ns, known.count)
            self._span.first = min(self._span.first, received_ns)
            self._span.last = max(self._span.last, received_ns)
            self._span.count += 1
            self.flush_if_due()
        except OSError as error:
            raise self._failed(error) from error

    def write(self, topic: str, type_name: str, message: Any, received_ns: int) -> None:
        """Write one message object, announcing its topic if need be."""
        self.add_topic(topic, type_name)
        self.write_raw(topic, serialise(message, type_name), received_ns)

    @property
    def count(self) -> int:
        """Messages written so far."""
        return self._span.count

    def flush_if_due(self) -> None:
        """Flush when the last time was long enough ago; to be called now and then while nothing is written."""
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Finish the chunk being filled and hand it to the system."""
        self._flushed = time.monotonic()
        # the library finishes a chunk by size only; by time is what survives a kill
        self._writer._Writer__finalize_chunk()
        self._stream.flush()

    def close(self) -> None:
        """Write the index and metadata.yaml; harmless when closed already."""
        if self._closed:
            return
        self._closed = True
        try:
            information = {"rosbag2_bagfile_information": self._information()}
            self._writer.add_metadata("rosbag2", {"serialized_metadata": _to_yaml(self._information())})
            self._writer.finish()
            self._stream.close()
            temporary = self.folder / ".metadata.yaml"
            temporary.write_text(_to_yaml(information), encoding="utf-8")
            os.replace(temporary, self.folder / "metadata.yaml")
        except OSError as error:
            raise self._failed(error) from error

    def _information(self) -> dict[str, Any]:
        span = self._span
        start = span.first if span.count else 0
        timing = {
            "duration": {"nanoseconds": span.last - start if span.count else 0},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": span.count,
        }
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **timing,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": name,
                        "type": topic.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": topic.qos,
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.count,
                }
                for name, topic in self._topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.file.name],
            "files": [
                {
                    "path": self.file.name,
                    "starting_time": timing["starting_time"],
                    "duration": timing["duration"],
                    "message_count": span.count,
                }
            ],
            "custom_data": None,
            "ros_distro": "jazzy",
        }

    def _failed(self, error: OSError) -> BadRecording:
        return BadRecording(
            str(self.file),
            f"cannot be written ({error.strerror})",
            "make room on the disk; what is written stays readable",
        )

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
