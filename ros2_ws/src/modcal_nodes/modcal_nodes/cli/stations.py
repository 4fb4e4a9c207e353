"""Reading stations from files."""

from __future__ import annotations

import csv
from pathlib import Path

from modcal_core.files import read_yaml
from modcal_core.geometry import Array
from modcal_core.planning import stations_from_data, stations_from_rows
from modcal_core.robots import Mechanism


def read_stations(path: Path, chain: Mechanism) -> Array:
    """Postures (N, n) [rad, m] in a plan.yaml, or in a CSV file whose head names the joints. Raises BadTable."""
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", errors="replace", newline="") as stream:
            return stations_from_rows(list(csv.reader(stream)), chain.names, str(path))
    return stations_from_data(read_yaml(path), chain.names, str(path))
