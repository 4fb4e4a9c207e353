"""What a method is given and what it answers. A task file holds no reading of a row that is scored."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from league.arm import Arm, Array


class NotApplicable(Exception):
    """Raised by a method that cannot do a task, with the reason."""


@dataclass(frozen=True)
class Task:
    """Postures of one recording, with readings of some of them.

    - kind: ``point``, ``pose`` or ``socket`` (the tool's ball rests in sockets, and only joints are known).
    - urdf, tip: the arm as its maker describes it. tip names the link that base and tool are about.
    - q: joints (N, n) [rad] of every row, in the order in which they were measured. before: where each came from.
    - train: rows (M,) whose readings are known. reading: (M, 3) [m], or (M, 7) with x y z w of the quaternion; of
      sockets NaN. frame: the socket of each row (N,), else zeros. pairs: sockets (P, 2), ``distance`` [m] apart.
    - block: rows that belong together, for methods that split once more.
    """

    name: str
    kind: str
    urdf: str
    tip: str
    q: Array
    before: Array
    train: Array
    reading: Array
    frame: Array
    pairs: Array = field(default_factory=lambda: np.empty((0, 2), int))
    distance: float = 0.0
    block: int = 1

    @property
    def arm(self) -> Arm:
        """The nominal arm."""
        return Arm.from_urdf(self.urdf, self.tip)

    @property
    def position(self) -> Array:
        """Positions (M, 3) [m] of the readings."""
        return self.reading[:, :3]

    def write(self, path: Path) -> None:
        """Write the file that a method's process reads."""
        np.savez(path, **{f.name: np.asarray(getattr(self, f.name)) for f in fields(self)})

    @classmethod
    def read(cls, path: Path) -> Task:
        """The task of a file."""
        with np.load(path) as data:
            return cls(**{name: data[name].item() if data[name].ndim == 0 else data[name] for name in data.files})

    @property
    def digest(self) -> str:
        """Twelve digits that change with anything a method is given."""
        told = hashlib.sha256(self.urdf.encode() + self.tip.encode())
        for values in (self.q, self.before, self.reading, self.frame, self.train, self.pairs):
            told.update(np.ascontiguousarray(np.round(np.asarray(values, dtype=float), 9)).tobytes())
        return told.hexdigest()[:12]


@dataclass(frozen=True)
class Answer:
    """T: poses (N, 4, 4) of the tool at every row, in the instrument's frame; of sockets in the arm's base.

    radius95: what 95 % of the errors stay below at each row (N,) [m], if the method says so. claim_p95: what it says of
    all of them together [m]. is_open: it says that something is left that it cannot explain, and claims nothing then.
    named: causes as (family, place). parameters: how many were fitted. remark: a sentence.
    """

    T: Array
    radius95: Array | None = None
    claim_p95: float | None = None
    is_open: bool = False
    named: tuple[tuple[str, str], ...] | None = None
    parameters: int = 0
    remark: str = ""
