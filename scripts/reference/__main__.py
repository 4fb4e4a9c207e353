"""Write the reference pages from the code: ``python scripts/reference``, as ``make docs`` does.

The pages of ``TRACKED`` stand in docs/reference and are committed. Those of ``BUILT`` go into a build folder, from
which mkdocs takes them (docs_site.py). What is said names the tracked pages that differed from what the code says.
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
from modcal_msgs_py.tables.convert import json_schema

ROOT = Path(__file__).resolve().parents[2]
TRACKED: dict[str, Callable[[], str]] = {
    "cli.md": verbs.page,
    "parameters.md": settings.page,
    "topics.md": graph.page,
    "import_mapping.schema.json": lambda: to_json(json_schema()),  # editors read it beside a mapping
}
BUILT: dict[str, Callable[[], str]] = {
    "messages.md": messages.page,
    "refusals.md": refusals.page,
    "constants.md": constants.page,
    **api.pages(),
}
HEADER = "<!-- Made by `make docs` from {}; change it there. -->\n\n"
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
    """Exit code: 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=ROOT / "docs" / "reference", help="of the tracked pages")
    parser.add_argument("--built", type=Path, default=ROOT / "build" / "reference", help="of the pages for the site")
    chosen = parser.parse_args()
    tracked = {chosen.folder / name: text(name, page) for name, page in TRACKED.items()}
    stale = [file for file, wanted in tracked.items() if not file.is_file() or file.read_text("utf-8") != wanted]
    for file in stale:
        write(file, tracked[file])
    for name, page in BUILT.items():
        write(chosen.built / name, text(name, page))
    print(f"written: {', '.join(file.name for file in stale)}" if stale else f"{', '.join(TRACKED)}: up to date")
    return 0


def text(name: str, page: Callable[[], str]) -> str:
    """Text of a page with the comment that says where it comes from; JSON has no comments."""
    return (HEADER.format(SOURCES[name]) if name in SOURCES else "") + page()


def write(file: Path, content: str) -> None:
    """Write a file, and the folders above it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(content, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
