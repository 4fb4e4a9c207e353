"""Whether the readings mean what they are taken for: conventions compared in closed form by likelihood.

The hand-eye problem ``T_i ≈ Y A_i X`` of the nominal arm is solved for the readings as they are and with each of the
:mod:`mistakes` undone: by rotations first and by positions first, then both together in a few Newton steps. Where
orientations hardly vary, positions say how the base is turned, and orientations must agree with that. Each way has a
likelihood at its own estimated noise: Gaussian, no narrower than a nominal arm is wrong by, with a share of readings
that may say anything. Nominal errors are alike in neighbouring postures, so no more than a hundred stations count as
independent. Base and tool may change along the recording: it may be cut into equal parts with a base and a tool of
their own, at the price of their parameters (BIC).

Another convention that is better by :data:`BEYOND_DOUBT` is a refusal; an inverse pose is undone. No limit is set to
the residual itself: on real cubes a wrong sequence leaves 1°, and the right one 0.1°.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, distinct, tool_and_place, turns_left
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import Samples, spread_rows
from modcal_core.plausibility.consensus import placed_by_most
from modcal_core.plausibility.mistakes import Mistake, inverse_pose, of_axes, of_joints, of_rotations, of_units
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

BEYOND_DOUBT = 50.0  # difference of log-likelihoods
MIN_STATIONS = 12  # poses of a frame: six unknown turns, and as much again to tell
INVERTED = "pose inverted"
_INDEPENDENT = 100  # stations that count: errors of a nominal arm are alike in neighbouring postures
_NOMINAL_ANGLE = 2e-3  # rad per axis; a nominal arm turns its tip by as much too far, so nothing finer decides
_NOMINAL_SHARE = 1e-3  # of the reach; the same for positions
_ASTRAY = 0.05  # share of readings that may say anything
_FEW, _MAX = 60, 300  # stations, evenly along the recording, to look for candidates and to judge them
_CANDIDATES = 6  # the likeliest on few stations, that are judged on many
_REFINED = (
    5.0  # in log-likelihood a station, by which the last refinement may bring one forward; nonsense lacks twice that
)
_PARTS = (1, 2, 4)  # equal parts with their own base and tool
_MIN_PART = 20  # stations
_AN_ARM = 0.05  # of the reach; what misses by more is not explained, whatever was undone
_ALIKE = 2.0  # in log-likelihood; conventions that say the same within it are named by the first of them
_TURNED = 3.0  # nominal angles RMS over space, as an arm's own errors come to
_MAX_LEFT = 0.5  # of the residual, by the convention that is meant
_PART = 0.2  # share of the stations that agree as they are, from which another convention is none of all of them
_ROUNDS = 8  # iterations
_HOPELESS = 0.25  # of the reach; what the usual row misses by more no bad row has brought about
_NEAR = 3.0  # nominal deviations within which a nominal arm's readings lie (Gaussian: 99 % along each axis)


@dataclass(frozen=True)
class Match:
    """How well readings fit the nominal arm. score: log-likelihood less what parameters cost. angle [rad], position
    [m]: what is left, RMS over space. perfect: nothing could fit better. typical: median of the distances left [m].
    parts: that the recording was cut into.
    """

    score: float
    angle: float
    position: float
    perfect: bool
    typical: float
    typical_angle: float
    parts: int


def proved(samples: Samples, chain: Mechanism, stated: str | None = None) -> tuple[Samples, str | None]:
    """The samples with what can be undone undone, and what that was ("pose inverted"), None if nothing.

    stated: the Euler sequence that the readings were composed by, where it is known. Raises BadRecording, naming the
    match, where another convention is better beyond doubt. Readings without orientation, frames with few postures and
    robots other than serial arms pass unasked.
    """
    undone: str | None = None
    if not is_serial_arm(chain):
        return samples, undone
    for f, frame in enumerate(samples.frames):
        rows = np.flatnonzero((samples.frame == f) & samples.is_pose)
        different = rows[np.unique(distinct(samples.q[rows]), return_index=True)[1]]  # one posture proves one thing
        if len(different) < MIN_STATIONS:
            continue
        better = _better(samples.select(different), chain, stated)
        if better is None:
            continue
        mistake, before, after = better
        if mistake.offender == inverse_pose().offender:
            samples, undone = _inverted(samples, rows), INVERTED
            continue
        said = _said(before, after)
        gain = f"better by {after.score - before.score:.0f} in log-likelihood, {BEYOND_DOUBT:.0f} decides"
        raise BadRecording(f"readings in frame '{frame}': {mistake.offender}", f"{said} ({gain})", mistake.remedy)
    return samples, undone


def _inverted(samples: Samples, rows: np.ndarray) -> Samples:
    part = inverse_pose().undone(samples.select(rows))
    position, R = samples.reading.copy(), samples.R.copy()
    position[rows], R[rows] = part.reading, part.R
    return replace(samples, reading=position, R=R)


def _said(before: Match, after: Match) -> str:
    """By how much the nominal arm misses before and after: RMS, or the medians where these alone got better."""
    if _throughout(after, before):
        was, now, where = (before.angle, before.position), (after.angle, after.position), ""
    else:
        was, now = (before.typical_angle, before.typical), (after.typical_angle, after.typical)
        where = " at the median station"
    return (
        f"the nominal arm misses by {_degrees(was[0])} and {1e3 * was[1]:.3g} mm{where}, "
        f"with that undone by {_degrees(now[0])} and {1e3 * now[1]:.3g} mm"
    )


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.3g}°"


def _better(samples: Samples, chain: Chain, stated: str | None) -> tuple[Mistake, Match, Match] | None:
    """The mistake that was made beyond doubt, and how well the readings fit with it and without."""
    few, more = (thinned(samples, count) for count in (_FEW, _MAX))
    whole = match(more, chain, parts=(1,))
    if whole.perfect:
        return None
    mistakes = list(_all(samples.names, stated, turned=_turned(whole)))
    as_is, *roughly = rough_scores(few, chain, mistakes)
    plausible = [(score, i) for i, score in enumerate(roughly) if score > as_is - _REFINED * len(few)]
    if not plausible:  # as of almost every recording: nothing has to be fitted for it
        return None
    before = match(more, chain)
    if before.perfect:
        return None
    if not _turned(before):
        plausible = [(score, i) for score, i in plausible if mistakes[i].touches != "rotation"]
    found = [(score, i, mistakes[i]) for score, i in sorted(plausible, key=lambda c: (-c[0], c[1]))]
    parts = tuple(dict.fromkeys((1, before.parts)))  # where base or tool changed, they did so by any convention
    judged = [(match(m.undone(more), chain, m.log_volume, parts), i, m) for _, i, m in found[:_CANDIDATES]]
    judged = [c for c in judged if c[0].typical <= _AN_ARM * chain.reach() and _explains(c[0], before)]
    top = max((after.score for after, _, _ in judged), default=-np.inf)
    if top - before.score <= BEYOND_DOUBT:
        return None
    after, _, mistake = min((c for c in judged if c[0].score >= top - _ALIKE), key=lambda c: c[1])
    if not _throughout(after, before) and _a_part_agrees(more, chain):
        return None  # it brings some back and spoils others: of those stations :mod:`consistency` speaks
    return mistake, before, after


def _throughout(after: Match, before: Match) -> bool:
    """Whether the RMS got better with the median: no mean is spoiled where the usual station is brought back."""
    return after.angle <= before.angle and after.position <= before.position


def _a_part_agrees(samples: Samples, chain: Chain) -> bool:
    """Whether many stations agree with the arm as they are, so that no other convention is that of all."""
    placed, agree = placed_by_most(samples, chain)
    return placed is not None and float(agree.mean()) >= _PART


def _turned(found: Match) -> bool:
    """Whether orientations fit so badly that they alone may mean something else, as most candidates say."""
    return found.angle > _TURNED * _NOMINAL_ANGLE


def _explains(after: Match, before: Match) -> bool:
    """Whether what was left of orientations or positions is mostly gone: to be a little better is no explanation."""
    pairs = (
        (after.angle, before.angle),
        (after.typical_angle, before.typical_angle),
        (after.position, before.position),
        (after.typical, before.typical),
    )
    return any(now <= _MAX_LEFT * then for now, then in pairs)


def _all(names: tuple[str, ...], stated: str | None, turned: bool) -> Iterable[Mistake]:
    """turned: whether orientations alone may mean something else."""
    yield inverse_pose()
    if turned:
        yield from of_rotations(stated)
    yield from of_units()
    yield from of_axes()
    yield from of_joints(names)


def thinned(samples: Samples, most: int) -> Samples:
    """At most ``most`` samples, evenly along the recording."""
    order = np.argsort(samples.stamps, kind="stable")
    return samples.select(order[spread_rows(len(order), most)])


@dataclass(frozen=True)
class _Scale:
    """What a chain's residuals are measured with: standard deviations [rad, m] and volumes of what may say anything."""

    position: float
    extent: float
    rotation: float = _NOMINAL_ANGLE
    turns: float = 8.0 * np.pi**2

    @classmethod
    def of(cls, chain: Chain, position: Array) -> _Scale:
        reach = chain.reach()
        return cls(_NOMINAL_SHARE * reach, (4.0 * max(reach, float(np.ptp(position, axis=0).max()))) ** 3)

    def log_likelihood(self, turns: Array, gaps: Array) -> float:
        """Log-likelihood of rotation and position residuals (N, 3)."""
        return _log_likelihood(turns, self.rotation, self.turns) + _log_likelihood(gaps, self.position, self.extent)


