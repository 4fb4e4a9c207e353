"""The page of refusals: every line in which something is refused, as it stands in the sources, by kind."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markup import prose, table

from modcal_core import errors

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ROOT / "ros2_ws" / "src"
GAP = "…"  # what stands for a value
KINDS = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, errors.ModcalError) and kind is not errors.ModcalError
}

INTRODUCTION = f"""# Refusals

Every refusal is one line, *offender: limit: remedy*. It appears on stderr with exit code 2, in the log and on
`/diagnostics` of a node, or as a `modcal.ModcalError` in Python with these three parts. Here are all of them; {GAP}
stands for a value, and a vertical bar separates alternatives. Search for the words of your line. The usual mistakes are
in [bad_input.md](../bad_input.md), what nodes do in [faults.md](../faults.md).

Exit codes of `modcal`: 0 done; 1 a fault of modcal itself; 2 refused; 3 done, but the tolerance asked for is not met,
or it cannot be told."""


@dataclass(frozen=True, order=True)
class Refusal:
    """One way to refuse: the three parts as templates."""

    limit: str
    offender: str
    remedy: str


def page() -> str:
    """Text of the page."""
    found: dict[str, set[Refusal]] = {}
    for source in sorted(PACKAGES.rglob("*.py")):
        if "build" not in source.relative_to(PACKAGES).parts:
            for kind, refusal in refusals(ast.parse(source.read_text(encoding="utf-8"))):
                found.setdefault(kind, set()).add(refusal)
    parts = [INTRODUCTION]
    for kind in sorted(found):
        said = (inspect.getdoc(KINDS[kind]) or "").split("\n\n")[0]
        rows = [(prose(r.offender), prose(r.limit), prose(r.remedy)) for r in sorted(found[kind])]
        parts += [f"## {kind}", prose(said), table(("what", "its limit", "what to do"), rows)]
    return "\n\n".join(parts) + "\n"


def refusals(tree: ast.Module) -> Iterator[tuple[str, Refusal]]:
    """Kind and templates of every refusal that a module makes in words of its own."""
    outer = _texts(tree.body)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    for function in functions:
        known = outer | _texts(list(ast.walk(function)))
        for call in ast.walk(function):
            kind = call.func.id if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) else ""
            if kind not in KINDS or not isinstance(call, ast.Call) or len(call.args) < 3:
                continue
            offender, limit, remedy = (_template(part, known) for part in call.args[:3])
            if set(limit) - set(f"{GAP} "):
                yield kind, Refusal(limit, offender, remedy)


def _texts(nodes: list[ast.AST] | list[ast.stmt]) -> dict[str, str]:
    """Names that a text is given to, and the texts; several for one name with a bar between."""
    out: dict[str, list[str]] = {}
    for node in nodes:
        if isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name):
            text = _template(node.value, {})
            if text != GAP:
                out.setdefault(node.targets[0].id, []).append(text)
    return {name: " | ".join(dict.fromkeys(texts)) for name, texts in out.items()}


def _template(node: ast.expr, known: dict[str, str]) -> str:
    """The text of an expression, with a gap for what is known only when it runs."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_template(part, {}) for part in node.values)
    if isinstance(node, ast.Name):
        return known.get(node.id, GAP)
    if isinstance(node, ast.IfExp):
        return " | ".join(dict.fromkeys((_template(node.body, known), _template(node.orelse, known))))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _template(node.left, known) + _template(node.right, known)
    return GAP
