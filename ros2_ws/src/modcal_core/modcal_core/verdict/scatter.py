"""What the rest scatters with: a variance that one place has beyond the others, or two values of one.

Nothing predicts such an error, and returns take it for what the arm does not repeat. But each station's residual is
drawn from a covariance that says where it comes from: a sum of v Z Zᵀ over the motions Z of what may scatter. Joints of
one arm are alike and have one variance; an instrument has those of distances, of angles, of places and of turns. To
these a candidate is added: a joint, the base or the tool with a covariance of all its directions, the way of the target
in motion. It is named where the likelihood is beyond doubt higher with it (random effects by the EM algorithm; Laird &
Ware 1982) and most of the error is its own, more than the mean predicts (:mod:`predictable`). What has two values along
a motion, and none between, is told from scatter (clusterwise regression; Späth 1979).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import eigh

from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import is_serial_arm
from modcal_core.verdict.rest import Rest

MIN_STATIONS = 40  # a covariance of a body has 21 numbers
_MAX = 240  # samples, for time; more are thinned evenly
_BEYOND_DOUBT = 50.0  # difference of log-likelihoods beyond the price of the numbers (BIC), as of conventions
_MOSTLY = 0.5  # share of the squared error of positions, or of orientations: most of it
_TIMES = 3.0  # the scatter of the usual joint; sizes of gears and encoders in one arm differ by about two
_ODDS = float(np.log(20.0))  # difference from joints of which the named ones are louder by no more than that
_ROUNDS, _SETTLED = 60, 0.1  # of the EM algorithm, and the gain in log-likelihood at which it ends
_MIN_TIME = 0.2  # ms; less is what clocks of computers are apart by
_SEPARATE = 0.85  # share of the squares along a motion that two values explain; of a wave, the next most, it is 0.81
_MIN_OF_THEM = 0.1  # share of the samples in the smaller group
_PLAINER = 0.9  # of the best share; a joint's axis is plainer than six directions
_EACH, _SHOWN = 10, 1e-3  # components a direction, that two arms are told by; of the largest, that a direction shows
_BITS, _BIT = (6, 24), 0.03  # that encoders have; of its size, to which a step is taken for one of a bit


@dataclass(frozen=True)
class _Part:
    """What may scatter. Z: motions in units of the noise, of unit size in the mean, (N, 6, d). size: what they were
    divided by, (d,). unit: of a thousandth of an amplitude, as text; empty of bodies. full: whether it has a covariance
    of all its directions, and not one variance.
    """

    who: str
    Z: Array
    size: Array
    unit: str = ""
    full: bool = False

    @classmethod
    def of(cls, who: str, columns: Array, unit: str = "", full: bool = False) -> _Part:
        """Of columns (d, 6, N)."""
        size = np.maximum(np.sqrt(np.mean(np.sum(columns**2, axis=1), axis=1)), 1e-300)
        return cls(who, (columns / size[:, None, None]).transpose(2, 1, 0), size, unit, full)

    @property
    def columns(self) -> Array:
        """The motions as (d, 6, N)."""
        return self.Z.transpose(2, 1, 0)

    def at(self, rows: np.ndarray) -> _Part:
        """The same of some samples."""
        return replace(self, Z=self.Z[rows])


@dataclass(frozen=True)
class _Fit:
    """height: log-likelihood. free: covariance of each part, (d, d)."""

    height: float
    free: list[Array]


def scatter(rest: Rest, predicted: Array | None = None, most: float = np.inf) -> str:
    """A sentence where most of a rest is scatter of one place, and more than the mean explains; else an empty one.

    predicted: of the rest, (6, N), where that is sure. most: share of the squares by which returns differ; scatter
    shows in these, and what does not is a function of the posture.
    """
    moving = bool(rest.samples.moving.any())
    rows = np.flatnonzero(rest.samples.moving == moving)
    rows = rows[spread_rows(len(rows), _MAX)]
    if len(rows) < MIN_STATIONS or not _asked(rest):
        return ""
    whole = rest.residual.T[rows]
    left = whole if predicted is None else whole - predicted.T[rows]
    joints = _joints(rest)
    parts = [part.at(rows) for part in ([_way(rest)] if moving else [*joints, *_bodies(rest)])]
    parts = _candidates(left, parts)
    if not parts:
        return ""
    usual = [part.at(rows) for part in (*_alike(rest, joints), *_of_instrument(rest))]
    named, fit = _selected(left, usual, parts)
    covariances = fit.free[len(usual) :]
    share = _share(whole, left, named, covariances)
    if not _MOSTLY <= share <= most:
        return ""
    unit = named[0].unit
    if not unit:
        return _of_body(named[0], covariances[0], rest.weight[:, rows], share)
    sizes = [1e3 * float(np.sqrt(C[0, 0]) / part.size[0]) for part, C in zip(named, covariances, strict=True)]
    if moving:
        return _of_way(sizes[0], share) if sizes[0] > _MIN_TIME else ""
    own = [_share(whole, left, [part], [C]) for part, C in zip(named, covariances, strict=True)]
    same = next(k for k, part in enumerate(usual) if part.unit == unit)
    others = 1e3 * float(np.sqrt(fit.free[same][0, 0]) / usual[same].size[0])
    found = {p.who: s for p, s, o in zip(named, sizes, own, strict=True) if s > _TIMES * others and o > 0.5 * _MOSTLY}
    loud = {part.who: found[part.who] for part in joints if part.who in found}
    limited = [part.at(rows) for part in (*_alike(rest, joints, tuple(loud)), *_of_instrument(rest))]
    within = _likelihood(left, limited, [part for part in named if part.who not in loud])
    return _of_joints(loud, others, unit, share) if loud and fit.height > within.height + _ODDS else ""


def _selected(left: Array, usual: Sequence[_Part], parts: list[_Part]) -> tuple[list[_Part], _Fit]:
    """The part, or the two joints, with which what is left (N, 6) is beyond doubt likelier; none at all otherwise."""
    named: list[_Part] = []
    fit = _likelihood(left, usual)
    while parts and len(named) < 2:
        found = [(_likelihood(left, usual, (*named, part)), part) for part in parts]
        best, part = max(found, key=lambda f: f[0].height - _price(f[1], len(left)))
        if best.height - _price(part, len(left)) < fit.height + _BEYOND_DOUBT:
            break
        fit, named = best, [*named, part]
        parts = [p for p in parts if p is not part and p.unit and p.unit == part.unit]
    return named, fit


def two_values(rest: Rest, fitted: bool) -> str:
    """A sentence where most of a rest falls into two groups along a motion of one place; else an empty one.

    For each candidate the residual is written as U (c ± θ), with the sign of each station and θ found in turn. Two
    groups must take away half of the squares, and along the motion they must be separate: within normal scatter the
    best two explain 2/π of it, of a uniform distribution 3/4, of a wave 8/π², and beyond these only what is two-valued.
    Along all of an arm's directions together they must take away nearly all: of noise they take 0.8 at most there.
    fitted: whether base, tool and joints fit these very samples.
    """
    if len(rest.samples) < MIN_STATIONS or not _asked(rest):
        return ""
    joints, (tool, base) = _joints(rest), _bodies(rest, every=True)
    residual = rest.raw
    if not fitted:  # what moved since a calibration is not in two places where stations are near two postures
        flat = np.concatenate([part.columns for part in (base, tool, *joints)]).reshape(-1, residual.size)
        residual = residual - (np.linalg.lstsq(flat.T, residual.ravel(), rcond=1e-9)[0] @ flat).reshape(6, -1)
    alone = [replace(base, who="the tracker, in its positions,", Z=base.Z[..., :3], size=base.size[:3])]
    arms = _whole_arm(rest)
    found: list[tuple[int, float, str]] = []
    for part in (*joints, tool, base, *(alone if len(rest.view.pose) else []), *arms):
        seen = slice(0, 3) if part in alone else slice(0, 6)
        split = _split(part.columns[:, seen], residual[seen])
        if split is not None and (split[0] >= _PLAINER or part not in arms):
            share, sign, theta = split
            few = int(min((sign > 0.0).sum(), (sign < 0.0).sum()))
            who = f"joint {part.who}" if part.unit else part.who
            apart = _apart(part, theta, rest.weight)
            as_if = f"{who} had two positions" if part not in arms else "two arms, or two states of one, had been mixed"
            sentence = (
                f"The residual falls into two groups of {few} and {len(sign) - few} stations, {apart} apart, as if "
                f"{as_if} ({share:.0%} of the squared error): that is not scatter."
            )
            found.append((2 * (part in arms) + (not part.unit), -share, sentence))
    best = min((share for _, share, _ in found), default=0.0)
    return next((said for _, share, said in sorted(found) if share <= _PLAINER * best), "")


def _whole_arm(rest: Rest) -> list[_Part]:
    """All that readings show of an arm's geometry at once, where there are enough of them."""
    columns = np.concatenate([rest.body(place) for place in range(rest.chain.tool_place + 1)])
    U, size, _ = np.linalg.svd(columns.reshape(len(columns), -1).T, full_matrices=False)
    U = U[:, size > _SHOWN * size[0]]
    few = int((rest.weight > 0.0).sum()) < _EACH * U.shape[1]
    return [] if few else [_Part.of("", U.T.reshape(-1, *columns.shape[1:]), full=True)]


