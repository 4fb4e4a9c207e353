"""One thing at a time that takes long, done in a thread of its own, so that every period of a node is kept."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


class Worker:
    """Does one piece of work at a time elsewhere; what comes of it is taken where :meth:`finish` is called."""

    def __init__(self, name: str) -> None:
        self._pool = ThreadPoolExecutor(1, name)
        self._future: Future[Any] | None = None
        self._then: Callable[[Any], None] = lambda _: None

    @property
    def busy(self) -> bool:
        """Whether something is being done, or was done and has not been taken."""
        return self._future is not None

    def begin(self, work: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Do this; ``then`` gets what comes of it."""
        self._then = then
        self._future = self._pool.submit(work)

    def finish(self) -> None:
        """Take what has been done, if it has; raises what the work raised."""
        if self._future is not None and self._future.done():
            future, self._future = self._future, None
            self._then(future.result())

    def close(self) -> None:
        """Begin nothing more."""
        self._pool.shutdown(wait=False, cancel_futures=True)
