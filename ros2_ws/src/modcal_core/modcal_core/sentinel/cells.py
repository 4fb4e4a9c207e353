"""What a recording says of an arm, averaged over cells of a quarter of a second.

Samples of a driver are not independent: noise, a servo's transient and a gear's ripple last longer than the time from
one to the next. A cell is the unit here, and blocks of cells have an error in common (see ``normal``). Velocities and
accelerations come from positions alone, by polynomials over a window that is the same at every rate.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.signal import savgol_filter

from modcal_core.errors import BadRecording, BadTable, NotEnoughData
from modcal_core.geometry import Array
from modcal_core.measurements import POINT, POSE, Recording, commanded_at, joints_by_time
from modcal_core.robots import Chain, Inertias

CELL = 0.25  # s: longer than a servo's transient, shorter than a motion
FEWEST = 40  # cells of a recording
LEAST_SECONDS = FEWEST * CELL
_WINDOW = 0.12  # s that a polynomial is fitted over
_SLOWEST = 10.0  # Hz
_GAP = 2.5  # times the usual period; what is missing longer is not interpolated
_SLIDES = 2e-3  # rad/s or m/s at which half of a joint's dry friction acts; encoders step by less
_FARTHEST = 0.2  # rad or m; a joint that is farther away does not follow this command


@dataclass(frozen=True)
class MonitoredArm:
    """The arm that is watched. names: of its joints. chain, bodies: of its description, else None."""

    names: tuple[str, ...]
    chain: Chain | None = None
    bodies: Inertias | None = None


@dataclass(frozen=True)
class Cells:
    """Cells of one recording, NaN where it says nothing. began: [s]. seconds: that were recorded.

    columns: by name. t (N,) [s] from the beginning; q, v, a, side, effort (N, n): positions, speeds, accelerations, the
    sign of the speed, smooth about zero, efforts; ``apart:TOPIC`` (N, n): what was commanded on a topic, or what a
    leader's joints said, less what was measured; tag (N, 7), tag_q, tag_v (N, n): one pose of a fixed tag in the camera
    on the hand, and the joints at that time; ``touch:FRAME`` (N, n): the joints while the tool rested in a socket.
    """

    name: str
    began: float
    seconds: float
    columns: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.columns["t"])

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def of(self, kind: str) -> tuple[str, ...]:
        """What there are columns of: topics of commands or of a leader ("apart"), frames of sockets ("touch")."""
        return tuple(name.partition(":")[2] for name in self.columns if name.startswith(f"{kind}:"))

    def to_bytes(self) -> bytes:
        """The columns in single precision, compressed."""
        stream = io.BytesIO()
        arrays: dict[str, Any] = {name: np.asarray(x, dtype=np.float32) for name, x in self.columns.items()}
        np.savez_compressed(stream, **arrays)
        return stream.getvalue()

    @classmethod
    def from_bytes(cls, name: str, began: float, seconds: float, content: bytes) -> Cells:
        """The same back. Raises BadTable for what is none."""
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as stored:
                return cls(name, began, seconds, {key: stored[key].astype(float) for key in stored.files})
        except (ValueError, OSError, KeyError, EOFError) as error:
            raise BadTable(f"history: {name}", "holds no cells", "begin a history in another folder") from error


def cells_of(recording: Recording, names: tuple[str, ...], name: str) -> Cells:
    """The cells of a recording. names: of the joints.

    Raises NotEnoughData for a recording that is too short, and BadRecording for joints that are missing or too slow.
    """
    t, q, effort = joints_by_time(recording, names, "effort")
    keep = np.isfinite(t) & np.isfinite(q).all(axis=1)
    if len(keep) and not keep.any():
        missing = [one for one, x in zip(names, q.T, strict=True) if not np.isfinite(x).any()]
        raise BadRecording(f"{name}, joint_states", f"do not contain {', '.join(missing)}", "give another --tip")
    keep[1:] &= np.diff(t) > 0.0
    t, q, effort = t[keep], q[keep], effort[keep]
    if len(t) < 2 or t[-1] - t[0] < LEAST_SECONDS:
        said = f"last {t[-1] - t[0] if len(t) else 0.0:.1f} s, {LEAST_SECONDS:g} s are needed"
        raise NotEnoughData(f"{name}, joint_states", said, "record the arm at its work for a minute")
    period = float(np.median(np.diff(t)))
    if period > 1.0 / _SLOWEST:
        said = f"come {1.0 / period:.1f} times a second, {_SLOWEST:g} are needed"
        raise BadRecording(f"{name}, joint_states", said, "record while the arm moves, not at its stations alone")
    grid = np.arange(t[0], t[-1], period)
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    known = t[after] - t[after - 1] <= _GAP * period
    window = max(5, 2 * round(0.5 * _WINDOW / period) + 1)

    def on_grid(x: Array) -> Array:
        return np.stack([np.interp(grid, t, column) for column in x.T], axis=1)

    at = on_grid(q)
    v, a = (savgol_filter(at, window, 3, deriv=k, delta=period, axis=0) for k in (1, 2))
    per = max(round(CELL / period), 1)
    count = len(grid) // per

    def mean(x: Array) -> Array:
        return x[: count * per].reshape(count, per, -1).mean(axis=1)

    columns = {"t": mean(grid[:, None] - grid[0])[:, 0], "q": mean(at), "v": mean(v), "a": mean(a)}
    columns |= {"side": mean(v / (np.abs(v) + _SLIDES)), "effort": mean(on_grid(effort))}
    for topic in dict.fromkeys(track.topic for track in recording.commands):
        told = [track for track in recording.commands if track.topic == topic]
        apart = commanded_at(told, names, grid) - at
        columns[f"apart:{topic}"] = mean(np.where(np.abs(apart) < _FARTHEST, apart, np.nan))
    moved = {"q": at, "v": v}
    columns |= _seen(recording, grid[: count * per].reshape(count, per), grid, moved)
    whole = mean(known[:, None].astype(float))[:, 0] == 1.0
    return Cells(name, float(t[0]), float(t[-1] - t[0]), {key: x[whole] for key, x in columns.items()})


def _seen(recording: Recording, cells: Array, grid: Array, moved: Mapping[str, Array]) -> dict[str, Array]:
    """The middle reading in each cell, where there is one, and the joints then: of the tag that is seen most often, and
    of closed contacts, which are points that always read zero.
    """
    out: dict[str, Array] = {}
    tracks = [track for track in recording.readings if len(track.stamps)]
    tags = sorted((track for track in tracks if track.kind == POSE), key=lambda one: len(one.stamps))[-1:]
    for track in [*tags, *(track for track in tracks if track.kind == POINT and not track.values.any())]:
        order = np.argsort(track.stamps, kind="stable")
        stamps, values = track.stamps[order], track.values[order]
        first, last = np.searchsorted(stamps, cells[:, 0]), np.searchsorted(stamps, cells[:, -1], side="right")
        seen, at = last > first, np.minimum((first + last) // 2, len(stamps) - 1)
        then = {k: np.stack([np.interp(stamps[at], grid, column) for column in x.T], axis=1) for k, x in moved.items()}
        if track.kind == POSE:
            read = {"tag": values[at], "tag_q": then["q"], "tag_v": then["v"]}
        else:
            read = {f"touch:{track.frame}": then["q"]}
        out |= {key: np.where(seen[:, None], x, np.nan) for key, x in read.items()}
    return out
