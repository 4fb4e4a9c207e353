"""A table as it is written, and what is true of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from arms import Recorded

LENGTH = {"mm": 1e3, "m": 1.0, "in": 1.0 / 0.0254, "cm": 1e2}
ANGLE = {"deg": 180.0 / np.pi, "rad": 1.0, "gon": 200.0 / np.pi}


@dataclass
class Written:
    """Files, and what was written into them, in SI. readings: kind → list of values, one for each instrument. whole:
    rows in which all of the readings' cells hold numbers. signals: of columns that are signals or temperatures.
    """

    paths: list[Path]
    recorded: Recorded
    readings: dict[str, list[np.ndarray]]
    whole: np.ndarray
    velocity: np.ndarray | None = None
    effort: np.ndarray | None = None
    commanded: np.ndarray | None = None
    std: np.ndarray | None = None
    signals: list[np.ndarray] = field(default_factory=list)
    about: dict[str, object] = field(default_factory=dict)


class Sheet:
    """Columns of one file."""

    def __init__(self, decimal: str) -> None:
        self.decimal = decimal
        self.labels: list[str] = []
        self.cells: list[list[str]] = []

    def add(self, label: str, values: np.ndarray, digits: int) -> list[str]:
        cells = [f"{v:.{digits}f}".replace(".", self.decimal) for v in values]
        self.labels.append(label)
        self.cells.append(cells)
        return cells

    def text(self, rng: np.random.Generator, order: np.ndarray, units: bool = False) -> str:
        separators = [";", "\t", "|"] + ([","] if self.decimal == "." else [])
        separator = str(rng.choice(separators))
        lines = ["Exported by the cell's logger", ""] if rng.random() < 0.3 else []
        lines.append(separator.join(self.labels))
        lines += [separator.join(column[i] for column in self.cells) for i in order]
        return str(rng.choice(["\n", "\r\n"])).join([*lines, ""])
