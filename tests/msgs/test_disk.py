"""A file written from a thread: everything arrives, nobody waits for a slow disk, and a refusal is not kept quiet."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from modcal_msgs_py.mcap_write import DiskFile


def test_what_is_handed_over_is_in_the_file(tmp_path: Path, rng: np.random.Generator) -> None:
    pieces = [rng.bytes(int(n)) for n in rng.integers(0, 100_000, 200)]
    file = DiskFile(tmp_path / "file")
    for k, piece in enumerate(pieces):
        file.write(piece)
        assert file.tell() == sum(map(len, pieces[: k + 1]))
        if k % 50 == 49:
            file.drain(sync=k % 100 == 99)
            assert (tmp_path / "file").read_bytes() == b"".join(pieces[: k + 1])
            assert file.waiting == 0
            assert k % 100 != 99 or file.on_disk == file.tell()
    file.close()
    assert (tmp_path / "file").read_bytes() == b"".join(pieces)
    file.close()


@pytest.mark.slow
def test_a_sync_that_hangs_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is handed over meanwhile is with the system, and so outlives a process that is killed."""
    moves = threading.Event()
    at_work = threading.Event()

    def stands_still(handle: int) -> None:
        at_work.set()
        moves.wait()

    monkeypatch.setattr(os, "fdatasync", stands_still)
    file = DiskFile(tmp_path / "file")
    file.write(b"first")
    assert at_work.wait(30.0)
    for _ in range(1000):
        file.write(b"more")
    file.drain()
    assert (tmp_path / "file").read_bytes() == b"first" + 1000 * b"more"
    assert (file.waiting, file.on_disk) == (0, 0)
    moves.set()
    file.drain(sync=True)
    assert file.on_disk == 4005
    file.close()


def test_nobody_waits_for_a_disk_that_takes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moves = threading.Event()
    write = os.write

    def stands_still(handle: int, data: bytes) -> int:
        moves.wait()
        return write(handle, data)

    monkeypatch.setattr(os, "write", stands_still)
    file = DiskFile(tmp_path / "file")
    for _ in range(1000):
        file.write(b"more")
    assert file.waiting == 4000
    moves.set()
    file.drain(sync=True)
    assert (tmp_path / "file").read_bytes() == 1000 * b"more"
    file.close()


_REFUSED = """
import errno, resource, sys
from pathlib import Path
from modcal_msgs_py.mcap_write import DiskFile
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
file = DiskFile(Path(sys.argv[1]))
file.write(bytes(600))
file.drain()
file.write(bytes(600))
for call in (file.drain, lambda: file.drain(sync=True), lambda: file.write(b"x"), file.check, file.close, file.close):
    try:
        call()
    except OSError as error:
        print(error.errno == errno.EFBIG)
"""


def test_a_refusal_is_raised_by_every_later_call(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _REFUSED, str(tmp_path / "file")], capture_output=True, text=True, timeout=60.0
    )
    assert done.stdout.split() == ["True"] * 6, done.stderr
    assert (tmp_path / "file").stat().st_size == 1000
