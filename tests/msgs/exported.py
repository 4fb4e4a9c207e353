"""Tables as tests of import write them: an arm that a tracker sees, and cells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from cells import ur10
from scipy.spatial.transform import Rotation

from modcal_core.geometry import Array, se3
from modcal_core.robots import forward

CHAIN = ur10()
TOOL = se3.transform(Rotation.from_euler("xyz", [0.3, 0.4, 0.5]).as_matrix(), [0.05, 0.02, 0.1])
BASE = se3.transform(Rotation.from_euler("xyz", [1.0, -0.4, 2.0]).as_matrix(), [2.0, 1.0, 0.5])
MIDDLE = np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.4])


def postures(rng: np.random.Generator, rows: int = 40, spread: float = 1.2) -> Array:
    return np.asarray(MIDDLE + spread * rng.uniform(-1.0, 1.0, (rows, CHAIN.n)))


def seen(q: Array, rng: np.random.Generator) -> Array:
    """Poses in a tracker that the nominal arm misses by two millimetres, (N, 4, 4)."""
    return np.asarray(BASE @ forward(CHAIN, q + 1.5e-3 * rng.standard_normal(CHAIN.n)) @ TOOL)


def named(names: str, values: Array) -> dict[str, Array]:
    return {name: values[:, k] for k, name in enumerate(names.split())}


def joints(q: Array) -> dict[str, Array]:
    return {name: q[:, k] for k, name in enumerate(CHAIN.names)}


def written(
    folder: Path,
    columns: dict[str, Any],
    name: str = "cell.csv",
    head: str = "",
    header: bool = True,
    marks: tuple[str, str] = (",", "."),
) -> Path:
    """A file of these columns, of numbers or texts. head: what stands above them. marks: separator and decimal sign."""
    separator, decimal = marks
    cells = [[v if isinstance(v, str) else f"{v:.8f}".replace(".", decimal) for v in c] for c in columns.values()]
    rows = [separator.join(row) for row in zip(*cells, strict=True)]
    path = folder / name
    path.write_text(head + "\n".join([separator.join(columns), *rows] if header else rows) + "\n")
    return path