def rough_scores(samples: Samples, chain: Chain, mistakes: Sequence[Mistake]) -> list[float]:
    """Log-likelihood of these poses as they are, and with each mistake undone, without the last refinement."""
    each = [samples, *(mistake.undone(samples) for mistake in mistakes)]
    position, R = (np.stack(x) for x in zip(*((s.reading, s.R) for s in each), strict=True))
    A = np.broadcast_to(forward(chain, samples.q), (len(each), len(samples), 4, 4)).copy()
    moved = [i for i, mistake in enumerate(mistakes, 1) if mistake.touches == "joints"]
    if moved:
        A[moved] = forward(chain, np.concatenate([each[i].q for i in moved])).reshape(len(moved), -1, 4, 4)
    a = A[..., :3, :3]
    # what says how the base is turned is the same where orientations alone are changed
    own = [0, *(i for i, mistake in enumerate(mistakes, 1) if mistake.touches != "rotation")]
    turned = np.zeros(len(each), int)
    turned[own] = np.arange(len(own))
    Y = base_by_positions(A[own], position[own])[turned]
    X = so3.nearest_rotation(np.sum(np.swapaxes(Y[:, None] @ a, -1, -2) @ R, axis=1))
    score = np.full(len(each), -np.inf)
    scales = [_Scale.of(chain, p) for p in position]
    for base, tool in (base_and_tool_turns(a, R), (Y, X)):
        turns, gaps = turns_left(base, a, tool, R), tool_and_place(base, A, position)[0]
        score = np.maximum(score, [s.log_likelihood(t, g) for s, t, g in zip(scales, turns, gaps, strict=True)])
    volume = [0.0, *(mistake.log_volume for mistake in mistakes)]
    return [float(x) for x in score + len(samples) * np.array(volume)]


