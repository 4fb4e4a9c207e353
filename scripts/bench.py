"""Benches: names them, each with the first line of its docstring, or runs one.

    python scripts/bench.py                     # the list
    python scripts/bench.py NAME [ARGUMENTS]    # bench/NAME.py or bench/NAME/run.py

A bench is such a file that can be run. Exit code 2 where there is none of that name.
"""

from __future__ import annotations

import ast
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def benches() -> dict[str, Path]:
    """The benches by name."""
    files = [*(ROOT / "bench").glob("*.py"), *(ROOT / "bench").glob("*/run.py")]
    runnable = [file for file in files if "__main__" in file.read_text(encoding="utf-8")]
    return dict(sorted((file.parent.name if file.name == "run.py" else file.stem, file) for file in runnable))


def listed(known: dict[str, Path]) -> str:
    """A line a bench."""
    lines = []
    for name, file in known.items():
        text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
        lines.append(f"  {name:{max(map(len, known))}}  {text.partition(chr(10))[0]}")
    return "\n".join(lines)


def main(words: list[str]) -> int:
    """List them, or become one of them."""
    known = benches()
    if not words or not words[0]:
        print(f'make bench NAME=… ARGS="…"\n{listed(known)}')
        return 0
    name, *arguments = words
    if (file := known.get(name.replace("-", "_"))) is None:
        print(f"make bench: no bench is called {name}; there are\n{listed(known)}", file=sys.stderr)
        return 2
    os.execv(sys.executable, [sys.executable, str(file), *arguments])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
