"""First guesses of a motion, robust to any share of gross outliers below a half: MLESAC over few samples.

Torr and Zisserman, MLESAC (2000): motions through randomly chosen samples are scored by a likelihood that is cut off
where an outlier begins, and the best are kept. Three positions give a circle, two a line, two poses a screw motion.
Samples are drawn by their order only, so a track that is moved or mirrored gets the moved or mirrored guesses.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from modcal_core.articulation.joints import Kind
from modcal_core.articulation.motion import PITCH, RADIUS, Motion
from modcal_core.articulation.track import Track
from modcal_core.geometry.single import crossed
from modcal_core.geometry.so3 import Array
from modcal_core.robots.posture import rotation_vector

_TRIES = 40
_CIRCLES = 6  # of them that are tried as threads
_SLOPES = (-0.4, -0.15, -0.04, 0.04, 0.15, 0.4)  # rad, of a thread against its circle
_SCORED = 50  # samples that a guess is scored on
ROUGH = (5e-3, 0.07)  # m and rad: noise when nothing is known of it yet
_CUT = 9.0  # squared, normalised residual at which an outlier begins
_PAIRS = 10


def seeds(track: Track, kind: Kind, rng: np.random.Generator, keep: int = 2, tries: int = _TRIES) -> list[Motion]:
    """The best few first guesses of a motion of this kind, best first, of so many tries."""
    rows = np.unique(np.linspace(0, len(track) - 1, _SCORED).round().astype(int))
    few = track.part(rows)
    if kind == "rigid":
        p = np.median(track.positions, axis=0)
        return [Motion("rigid", p, np.eye(3), None if track.rotations is None else middle_rotation(track.rotations))]
    best = best_of(_guesses(few, kind, rng, tries), few, keep if kind != "screw" else _CIRCLES)
    if kind == "screw":
        best = best_of((thread for circle in best for thread in _threads(circle, few)), few, keep + 1)
    return best or [_fallback(few, kind)]


def best_of(guesses: Iterable[Motion], track: Track, keep: int) -> list[Motion]:
    """The best of these guesses, best first, by a likelihood that is cut off."""
    sound = [g for g in guesses if np.isfinite(g.p).all() and np.isfinite(g.G).all()]
    scored = sorted((_score(g, track), i) for i, g in enumerate(sound))
    return [sound[i] for _, i in scored[:keep]]


def rough(track: Track, kind: Kind, circle: Motion | None, turn: int) -> Motion | None:
    """One quick guess, from the two samples that lie farthest apart and one between; None where there is none.

    circle: from which a screw is begun, with a rise whose sign and size change with turn.
    """
    p, R = track.positions, track.rotations
    middle = p - p.mean(axis=0)
    first = int(np.argmax((middle * middle).sum(axis=1)))
    away = ((p - p[first]) ** 2).sum(axis=1)
    last = int(np.argmax(away))
    between = int(np.argmin(np.abs(away - 0.25 * away[last])))
    hold = None if R is None else R[between]
    if kind == "rigid":
        return Motion(kind, p.mean(axis=0), np.eye(3), hold)
    if kind == "prismatic":
        d = p[last] - p[first]
        return Motion(kind, p[between], _frame(d, None), hold) if np.linalg.norm(d) > 1e-6 else None
    if kind == "revolute":
        of_poses = None if R is None or turn % 2 else _of_poses(p[first], R[first], p[last], R[last])
        circle = of_poses or _of_points(p[first], p[between], p[last], hold)
        d = p[last] - p[first]
        # three on a line lie on no circle, but on many that are wide
        return circle or (Motion(kind, p[between], _frame(d, None), hold) if np.linalg.norm(d) > 1e-6 else None)
    if circle is None:
        return None
    slope = _SLOPES[turn % len(_SLOPES)]
    s, c = np.sin(slope), np.cos(slope)
    t, n, b = circle.G.T
    r = circle.r * c * c
    return Motion(
        "screw", circle.p, np.stack([c * t - s * b, n, s * t + c * b], axis=1), circle.R, r, _pitch(r * s / c)
    )


def _score(guess: Motion, track: Track) -> float:
    """Cut-off negative log-likelihood."""
    e = guess.residuals(track, guess.configurations(track, ROUGH))
    z = (e[:, :3] ** 2).sum(axis=1) / ROUGH[0] ** 2
    if e.shape[1] == 6:
        z = np.minimum(z, _CUT) + np.minimum((e[:, 3:] ** 2).sum(axis=1) / ROUGH[1] ** 2, _CUT)
    cost = float(np.minimum(z, 2.0 * _CUT if e.shape[1] == 6 else _CUT).sum())
    # The rise of a thread and the width of a circle are bounded by what exists; ties go to the nearer axis.
    return cost + (1e-3 * abs(np.log(guess.r / 0.4)) if guess.turns else 0.0)


def _guesses(track: Track, kind: Kind, rng: np.random.Generator, tries: int) -> Iterator[Motion]:
    p, R, n = track.positions, track.rotations, len(track)
    for t in range(tries):
        i, j, k = np.sort(rng.choice(n, 3, replace=False))
        if kind == "prismatic":
            d = p[k] - p[i]
            if np.linalg.norm(d) > 1e-9:
                yield Motion(kind, p[j], _frame(d, None), None if R is None else R[j])
            continue
        if R is not None and t % 2:
            guess = _of_poses(p[i], R[i], p[k], R[k])
        else:
            guess = _of_points(p[i], p[j], p[k], None if R is None else R[j])
        if guess is None:
            continue
        yield guess


def _threads(circle: Motion, track: Track) -> Iterator[Motion]:
    """Helices that touch a circle and bend as it does, for a few slopes; and the circle with the rise that is seen."""
    t, n, b = circle.G.T
    for slope in _SLOPES:
        s, c = np.sin(slope), np.cos(slope)
        r = circle.r * c * c
        yield Motion(
            "screw", circle.p, np.stack([c * t - s * b, n, s * t + c * b], axis=1), circle.R, r, _pitch(r * s / c)
        )
    a = circle.configurations(track, ROUGH)
    rise = ((track.positions - circle.p) @ circle.G)[:, 2]
    i = np.arange(len(a))
    j = (i + len(a) // 2) % len(a)
    apart = np.abs(a[i] - a[j]) > 1e-3
    if apart.any():
        h = float(np.median((rise[i] - rise[j])[apart] / (a[i] - a[j])[apart]))
        yield Motion("screw", circle.p, circle.G, circle.R, circle.r, _pitch(h))


def _pitch(h: float) -> float:
    return float(np.copysign(np.clip(abs(h), *PITCH), h))


def _of_points(a: Array, b: Array, c: Array, R: Array | None) -> Motion | None:
    """The circle through three points, beginning at the middle one."""
    u, v = a - b, c - b
    w = crossed(u, v)
    ww = float(w @ w)
    if ww < 1e-16:
        return None
    arm = (float(u @ u) * crossed(v, w) + float(v @ v) * crossed(w, u)) / (2.0 * ww)
    return _circle(b, arm, -w, R)


def _of_poses(p1: Array, R1: Array, p2: Array, R2: Array) -> Motion | None:
    """The circle that brings one pose to another, beginning at the first."""
    w = rotation_vector(R2 @ R1.T)
    angle = math.sqrt(w @ w)
    if angle < 0.02:
        return None
    axis, d = w / angle, p2 - p1
    d = d - axis * (axis @ d)
    arm = 0.5 * (d + crossed(axis, d) / math.tan(0.5 * angle))
    return _circle(p1, arm, axis, R1)


def _circle(p: Array, arm: Array, axis: Array, R: Array | None) -> Motion | None:
    r = math.sqrt(arm @ arm)
    if not RADIUS[0] < r < RADIUS[1]:
        return None
    n, d = arm / r, axis / math.sqrt(axis @ axis)
    return Motion("revolute", p, np.array([crossed(n, d), n, d]).T, R, r)


def _frame(e: Array, n: Array | None) -> Array:
    """A frame (3, 3) whose first axis is along e."""
    e = e / math.sqrt(e @ e)
    n = np.eye(3)[int(np.argmin(np.abs(e)))] if n is None else n
    n = n - e * (e @ n)
    n = n / math.sqrt(n @ n)
    return np.array([e, n, crossed(e, n)]).T


def _fallback(track: Track, kind: Kind) -> Motion:
    """Something to begin with where no sample differs from another."""
    G = _frame(np.linalg.svd(track.positions - track.positions.mean(axis=0))[2][0], None)
    R = None if track.rotations is None else middle_rotation(track.rotations)
    return Motion(kind, track.positions[0], G, R, 0.4, 0.01 if kind == "screw" else 0.0)


def middle_rotation(rotations: Array) -> Array:
    """Of the rotations, one that is near most: outliers cannot pull it."""
    some = rotations[np.unique(np.linspace(0, len(rotations) - 1, _PAIRS * 3).round().astype(int))]
    apart = np.linalg.norm(some[:, None] - some[None], axis=(2, 3))
    return some[int(np.argmin(np.median(apart, axis=1)))]