def match(samples: Samples, chain: Chain, log_volume: float = 0.0, parts: tuple[int, ...] = _PARTS) -> Match:
    """How well these poses fit, cut into as many of these numbers of parts as pay.

    log_volume: by how much the readings' volume was shrunk to have them in metres, in logarithm.
    """
    A, size = forward(chain, samples.q), len(samples)
    scale = _Scale.of(chain, samples.reading)
    best: Match | None = None
    for count in parts:
        if count > 1 and size < count * _MIN_PART:
            continue
        left = [
            _together(A[rows], samples.R[rows], samples.reading[rows], scale)
            for rows in np.array_split(np.arange(size), count)
        ]
        total = sum(scale.log_likelihood(turns, gaps) for turns, gaps in left) + size * log_volume
        score = total * min(1.0, _INDEPENDENT / size) - 6.0 * count * np.log(size)  # BIC: half of twelve values a part
        turns, gaps = (np.concatenate(parts) for parts in zip(*left, strict=True))
        if best is None or score > best.score:
            typical, turned = (float(np.median(np.linalg.norm(x, axis=1))) for x in (gaps, turns))
            best = Match(float(score), _rms(turns), _rms(gaps), _perfect(turns, gaps, scale), typical, turned, count)
        if best.perfect:
            break
    assert best is not None
    return best


