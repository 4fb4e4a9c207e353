"""A file that is written beside the caller, who never waits for the disk.

A busy disk can hold up a write, and more so a sync, for hundreds of milliseconds; a recorder that waited would lose
what arrives meanwhile. Whatever is handed over goes to the operating system at once, from a thread; once a second the
system is asked to bring it onto the disk, so that losing power costs little more than losing the process.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from pathlib import Path

SYNC_SECONDS = 1.0
# What may wait for a disk that stands still; more, and the caller waits too.
_MOST_WAITING = 256 * 2**20


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
        self._sync_wanted = False
        self._closing = False
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._work, name=f"disk {path.name}", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> int:
        """Hand over bytes, which must not change any more; their number."""
        with self._changed:
            self._changed.wait_for(lambda: self.waiting < _MOST_WAITING or self._error is not None)
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
            self._sync_wanted |= sync
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
        self._thread.join()
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1
        self.check()

    def _work(self) -> None:
        synced = time.monotonic()
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._sync_wanted or self._closing, SYNC_SECONDS)
                    data, self._waiting = self._waiting, []
                    ending = self._closing and not data
                for piece in data:
                    self._write_all(piece)
                if self._sync_wanted or ending or time.monotonic() - synced >= SYNC_SECONDS:
                    self._sync()
                    synced = time.monotonic()
                if ending:
                    return
        except OSError as error:
            with self._changed:
                self._error = error
                self._waiting = []
                self._changed.notify_all()

    def _write_all(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            written = os.write(self._handle, rest)
            rest = rest[written:]
            with self._changed:
                self._with_system += written
                self._changed.notify_all()

    def _sync(self) -> None:
        with self._changed:
            # asked again for what came meanwhile: then once more, after that is written
            goal, self._sync_wanted = self._with_system, self._sync_wanted and bool(self._waiting)
        if goal > self._on_disk:
            os.fdatasync(self._handle)
        with self._changed:
            self._on_disk = goal
            self._changed.notify_all()


def _sync_folder(folder: Path) -> None:
    # a file whose name is not on the disk is lost with the power, however well its content is
    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some file systems cannot, and a recording need not fail over it
            os.fsync(handle)
    finally:
        os.close(handle)
