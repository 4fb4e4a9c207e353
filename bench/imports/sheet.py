"""Arms with errors of 1 to 3 mm, moved by MuJoCo; a table as it is written, and what is true of it.

Nothing here comes from modcal.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from arms import FOLDER, TURN, Arm, Array, displaced
from scipy.spatial.transform import Rotation

Rng = np.random.Generator
ARMS = {"ur10": "tool0", "panda": "panda_hand_tcp", "iiwa14": "iiwa_link_7", "xarm7": "link7"}  # what carries the tool
LENGTH = {"mm": 1e3, "m": 1.0, "in": 1.0 / 0.0254, "cm": 1e2}
ANGLE = {"deg": 180.0 / np.pi, "rad": 1.0, "gon": 200.0 / np.pi}
DIGITS = {"mm": 4, "m": 7, "in": 5, "cm": 5}


@dataclass(frozen=True)
class Recorded:
    """q: (N, n) [rad] as reported. T: tool in the tracker, (N, 4, 4) [m], with noise. And commanded joints."""

    robot: str
    names: tuple[str, ...]
    q: Array
    T: Array
    stamps: Array
    commanded: Array


def nominal(robot: str, rng: Rng | None = None) -> Arm:
    urdf = (FOLDER / f"{robot}.urdf").read_text(encoding="utf-8")
    return Arm(urdf, ARMS[robot], rng and displaced(rng, 6e-4, 6e-4), bare=True)


def record(robot: str, rng: Rng, rows: int, rate: float = 0.0) -> Recorded:
    """Postures of an arm whose links, axes and zeros are a little off, seen by a tracker.

    rate: rows a second of one smooth motion; 0: postures apart.
    """
    arm = nominal(robot, rng)
    low, high = np.maximum(arm.limits[0], -3.0), np.minimum(arm.limits[1], 3.0)
    tool, turned = rng.uniform(-0.12, 0.12, 3), Rotation.random(random_state=rng)
    middle, half, n = 0.5 * (low + high), 0.5 * (high - low), len(low)
    q = middle + half * rng.uniform(-0.75, 0.75, (rows, n))
    if rate:
        t = np.arange(rows)[:, None] / rate
        turns = rng.uniform(0.05, 0.2, (2, 1, n))
        q = middle + half * 0.4 * sum(np.sin(2.0 * np.pi * f * t + rng.uniform(0, 6.28, n)) for f in turns)
    offset, B = 7e-4 * rng.standard_normal(n), Rotation.random(random_state=rng)
    distance, way = rng.uniform(1.0, 3.5), rng.standard_normal(3)
    noise, T = (rng.uniform(1e-5, 8e-5), rng.uniform(5e-5, 4e-4)), np.tile(np.eye(4), (rows, 1, 1))
    p, R = arm.tool(q + offset, tool)
    scatter = rng.standard_normal((rows, 6))
    T[:, :3, :3] = (B * Rotation.from_matrix(R) * turned * Rotation.from_rotvec(noise[1] * scatter[:, :3])).as_matrix()
    T[:, :3, 3] = B.apply(p) + distance * (way / np.linalg.norm(way)) + noise[0] * scatter[:, 3:]
    stamps = 1.7e9 + (np.arange(rows) / rate if rate else np.cumsum(rng.uniform(4.0, 9.0, rows)))
    commanded = q + 2e-5 * rng.standard_normal(q.shape)
    rng.standard_normal(rows)  # of a temperature that nobody writes: seeds go on making the files they made
    return Recorded(robot, arm.names, q, T, stamps, commanded)


def holding(robot: str, q: Array) -> Array:
    """Torques (N, n) [N m] with which actuators hold the described bodies at joints q, positive along the axes."""
    return nominal(robot).loads(q)[..., TURN]


@dataclass
class Written:
    """Files, and what was written into them, in SI. readings: kind → list of values, one for each instrument. whole:
    rows in which all of the readings' cells hold numbers. signals: of columns that are signals or temperatures.
    """

    paths: list[Path]
    recorded: Recorded
    readings: dict[str, list[Array]]
    whole: Array
    velocity: Array | None = None
    effort: Array | None = None
    commanded: Array | None = None
    std: Array | None = None
    signals: list[Array] = field(default_factory=list)
    about: dict[str, Any] = field(default_factory=dict)


class Sheet:
    """Columns of one file."""

    def __init__(self, decimal: str) -> None:
        self.decimal, self.labels, self.cells = decimal, [], []

    def add(self, label: str, values: Array, digits: int) -> list[str]:
        """A column; its cells, which may still be changed."""
        self.labels.append(label)
        self.cells.append([f"{v:.{digits}f}".replace(".", self.decimal) for v in values])
        return self.cells[-1]

    def add_all(self, labels: Iterable[str], values: Array, digits: int) -> list[list[str]]:
        """A column for each label, values (N, …)."""
        return [self.add(label, column, digits) for label, column in zip(labels, values.T, strict=True)]

    def text(self, rng: Rng, order: Array) -> str:
        separator = str(rng.choice([";", "\t", "|"] + ([","] if self.decimal == "." else [])))
        lines = ["Exported by the cell's logger", ""] if rng.random() < 0.3 else []
        lines.append(separator.join(self.labels))
        lines += [separator.join(column[i] for column in self.cells) for i in order]
        return str(rng.choice(["\n", "\r\n"])).join([*lines, ""])
