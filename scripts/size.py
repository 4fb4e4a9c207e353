"""How large modcal is: files, lines, statements and numeric constants of each package, and lines of everything tracked.

    python scripts/size.py             # a table
    python scripts/size.py OTHER_TREE  # of another checkout

``tests/structure/test_budgets.py`` holds every package to a ceiling of these counts.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


@dataclass
class Size:
    """Counts of a package. statements: nodes of the syntax tree. constants: names in capitals that hold numbers."""

    files: int = 0
    lines: int = 0
    statements: int = 0
    constants: int = 0

    def add(self, source: str) -> None:
        """Count one more file."""
        tree = ast.parse(source)
        self.files += 1
        self.lines += source.count("\n")
        self.statements += sum(isinstance(node, ast.stmt) for node in ast.walk(tree))
        self.constants += sum(_numbers(node) for node in tree.body)


@dataclass
class Sizes:
    """Counts by package of the source, ``tests`` and ``bench`` beside them, and lines of all tracked text but bags."""

    packages: dict[str, Size] = field(default_factory=dict)
    text: int = 0

    @property
    def source(self) -> Size:
        """The three packages of the source together."""
        parts = [size for name, size in self.packages.items() if name not in ("tests", "bench")]
        return Size(
            *(sum(getattr(part, what) for part in parts) for what in ("files", "lines", "statements", "constants"))
        )


def sizes(root: Path = ROOT) -> Sizes:
    """The counts of a checkout."""
    found = Sizes()
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=True)
    for name in listed.stdout.split("\0"):
        path = root / name
        if not name or not path.is_file() or name.startswith("bags/"):
            continue
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue  # no text
        found.text += text.count("\n")
        package = package_of(name)
        if package and name.endswith(".py"):
            found.packages.setdefault(package, Size()).add(text)
    return found


def package_of(name: str) -> str | None:
    """``modcal_core/robots`` for a file of it; ``modcal_core`` for those beside its packages; ``tests``; ``bench``."""
    parts = Path(name).parts
    if parts[0] in ("tests", "bench"):
        return parts[0]
    if parts[:2] != ("ros2_ws", "src"):
        return None
    inside = parts[3:]
    return parts[3] if len(inside) == 2 else "/".join(inside[:2]) if len(inside) > 2 else parts[2]


def _numbers(node: ast.stmt) -> int:
    """How many names in capitals a statement at the top of a file gives numbers to."""
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return 0
    numbers = [n for n in ast.walk(node.value) if isinstance(n, ast.Constant) and type(n.value) in (int, float)]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    return sum(name.isupper() for name in names) if numbers else 0


def main() -> None:
    """Print the table."""
    found = sizes(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT)
    print(f"{'package':36}{'files':>7}{'lines':>9}{'statements':>12}{'constants':>11}")
    for name, size in [*sorted(found.packages.items()), ("source", found.source)]:
        print(f"{name:36}{size.files:7}{size.lines:9}{size.statements:12}{size.constants:11}")
    print(f"all tracked text outside bags: {found.text} lines")


if __name__ == "__main__":
    main()
