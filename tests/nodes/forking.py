"""Nodes without what every interpreter takes to begin: a process that has imported them forks for each.

Importing NumPy, SciPy, rclpy and a node takes half a second to a second of processor, and the tests start some hundred.
What is forked runs the executable of the install tree from its first line to the end of its interpreter, in a process of
its own. Nodes that other nodes start, and those of test_conventions, start from nothing, as those of a user do.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import runpy
import selectors
import signal
import socket
import subprocess
import sys
from pathlib import Path

_ALL = 1 << 20  # bytes of a call


class Forked:
    """A process that was forked for a test, with what tests ask of a Popen."""

    def __init__(self, pid: int, ends: socket.socket) -> None:
        self.pid, self._ends = pid, ends
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Its exit code; minus the signal that ended it; None while it lives."""
        return self._heard(0.0)

    def wait(self, timeout: float | None = None) -> int:
        """The exit code, when it has ended."""
        code = self._heard(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Nothing happens to one that has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it ended between the two
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """Ask it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self.send_signal(signal.SIGKILL)

    def _heard(self, timeout: float | None) -> int | None:
        if self.returncode is None:
            self._ends.settimeout(timeout)
            try:
                said = self._ends.recv(16)
            except (TimeoutError, BlockingIOError):
                return None
            self._ends.close()
            self.returncode = int(said or b"-9")  # nothing: who forked it has ended, and it with that
        return self.returncode


class Forker:
    """The process that forks, as long as this one lives."""

    def __init__(self, environment: dict[str, str]) -> None:
        self._calls, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with there:
            self._process = subprocess.Popen(
                [sys.executable, __file__], env=environment, stdin=there.fileno(), stdout=subprocess.DEVNULL
            )
        atexit.register(self._end)

    def start(self, words: list[str], environment: dict[str, str], folder: Path, stream: int) -> Forked:
        """Run a Python program with these words, its output going to ``stream``."""
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        call = {"words": words, "environment": environment, "folder": str(folder)}
        with there:
            socket.send_fds(self._calls, [json.dumps(call).encode()], [stream, there.fileno()])
        return Forked(int(here.recv(16)), here)

    def _end(self) -> None:
        self._calls.close()
        self._process.wait()


def serve() -> list[str]:
    """Fork for each call, and say how each child ended; what comes back is, in a child, what it is to run.

    With who calls all children end.
    """
    import gc
    from importlib import import_module
    from importlib.metadata import distribution

    for point in distribution("modcal-nodes").entry_points:
        if ".nodes." in point.value:
            import_module(point.module)
    gc.freeze()
    calls = socket.socket(fileno=os.dup(0))
    living: dict[int, tuple[int, socket.socket]] = {}
    look = selectors.DefaultSelector()
    look.register(calls, selectors.EVENT_READ)
    while True:
        for key, _ in look.select():
            if key.fileobj is not calls:
                look.unregister(key.fileobj)
                pid, ends = living.pop(key.fd)
                _, status = os.waitpid(pid, 0)
                ends.send(str(os.waitstatus_to_exitcode(status)).encode())
                ends.close()
                os.close(key.fd)
                continue
            said, streams, _, _ = socket.recv_fds(calls, _ALL, 2)
            if not said:
                for pid, _ in living.values():
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)
                sys.exit(0)
            pid = os.fork()
            if pid == 0:
                call = json.loads(said)
                os.dup2(streams[0], 1)
                os.dup2(streams[0], 2)
                nothing = os.open(os.devnull, os.O_RDONLY)
                os.dup2(nothing, 0)
                look.close()
                calls.close()
                for fd in (*streams, nothing, *living):
                    os.close(fd)
                for _, ends in living.values():
                    ends.close()
                os.environ.clear()
                os.environ.update(call["environment"])
                os.chdir(call["folder"])
                return call["words"]
            ends = socket.socket(fileno=streams[1])
            os.close(streams[0])
            ends.send(str(pid).encode())
            fd = os.pidfd_open(pid)
            living[fd] = (pid, ends)
            look.register(fd, selectors.EVENT_READ)


if __name__ == "__main__":
    sys.argv = serve()
    sys.path[0] = str(Path(sys.argv[0]).parent)
    runpy.run_path(sys.argv[0], run_name="__main__")
