"""Sentences use the field's words: none of these phrases stands in a string, a docstring, a template or a page."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# What stands there instead. Only phrases that have no technical use.
INSTEAD = {
    r"\bg(?:i|a)ves? way\b": "is compliant, deflects, is replaced by",
    r"\banew\b": "again, restart",
    r"\bis no (?:finite )?number\b": "is not a number, is not finite",
    r"\bnobody (?:has |had )?declared\b": "unmodelled effect",
    r"\bgo(?:es)? along with\b": "correlates with",
    r"\bas drawn\b": "nominal",
    r"\b(?:mend|mends|mended|mending)\b": "fix, repair",
    r"\b(?:was|were|is|are|not|nothing) heard\b": "received",
    r"\bsays? of (?:itself|themselves)\b": "reports",
    r"\b(?:is|are) told to\b": "is asked to",
    r"\bsee to (?:it|that|the)\b": "check, clear the cause",
    r"\bnot said what\b": "unknown",
    r"\bwhat it brought\b": "its gain, its result",
}
PHRASE = re.compile("|".join(INSTEAD), re.IGNORECASE)
PAGES = (
    "*.md",
    "docs/**/*.md",
    "docs/**/*.svg",
    "examples/**/*.py",
    "examples/**/*.yaml",
    "examples/**/*.sh",
    "Makefile",
)


def phrases(text: str) -> list[str]:
    """The phrases of a text that should be others."""
    return [found[0] for found in PHRASE.finditer(" ".join(text.split()))]


def strings(source: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each string of a module that is not a docstring; a sentence in pieces is one string."""
    tree = ast.parse(source.read_text())
    skipped = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(node.value)
        if isinstance(node, ast.JoinedStr):
            skipped.update(part for part in node.values if isinstance(part, ast.Constant))
            yield node.lineno, "".join(p.value if isinstance(p, ast.Constant) else "…" for p in node.values)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in skipped:
            yield node.lineno, node.value


def docstrings(source: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each docstring of a module."""
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield getattr(node, "lineno", 1), ast.get_docstring(node) or ""


@pytest.mark.slow
@pytest.mark.parametrize("package", ["modcal_core", "modcal_msgs_py", "modcal_nodes"])
def test_no_message_or_docstring_has_a_banned_phrase(package: str) -> None:
    found = []
    for source in sorted((ROOT / "ros2_ws/src" / package).rglob("*.py")):
        texts = [*strings(source), *docstrings(source)]
        found += [
            f"{source.relative_to(ROOT)}:{line}: {', '.join(said)}" for line, text in texts if (said := phrases(text))
        ]
    assert not found, "\n".join(found)


def test_no_template_or_setting_has_one() -> None:
    found = []
    for path in sorted((ROOT / "ros2_ws/src").rglob("*")):
        if path.suffix in (".j2", ".js", ".yaml", ".xml", ".rviz") and (said := phrases(path.read_text())):
            found.append(f"{path.relative_to(ROOT)}: {', '.join(said)}")
    assert not found, "\n".join(found)


def test_no_page_has_one() -> None:
    found = []
    for path in sorted({path for pattern in PAGES for path in ROOT.glob(pattern)}):
        text = re.sub(r"`[^`\n]*`", "", path.read_text())  # names of tests, of files and of parameters stay
        found += [f"{path.relative_to(ROOT)}: {said}" for said in phrases(text)]
    assert not found, "\n".join(found)


def test_the_phrases_are_seen() -> None:
    """Also over the end of a line, and in the middle of a sentence with values in it."""
    assert phrases("the elbow gives\n  way under load, begins Anew, and is no finite number") == [
        "gives way",
        "Anew",
        "is no finite number",
    ]
    assert not phrases("gives a way to mount it, drawn as a line, heard of")