def points_match(
    chain: Chain, q: Array, position: Array, log_volume: float = 0.0, group: np.ndarray | None = None
) -> Match:
    """How well points (N, 3) [m] of the tool fit, as :func:`match` of poses; angles are zero. group: see below."""
    gaps, size, scale = points_left(chain, q, position, group), len(q), _Scale.of(chain, position)
    total = _log_likelihood(gaps, scale.position, scale.extent) + size * log_volume
    cost = 3.0 + 1.5 * (1 if group is None else len(np.unique(group)))
    score = total * min(1.0, _INDEPENDENT / size) - cost * np.log(size)
    typical = float(np.median(np.linalg.norm(gaps, axis=1)))
    return Match(float(score), 0.0, _rms(gaps), _perfect(np.zeros_like(gaps), gaps, scale), typical, 0.0, 1)


def points_left(chain: Chain, q: Array, position: Array, group: np.ndarray | None = None) -> Array:
    """What base and tool leave of points (N, 3) [m], fitted so that single bad rows do not move them.

    group: which target on the tool each is of (N,), where there are several; each has a place of its own.
    """
    A, scale = forward(chain, q), _Scale.of(chain, position)
    of = np.zeros(len(q), int) if group is None else np.unique(group, return_inverse=True)[1]
    best, most, rows = np.zeros((0, 3)), -np.inf, np.arange(len(q))
    for _ in range(2):  # from all rows, and from the half that then fits best
        Y = base_by_positions(A[None, rows], position[None, rows])[0]
        gaps = _refined_points(Y, A, position, of, scale)
        if (now := _log_likelihood(gaps, scale.position, scale.extent)) > most:
            best, most = gaps, now
        away = np.linalg.norm(gaps, axis=1)
        if not _NEAR * scale.position < np.median(away) < _HOPELESS * chain.reach():
            break
        rows = np.sort(np.argsort(away, kind="stable")[: max(len(q) // 2, 6)])
    return best


def _refined_points(Y: Array, A: Array, position: Array, of: np.ndarray, scale: _Scale) -> Array:
    """Residuals (N, 3) after robust Newton steps of the base's turn, its place, and a place of each target."""
    _, x0, t = tool_and_place(Y, A, position)
    x, N = np.tile(x0, (int(of.max()) + 1, 1)), len(A)
    for _ in range(_ROUNDS):
        point = (A[:, :3, :3] @ x[of][..., None])[..., 0] + A[:, :3, 3]
        gaps = position - (point @ Y.T + t)
        G = np.zeros((N, 3, 6 + x.size))
        G[:, :, :3] = -Y @ so3.hat(point)
        G[:, :, 3:6] = np.eye(3)
        for k in range(len(x)):
            G[of == k, :, 6 + 3 * k : 9 + 3 * k] = Y @ A[of == k, :3, :3]
        square = np.sum(gaps**2, axis=1)
        weight = 1.0 / (max(float(np.median(square)) / 2.366, scale.position**2) + square)  # Cauchy
        H = np.einsum("n,nij,nik->jk", weight, G, G)
        unit = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        g = np.einsum("n,nij,ni->j", weight, G, gaps)
        step = unit * np.linalg.solve(H * np.outer(unit, unit) + 1e-9 * np.eye(len(H)), unit * g)
        step = step / max(float(np.linalg.norm(step[:3])), 1.0)
        Y, t, x = Y @ so3.exp(step[:3]), t + step[3:6], x + step[6:].reshape(-1, 3)
        if np.linalg.norm(step[:3]) < 1e-6:
            break
    return position - ((A[:, :3, :3] @ x[of][..., None])[..., 0] + A[:, :3, 3]) @ Y.T - t


def is_astray(chain: Chain, position: Array, gaps: Array) -> np.ndarray:
    """Rows (N,) whose residuals (N, 3) are twenty times as likely of a reading that may say anything."""
    scale, square = _Scale.of(chain, position), np.sum(gaps**2, axis=1)
    sigma = max(scale.position, float(np.sqrt(np.median(square) / 2.366)))
    inside = np.log((1.0 - _ASTRAY) / (2.0 * np.pi * sigma**2) ** 1.5) - 0.5 * square / sigma**2
    return np.log(_ASTRAY / scale.extent) - inside > np.log(20.0)


def _perfect(turns: Array, gaps: Array, scale: _Scale) -> bool:
    """Whether readings fit as well as a nominal arm can, so that nothing can fit better."""
    turned, missed = np.linalg.norm(turns, axis=1), np.linalg.norm(gaps, axis=1)
    near = (turned < _NEAR * scale.rotation) & (missed < _NEAR * scale.position)
    return bool(near.mean() > 1.0 - _ASTRAY)


def _rms(residual: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


def _log_likelihood(residual: Array, floor: float, volume: float) -> float:
    """Log-likelihood of residuals (N, 3), maximised over the standard deviation per axis, which is at least ``floor``.

    A share of them is spread evenly over the volume.
    """
    square = np.sum(residual**2, axis=1)
    sigma = floor * 2.0 ** np.arange(24.0)
    sigma = sigma[sigma <= 2.0 * max(floor, float(np.sqrt(square.max())))][:, None]
    inside = (1.0 - _ASTRAY) * np.exp(-0.5 * square / sigma**2) / (2.0 * np.pi * sigma**2) ** 1.5
    return float(np.log(inside + _ASTRAY / volume).sum(axis=1).max())


def _together(A: Array, R: Array, position: Array, scale: _Scale) -> tuple[Array, Array]:
    """Residuals (N, 3) of rotations [rad] and positions [m], base and tool fitted to both from the better start."""
    Y = base_by_positions(A[None], position[None])[0]
    starts = base_and_tool_turns(A[:, :3, :3], R), (Y, so3.mean(np.swapaxes(Y @ A[:, :3, :3], 1, 2) @ R))
    each = [_refined(Y, X, A, R, position, scale) for Y, X in starts]
    return max(each, key=lambda left: scale.log_likelihood(*left))


def _refined(Y: Array, X: Array, A: Array, R: Array, position: Array, scale: _Scale) -> tuple[Array, Array]:
    """Residuals after robust Newton steps of base and tool from here."""
    a = A[:, :3, :3]
    gaps, x, t = tool_and_place(Y, A, position)
    for _ in range(_ROUNDS):
        turns = turns_left(Y, a, X, R)
        gaps = position - (se3.apply(A, x) @ Y.T + t)
        # rows: turn of the base, turn of the tool, tool point, base's place
        G = np.zeros((2, len(A), 3, 12))
        G[0, :, :, :3] = np.swapaxes(a @ X, 1, 2)
        G[0, :, :, 3:6] = np.eye(3)
        G[1, :, :, :3] = -Y @ so3.hat(se3.apply(A, x))
        G[1, :, :, 6:9] = Y @ a
        G[1, :, :, 9:] = np.eye(3)
        r = np.stack([turns, gaps])
        square = np.sum(r**2, axis=2)
        least = np.array([scale.rotation, scale.position]) ** 2
        typical = np.maximum(np.median(square, axis=1) / 2.366, least)[:, None]
        weight = 1.0 / (typical + square)  # Cauchy
        flat, weighted = G.reshape(-1, 12), (weight[..., None, None] * G).reshape(-1, 12)
        H, g = flat.T @ weighted, weighted.T @ r.ravel()
        unit = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        step = unit * np.linalg.solve(H * np.outer(unit, unit) + 1e-9 * np.eye(12), unit * g)
        if (size := float(np.linalg.norm(step[:6]))) > 1.0:
            step = step / size
        Y, X, x, t = Y @ so3.exp(step[:3]), X @ so3.exp(step[3:6]), x + step[6:9], t + step[9:]
        if size < 1e-6:
            break
    return turns_left(Y, a, X, R), tool_and_place(Y, A, position)[0]
