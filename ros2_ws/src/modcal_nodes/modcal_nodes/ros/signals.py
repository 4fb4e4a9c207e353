"""Signals that ask a process to end: noted, so that what is being done is finished and closing cannot be cut short."""

from __future__ import annotations

import signal
import socket
import threading
import time
from collections.abc import Callable
from types import FrameType

_PATIENCE = 10.0  # s after the first signal, from which another one interrupts what hangs


class SignalGuard:
    """SIGINT and SIGTERM set ``asked``, and nothing else, however often they come."""

    def __init__(self) -> None:
        self.asked = False
        self._since = 0.0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if not self.asked:
            self.asked, self._since = True, time.monotonic()
        elif time.monotonic() - self._since > _PATIENCE:
            raise KeyboardInterrupt

    def done(self) -> None:
        """Closed: what comes from now on must not end Python's own end, which would restore what signals do."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)

    def wake(self, wake: Callable[[], object]) -> None:
        """Have this called, from a thread, at every signal: a wait outside Python would not see it."""
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        self._ends = ours, theirs  # open as long as this is

        def listen() -> None:
            while ours.recv(64):
                wake()

        threading.Thread(target=listen, name="signals", daemon=True).start()
