"""A package shows a face: others import its names from the package, never from a file inside it."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest
from structure.test_layers import MODCAL, SRC, files, imports_of

# A distribution's own files (modcal_core.loop, modcal_core.errors, …) are faces themselves.
ROOTS = {"modcal_core", "modcal_nodes"}


def _dotted(package: str, place: str) -> str:
    return ".".join([package, *Path(place).with_suffix("").parts]).removesuffix(".__init__")


MODULES = {_dotted(package, place): place for package in sorted(MODCAL) for place in files(package)}
PACKAGES = {module for module, place in MODULES.items() if place.endswith("__init__.py")}
FACES = sorted(PACKAGES - ROOTS)


def owner(module: str) -> str:
    """The package to which a module belongs: the second level of a distribution, or the distribution."""
    parts = module.split(".")
    second = ".".join(parts[:2])
    return second if second in PACKAGES else parts[0]


def past_the_face(module: str, imported: str) -> bool:
    """Whether a module takes a name out of a file of another package, in place of the package."""
    source = imported if imported in MODULES else imported.rpartition(".")[0]
    if source not in MODULES or source in PACKAGES or owner(source) == owner(module):
        return False
    inside = source.rpartition(".")[0]
    taken_as_module = imported in MODULES  # `from modcal_core.geometry import so3`: the file is what the face shows
    return inside not in ROOTS and not taken_as_module


@pytest.mark.slow
def test_other_packages_are_imported_by_their_faces() -> None:
    broken = [
        f"{module}:{found.line} imports {found.module}"
        for module, place in MODULES.items()
        for found in imports_of(module.split(".")[0], place)
        if not place.endswith("__init__.py") and past_the_face(module, found.module)
    ]
    assert len(MODULES) > 300
    assert not broken


def test_the_rule_knows_a_face_from_a_file() -> None:
    assert past_the_face("modcal_core.loop", "modcal_core.calibration.noise.NoiseModel")
    assert not past_the_face("modcal_core.loop", "modcal_core.calibration.NoiseModel")
    assert not past_the_face("modcal_core.calibration.fit", "modcal_core.calibration.noise.NoiseModel")
    assert not past_the_face("modcal_core.calibration.fit", "modcal_core.geometry.so3")
    assert not past_the_face("modcal_core.calibration.fit", "modcal_core.errors.ModcalError")


@pytest.mark.slow
@pytest.mark.parametrize("package", FACES)
def test_a_face_shows_what_it_names(package: str) -> None:
    source = (SRC / package.split(".")[0] / Path(*package.split("."))).joinpath("__init__.py").read_text()
    shown = importlib.import_module(package)
    names = getattr(shown, "__all__", [])
    assert ast.get_docstring(ast.parse(source))
    assert len(names) == len(set(names))
    for name in names:
        found = getattr(shown, name)
        beside = f"{package}.{name}"
        # A name of a face may be that of a file only where the file itself is shown: which of both one gets would
        # depend on what was imported before.
        assert beside not in MODULES or getattr(found, "__name__", "") == beside, beside


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        importlib.import_module("modcal_core.calibration").nothing  # noqa: B018


def hidden_by_a_file(face: str, shown: str) -> bool:
    """Whether a name that a face shows (with where it is) is that of a file beside it, which would stand in its place
    once that is imported.
    """
    module = f"{face}.{shown.rpartition('.')[2]}"
    return module in MODULES and shown != module


def test_no_face_shows_a_name_that_a_file_inside_has() -> None:
    assert not [
        found.module
        for face in FACES
        for found in imports_of(face.split(".")[0], MODULES[face])
        if hidden_by_a_file(face, found.module)
    ]
    assert hidden_by_a_file("modcal_core.report", "modcal_core.report.tables.charts")
    assert not hidden_by_a_file("modcal_core.geometry", "modcal_core.geometry.so3")
