"""One idea, one package: nothing outside a family's file asks for its name, and nothing in effects/ goes in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from structure.test_layers import SRC, files, imports_of

from modcal_core.effects.registry import known_families

FAMILIES = "effects/families/"


def asked(source: str) -> Iterator[int]:
    """Lines that compare a family with a name, or make an effect of a family that they name."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            if any(_is_family(side) for side in sides) and any(_names(side) for side in sides):
                yield node.lineno
        elif (isinstance(node, ast.Match) and _is_family(node.subject)) or (
            isinstance(node, ast.Subscript) and _is_family(node.slice) and isinstance(node.value, ast.Dict)
        ):
            yield node.lineno
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Effect":
            given = [*node.args[:1], *(k.value for k in node.keywords if k.arg == "family")]
            if any(_names(value) for value in given):
                yield node.lineno


def _is_family(node: ast.expr) -> bool:
    return (isinstance(node, ast.Attribute) and node.attr == "family") or (
        isinstance(node, ast.Name) and node.id == "family"
    )


def _names(node: ast.expr) -> bool:
    if isinstance(node, ast.Tuple | ast.List | ast.Set):
        return any(_names(part) for part in node.elts)
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


@pytest.mark.slow
def test_nothing_outside_a_familys_file_asks_for_its_name() -> None:
    packages = ("modcal_core", "modcal_msgs_py", "modcal_nodes")
    sources = {(package, place): path for package in packages for place, path in files(package).items()}
    assert len(sources) > 300
    outside = {key: path for key, path in sources.items() if not key[1].startswith(FAMILIES)}
    found = {key: list(asked(path.read_text())) for key, path in outside.items()}
    assert not {key: lines for key, lines in found.items() if lines}


@pytest.mark.parametrize(
    "line",
    [
        'e.family == "step"',
        'family in ("step", "drift")',
        '"step" != effect.family',
        'Effect("step", place, AXIS, "time", shape)',
        'Effect(family="step", place=place)',
        'match effect.family:\n    case "step":\n        pass',
        '{"step": 1}[effect.family]',
    ],
)
def test_the_rule_catches_what_it_forbids(line: str) -> None:
    assert list(asked(line))


def test_a_rule_lets_a_family_be_looked_up() -> None:
    assert not list(asked('family(effect.family).sizes(effect, chain); effect.family != name; Effect(NAME, "tool")'))


def circles(package: str, room: str) -> list[list[str]]:
    """Circles among the modules of a room, imports for the type checker and within functions included."""
    places = [place for place in files(package) if place.startswith(room)]
    names = {
        place: ".".join([package, *Path(place).with_suffix("").parts]).removesuffix(".__init__") for place in places
    }
    of = {name: place for place, name in names.items()}

    def targets(place: str) -> set[str]:
        out = set()
        for found in imports_of(package, place):
            # `from package import module` names the module; `from module import thing` a thing in it
            target = of.get(found.module) or of.get(found.module.rpartition(".")[0])
            if target not in (None, place):
                out.add(str(target))
        return out

    left = {place: targets(place) for place in places}
    while free := [place for place, on in left.items() if not on & left.keys()]:
        for place in free:
            del left[place]
    return [[place, *sorted(on & left.keys())] for place, on in left.items()]


def test_effects_go_in_no_circle() -> None:
    assert len([place for place in files("modcal_core") if place.startswith("effects/")]) > 20
    assert circles("modcal_core", "effects/") == []


def test_a_file_is_one_family_of_the_report() -> None:
    """The names are a contract of report.json and calibration.yaml."""
    built_in = {path.stem for path in (SRC / "modcal_core/modcal_core" / FAMILIES).glob("*.py")} - {"__init__"}
    contract = {
        *("compliance", "gear_harmonic", "gear_ratio", "backlash", "coupling", "axis_wobble", "thermal", "drift"),
        *("step", "payload", "latency", "joint_lag", "scale", "outliers", "unknown", "parallelogram", "hysteresis"),
    }
    unnamed = {"residual"}  # stands in calibration.yaml, and in no report
    assert built_in == contract | unnamed
    assert {name for name in built_in if not known_families()[name].claimed} == unnamed
    assert contract <= set(known_families())
    assert all(name == family.name for name, family in known_families().items())
