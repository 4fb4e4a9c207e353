"""The page of the core's constants: every module-level number that results may depend on, with its comment."""

from __future__ import annotations

from markup import code, prose, table
from module_numbers import WHERE, numbers

INTRODUCTION = """# Constants

Every number at the top of a file of these packages, with the comment that gives its reason or its source."""
_LONGEST = 70  # characters of a value that a table shows


def page() -> str:
    """Text of the page."""
    parts, everything = [INTRODUCTION], numbers()
    for place in WHERE:
        own = [n for n in everything if n.file == place or n.file.startswith(f"{place}/")]
        if not own:
            continue
        rows = [
            (code(n.file.removeprefix(f"{place}/")), code(n.name), code(_shown(n.value)), prose(n.comment)) for n in own
        ]
        parts += [f"## {place}", table(("file", "name", "value", ""), rows)]
    return "\n\n".join(parts) + "\n"


def _shown(value: str) -> str:
    return value if len(value) <= _LONGEST else value[:_LONGEST] + "…"
