"""What a method is given and what it answers. A task file holds no reading of a row that is scored."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from league.arm import Arm, Array


@dataclass(frozen=True)
class Task:
    """Postures of one recording, with readings of some of them; or tracks of handles.

    - kind: ``point``, ``pose``, ``socket`` (the tool's ball rests in sockets, and only joints are known), ``corners``
      (a camera sees a board) or ``track`` (a handle moves on what it is fixed to, and there is no arm).
    - urdf, tip: the arm as its maker describes it. tip names the link that base and tool are about.
    - q: joints (N, n) [rad] of every row, in the order in which they were measured. before: where each came from.
    - train: rows (M,) whose readings are known. reading: (M, 3) [m], or (M, 7) with x y z w of the quaternion; of
      sockets NaN; of corners (M, 2 C) [px], NaN where they are not seen. frame: the socket or the object of each row
      (N,), else zeros. pairs: sockets (P, 2), ``distance`` [m] apart.
    - block: rows that belong together, for methods that split once more.
    - board: corners (C, 3) [m], x right, y down, z into it; size: of the images [px]; on_tip: the arm carries the
      camera and not the board.
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
    board: Array = field(default_factory=lambda: np.empty((0, 3)))
    size: Array = field(default_factory=lambda: np.empty(0, int))
    on_tip: bool = False

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
        told = hashlib.sha256(f"{self.urdf}{self.tip}{' camera on tip' * self.on_tip}".encode())
        for values in (self.q, self.before, self.reading, self.frame, self.train, self.pairs, self.board, self.size):
            told.update(np.ascontiguousarray(np.round(np.asarray(values, dtype=float), 9)).tobytes())
        return told.hexdigest()[:12]


@dataclass(frozen=True)
class Answer:
    """T: poses (N, 4, 4) of the tool at every row, in the instrument's frame; of sockets in the arm's base; of corners
    those of the camera in the board's frame, whichever stands; of tracks (objects, K, 4, 4), poses of
    each handle all along the line or curve on which it moves. oriented: whether rotations were fitted.

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
    oriented: bool = True
