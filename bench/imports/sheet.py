"""A table as it is written, and what is true of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from arms import Recorded

LENGTH = {"mm": 1e3, "m": 1.0, "in": 1.0 / 0.0254, "cm": 1e2}
ANGLE = {"deg": 180.0 / np.pi, "rad": 1.0, "gon": 200.0 / np.pi}
DIGITS = {"mm": 4, "m": 7, "in": 5, "cm": 5}


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
        self.decimal, self.labels, self.cells = decimal, [], []

    def add(self, label: str, values: np.ndarray, digits: int) -> list[str]:
        """A column; its cells, which may still be changed."""
        self.labels.append(label)
        self.cells.append([f"{v:.{digits}f}".replace(".", self.decimal) for v in values])
        return self.cells[-1]

    def add_all(self, labels: Iterable[str], values: np.ndarray, digits: int) -> list[list[str]]:
        """A column for each label, values (N, …)."""
        return [self.add(label, column, digits) for label, column in zip(labels, values.T, strict=True)]

    def text(self, rng: np.random.Generator, order: np.ndarray) -> str:
        separator = str(rng.choice([";", "\t", "|"] + ([","] if self.decimal == "." else [])))
        lines = ["Exported by the cell's logger", ""] if rng.random() < 0.3 else []
        lines.append(separator.join(self.labels))
        lines += [separator.join(column[i] for column in self.cells) for i in order]
        return str(rng.choice(["\n", "\r\n"])).join([*lines, ""])
