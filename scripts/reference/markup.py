"""Tables in Markdown, alike on every page, and the same to every reader of Markdown."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table, its lines joined, without an end of line."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell or " " for cell in line) + " |" for line in lines)


def code(text: str) -> str:
    """A cell, or part of one, shown as code; a bar in it is none between cells."""
    if "|" not in text and "`" not in text:
        return f"`{text}`"
    return "<code>" + html.escape(text, quote=False).replace("|", "&#124;") + "</code>"


def prose(text: str) -> str:
    """A cell of plain words on one line: nothing in it is taken for markup, or for the end of the cell."""
    kept = " ".join(text.split())
    for sign, shown in (("&", "&amp;"), ("<", "&lt;"), ("|", "&#124;"), ("*", "&#42;")):
        kept = kept.replace(sign, shown)
    return kept