def along(rest: Rest) -> tuple[str, float] | None:
    """The joint along whose motion most of a rest lies, station by station, with base or tool beside it where these
    account for as much, and the share. None if there is no such joint.
    """
    if not _asked(rest):
        return None
    left, bodies = rest.residual.T, _bodies(rest, every=True)
    parts = [*_joints(rest), *(_Part.of(body.who, _leading(body, left)[None]) for body in bodies)]
    # a residual that points anywhere lies along a motion by one part in as many as a reading has components
    chance = 1.0 / max(float(np.mean(np.sum(rest.weight > 0.0, axis=0))), 1.0)
    shares = [(share - chance) / (1.0 - chance) for share in _along(left, parts)]
    named = [part for part, share in zip(parts, shares, strict=True) if share >= _PLAINER * max(shares)]
    if max(shares) < _MOSTLY or not any(part.unit for part in named):
        return None
    return ", or of ".join(f"joint {part.who}" if part.unit else part.who for part in named), max(shares)


def _leading(part: _Part, left: Array) -> Array:
    """The one direction of a body along which most of what is left (N, 6) lies, as a column (6, N)."""
    along = np.einsum("nid,ni->nd", part.Z, left)
    size = np.tensordot(part.Z, part.Z, axes=([0, 1], [0, 1]))
    held = size + 1e-9 * np.trace(size) * np.eye(len(size))
    return np.asarray((part.Z @ eigh(along.T @ along, held)[1][:, -1]).T)


