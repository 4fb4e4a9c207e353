"""What installed packages add, by entry points.

``importlib.metadata`` takes as long to import as NumPy, and few installations have such a package; so the files that
installers write are looked through first, for any group of ours.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from modcal_core.errors import BadTable

_OURS = b"[modcal."


def added(group: str) -> Iterator[tuple[str, Any]]:
    """(how to call it in a message to people, what it names) of each entry point of a group.

    Raises BadTable where a package cannot be loaded.
    """
    if not _any_announced():
        return
    from importlib.metadata import entry_points

    for point in entry_points(group=group):
        offender = f"entry point {point.name} of {group}"
        try:
            named = point.load()
        except Exception as error:  # whatever a package may do
            package = "its package" if point.dist is None else f"package {point.dist.name}"
            said = f"{package} raises {type(error).__name__} ({error})"
            raise BadTable(offender, said, "fix the package, or uninstall it") from error
        yield offender, named


@cache
def _any_announced() -> bool:
    """Whether any package on the path has entry points of ours."""
    for folder in map(Path, dict.fromkeys(sys.path)):
        for pattern in ("*.dist-info/entry_points.txt", "*.egg-info/entry_points.txt"):
            if any(_OURS in file.read_bytes() for file in folder.glob(pattern)):
                return True
    return False
