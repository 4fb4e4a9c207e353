"""Writes the pages of docs/reference from the code: ``python scripts/reference``, as ``make reference`` does.

With ``--check`` it writes nothing, and fails when a page is not what the code says.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import api
import constants
import graph
import messages
import refusals
import settings
import verbs

from modcal_core.files import to_json
from modcal_msgs_py.tables.schema import json_schema

ROOT = Path(__file__).resolve().parents[2]
PAGES: dict[str, Callable[[], str]] = {
    "cli.md": verbs.page,
    "parameters.md": settings.page,
    "topics.md": graph.page,
    "messages.md": messages.page,
    "refusals.md": refusals.page,
    "constants.md": constants.page,
    **api.pages(),
    "import_mapping.schema.json": lambda: to_json(json_schema()),
}
HEADER = "<!-- Made by `make reference` from {}; change it there. -->\n\n"
SOURCES = {
    "cli.md": "modcal_nodes/cli",
    "parameters.md": "modcal_nodes/ros/parameters.py",
    "topics.md": "the running nodes",
    "messages.md": "the running nodes and `scripts/reference/messages.py`",
    "refusals.md": "the refusals in the sources",
    "constants.md": "modcal_core",
    **dict.fromkeys(api.pages(), "the docstrings of `modcal_core` and `modcal_msgs_py`"),
}


def main() -> int:
    """Exit code: 0, or 1 with the names of the pages that are out of date."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare only")
    parser.add_argument("--folder", type=Path, default=ROOT / "docs" / "reference", help="where the pages are")
    chosen = parser.parse_args()
    stale = []
    for name, page in PAGES.items():
        head = HEADER.format(SOURCES[name]) if name in SOURCES else ""  # JSON has no comments
        file, text = chosen.folder / name, head + page()
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            stale.append(name)
            if not chosen.check:
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
    if stale and chosen.check:
        print(f"out of date: {', '.join(stale)}: run make reference", file=sys.stderr)
        return 1
    print(f"written: {', '.join(stale)}" if stale else f"{', '.join(PAGES)}: as the code says")
    return 0


if __name__ == "__main__":
    sys.exit(main())