def _asked(rest: Rest) -> bool:
    """Whether the arm and its readings are of a kind whose scatter is known."""
    return is_serial_arm(rest.chain) and is_direct(rest.samples.kinds)


def _joints(rest: Rest) -> list[_Part]:
    chain = rest.chain
    units = ["mrad" if turns else "mm" for turns in chain.revolute]
    return [_Part.of(name, rest.axis(j)[None], units[j]) for j, name in enumerate(chain.names)]


def _alike(rest: Rest, joints: list[_Part], loud: Sequence[str] = ()) -> list[_Part]:
    """The joints that turn, and those that slide, with one variance each. loud: those that scatter more by a factor."""
    out = []
    for unit in dict.fromkeys(part.unit for part in joints):
        some = [part for part in joints if part.unit == unit]
        Z = np.concatenate([part.Z * part.size * (_TIMES if part.who in loud else 1.0) for part in some], axis=2)
        size = np.sqrt(np.mean(np.sum(Z**2, axis=(1, 2))))
        out.append(_Part("", Z / size, np.array([size]), unit))
    return out


def _bodies(rest: Rest, every: bool = False) -> list[_Part]:
    """Tool and base, where poses show all their directions; or those directions that readings show."""
    if not every and (rest.samples.sockets or not rest.samples.is_pose.all()):
        return []
    names = ("the tool (or the target on it)", "the base (or the tracker)")
    bodies = [rest.body(place) for place in (rest.chain.tool_place, 0)]
    shown = [body[np.abs(body).max(axis=(1, 2)) > 0.0] for body in bodies]
    return [_Part.of(who, body, full=True) for who, body in zip(names, shown, strict=True)]


