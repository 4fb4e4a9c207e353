"""Reading module libraries and assemblies from their YAML files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from modcal_core.errors import BadTable
from modcal_core.files import read_yaml
from modcal_core.modules import Assembly, Library, assembly_from_data, library_from_data, published


def read_library(path: Path | None) -> Library:
    """The library in a file; the published one where none is given."""
    return published() if path is None else library_from_data(read_yaml(path), str(path))


def read_assembly(spec: Path, library_file: Path | None = None) -> tuple[Assembly, Library]:
    """The assembly in a file and its library: the one given, or else the one the file names, or the published one."""
    data = read_yaml(spec)
    if library_file is None and isinstance(data, Mapping) and data.get("library") is not None:
        library_file = spec.parent / str(data["library"])
        if not library_file.is_file():
            raise BadTable(f"{spec}: library {data['library']}", "is not beside it", "correct the path")
    library = read_library(library_file)
    return assembly_from_data(data, library, str(spec)), library
