"""Writing a bag as ``ros2 bag record -s mcap`` lays it out: a folder with NAME_0.mcap and metadata.yaml.

Messages come as CDR bytes and go to the system in whole chunks several times a second, so that a recorder that is
killed loses no more than that: every finished chunk can be read without the index at the end of the file.

A busy disk can hold up a write for hundreds of milliseconds, and a sync for many seconds; a recorder that waited would
lose what arrives meanwhile. So the file is written from a thread, which hands what comes to the operating system at
once: it outlives this process. Another thread asks the system once a second to bring it onto the disk, so that losing
power costs little more than losing the process.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import Any

from mcap.writer import CompressionType, Writer

from modcal_core.errors import BadRecording
from modcal_msgs_py.bag_files import BagFile, BagTopic, information, qos_profile, to_yaml
from modcal_msgs_py.layout import definition, serialise
from modcal_msgs_py.topics import LATCHED

SYNC_SECONDS = 1.0
# What may wait for a disk that stands still; more, and the caller waits too.
_MAX_WAITING = 256 * 2**20


class DiskFile:
    """A new file, written from a thread. Raises OSError, at the next call, when the disk refused what came before.

    on_disk: bytes that the system has brought onto the disk.
    """

    def __init__(self, path: Path) -> None:
        """Create the file; raises FileExistsError when it is there already."""
        self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o644)
        _sync_folder(path.parent)
        self._pieces: SimpleQueue[bytes] = SimpleQueue()  # nothing, b"", is the end
        self._given = self._with_system = self.on_disk = 0
        self._changed = threading.Condition()  # what the system has, and the error
        self._error: OSError | None = None
        self._syncing, self._ended = threading.Lock(), threading.Event()
        self._threads = [
            threading.Thread(target=self._guarded, args=(work,), name=f"{name} {path.name}", daemon=True)
            for name, work in (("write", self._write_on), ("sync", self._sync_on))
        ]
        for thread in self._threads:
            thread.start()

    def write(self, data: bytes) -> int:
        """Hand over bytes, which must not change any more; their number."""
        self._wait(lambda: self.waiting < _MAX_WAITING)
        if data:
            self._given += len(data)
            self._pieces.put(data)
        return len(data)

    def tell(self) -> int:
        """Bytes handed over so far."""
        return self._given

    def flush(self) -> None:
        """Nothing: the thread does not wait to be asked."""

    def check(self) -> None:
        """Raise the error that the disk has answered with, if it has."""
        if self._error is not None:
            raise OSError(self._error.errno, self._error.strerror)

    @property
    def waiting(self) -> int:
        """Bytes that the system has not taken yet."""
        return self._given - self._with_system

    def drain(self, sync: bool = False) -> None:
        """Return when the system has taken everything; with ``sync``, when it is on the disk."""
        goal = self._given
        self._wait(lambda: self._with_system >= goal)
        if sync:
            self._guarded(self._sync)
            self.check()

    def close(self) -> None:
        """Write and sync what is left, and close; harmless when closed already."""
        self._pieces.put(b"")
        self._threads[0].join()
        self._ended.set()
        self._threads[1].join()
        if self._handle >= 0:
            self._guarded(self._sync)
            os.close(self._handle)
            self._handle = -1
        self.check()

    def _wait(self, done: Callable[[], bool]) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._error is not None or done())
        self.check()

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except OSError as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _write_on(self) -> None:
        while rest := memoryview(self._pieces.get()):
            while rest:
                written = os.write(self._handle, rest)
                rest = rest[written:]
                with self._changed:
                    self._with_system += written
                    self._changed.notify_all()

    def _sync_on(self) -> None:
        while not self._ended.wait(SYNC_SECONDS):
            self._sync()

    def _sync(self) -> None:
        with self._syncing:
            goal = self._with_system
            if goal > self.on_disk:
                os.fdatasync(self._handle)
                self.on_disk = goal


def _sync_folder(folder: Path) -> None:
    # a file whose name is not on the disk is lost with the power, however well its content is
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some file systems cannot, and a recording need not fail over it
            os.fsync(handle)
    finally:
        os.close(handle)


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
            raise BadRecording(str(folder), f"cannot be made ({error.strerror})", "give one that can be") from error
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
        with self._writing():
            self._writer = Writer(self._disk, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
            self._writer.start(profile="ros2", library=LIBRARY)

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
        with self._writing():
            self._writer.add_message(self._channels[topic], received_ns, cdr, published, known.count)
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
        with self._writing():
            self._disk.drain(sync)
        return self.count

    def close(self) -> None:
        """Write the index and metadata.yaml; harmless when closed already, or when the disk has refused before."""
        if not self._open:
            return
        with self._writing():
            self._writer.add_metadata("rosbag2", {"serialized_metadata": to_yaml(self._information())})
            self._writer.finish()
            self._disk.close()
            whole = {"rosbag2_bagfile_information": self._information()}
            temporary = self.folder / ".metadata.yaml"
            temporary.write_text(to_yaml(whole), encoding="utf-8")
            os.replace(temporary, self.folder / "metadata.yaml")
        self._open = False

    def _finish_chunk(self) -> None:
        self._flushed = time.monotonic()
        with self._writing():
            self._disk.check()
            self._writer.flush()

    def _information(self) -> dict[str, Any]:
        return information(self._topics.values(), [self._seen])

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # nothing more is written: the last whole message on disk must stay the last
            self._open, self.broken = False, True
            with contextlib.suppress(OSError):
                self._disk.close()
            raise _refused(self.file, error) from error

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _refused(file: Path, error: OSError) -> BadRecording:
    remedy = "make room on the disk; what it holds can be read, and `modcal repair` makes a whole bag of it"
    return BadRecording(str(file), f"cannot be written ({error.strerror})", remedy)