def _way(rest: Rest) -> _Part:
    """The way of the target in motion, per second."""
    speed = np.nan_to_num(rest.samples.velocity)
    way = np.sum([rest.axis(j) * speed[:, j] for j in range(rest.chain.n)], axis=0)
    return _Part.of("", way[None], "ms")


def _of_instrument(rest: Rest) -> list[_Part]:
    """Distances, angles, places and turns that an instrument scatters by."""
    x, N = rest.view.expected, len(rest.samples)
    x = x / max(float(np.abs(x).max()), 1e-9)
    every = np.broadcast_to(np.eye(3)[..., None], (3, 3, N))
    across = np.stack([np.cross(x.T, axis).T for axis in np.eye(3)])
    sights = [_Part.of("", columns) for columns in (rest.read(x)[None], rest.read(across))]
    alone = [_Part.of("", columns, full=True) for columns in (rest.read(every), rest.turned(every)) if columns.any()]
    return [*sights, *alone]


def _candidates(left: Array, parts: list[_Part]) -> list[_Part]:
    """Those that may be what most of it is: joints along which much of it lies, and the likelier of two bodies.

    Maps between places of a rigid motion keep volumes, so the place where the scatter has the smallest covariance
    determinant is the likeliest.
    """
    along = _along(left, parts)
    likely = [part for part, share in zip(parts, along, strict=True) if part.unit and share > 0.5 * _MOSTLY]
    bodies = [part for part in parts if not part.unit]
    if bodies:
        here = _volume(left)
        carried = [np.asarray(np.linalg.solve(p.Z * p.size, left[..., None])[..., 0]) for p in bodies]
        gains = [0.5 * len(left) * (here - _volume(twists)) for twists in carried]
        k = int(np.argmax(gains))
        likely += [bodies[k]] if gains[k] > _BEYOND_DOUBT else []
    return likely


def _along(left: Array, parts: Sequence[_Part]) -> list[float]:
    """Shares of the squares of what is left (N, 6) that lie along motions, at most."""
    whole = max(float(np.sum(left**2)), 1e-300)
    axes = [part.Z[..., 0] for part in parts]
    return [
        float(np.sum(np.sum(z * left, axis=1) ** 2 / np.maximum(np.sum(z**2, axis=1), 1e-300))) / whole for z in axes
    ]


def _by_kind(x: Array) -> Array:
    """Sums of squares of positions and of orientations, (2,), of (N, 6)."""
    return np.array([np.sum(x[:, :3] ** 2), np.sum(x[:, 3:] ** 2)])


def _volume(x: Array) -> float:
    """Logarithm of the determinant of the covariance of x (N, 6) about zero."""
    size = np.sqrt(np.mean(x**2, axis=0))
    return float(np.linalg.slogdet(x.T @ x / len(x) / np.outer(size, size))[1] + 2.0 * np.log(size).sum())


