"""Processes of our own: what each does first."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing.connection import wait


def settle_in(yielding: int = 0) -> None:
    """Leave Ctrl-C to the parent, and end with it, however that ends. yielding: by how much nicer than it."""
    if yielding:
        os.nice(yielding)
    # Ctrl-C in a terminal reaches every process of the group; the parent decides when this one ends
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
