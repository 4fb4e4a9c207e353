"""Where instruments stand whose readings are no positions, and where the tool is when nothing else tells.

Each kind places itself in closed form once the tool is known. Where no instrument shows positions, the tool's place is
tried at several starts, and fitted together with the instruments from each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.model import Instrument
from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.geometry import Array, descend, se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import PLANE, POSE_OF_FRAME, kinds, scene_in

MAX_ROWS = 500  # a start needs no more; spread over the recording
_STARTS, _GOOD = 0.15, 0.005  # of the reach: starts of the tool, and a median miss that needs no further one
_STEPS = 30  # iterations
_SOFT = 1e-4  # m²; misses beyond a centimetre count less
_SETTLED = 1e-6  # share of the cost that a last step gains


@dataclass(frozen=True)
class Known:
    """A frame whose place relative to another is known. to: that frame, or "base". T_frame_to: pose of ``to`` in the
    frame, (4, 4) [m]. std: how well position [m] and orientation [rad] are known, of a frame in the base; None:
    exactly, as of any other.
    """

    frame: str
    to: str
    T_frame_to: Array
    std: tuple[float, float] | None = None

    def T_frame_base(self, frames: Sequence[str], T_frame_base: Array) -> Array:
        """The pose of the base in the frame, where those of the other frames (F, 4, 4) are."""
        return self.T_frame_to if self.to == "base" else self.T_frame_to @ T_frame_base[frames.index(self.to)]


def leaders(frames: Sequence[str], known: Sequence[Known]) -> tuple[int, ...]:
    """For each frame the one whose errors it shares; empty where each stands for itself."""
    out = list(range(len(frames)))
    for k in known:
        if k.to != "base" and k.frame in frames:
            out[frames.index(k.frame)] = frames.index(k.to)
    for _ in known:  # what is known relative to something known
        out = [out[f] for f in out]
    return () if out == list(range(len(frames))) else tuple(out)


def require_placeable(known: Sequence[Known], samples: Samples) -> None:
    """Raises BadTable for a frame known relative to one that has no pose itself: an anchor, or, but for the very same
    plane, a plane.
    """
    for k in known:
        if k.to == "base":
            continue
        seen = {
            kinds()[str(name)].frame for name in np.unique(samples.kind[samples.frame == samples.frames.index(k.to)])
        }
        same = np.allclose(k.T_frame_to, np.eye(4))
        if POSE_OF_FRAME not in seen and not (seen == {PLANE} and same):
            said = f"'{k.to}' is {'a plane' if PLANE in seen else 'an anchor'} and has no orientation of its own"
            remedy = "state it in a tracker's or a station's frame, or in the base"
            raise BadTable(f"frame '{k.frame}', known in '{k.to}'", said, remedy)


def place_instruments(
    instruments: Sequence[Instrument],
    samples: Samples,
    T_base_tool: Array,
    T_frame_base: Array,
    fixed: Sequence[int] = (),
    known: Sequence[Known] = (),
) -> tuple[tuple[Instrument, ...], Array]:
    """(instruments with their constants, T_frame_base (F, 4, 4)) for a known tool T_base_tool (N, 4, 4).

    fixed: frames that have been placed already.
    """
    poses, placed = T_frame_base.copy(), set(fixed)
    relative = {k.frame: k for k in known}

    def links(frame: str) -> int:
        """How many others must stand before this frame does."""
        count = 0
        while frame in relative and count <= len(relative):
            count, frame = count + 1, relative[frame].to
        return count

    out: dict[int, Instrument] = {}
    for i, instrument in sorted(enumerate(instruments), key=lambda pair: links(pair[1].frame)):
        f = samples.frames.index(instrument.frame)
        if instrument.frame in relative:
            poses[f] = relative[instrument.frame].T_frame_base(samples.frames, poses)
            placed.add(f)
        rows = instrument.rows(samples)
        rows = rows[spread_rows(len(rows), MAX_ROWS)]
        poses[f], values = instrument.of_kind.place(
            instrument.at_target(T_base_tool[rows]), samples.reading[rows], poses[f] if f in placed else None
        )
        placed.add(f)
        out[i] = replace(instrument, values=values)
    return tuple(out[i] for i in range(len(instruments))), poses


def require_readings(instruments: Sequence[Instrument], samples: Samples) -> None:
    """Raises NotEnoughData where an instrument has fewer readings than it can be placed from."""
    for instrument in instruments:
        count, least = len(instrument.rows(samples)), instrument.of_kind.least
        if count < least:
            said = f"{count} readings of kind {instrument.kind}, at least {least} are needed"
            raise NotEnoughData(f"frame '{instrument.frame}'", said, "record more stations in it")


@dataclass(frozen=True)
class PlacedSight:
    """What one placed instrument leaves: residual (3, m) in its unit, lever (m,) [m per unit]; reading (m, 3)."""

    residual: Array
    lever: Array
    reading: Array
    unit: str
    dimensions: int

    @property
    def square(self) -> Array:
        """Squares of what is left [m²], (m,)."""
        return np.asarray(np.sum((self.residual * self.lever) ** 2, axis=0))


@dataclass(frozen=True)
class PlacedTool:
    """The tool's point x in the tip, instruments and poses of their frames; what they leave, and its derivatives
    (m, 3, k) by the tool, by their frames and by their constants.
    """

    x: Array
    instruments: tuple[Instrument, ...]
    poses: Array
    seen: tuple[PlacedSight, ...]
    derivatives: tuple[Array, ...]

    @classmethod
    def of(cls, x: Array, instruments: Sequence[Instrument], poses: Array, samples: Samples, tip: Array) -> PlacedTool:
        """At tip poses (N, 4, 4).

        A frame that moves by a twist (v, ω) changes the prediction as its target would by v + ω × p.
        """
        seen, derivatives = [], []
        for instrument in instruments:
            rows, kind = instrument.rows(samples), instrument.of_kind
            rows = rows[spread_rows(len(rows), MAX_ROWS)]
            tool, reading = tip[rows] @ se3.transform(p=x), samples.reading[rows]
            scene = scene_in(poses[samples.frames.index(instrument.frame)], instrument.at_target(tool))
            sight = instrument.see(scene, reading)
            seen.append(PlacedSight(sight.residual, sight.lever, reading, kind.unit, kind.dimensions))
            through = np.moveaxis(sight.through, 2, 0)
            by_change = instrument.moved_by(np.zeros(len(instrument.constants)))
            own = np.moveaxis(sight.constants, (0, 2), (2, 0)) @ by_change
            J = np.concatenate([through @ tool[:, :3, :3], through, -through @ so3.hat(scene.target.T), own], axis=2)
            derivatives.append(J * sight.lever[:, None, None])
        return cls(x, tuple(instruments), poses, tuple(seen), tuple(derivatives))

    @property
    def cost(self) -> float:
        """Robust sum of what all of them leave."""
        return sum(float(np.sum(np.log1p(one.square / _SOFT))) for one in self.seen)

    @property
    def middle(self) -> float:
        """Median of what instruments leave [m]."""
        return float(np.median(np.sqrt(np.concatenate([one.square for one in self.seen]))))


def find_tool(
    instruments: Sequence[Instrument],
    samples: Samples,
    T_base_tip: Array,
    known: Sequence[Known] = (),
    hopeless: float = np.inf,
) -> PlacedTool:
    """The tool with which instruments meet their readings best, and where they stand then.

    hopeless: share of the reach; no other start improves what misses by more after three.
    """
    reach = float(np.linalg.norm(T_base_tip[:, :3, 3], axis=1).mean())
    best: PlacedTool | None = None
    for tried, start in enumerate((np.zeros(3), *(_STARTS * reach * np.r_[np.eye(3), -np.eye(3)]))):
        found = _fitted(instruments, samples, T_base_tip, start, known)
        best = found if best is None or found.middle < best.middle else best
        if best.middle < _GOOD * reach or (tried == 2 and best.middle > hopeless * reach):
            break
    assert best is not None
    return best


def _fitted(
    instruments: Sequence[Instrument], samples: Samples, T_base_tip: Array, start: Array, known: Sequence[Known]
) -> PlacedTool:
    """Instruments and tool fitted together, from a tool's place in the tip."""
    frames = samples.frames
    at = np.tile(np.eye(4), (len(frames), 1, 1))
    placed, poses = place_instruments(instruments, samples, T_base_tip @ se3.transform(p=start), at, (), known)
    moving = leaders(frames, known) or tuple(range(len(frames)))  # a frame moves with the one that it is known in
    still = {k.frame for k in known if k.to == "base"}
    twist = {f: 3 + 6 * k for k, f in enumerate(sorted({moving[frames.index(i.frame)] for i in placed}))}
    columns, end = [], 3 + 6 * len(twist)
    for one in placed:
        first = twist[moving[frames.index(one.frame)]]
        columns.append(np.r_[0:3, first : first + 6, end : end + len(one.constants)])
        end += len(one.constants)
    free = np.ones(end, bool)
    for f, first in twist.items():
        free[first : first + 6] = frames[f] not in still
    equations: list[Array] = []

    def look(here: PlacedTool) -> float:
        A, g = np.zeros((end, end)), np.zeros(end)
        for one, J, own in zip(here.seen, here.derivatives, columns, strict=True):
            weighted = J / (1.0 + one.square / _SOFT)[:, None, None]
            A[np.ix_(own, own)] += np.tensordot(weighted, J, ([0, 1], [0, 1]))
            g[own] += np.tensordot(weighted, (one.residual * one.lever).T, ([0, 1], [0, 1]))
        equations[:] = A * np.outer(free, free), g * free
        return here.cost

    def step(here: PlacedTool, damping: float) -> tuple[PlacedTool, float]:
        A, g = equations
        change = np.asarray(np.linalg.lstsq(A + damping * np.diag(np.diag(A) + 1e-9), g, rcond=None)[0], dtype=float)
        moved = [i.moved(change[own[9:]]) for i, own in zip(here.instruments, columns, strict=True)]
        turns = [se3.exp(change[twist[m] : twist[m] + 6]) if m in twist else np.eye(4) for m in moving]
        there = PlacedTool.of(here.x + change[:3], moved, here.poses @ np.array(turns), samples, T_base_tip)
        return there, there.cost

    begin = PlacedTool.of(start, placed, poses, samples, T_base_tip)
    return descend(begin, look, step, lambda _, gain, cost: gain < _SETTLED * cost, _STEPS).place
