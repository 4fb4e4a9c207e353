"""Where instruments stand whose readings are no positions, and where the tool is when nothing else tells.

Each kind places itself in closed form once the tool is known. Where no instrument shows positions, the tool's three
numbers are searched for such that the placed instruments meet their readings best, each trial placing them again
(variable projection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.instruments import Instrument
from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import PLANE, POSE_OF_FRAME, scene_in
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows

MAX_ROWS = 500  # a start needs no more; spread over the recording
_GOOD = 0.005  # median miss, as a share of the arm's reach, that needs no further start


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
            raise BadTable(
                f"frame '{k.frame}', known in '{k.to}'",
                f"'{k.to}' is {'a plane' if PLANE in seen else 'an anchor'} and has no orientation of its own",
                "state it in a tracker's or a station's frame, or in the base",
            )


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
            raise NotEnoughData(
                f"frame '{instrument.frame}'",
                f"{count} readings of kind {instrument.kind}, at least {least} are needed",
                "record more stations in it",
            )


def residuals(instruments: Sequence[Instrument], samples: Samples, T_base_tool: Array, T_frame_base: Array) -> Array:
    """What placed instruments miss by [m at the tool], all rows of all of them, three components each."""
    out = []
    for instrument in instruments:
        rows = instrument.rows(samples)
        rows = rows[spread_rows(len(rows), MAX_ROWS)]
        scene = scene_in(T_frame_base[samples.frames.index(instrument.frame)], instrument.at_target(T_base_tool[rows]))
        sight = instrument.of_kind.see(scene, instrument.values, samples.reading[rows])
        out.append((sight.residual * sight.lever).ravel())
    return np.concatenate(out)


def find_tool(
    instruments: Sequence[Instrument],
    samples: Samples,
    T_base_tip: Array,
    T_frame_base: Array,
    known: Sequence[Known] = (),
) -> Array:
    """T_tip_tool (4, 4) with which instruments that watch the tool can be placed to meet their readings best."""
    from scipy.optimize import least_squares  # slow to import

    watching = [i for i in instruments if i.of_kind.target]
    if not watching:
        return np.eye(4)
    followed = {i.frame for i in watching}
    links = [k for k in known if k.frame in followed and (k.to == "base" or k.to in followed)]
    reach = float(np.linalg.norm(T_base_tip[:, :3, 3], axis=1).mean())

    def miss(t: Array) -> Array:
        tool = T_base_tip @ se3.transform(p=t)
        placed, poses = place_instruments(watching, samples, tool, T_frame_base, (), links)
        return residuals(placed, samples, tool, poses)

    best: tuple[float, Array] = (np.inf, np.zeros(3))
    for start in (np.zeros(3), *(0.15 * reach * np.r_[np.eye(3), -np.eye(3)])):
        found = least_squares(miss, start, loss="soft_l1", f_scale=0.01, diff_step=[1e-4], max_nfev=15, x_scale=0.1)
        cost = float(np.median(np.linalg.norm(found.fun.reshape(-1, 3), axis=1)))
        if cost < best[0]:
            best = cost, found.x
        if cost < _GOOD * reach:
            break
    return se3.transform(p=best[1])
