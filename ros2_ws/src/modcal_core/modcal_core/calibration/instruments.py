"""The instruments of a cell whose readings are no positions, and what they say of a model at given samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.geometry import Array, se3
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import Constant, Kind, Scene, Sight, kinds
from modcal_core.robots import Frames

_TARGET = tuple(Constant(f"target_{axis}", "m", 0.05) for axis in "xyz")


@dataclass(frozen=True)
class Instrument:
    """One kind of reading in one frame. values: constants of the kind, (V,). target: where the point that it watches
    sits in the tool's frame [m], (3,); None where it is the tool's origin, as for all others.
    """

    frame: str
    kind: str
    values: Array
    target: Array | None = None

    @property
    def of_kind(self) -> Kind:
        """The kind itself."""
        return kinds()[self.kind]

    @property
    def constants(self) -> tuple[Constant, ...]:
        """What is fitted: the kind's constants, then the target, where it is its own."""
        return (*self.of_kind.constants, *(() if self.target is None else _TARGET))

    def moved(self, change: Array) -> Instrument:
        """The instrument with its constants changed by parameters (k,)."""
        own = len(self.of_kind.constants)
        target = None if self.target is None else self.target + change[own:]
        return replace(self, values=self.of_kind.moved(self.values, change[:own]), target=target)

    def moved_by(self, change: Array) -> Array:
        """d(values, target)/d(parameters), at this change."""
        own = len(self.of_kind.constants)
        J = self.of_kind.moved_by(self.values, change[:own])
        if self.target is None:
            return J
        out = np.zeros((J.shape[0] + 3, J.shape[1] + 3))
        out[: J.shape[0], : J.shape[1]] = J
        out[J.shape[0] :, J.shape[1] :] = np.eye(3)
        return out

    def rows(self, samples: Samples) -> np.ndarray:
        """Indices of its samples."""
        if self.frame not in samples.frames:
            return np.empty(0, int)
        return np.flatnonzero((samples.frame == samples.frames.index(self.frame)) & (samples.kind == self.kind))

    def at_target(self, T_base_tool: Array) -> Array:
        """Poses (m, 4, 4) of the tool shifted to what is watched."""
        return T_base_tool if self.target is None else T_base_tool @ se3.transform(p=self.target)

    def scene(self, T_root_frame: Array, f: Frames, rows: np.ndarray) -> Scene:
        """Scene of the target at these rows. f: frames of the chain from the root, the tool last."""
        axes, tool = f.axes[-1][:, :, rows], f.p[-1][:, rows]
        target = tool if self.target is None else tool + np.einsum("dim,d->im", axes, self.target)
        return Scene(T_root_frame, target, tool, axes)

    def see(self, scene: Scene, reading: Array) -> Sight:
        """What its readings (m, 3) say, the target's derivatives behind those of its constants."""
        sight = self.of_kind.see(scene, self.values, reading)
        if self.target is None:
            return sight
        by_target = np.einsum("ijm,djm->dim", sight.through, scene.axes)
        return replace(sight, constants=np.concatenate([sight.constants, by_target]))


def new_instruments(
    samples: Samples, own_target: Sequence[str] = (), before: Sequence[Instrument] = ()
) -> tuple[Instrument, ...]:
    """An instrument, its constants unknown yet, for every kind in every frame that gives no positions.

    own_target: frames whose instrument watches a point of the tool of its own. before: instruments whose targets are
    where they were.
    """
    targets = {name: np.zeros(3) for name in own_target}
    targets |= {i.frame: i.target for i in before if i.target is not None}
    pairs = sorted({(int(f), str(k)) for f, k in zip(samples.frame, samples.kind, strict=True)})
    return tuple(
        Instrument(samples.frames[f], k, kinds()[k].start(), targets.get(samples.frames[f]))
        for f, k in pairs
        if not kinds()[k].direct
    )


@dataclass
class Sights:
    """What the readings of all instruments say, among N samples.

    watched: the point of each sample that counts, (3, N). rows: of the instruments' samples, (m,). residual, scale: in
    the kind's unit; scale is the change of the prediction per unit of an error of scale, (3, m). through: (3, 3, m).
    lever: metres at the tool per unit of residual, (N,), one for positions. constants: for each instrument that read
    something its rows and the change of the prediction per constant, (V, 3, m).
    """

    watched: Array
    rows: np.ndarray
    residual: Array
    scale: Array
    through: Array
    lever: Array
    constants: dict[int, tuple[np.ndarray, Array]]

    def look_through(self, motion: Array) -> None:
        """Replace motions (3, N) of the watched points by what the instruments see of them."""
        motion[:, self.rows] = np.einsum("ijm,jm->im", self.through, motion[:, self.rows])


def look(
    instruments: Sequence[Instrument], samples: Samples, reading: Array, T_root_frame: Array, f: Frames
) -> Sights | None:
    """What the instruments say of a chain; None where none of them read anything.

    reading: the samples' readings, free of an error of scale, (N, 3). T_root_frame: (F, 4, 4). f: frames of the chain
    from the root, the tool last.
    """
    seen: dict[int, tuple[np.ndarray, Sight]] = {}
    for i, instrument in enumerate(instruments):
        if len(rows := instrument.rows(samples)):
            scene = instrument.scene(T_root_frame[samples.frames.index(instrument.frame)], f, rows)
            seen[i] = rows, instrument.see(scene, reading[rows])
    if not seen:
        return None
    watched, lever = f.p[-1].copy(), np.ones(len(samples))
    for rows, sight in seen.values():
        watched[:, rows], lever[rows] = sight.watched, sight.lever
    parts = seen.values()
    return Sights(
        watched,
        np.concatenate([rows for rows, _ in parts]),
        np.concatenate([sight.residual for _, sight in parts], axis=1),
        np.concatenate([sight.scale for _, sight in parts], axis=1),
        np.concatenate([np.broadcast_to(sight.through, (3, 3, len(rows))) for rows, sight in parts], axis=2),
        lever,
        {i: (rows, sight.constants) for i, (rows, sight) in seen.items()},
    )