def _price(part: _Part, count: int) -> float:
    """What the numbers of a covariance cost, by the Bayesian information criterion."""
    d = len(part.size)
    return 0.25 * d * (d + 1) * float(np.log(count))


def _share(whole: Array, left: Array, named: Sequence[_Part], covariances: Sequence[Array]) -> float:
    """Share of the squares of all (N, 6), of positions or of orientations, that what is named makes; none where the
    mean explains more of them.
    """
    if not named:
        return 0.0
    made = np.sum([np.einsum("nip,pq,niq->ni", p.Z, C, p.Z) for p, C in zip(named, covariances, strict=True)], axis=0)
    squares = _by_kind(np.sqrt(made))
    wins = squares > _by_kind(whole) - _by_kind(left)
    return float(np.where(wins, squares / np.maximum(_by_kind(whole), 1e-300), 0.0).max().clip(max=1.0))


def _likelihood(left: Array, usual: Sequence[_Part], named: Sequence[_Part] = ()) -> _Fit:
    """The likeliest variance of each usual part and covariance of each named one, of what is left (N, 6).

    Each begins from above, with all that lies along it: from below, the algorithm stalls.
    """
    parts = (*usual, *named)
    Z, N = np.concatenate([part.Z for part in parts], axis=2), len(left)
    ends = np.cumsum([0, *(part.Z.shape[2] for part in parts)])
    blocks = [slice(a, b) for a, b in pairwise(ends.tolist())]
    C = np.zeros((Z.shape[2], Z.shape[2]))
    for block in blocks:
        moved = float(np.sum(Z[..., block] ** 2))  # nothing of a joint that does not move what is read
        C[block, block] = np.eye(block.stop - block.start) * (np.sum(left**2) / moved if moved > 0.0 else 0.0)
    best = _Fit(-np.inf, [])
    for _ in range(_ROUNDS):
        S = Z @ C @ Z.transpose(0, 2, 1) + 1e-9 * np.eye(Z.shape[1])
        inverse = np.linalg.inv(S)
        u = np.einsum("nij,nj->ni", inverse, left)
        height = -0.5 * float(np.sum(np.linalg.slogdet(S)[1]) + np.sum(u * left))
        if height < best.height + _SETTLED:
            break
        best = _Fit(height, [C[block, block] for block in blocks])
        b, A = np.einsum("nid,ni->nd", Z, u), inverse @ Z
        seen, expected = np.sum(b**2, axis=0), np.sum(A * Z, axis=(0, 1))
        C = np.zeros_like(C)
        for one, block, old in zip((not p.full for p in parts), blocks, best.free, strict=True):
            if one:  # one variance: by the square root of the ratio, which is quicker
                C[block, block] = old * np.sqrt(seen[block].sum() / max(float(expected[block].sum()), 1e-300))
            else:
                inner = np.tensordot(Z[..., block], A[..., block], axes=([0, 1], [0, 1]))
                C[block, block] = old + old @ (b[:, block].T @ b[:, block] - inner) @ old / N
    return best


