"""What installed packages add, by entry points."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points
from typing import Any

from modcal_core.errors import BadTable


def added(group: str) -> Iterator[tuple[str, Any]]:
    """(how to call it in a message to people, what it names) of each entry point of a group.

    Raises BadTable where a package cannot be loaded.
    """
    for point in entry_points(group=group):
        offender = f"entry point {point.name} of {group}"
        try:
            named = point.load()
        except Exception as error:  # whatever a package may do
            package = "its package" if point.dist is None else f"package {point.dist.name}"
            said = f"{package} raises {type(error).__name__} ({error})"
            raise BadTable(offender, said, "fix the package, or uninstall it") from error
        yield offender, named
