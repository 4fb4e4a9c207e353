"""Reading and writing the files of a calibration; a folder is written whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.distances import Distance
from modcal_core.calibration.store import Calibration, from_data
from modcal_core.errors import BadTable


def write_folder(folder: Path, files: Mapping[str, str]) -> None:
    """Write these texts into a folder, made if need be; on failure the folder is left as it was.

    All files are written elsewhere first, on the same disk, and only then moved into place one after the other.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.exists() and not folder.is_dir():
        raise BadTable(str(folder), "is a file", "give --out a folder")
    stage = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        for name, text in files.items():
            (stage / name).write_text(text, encoding="utf-8")
        folder.mkdir(exist_ok=True)
        for name in files:
            os.replace(stage / name, folder / name)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def to_json(data: Any) -> str:
    """JSON text; raises ValueError for a number that is not finite, which no reader of ours may meet."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def to_yaml(data: Any) -> str:
    """YAML text with keys in the order given and short lists in one line."""
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=160, allow_unicode=True)


def read_yaml(path: Path) -> Any:
    """The data of a YAML file; raises BadTable with the place of the mistake."""
    try:
        with path.open(encoding="utf-8") as stream:
            return yaml.load(stream, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark is not None else ""
        raise BadTable(str(path), f"is not YAML{where}", "correct the file") from error
    except UnicodeDecodeError as error:
        raise BadTable(str(path), "is not UTF-8 text", "give a YAML file") from error


def read_calibration(path: Path) -> Calibration:
    """The calibration in a file, or in the folder that ``modcal calibrate`` wrote."""
    file = path / "calibration.yaml" if path.is_dir() else path
    if not file.is_file():
        raise BadTable(str(file), "does not exist", "give the folder or calibration.yaml that modcal calibrate wrote")
    return from_data(read_yaml(file), str(file))


def parse_calibration(text: str, source: str) -> Calibration:
    """The calibration in a text as calibration.yaml holds it; raises BadTable, naming the source."""
    try:
        data = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise BadTable(source, "is not YAML", "send the text of a calibration.yaml") from error
    return from_data(data, source)


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
