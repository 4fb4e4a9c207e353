"""The pages of the public API: signatures and docstrings of what ``modcal`` names, a page for each thing one does."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import modcal

# Page: its title, what it is about, and the public names on it. Every name stands on one page; a test compares.
TOPICS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "robot": (
        "Robots",
        "What is calibrated: kinematics, limits, and what the description says besides.",
        ("Robot", "Chain", "Delta"),
    ),
    "samples": (
        "Samples and bags",
        "What was measured: postures, readings, and whatever an error may depend on.",
        ("Samples", "Bag", "read_bag"),
    ),
    "calibrate": (
        "Calibrating",
        "From a robot and samples to a result, and what may be stated beforehand.",
        ("calibrate", "Result", "Cell", "Distance", "Stated"),
    ),
    "calibration": (
        "Using a calibration",
        "Where the tool is, and whether that still holds.",
        ("Calibration", "evaluate", "Report", "check", "Checked", "Claim"),
    ),
    "plan": ("Planning", "Where to measure.", ("plan", "Plan", "Site")),
    "articulation": ("Doors and drawers", "How something moves that is opened.", ("articulate", "Track", "Choice")),
    "modules": ("Modules", "Arms that are bolted together from modules.", ("Assembly", "Module", "Library")),
    "errors": (
        "Errors",
        "Whatever is refused is refused with one of these: what offends, the limit, and the remedy.",
        (
            *("ModcalError", "BadRecording", "BadTable", "BadRobot", "NotEnoughData", "NotReachable", "NotPlannable"),
            *("MissingDriver", "NotRepresentable", "Overloaded", "BadCommand"),
        ),
    ),
}
_LONG = 100  # characters of a signature in one line
_PRIVATE = ("trusted",)


def pages() -> dict[str, Callable[[], str]]:
    """Names of the pages, and what writes each."""
    return {f"api/{topic}.md": partial(page, topic) for topic in TOPICS}


def page(topic: str) -> str:
    """Text of a page."""
    title, about, names = TOPICS[topic]
    parts = [f"# {title}", about]
    for name in names:
        parts += _one(name, getattr(modcal, name))
    return "\n\n".join(part for part in parts if part) + "\n"


def _one(name: str, what: Any) -> Iterator[str]:
    yield f"## {name}"
    if not inspect.isclass(what):
        yield _signature(f"modcal.{name}", what)
        yield _prose(what)
        return
    built = is_dataclass(what) and name not in ("Samples", "Report", "Result", "Bag")
    if built and not any(isinstance(v, classmethod) for v in vars(what).values()):
        yield _signature(f"modcal.{name}", what)
    yield _prose(what)
    own = {field.name for field in fields(what)} if is_dataclass(what) else set()
    hidden = [base for base in reversed(what.__mro__[1:]) if is_dataclass(base) and base.__name__ not in modcal.__all__]
    for base in hidden:
        yield _prose(base)
    for member, value in (item for known in (*hidden, what) for item in vars(known).items()):
        if member.startswith("_") or member in own or member in _PRIVATE or not inspect.getdoc(value):
            continue
        if isinstance(value, property):
            yield f"### {name}.{member}"
            yield _prose(value)
        elif isinstance(value, classmethod | staticmethod) or inspect.isfunction(value):
            yield f"### {name}.{member}"
            yield _signature(f"{name}.{member}", getattr(what, member))
            yield _prose(value)


def _signature(name: str, what: Any) -> str:
    """A call as a block of code, one argument a line where it is long."""
    signature = inspect.signature(what)
    arguments = [p for p in signature.parameters.values() if p.name != "self"]
    shown: list[str] = []
    for at, argument in enumerate(arguments):
        if argument.kind is argument.KEYWORD_ONLY and not any(a.kind is a.KEYWORD_ONLY for a in arguments[:at]):
            shown.append("*")
        shown.append(_argument(argument))
    back = (
        ""
        if signature.return_annotation in (inspect.Signature.empty, None, "None")
        else " -> " + _type(signature.return_annotation)
    )
    line = f"{name}({', '.join(shown)}){back}"
    if len(line) > _LONG:
        line = f"{name}(\n" + "".join(f"    {argument},\n" for argument in shown) + f"){back}"
    return "\n".join("    " + part for part in line.splitlines())


def _argument(argument: inspect.Parameter) -> str:
    star = {argument.VAR_POSITIONAL: "*", argument.VAR_KEYWORD: "**"}.get(argument.kind, "")
    kind = "" if argument.annotation is inspect.Parameter.empty else f": {_type(argument.annotation)}"
    if argument.default is inspect.Parameter.empty:
        return f"{star}{argument.name}{kind}"
    default = argument.default
    plain = default is None or isinstance(default, bool | int | float | str | tuple)
    return f"{star}{argument.name}{kind} = {repr(default) if plain else '…'}"


def _type(annotation: Any) -> str:
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))
    return re.sub(r"\b(?:\w+\.)+(\w+)", r"\1", text)


def _prose(what: Any) -> str:
    """A docstring as Markdown: roles and double quotes of reStructuredText become code."""
    text = inspect.getdoc(what) or ""
    text = re.sub(r":\w+:`~?([^`]+)`", lambda role: f"`{role[1].rpartition('.')[2]}`", text)
    text = text.replace("``", "`")
    kept = [part if part.startswith("    ") else _paragraph(part) for part in text.split("\n\n")]
    return "\n\n".join(kept)


def _paragraph(text: str) -> str:
    """A paragraph in which nothing outside code is taken for markup."""
    pieces = re.split(r"(`[^`]*`)", text)
    return "".join(p if p.startswith("`") else re.sub(r"([*_<\[\]|])", r"\\\1", p) for p in pieces)