def _split(columns: Array, residual: Array) -> tuple[float, Array, Array] | None:
    """(share of the squares explained, signs (N,), θ (d,)) of the best two groups, None where they are no two."""
    d = len(columns)
    flat, r = columns.reshape(d, -1), residual.ravel()
    gram = flat @ flat.T
    held = 1e-9 * float(np.trace(gram)) / d * np.eye(2 * d)
    level = residual - np.tensordot(np.linalg.solve(gram + held[:d, :d], flat @ r), columns, axes=1)
    total = max(float(np.sum(level**2)), 1e-300)
    best: tuple[float, Array, Array, float] | None = None
    for start in columns:
        sign = np.where(np.sum(start * level, axis=0) > 0.0, 1.0, -1.0)
        for _ in range(_ROUNDS // 5):
            signed = (columns * sign).reshape(d, -1)
            cross = flat @ signed.T
            both = np.linalg.solve(np.block([[gram, cross], [cross.T, gram]]) + held, np.r_[flat @ r, signed @ r])
            off = residual - np.tensordot(both[:d], columns, axes=1)
            along = np.tensordot(both[d:], columns, axes=1)
            new = np.where(np.sum(along * off, axis=0) > 0.0, 1.0, -1.0)
            if (new == sign).all():
                break
            sign = new
        share = 1.0 - float(np.sum((off - sign * along) ** 2)) / total
        if best is None or share > best[0]:
            best = share, sign, np.asarray(both[d:]), _separate(off, along, sign)
    assert best is not None
    share, sign, theta, separate = best
    few = min(float(np.mean(sign > 0.0)), float(np.mean(sign < 0.0)))
    return (share, sign, theta) if share >= _MOSTLY and separate >= _SEPARATE and few >= _MIN_OF_THEM else None


def _separate(off: Array, along: Array, sign: Array) -> float:
    """Share of the squares along the motion (C, N) that the two groups explain."""
    weight = np.maximum(np.sum(along**2, axis=0), 1e-300)
    place = np.sum(along * off, axis=0) / weight
    mean = float(np.average(place, weights=weight))
    spread = max(float(np.average((place - mean) ** 2, weights=weight)), 1e-300)
    return 1.0 - float(np.average((place - sign) ** 2, weights=weight)) / spread


def _of_joints(loud: Mapping[str, float], others: float, unit: str, share: float) -> str:
    who, one = " and ".join(loud), len(loud) == 1
    see = "See its encoder, coupling and brake, and whether it stands"
    see = see if one else "See their encoders, couplings and brakes, and whether they stand"
    return (
        f"{f'Joint {who} scatters by' if one else f'Joints {who} scatter by at least'} {min(loud.values()):.2g} {unit} "
        f"RMS and each of the others by {others:.2g} {unit} ({share:.0%} of the squared error). {see} still when "
        "readings are taken; if the arm is like that, state its repeatability."
    )


def _of_body(part: _Part, covariance: Array, weight: Array, share: float) -> str:
    made = np.einsum("nip,pq,niq->in", part.Z, covariance, part.Z) / np.maximum(weight, 1e-300) ** 2
    moved, turned = (float(np.sqrt(made[some].sum(axis=0).mean())) for some in (slice(0, 3), slice(3, 6)))
    return (
        f"Most of what is left ({share:.0%} of the squared error) is scatter of {part.who}, which stands elsewhere at "
        f"each station ({1e3 * moved:.2g} mm and {np.degrees(turned):.2g}° RMS at the target) in a way that neither "
        "joints nor the instrument scatter. See how it is fixed; if the cell is like that, state its repeatability."
    )


def _of_way(ms: float, share: float) -> str:
    return (
        f"Most of what is left while the arm moves ({share:.0%} of the squared error) lies along the direction of "
        f"motion: as if the stamps of readings were off by {ms:.2g} ms RMS, each by another time. Look at how readings "
        "and joint states are stamped (a busy computer, buffers, the time of arrival), or record at rest."
    )


def _apart(part: _Part, theta: Array, weight: Array) -> str:
    """The size between two values, as text."""
    if not part.unit:
        moved = np.tensordot(theta, part.columns, axes=1)[:3] / weight[:3]
        return f"{2e3 * float(np.sqrt(np.mean(np.sum(moved**2, axis=0)))):.3g} mm"
    step = 2.0 * abs(float(theta[0] / part.size[0]))
    bits = np.log2(2.0 * np.pi / step)
    whole = _BITS[0] <= round(bits) <= _BITS[1] and abs(2.0 ** (round(bits) - bits) - 1.0) < _BIT
    whole = whole and part.unit == "mrad"
    bit = f", 1/{2 ** round(bits)} of a turn, as an encoder's bit is," if whole else ""
    return f"{1e3 * step:.3g} {part.unit}{bit}"
