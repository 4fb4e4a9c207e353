"""Writing a bag as ``ros2 bag record -s mcap`` lays it out: a folder with NAME_0.mcap and metadata.yaml.

Messages come as CDR bytes and go to the system in whole chunks several times a second, so that a recorder that is
killed loses no more than that: every finished chunk can be read without the index at the end of the file.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.writer import CompressionType, Writer

from modcal_core.errors import BadRecording
from modcal_msgs_py.bag_files import BagFile, BagTopic, information, qos_profile, to_yaml
from modcal_msgs_py.disk import DiskFile
from modcal_msgs_py.layout import definition, serialise
from modcal_msgs_py.topics import LATCHED

CHUNK_BYTES = 768 * 1024
FLUSH_SECONDS = 0.2
LIBRARY = "modcal"


class BagWriter:
    """Writes one bag; use it as a context manager.

    Raises BadRecording when the folder exists already, or the disk refuses to be written (what it has taken stays
    readable).
    """

    def __init__(self, folder: Path) -> None:
        """Make the folder and open the file in it."""
        try:
            folder.mkdir(parents=True)
        except FileExistsError as error:
            raise BadRecording(str(folder), "exists already", "give another name, or remove it") from error
        except OSError as error:
            raise BadRecording(
                str(folder), f"cannot be made ({error.strerror})", "give a folder that can be written"
            ) from error
        self.folder = folder
        self.file = folder / f"{folder.name}_0.mcap"
        self._seen = BagFile(self.file.name)
        self._topics: dict[str, BagTopic] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, tuple[int, str]] = {}
        self._flushed = time.monotonic()
        self._open = True
        self.broken = False
        try:
            self._disk = DiskFile(self.file)
        except OSError as error:
            folder.rmdir()
            raise _refused(self.file, error) from error
        try:
            self._writer = Writer(self._disk, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
            self._writer.start(profile="ros2", library=LIBRARY)
        except OSError as error:
            raise self._failed(error) from error

    def add_topic(self, topic: str, type_name: str, qos: list[dict[str, Any]] | None = None) -> None:
        """Announce a topic and the QoS its publishers offer; of a topic that is known, only new QoS is noted."""
        if topic in self._topics:
            known = self._topics[topic].qos
            known += [profile for profile in qos or [] if profile not in known]
            return
        if type_name not in self._schemas:
            text, type_hash = definition(type_name)
            self._schemas[type_name] = (self._writer.register_schema(type_name, "ros2msg", text.encode()), type_hash)
        schema, type_hash = self._schemas[type_name]
        if qos is None:
            qos = [qos_profile(latched=any(topic.endswith("/" + role) for role in LATCHED))]
        described = {"offered_qos_profiles": to_yaml(qos), "topic_type_hash": type_hash}
        self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, described)
        self._topics[topic] = BagTopic(topic, type_name, type_hash, list(qos))

    def write_raw(self, topic: str, cdr: bytes, received_ns: int, published_ns: int | None = None) -> None:
        """Write the CDR bytes of one message of an announced topic."""
        known = self._topics[topic]
        known.count += 1
        published = received_ns if published_ns is None else published_ns
        try:
            self._writer.add_message(self._channels[topic], received_ns, cdr, published, known.count)
        except OSError as error:
            raise self._failed(error) from error
        self._seen.add(received_ns)
        self.flush_if_due()

    def write(self, topic: str, type_name: str, message: Any, received_ns: int) -> None:
        """Write one message object, announcing its topic if need be."""
        self.add_topic(topic, type_name)
        self.write_raw(topic, serialise(message, type_name), received_ns)

    @property
    def count(self) -> int:
        """Messages written so far."""
        return self._seen.count

    @property
    def size(self) -> int:
        """Bytes of the file so far, without the chunk that is being filled."""
        return self._disk.tell()

    @property
    def waiting(self) -> int:
        """Bytes that the disk has not taken yet."""
        return self._disk.waiting

    def flush_if_due(self) -> None:
        """Begin to flush when the last time was long enough ago; to be called also while nothing is written.

        Does not wait for the disk, and raises BadRecording if the disk has refused what came before.
        """
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            self._finish_chunk()

    def flush(self, sync: bool = False) -> int:
        """Messages that the system has taken once this returns, which is all of them; with ``sync``, those on disk."""
        self._finish_chunk()
        try:
            self._disk.drain(sync)
        except OSError as error:
            raise self._failed(error) from error
        return self.count

    def close(self) -> None:
        """Write the index and metadata.yaml; harmless when closed already, or when the disk has refused before."""
        if not self._open:
            return
        try:
            self._writer.add_metadata("rosbag2", {"serialized_metadata": to_yaml(self._information())})
            self._writer.finish()
            self._disk.close()
            whole = {"rosbag2_bagfile_information": self._information()}
            temporary = self.folder / ".metadata.yaml"
            temporary.write_text(to_yaml(whole), encoding="utf-8")
            os.replace(temporary, self.folder / "metadata.yaml")
        except OSError as error:
            raise self._failed(error) from error
        self._open = False

    def _finish_chunk(self) -> None:
        self._flushed = time.monotonic()
        try:
            self._disk.check()
            self._writer.flush()
        except OSError as error:
            raise self._failed(error) from error

    def _information(self) -> dict[str, Any]:
        return information(self._topics.values(), [self._seen])

    def _failed(self, error: OSError) -> BadRecording:
        # nothing more is written: the last whole message on disk must stay the last
        self._open = False
        self.broken = True
        with contextlib.suppress(OSError):
            self._disk.close()
        return _refused(self.file, error)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _refused(file: Path, error: OSError) -> BadRecording:
    return BadRecording(
        str(file),
        f"cannot be written ({error.strerror})",
        "make room on the disk; what it holds can be read, and `modcal repair` makes a whole bag of it",
    )
