"""What long work tells of how far it is."""

from __future__ import annotations

from typing import Protocol


class Watch(Protocol):
    """Hears what is being done, and, where that is known, the share of it that is done."""

    def __call__(self, stage: str, share: float | None = None) -> None:
        """Take notice."""


def silent(stage: str, share: float | None = None) -> None:
    """A watch that says nothing."""
