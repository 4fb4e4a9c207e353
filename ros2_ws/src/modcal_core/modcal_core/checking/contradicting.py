"""Stations of a check that contradict each other or the arm: base or tool moved between two, rows were mixed up.

No change since the calibration explains those, and what comes nearest would be named instead. Base and tool of each
part are found in closed form about the frozen arm (orthogonal Procrustes); a reading that is another station's agrees
with where the arm was then. A gear that slipped, or one whose axis passes near the target, moves readings by as much as
another robot would: what such changes leave tells them apart, of the calibrated arm its noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import FINEST, Model, NoiseModel
from modcal_core.checking.hypotheses import BASE, FRAME, GEAR, LOAD, NOISE, TOOL, ZERO
from modcal_core.checking.outcome import OF_A_GEAR
from modcal_core.checking.searching import FoundChanges
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, so3
from modcal_core.hypotheses import ANGLE, OF_REACH
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import is_serial_arm

_MIN = 8  # stations, of which each part has at least
_MIN_PART = 3  # three: a base has six numbers, of three points nine
_BEYOND_DOUBT = 100.0  # twice 50 in log-likelihood, as where conventions are compared
_NEAR = 2.0  # standard deviations RMS that two parts may leave: what is expected is itself known to some ten per cent
_MIXED = 3  # readings that are another station's; two might be so by chance
_EXPLAINED = 0.8  # share of those that miss by far which must be another's
_CHANGES = (BASE, FRAME, TOOL, ZERO, GEAR, LOAD)  # not a metre or links of another length, nor readings that scatter


def require_own_rows(model: Model, samples: Samples, noise: NoiseModel) -> None:
    """Raises BadRecording where readings are those of other stations. model: frozen. noise: of its own recording."""
    if not _comparable(model, samples):
        return
    order = np.argsort(samples.stamps, kind="stable")
    _require_own_rows(_Readings.of(model, samples.select(order), noise.position, noise.rotation), model.serial.reach())


def require_one_setting(found: FoundChanges, model: Model, expected: tuple[float | None, float | None]) -> None:
    """Raises BadRecording where base or tool moved between two stations and what was found does not explain both parts.

    model: frozen. expected: RMS of position [mm] and orientation [deg] that it should show while nothing has changed.
    """
    if not found.changes or not _comparable(model, found.samples) or expected[0] is None:
        return
    samples = found.samples.select(np.argsort(found.samples.stamps, kind="stable"))
    sigma = 1e-3 * expected[0] / np.sqrt(3.0), np.radians(expected[1] or 0.0) / np.sqrt(3.0)
    frozen = _Readings.of(model, samples, *map(float, sigma))
    changed = _Readings.of(found.state.model, _with_curves(found, samples), *map(float, sigma))
    _require_one_part(frozen, changed, any(change.hypothesis.kind == NOISE for change in found.changes))


def _with_curves(found: FoundChanges, samples: Samples) -> Samples:
    """The samples with the joints where gears of any course turned them, which no model has."""
    q, station = samples.q.copy(), np.searchsorted(np.unique(found.samples.station), samples.station)
    for change in found.changes:
        if change.judged.candidate.free and len(change.sizes):
            q[:, change.hypothesis.curve] += change.sizes[station]
    return replace(samples, q=q)


def _comparable(model: Model, samples: Samples) -> bool:
    """Whether these are enough positions of one frame, read directly of a serial arm."""
    direct = is_serial_arm(model.chain) and is_direct(samples.kinds)
    return direct and len(samples) >= _MIN and len(samples.frames) == 1 and not samples.sockets


@dataclass(frozen=True)
class _Readings:
    """What is predicted and read, in order: T (N, 4, 4), p (N, 3) [m], R (N, 3, 3) or None of points; their standard
    deviations per axis [m, rad]; numbers of the stations.
    """

    T: Array
    p: Array
    R: Array | None
    sigma: tuple[float, float]
    station: np.ndarray

    @classmethod
    def of(cls, model: Model, samples: Samples, position: float, rotation: float) -> _Readings:
        """position, rotation: standard deviations per axis [m, rad]; with 0, rotations are not compared."""
        turned = samples.R if bool(samples.is_pose.all()) and rotation > 0.0 else None
        T = model.predict_samples(samples)
        return cls(T, samples.reading, turned, (max(position, FINEST), rotation), samples.station + 1)

    def __len__(self) -> int:
        return len(self.p)

    def left(self, rows: slice, Y: Array, y: Array, X: Array, x: Array) -> float:
        """Squares, in variances, that readings of some rows leave of Y (T x) + y, and of Y R X."""
        R = self.T[rows, :3, :3]
        gap = self.p[rows] - ((self.T[rows, :3, 3] + R @ x) @ Y.T + y)
        square = float(np.sum(gap**2)) / self.sigma[0] ** 2
        if self.R is not None:
            turn = so3.log(np.swapaxes(Y @ R @ X, -1, -2) @ self.R[rows])
            square += float(np.sum(turn**2)) / self.sigma[1] ** 2
        return square

    def as_is(self, rows: slice) -> float:
        """The same of what is predicted."""
        none = np.zeros(3)
        return self.left(rows, np.eye(3), none, np.eye(3), none)

    def base_at(self, rows: slice) -> tuple[Array, Array, Array, Array]:
        """Y, y, X, x with the base where these rows have it."""
        p, known = self.p[rows], self.T[rows, :3, 3]
        middle, about = p.mean(axis=0), known.mean(axis=0)
        M = (p - middle).T @ (known - about) / self.sigma[0] ** 2
        if self.R is not None:
            M = M + np.einsum("nij,nkj->ik", self.R[rows], self.T[rows, :3, :3]) / self.sigma[1] ** 2
        Y = so3.nearest_rotation(M)
        return Y, middle - Y @ about, np.eye(3), np.zeros(3)

    def tool_at(self, rows: slice) -> tuple[Array, Array, Array, Array]:
        """Y, y, X, x with the tool where these rows have it."""
        R = np.swapaxes(self.T[rows, :3, :3], -1, -2)
        x = (R @ (self.p[rows] - self.T[rows, :3, 3])[..., None])[..., 0].mean(axis=0)
        X = np.eye(3) if self.R is None else so3.nearest_rotation((R @ self.R[rows]).sum(axis=0))
        return np.eye(3), np.zeros(3), X, x

    def base(self, rows: slice) -> float:
        """What is left with the base where these rows have it."""
        return self.left(rows, *self.base_at(rows))

    def tool(self, rows: slice) -> float:
        """What is left with the tool where these rows have it."""
        return self.left(rows, *self.tool_at(rows))

    def placed(self, Y: Array, y: Array, X: Array, x: Array) -> _Readings:
        """The same readings with base (Y, y) and tool (X, x) applied."""
        at, tool = np.eye(4), np.eye(4)
        at[:3, :3], at[:3, 3], tool[:3, :3], tool[:3, 3] = Y, y, X, x
        return replace(self, T=at @ self.T @ tool)


def _require_one_part(frozen: _Readings, changed: _Readings, noisier: bool) -> None:
    """changed: with what was found put in. noisier: whether that is more noise."""
    N = len(frozen)
    moved: tuple[tuple[str, Callable[[slice], float]], ...] = (
        ("the base (or the tracker)", frozen.base),
        ("the tool (or the target on it)", frozen.tool),
    )
    found = min(
        (of(slice(0, k)) + of(slice(k, N)), k, what) for what, of in moved for k in range(_MIN_PART, N - _MIN_PART + 1)
    )
    square, k, what = found
    numbers = N * (3 if frozen.R is None else 6)
    as_is = changed.as_is(slice(0, N))
    if noisier and as_is > numbers:  # twice a log-likelihood, with the noise as large as it is most likely
        as_is = numbers * (1.0 + float(np.log(as_is / numbers)))
    as_well = min(as_is, *(of(slice(0, N)) for _, of in moved))
    if square > _NEAR**2 * numbers or as_well - square < _BEYOND_DOUBT:
        return
    raise BadRecording(
        f"{what} moved between stations {frozen.station[k - 1]} and {frozen.station[k]} of this recording",
        f"the stations before and those after agree in themselves ({_rms(square, numbers):.1f} times the expected "
        f"noise together), and no change since the calibration explains both ({_rms(as_well, numbers):.1f} times)",
        "fix it, and check again with stations that were all taken afterwards",
    )


def _rms(square: float, numbers: int) -> float:
    return float(np.sqrt(square / numbers))


def _require_own_rows(frozen: _Readings, reach: float) -> None:
    """Raises BadRecording where most readings that miss by far are those of other stations.

    What one move of base or tool brings to its own station is no other's, however near they stand.
    """
    near, gap = _near(frozen, reach)
    every = slice(0, len(frozen))
    moved = (frozen.placed(*frozen.base_at(every)), frozen.placed(*frozen.tool_at(every)))
    own = np.any([np.diag(near), *(np.diag(_near(each, reach)[0]) for each in moved)], axis=0)
    far = np.flatnonzero(~own)
    others = near[far].any(axis=1)
    if others.sum() < _MIXED or others.mean() < _EXPLAINED:
        return
    rows = far[others]
    belongs = frozen.station[[int(np.argmin(np.where(near[i], gap[i], np.inf))) for i in rows]]
    raise BadRecording(
        f"readings at {len(rows)} of {len(frozen)} stations",
        f"are those of other stations (that at station {frozen.station[rows[0]]} is where the arm was at station "
        f"{belongs[0]})",
        "pair each reading with its own posture, and check again",
    )


def _near(readings: _Readings, reach: float) -> tuple[np.ndarray, Array]:
    """Whether each reading is where the arm was at each station, as a nominal arm would be, and how far away [m]."""
    gap = np.linalg.norm(readings.p[:, None] - readings.T[None, :, :3, 3], axis=-1)
    near = gap < OF_REACH * reach
    if readings.R is not None:
        turned = so3.log(np.swapaxes(readings.T[None, :, :3, :3], -1, -2) @ readings.R[:, None])
        near &= np.linalg.norm(turned, axis=-1) < ANGLE
    return near, gap


def require_accounted(found: FoundChanges, doubt: BadRecording) -> None:
    """Raises the doubt unless what was found explains the readings down to their noise, in few enough numbers: a curve
    that may take any course has one for every station, so that only one of them counts. Raises BadRecording with the
    joint where its curve is no gear's.
    """
    curves = [c for c in found.changes if c.hypothesis.curve >= 0]
    explained = not found.more and all(c.hypothesis.kind in _CHANGES for c in found.changes)
    if not found.changes or not explained or len(curves) > 1:
        raise doubt
    for curve in curves:
        rms = float(np.sqrt(np.mean(curve.sizes**2)))
        if rms > OF_A_GEAR:
            raise BadRecording(
                f"angles of {curve.hypothesis.place}",
                f"differ from those of the calibrated arm by {np.degrees(rms):.3g}° RMS, another at every station",
                "check its encoder and its place in joint_states; calibrate again once it is right",
            )
