"""What a user gives as a file: a calibration, a cell."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.distances import Distance
from modcal_core.calibration.store import Calibration, from_data
from modcal_core.errors import BadTable
from modcal_nodes.files import parse_yaml, read_yaml


def read_calibration(path: Path) -> Calibration:
    """The calibration in a file, or in the folder that ``modcal calibrate`` wrote."""
    file = path / "calibration.yaml" if path.is_dir() else path
    if not file.is_file():
        raise BadTable(str(file), "does not exist", "give the folder or calibration.yaml that modcal calibrate wrote")
    return from_data(read_yaml(file), str(file))


def parse_calibration(text: str, source: str) -> Calibration:
    """The calibration in a text as calibration.yaml holds it; raises BadTable, naming the source."""
    return from_data(parse_yaml(text, source), source)


def read_cell(path: Path | None, fixed: tuple[str, ...] = ()) -> Cell:
    """What a cell file says, with these parameters held fixed besides. No path: an empty cell."""
    if path is None:
        return Cell(fixed=fixed)
    data = read_yaml(path)
    if not isinstance(data, Mapping) or not set(data) <= {"distances", "fixed"}:
        raise BadTable(str(path), "must have the keys distances and fixed only", "see docs/calibration.md")
    try:
        distances = tuple(
            Distance((str(d["between"][0]), str(d["between"][1])), float(d["distance_m"]), float(d.get("std_m", 5e-5)))
            for d in data.get("distances") or ()
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise BadTable(
            str(path), f"a distance is not {{between: [a, b], distance_m: 0.05}}: {error!r}", "see docs/calibration.md"
        ) from error
    for distance in distances:
        if not (0.0 < distance.distance < 50.0 and 0.0 < distance.std < 1.0):
            raise BadTable(
                f"{path}: distance {' to '.join(distance.between)}",
                f"{distance.distance:g} ± {distance.std:g} m, 0 to 50 m is allowed",
                "give metres",
            )
    return Cell(distances, (*(str(f) for f in data.get("fixed") or ()), *fixed))
