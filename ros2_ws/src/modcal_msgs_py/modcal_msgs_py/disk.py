"""A file that is written beside the caller, who never waits for the disk.

A busy disk can hold up a write for hundreds of milliseconds, and a sync for many seconds; a recorder that waited would
lose what arrives meanwhile. Whatever is handed over goes to the operating system at once, from a thread, so that it
outlives this process. From another thread the system is asked once a second to bring it onto the disk, so that losing
power costs little more than losing the process.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable
from pathlib import Path

SYNC_SECONDS = 1.0
# What may wait for a disk that stands still; more, and the caller waits too.
_MAX_WAITING = 256 * 2**20


class DiskFile:
    """A new file, written from a thread. Raises OSError, at the next call, when the disk refused what came before."""

    def __init__(self, path: Path) -> None:
        """Create the file; raises FileExistsError when it is there already."""
        self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o644)
        _sync_folder(path.parent)
        self._changed = threading.Condition()
        self._waiting: list[bytes] = []
        self._given = 0
        self._with_system = 0
        self._on_disk = 0
        self._sync_goal = 0  # bytes that somebody waits for to be on the disk
        self._closing = self._complete = False  # complete: nothing more will be written
        self._error: OSError | None = None
        self._threads = [
            threading.Thread(target=self._guarded, args=(work,), name=f"{name} {path.name}", daemon=True)
            for name, work in (("write", self._write_on), ("sync", self._sync_on))
        ]
        for thread in self._threads:
            thread.start()

    def write(self, data: bytes) -> int:
        """Hand over bytes, which must not change any more; their number."""
        with self._changed:
            self._changed.wait_for(lambda: self.waiting < _MAX_WAITING or self._error is not None)
            self.check()
            if data:
                self._waiting.append(data)
                self._given += len(data)
                self._changed.notify_all()
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

    @property
    def on_disk(self) -> int:
        """Bytes that the system has brought onto the disk."""
        return self._on_disk

    def drain(self, sync: bool = False) -> None:
        """Return when the system has taken everything; with ``sync``, when it is on the disk."""
        with self._changed:
            goal = self._given
            self._sync_goal = goal if sync else self._sync_goal
            self._changed.notify_all()
            self._changed.wait_for(
                lambda: self._error is not None or (self._on_disk if sync else self._with_system) >= goal
            )
            self.check()

    def close(self) -> None:
        """Write and sync what is left, and close; harmless when closed already."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1
        self.check()

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except OSError as error:
            with self._changed:
                self._error = error
                self._waiting = []
                self._changed.notify_all()

    def _write_on(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing or self._error is not None)
                data, self._waiting = self._waiting, []
                if not data:
                    self._complete = True
                    self._changed.notify_all()
                    return
            for piece in data:
                self._write_all(piece)

    def _write_all(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            written = os.write(self._handle, rest)
            rest = rest[written:]
            with self._changed:
                self._with_system += written
                self._changed.notify_all()

    def _sync_on(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._sync_due, SYNC_SECONDS)
                if self._error is not None:
                    return
                goal, complete = self._with_system, self._complete
            if goal > self._on_disk:
                os.fdatasync(self._handle)
            with self._changed:
                self._on_disk = goal
                self._changed.notify_all()
            if complete:
                return

    def _sync_due(self) -> bool:
        wanted = self._with_system >= self._sync_goal > self._on_disk
        return wanted or self._complete or self._error is not None


def _sync_folder(folder: Path) -> None:
    # a file whose name is not on the disk is lost with the power, however well its content is
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some file systems cannot, and a recording need not fail over it
            os.fsync(handle)
    finally:
        os.close(handle)
