"""Where a mutant stands in the sources: found by the name of its function and by the words that it changes."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

SOURCES = "ros2_ws/src"
SAMPLE = Path(__file__).with_name("sample.txt")


@dataclass(frozen=True)
class Mutant:
    """One fault. area: where it counts in the table. function: the end of its dotted name, as ``so3.log`` or
    ``Chain.build``. what: the fault in words. old, new: words of the function, and what stands there instead; any white
    space in the old ones matches any other.
    """

    area: str
    function: str
    what: str
    old: str
    new: str

    @property
    def name(self) -> str:
        return f"{self.function}: {self.what}"


@dataclass(frozen=True)
class Place:
    """Where a mutant stands: from and to which character of which file, and before which line its statement begins."""

    path: Path
    text: str
    start: int
    end: int
    line: int

    def mutated(self, new: str) -> str:
        return self.text[: self.start] + new + self.text[self.end :]


class NotApplicable(Exception):
    """The function is not there any more, or what it says is another thing, or there are several of them."""


@dataclass(frozen=True)
class Function:
    """A function or method. name: dotted, with package and class. span: its characters in the text of the file."""

    name: str
    path: Path
    text: str
    span: tuple[int, int]
    node: ast.FunctionDef | ast.AsyncFunctionDef

    def statement(self, character: int) -> int:
        """The line of the innermost statement around a character, before which another one may stand."""
        line = self.text.count("\n", 0, character) + 1
        body, best = list(self.node.body), self.node.body[0].lineno
        while around := [s for s in body if s.lineno <= line <= (s.end_lineno or s.lineno)]:
            inner = around[-1]
            if not self.text.splitlines()[inner.lineno - 1].lstrip().startswith(("elif", "else")):
                best = min([inner.lineno, *(d.lineno for d in getattr(inner, "decorator_list", []))])
            body = [s for s in ast.iter_child_nodes(inner) if isinstance(s, (ast.stmt, ast.ExceptHandler))]
            body = [s for b in body for s in (b.body if isinstance(b, ast.ExceptHandler) else [b])]
        return best


def sample() -> tuple[Mutant, ...]:
    out, area = [], ""
    for line in SAMPLE.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            area = line.strip("[]")
        elif line and not line.startswith("#"):
            function, what, old, new = line.split(" ¦ ")
            out.append(Mutant(area, function, what, old, new.replace("⏎", "\n").replace("∅", "")))
    return tuple(out)


def find(root: Path, mutant: Mutant) -> Place:
    """The one place of a mutant in the sources of a checkout. Raises NotApplicable."""
    *rooms, own = mutant.function.split(".")
    candidates: list[Function] = []
    for left in range(len(rooms) + 1):  # a function that has moved into another file is still this one
        ending = ".".join(["", *rooms[left:], own])
        if candidates := [f for f in functions(root / SOURCES) if f.name.endswith(ending)]:
            break
    words = re.compile(r"\s+".join(re.escape(word) for word in mutant.old.split()))
    found = [(f, hit) for f in candidates for hit in words.finditer(f.text, *f.span)]
    if len(found) != 1:
        said = f"'{mutant.old}' stands there {len(found)} times" if candidates else "there is no such function"
        raise NotApplicable(f"{mutant.name}: {said}")
    function, hit = found[0]
    place = Place(function.path, function.text, hit.start(), hit.end(), function.statement(hit.start()))
    ast.parse(place.mutated(mutant.new))
    return place


@lru_cache
def functions(sources: Path) -> tuple[Function, ...]:
    return tuple(f for path in sorted(sources.glob("*/*/**/*.py")) for f in _of(path, sources))


def _of(path: Path, sources: Path) -> Iterator[Function]:
    text = path.read_text(encoding="utf-8")
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def walk(body: list[ast.stmt], name: str) -> Iterator[Function]:
        for node in body:
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                span = starts[node.lineno - 1], starts[node.end_lineno or node.lineno]
                yield Function(f"{name}.{node.name}", path, text, span, node)
            elif isinstance(node, ast.ClassDef):
                yield from walk(node.body, f"{name}.{node.name}")

    yield from walk(ast.parse(text).body, ".".join(path.relative_to(sources).with_suffix("").parts[1:]))


def marked(text: str, marks: dict[int, list[str]]) -> str:
    """The text of a file with a mark before each of these lines, which tells the probe that a test came by."""
    lines = text.splitlines(keepends=True)
    for line in sorted(marks, reverse=True):
        indent = lines[line - 1][: -len(lines[line - 1].lstrip())]
        said = "; ".join(f'__import__("mutants_probe").reached({name!r})' for name in marks[line])
        lines.insert(line - 1, f"{indent}{said}\n")
    return "".join(lines)
