"""The module-level numbers of the core, with the comment beside each, as the source has them."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

CORE = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "modcal_core" / "modcal_core"
WHERE = (
    *("measurements", "hypotheses", "calibration", "camera", "moves", "effects", "diagnosis", "verdict"),
    *("planning", "online", "articulation"),
    *("preprocess.py", "recalibrate.py", "evaluation.py"),
)


@dataclass(frozen=True)
class Number:
    """A module-level number: its file below ``modcal_core``, name, value as written, and comment, "" if none."""

    file: str
    line: int
    name: str
    value: str
    comment: str


def numbers() -> list[Number]:
    """All of them, in the order of packages, files and lines."""
    files = [file for place in WHERE for file in _files(CORE / place)]
    return [n for file in files for n in of_source(file.read_text("utf-8"), file.relative_to(CORE).as_posix())]


def of_source(source: str, file: str = "") -> list[Number]:
    """The numbers of a module's text.

    A comment is what stands on the lines of an assignment; else what stands above it, or above the first of the
    assignments that follow one another without a blank line, which then holds for all of these.
    """
    said = _comments(source)
    lines = source.splitlines()
    found: list[Number] = []
    above, end = "", -1
    for statement in ast.parse(source).body:
        assigned = _assigned(statement)
        if not assigned:
            continue
        first, last = statement.lineno, statement.end_lineno or statement.lineno
        heading = _above(lines, first, said)
        if heading or first != end + 1:
            above = heading
        end = last
        own = " ".join(said[k] for k in range(first, last + 1) if k in said)
        for name, value in assigned:
            if _is_number(value):
                found.append(Number(file, first, name, " ".join(ast.unparse(value).split()), own or above))
    return found


def _files(place: Path) -> list[Path]:
    return [place] if place.is_file() else sorted(place.rglob("*.py"))


def _comments(source: str) -> dict[int, str]:
    """Comments by line, without those for tools."""
    tokens: Iterator[tokenize.TokenInfo] = tokenize.generate_tokens(io.StringIO(source).readline)
    found = {t.start[0]: t.string.lstrip("# ").strip() for t in tokens if t.type == tokenize.COMMENT}
    return {line: text for line, text in found.items() if text and not text.startswith(("fmt:", "noqa", "type:"))}


def _above(lines: list[str], first: int, said: dict[int, str]) -> str:
    """The comment on the lines above line ``first``, which counts from one."""
    start = first
    while start - 1 in said and lines[start - 2].startswith("#"):
        start -= 1
    return " ".join(said[k] for k in range(start, first))


def _assigned(statement: ast.stmt) -> list[tuple[str, ast.expr]]:
    """Names and what each is assigned."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        return [(ast.unparse(statement.target), statement.value)]
    if not isinstance(statement, ast.Assign):
        return []
    target, value = statement.targets[0], statement.value
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
        return [(ast.unparse(t), v) for t, v in zip(target.elts, value.elts, strict=True)]
    return [(ast.unparse(target), value)]


def _is_number(value: ast.expr) -> bool:
    """Whether an expression is a number, or several, and not a table of other things that holds some."""
    if isinstance(value, ast.Tuple | ast.List):
        return bool(value.elts) and all(map(_is_number, value.elts))
    if isinstance(value, ast.Dict):
        return bool(value.values) and all(map(_is_number, value.values))
    if isinstance(value, ast.UnaryOp):
        return _is_number(value.operand)
    if isinstance(value, ast.BinOp):
        return any(isinstance(c, ast.Constant) for c in ast.walk(value)) and not _texts(value)
    if isinstance(value, ast.Call):
        if ast.unparse(value.func) in ("np.eye", "np.arange"):
            return False
        return any(isinstance(c, ast.Constant) for a in value.args for c in ast.walk(a)) and not _texts(value)
    return (
        isinstance(value, ast.Constant) and isinstance(value.value, int | float) and not isinstance(value.value, bool)
    )


def _texts(value: ast.expr) -> bool:
    return any(isinstance(c, ast.Constant) and not isinstance(c.value, int | float) for c in ast.walk(value))
