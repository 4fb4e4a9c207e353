"""How far the arm's model is off at the tool, in millimetres, with an interval: over postures, from the fit alone.

What counts is where the model has a point of the tool in the frame of the other half: the flange in the target's frame
where the camera is carried, in the camera's where the target is. Errors over M postures are drawn from the fit's
covariance; each draw has one RMS, and the interval is that of the draws. Of the nominal arm, camera and target placed
by the same images, the same draws say what it is off by, so that the two can be compared draw by draw. What each image
has of its own, joints that do not repeat and whatever no parameter describes, is part of both.

Every statement that may be wrong has draws of its own. Where it is in doubt, the interval holds either way: from the
lower of both lower ends to the upper of both upper ones; else it holds if the statement is right. In the chance of an
arm made worse they always count, each by its chance, for that may be one in two hundred.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import beyond_normal
from modcal_core.camera.causes import at_flange, flange_in_tool, flange_motions, frame_basis
from modcal_core.camera.contradicted import IN_DOUBT, SIZE, DoubtedStatement
from modcal_core.camera.corners import COMMON, READOUT, CornerTable
from modcal_core.camera.equations import Equations, Sizes
from modcal_core.camera.fit import CameraFit, usual
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.mounting import Mounting
from modcal_core.geometry import Array, se3
from modcal_core.robots import Chain

_INSIDE_INTERVAL = 0.95  # of the draws, as an interval of 95 % says
_PLACES = 51  # at which an interval is tried, a thousandth apart
_DRAWS = 2000  # for the ends of a 95 % interval to within a few per cent of themselves
_POSTURES = 150  # which give the RMS over a range of joints to a few per cent
_TRIES = 20  # postures drawn for each that shows the target
_MIN_SEEN = 20  # postures that show the target, below which those of the images are taken
# Of a body, between two lines of sight: markers are read up to some 60° off square, so turned by half of that most of
# those that one image shows are still read.
_SAME_SIDE = float(np.radians(30.0))
_INSIDE = 0.6  # of the corners, inside the image, count as a target that is in view


@dataclass(frozen=True)
class ToolError:
    """RMS errors at the tool over postures [m], of D draws. calibrated, nominal: (D,). weight: of each, every statement
    being wrong by its chance, sum 1, (D,). of: which statement is wrong in each, an index into ``wrong``, −1 for none,
    (D,). wrong: what these are. in_doubt: those that the intervals hold without as well.

    both_ends: whether the intervals leave out the same on either side. worse: chance that the calibrated arm is no
    better than the nominal one in the normal distribution that each is drawn from, (D,); None: of the draws themselves.
    model: the calibrated arm's without what each image has of its own, (D,), None where that is not known apart.
    """

    calibrated: Array
    nominal: Array
    weight: Array
    of: np.ndarray
    wrong: tuple[str, ...] = ()
    in_doubt: tuple[str, ...] = ()
    both_ends: bool = False
    worse: Array | None = None
    model: Array | None = None

    @property
    def interval(self) -> tuple[float, float, float]:
        """(median, lower, upper end of the 95 % interval) of the calibrated arm's [m].

        The interval is the shortest that holds 95 %, or leaves out the same on either side. What each image has of its
        own is joints that do not repeat, no error of the model, or what no parameter describes, which is one: the
        interval holds either way.
        """
        middle, low, high = self._holding(self.calibrated)
        return middle, low if self.model is None else min(low, self._holding(self.model)[1]), high

    @property
    def nominal_interval(self) -> tuple[float, float, float]:
        """The same of the nominal arm."""
        return self._holding(self.nominal)

    def _holding(self, values: Array) -> tuple[float, float, float]:
        """The interval of these values (D,), whether the statements in doubt are right or wrong."""
        every = [-1, *(self.wrong.index(what) for what in self.in_doubt)]
        shortest = not self.both_ends and len(every) == 1
        ends = [_interval(values[self.of == k], shortest) for k in every]
        shares = np.array([self.weight[self.of == k].sum() for k in every])
        return ends[int(shares.argmax())][0], min(low for _, low, _ in ends), max(high for *_, high in ends)

    @property
    def chance_worse(self) -> float:
        """Chance that the calibrated arm is no better than the nominal one, every statement wrong by its chance."""
        return float(self.weight @ (self.calibrated >= self.nominal if self.worse is None else self.worse))

    def if_wrong(self, what: str) -> tuple[float, float, float]:
        """(median, lower, upper end of the 95 % interval) [m] of the calibrated arm if this statement is wrong."""
        return _interval(self.calibrated[self.of == self.wrong.index(what)], shortest=False)

    def either_way(self, what: str) -> ToolError:
        """The same with intervals that hold also if this statement is wrong."""
        return self if what in self.in_doubt else replace(self, in_doubt=(*self.in_doubt, what))

    @property
    def as_stated(self) -> ToolError:
        """What it is if all that was stated is right."""
        right = self.of < 0
        even = np.full(int(right.sum()), 1.0 / right.sum())
        worse, model = (None if one is None else one[right] for one in (self.worse, self.model))
        some = (self.calibrated[right], self.nominal[right], even, self.of[right])
        return ToolError(*some, both_ends=self.both_ends, worse=worse, model=model)


def _interval(values: Array, shortest: bool) -> tuple[float, float, float]:
    ordered = np.sort(values)
    below = (np.arange(len(ordered)) + 0.5) / len(ordered)
    outside = 1.0 - _INSIDE_INTERVAL
    starts = np.linspace(0.0, outside, _PLACES) if shortest else np.array([0.5 * outside])
    low, high = np.interp(starts, below, ordered), np.interp(starts + _INSIDE_INTERVAL, below, ordered)
    best = int(np.argmin(high - low))
    return float(np.interp(0.5, below, ordered)), float(low[best]), float(high[best])


@dataclass(frozen=True)
class ParameterDraws:
    """D draws of what the arm's parameters are off by. values: (D, P). means (C, P), roots (C, P, P): of the normal
    distributions that they are from. source: which of these each is from, (D,). The rest as of a ToolError.
    """

    values: Array
    means: Array
    roots: Array
    source: np.ndarray
    weight: Array
    of: np.ndarray
    wrong: tuple[str, ...]
    in_doubt: tuple[str, ...]


def parameter_draws(
    fit: CameraFit, rng: np.random.Generator, doubted: Sequence[DoubtedStatement] = ()
) -> ParameterDraws:
    """Draws by a fit, and by each of the statements being wrong."""
    P = fit.poses.count
    parts = [_draws(fit, fit.equations, fit.sizes, P, rng)]
    parts += [_draws(fit, d.equations, d.sizes, P, rng) for d in doubted]
    chance = np.array([1.0 - sum(d.counted for d in doubted), *(d.counted for d in doubted)])
    counts = [sum(len(values) for values, *_ in part) for part in parts]
    drawn, means, roots = zip(*(one for part in parts for one in part), strict=True)
    return ParameterDraws(
        np.concatenate(drawn),
        np.stack(means),
        np.stack(roots),
        np.repeat(np.arange(len(drawn)), [len(values) for values in drawn]),
        np.repeat(chance / counts, counts),
        np.repeat(np.arange(len(parts)) - 1, counts),
        tuple(d.what for d in doubted),
        tuple(d.what for d in doubted if d.chance > IN_DOUBT),
    )


def tool_error(
    fit: CameraFit,
    nominal: CameraFit,
    q: Array,
    draws: ParameterDraws,
    both_ends: bool = False,
    arm_alone: bool = False,
) -> ToolError:
    """The errors over postures q (M, n).

    nominal: of the same images, the arm held nominal. draws: of the fit. both_ends: the intervals leave out the same on
    either side, which suits postures that no image is near, and is so where a statement is in doubt. arm_alone: what is
    left once the frame of the other half is put where it suits best, which is the lens's matter and no arm's.
    """
    at = fit.poses.at_postures(q)
    T, motions = at.tool_motions(fit.state.values)
    point = flange_in_tool(fit)
    J = at_flange(T, point, motions)
    # the mean square over postures is a form of second order in the parameters, however many postures there are
    drawn, _ = nominal.poses.at_postures(q).tool_motions(nominal.state.values)
    apart = (se3.apply(drawn, point) - se3.apply(T, point)).reshape(-1)
    rows = J.reshape(len(apart), -1)
    if arm_alone:
        basis = frame_basis(se3.apply(T, point))
        rows, apart = rows - basis @ (basis.T @ rows), apart - basis @ (basis.T @ apart)
    gram, cross, square = rows.T @ rows, rows.T @ apart, float(apart @ apart)
    throw = at_flange(T, point, at.joint_motions(fit.state.values, T))
    scatter = fit.sizes.joint**2 * float((throw**2).sum() / len(q)) + 3.0 * fit.sizes.shift**2
    own = ((draws.values @ gram) * draws.values).sum(axis=1)
    model = np.sqrt(np.maximum(own, 0.0) / len(q))
    calibrated = np.hypot(model, np.sqrt(scatter))
    against = np.sqrt(np.maximum(own - 2.0 * draws.values @ cross + square, 0.0) / len(q) + scatter)
    # own ≥ against where what is drawn reaches far enough along what both arms differ by: exact where draws are few
    along, across = draws.means @ cross, np.linalg.norm(np.swapaxes(draws.roots, 1, 2) @ cross, axis=1)
    short = (0.5 * square - along) / np.maximum(across, 1e-300)
    worse = np.array([beyond_normal(float(z)) for z in short])[draws.source]
    return ToolError(calibrated, against, draws.weight, draws.of, draws.wrong, draws.in_doubt, both_ends, worse, model)


def _draws(
    fit: CameraFit, equations: Equations, best: Sizes, P: int, rng: np.random.Generator
) -> list[tuple[Array, Array, Array]]:
    """Draws of what the arm's P parameters are off by, by these equations of the fit and about these sizes: (values
    (D, P), the mean (P,) and root (P, P) of the normal distribution that they are from) of each.

    How faulty this arm is, is known from these images only where it is not stated; so the draws are from a mixture over
    the sizes that its faults may have, each as likely as the data make it.
    """
    sizes = [best]
    if fit.poses.of_arm.any() and not fit.arm_stated:
        sizes = [
            replace(best, arm=float(best.arm * arm), lengths=float(best.lengths * lengths))
            for arm in np.exp(np.linspace(-2.5, 2.5, 11))
            for lengths in np.exp(np.linspace(-0.8, 0.8, 3))
        ]
    solved = [equations.solve(size) for size in sizes]
    misfit = np.array([s.misfit() + usual(size) for s, size in zip(solved, sizes, strict=True)])
    share = np.exp(-0.5 * (misfit - misfit.min()))
    counts = rng.multinomial(_DRAWS, share / share.sum())
    out = []
    for s, count in zip(solved, counts, strict=True):
        if count:
            mean, root = s.step()[:P], _root(s.covariance()[:P, :P])
            out.append((mean + rng.standard_normal((count, P)) @ root.T, mean, root))
    return out


def postures_in_view(fit: CameraFit, rng: np.random.Generator) -> tuple[Array, bool]:
    """(postures (M, n) within the images' joint ranges that show the target, whether there are enough of them).

    Where too few do, those of the images themselves, and what lies between neighbours among them.
    """
    q = fit.poses.q
    low, high = q.min(axis=0), q.max(axis=0)
    tried = rng.uniform(low, high, (_TRIES * _POSTURES, q.shape[1]))
    good = tried[in_view(fit, tried)][:_POSTURES]
    if len(good) >= _MIN_SEEN:
        return good, True
    a, b = rng.integers(len(q), size=(2, _POSTURES))
    mixed = q[a] + rng.uniform(0.0, 1.0, (_POSTURES, 1)) * (q[b] - q[a])
    mixed = np.concatenate([q, mixed[in_view(fit, mixed)]])
    return mixed[:_POSTURES], False


def postures_anywhere(chain: Chain, rng: np.random.Generator) -> Array:
    """Postures (M, n) anywhere within the joint limits; a full turn, or ±0.5 m, where there are none."""
    span = np.where(chain.revolute, np.pi, 0.5)
    low = np.where(np.isfinite(chain.lower), chain.lower, -span)
    high = np.where(np.isfinite(chain.upper), chain.upper, span)
    return rng.uniform(low, high, (_POSTURES, chain.n))


def in_view(fit: CameraFit, q: Array) -> np.ndarray:
    """Whether the camera sees the front of the target at these postures (M, n), (M,) bool."""
    at = fit.poses.at_postures(q)
    T = at.seen(at.tool_at(fit.state.values))
    points = fit.table.points[np.unique(fit.table.ids, return_index=True)[1]]  # that any image shows
    X = np.einsum("mij,cj->mci", T[:, :3, :3], points) + T[:, None, :3, 3]
    ahead = X[:, :, 2] > 1e-3
    pixels = fit.state.lens.project(np.where(ahead[:, :, None], X, [0.0, 0.0, 1.0]))
    inside = ahead & ((pixels >= 0.0) & (pixels < np.array(fit.state.lens.size))).all(axis=2)
    if fit.table.places:
        return np.asarray((inside.mean(axis=1) >= _INSIDE) & _seen_from_there(fit, T, points.mean(axis=0)))
    # the side that the images show
    side = np.einsum("mi,mi->m", T[:, :3, 2], X.mean(axis=1))
    seen = fit.poses.seen(fit.poses.tool_at(fit.state.values))
    front = np.sign(np.median(np.einsum("mi,mi->m", seen[:, :3, 2], seen[:, :3, 3])))
    return np.asarray((inside.mean(axis=1) >= _INSIDE) & (side * front > 0.0))


def _seen_from_there(fit: CameraFit, T: Array, middle: Array) -> np.ndarray:
    """Whether images show a body from about where the camera is at T_camera_target (M, 4, 4), (M,) bool."""

    def sides(poses: Array) -> Array:
        back = se3.inverse(poses)[:, :3, 3] - middle
        return np.asarray(back / np.linalg.norm(back, axis=1, keepdims=True))

    seen = sides(fit.poses.seen(fit.poses.tool_at(fit.state.values)))
    return np.asarray((sides(T) @ seen.T).max(axis=1) > np.cos(_SAME_SIDE))


def _root(C: Array) -> Array:
    """A matrix whose product with its transpose is the covariance C."""
    scale = np.sqrt(np.maximum(np.diag(C), 1e-300))
    values, vectors = np.linalg.eigh(C / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


_TILT = np.radians(20.0)  # below, the focal length is told by perspective of second order only
_DISTANCES = 1.3  # farthest over nearest
_COVERED = 0.4  # of the image, in a grid of eight by eight
_GRID = 8  # cells a side
_JOINT = np.radians(20.0)  # range of a joint that shows what its axis does
_RESTS = 3.0  # times better is the stated size known than the images show it: they say nothing against it
_SLIDE = 0.05  # m, of a sliding joint
ALL_BUT_IMAGES = "lens, sheet and clock"


def weak_directions(fit: CameraFit, mounting: Mounting) -> tuple[str, ...]:
    """What these images leave open, each with what to do, in sentences."""
    out = []
    T, _ = fit.poses.tool_motions(fit.state.values, fit.state.offset_s)
    seen = fit.poses.seen(T)
    centre = fit.table.points.mean(axis=0)
    tilts, away = tilt_and_distance(seen, centre)
    tilt = float(tilts.max())
    if tilt < _TILT and not fit.table.places:
        out.append(
            f"The target was never tilted by more than {np.degrees(tilt):.0f}°: focal length and distance cannot be "
            "told apart. Take images with 20° to 45° of tilt."
        )
    if away.max() < _DISTANCES * away.min():
        out.append(
            f"All images are from {away.min():.2f} to {away.max():.2f} m: the distance and the lens go together. "
            "Take some from half as far, or twice as far."
        )
    if (share := covered(fit.table, fit.state.lens.size)) < _COVERED:
        out.append(
            f"Corners cover {100.0 * share:.0f} % of the image: the lens is not known at its edges. "
            "Bring the target into every corner of the image."
        )
    if mounting.one_axis:
        turns = np.degrees(mounting.turns)
        out.append(
            f"The arm turned its tip about one axis only (RMS {turns[0]:.0f}°, across it {turns[1]:.1f}°): where "
            "camera and target are along this axis is open. Turn the wrist about a second axis."
        )
    chain = fit.poses.model.serial
    for name, low, high, turning in zip(
        chain.names, fit.poses.q.min(0), fit.poses.q.max(0), chain.revolute, strict=True
    ):
        if high - low < (_JOINT if turning else _SLIDE):
            moved = f"{np.degrees(high - low):.0f}°" if turning else f"{1e3 * (high - low):.0f} mm"
            out.append(f"Joint {name} moved by {moved} only: its axis is known from the drawing.")
    return tuple(out)


@dataclass(frozen=True)
class RestsOn:
    """What the sheet's stated size is worth. images_std: to what the images by themselves show it, relative.
    per_unit_m: RMS by which the tool is off per unit that it is wrong. if_wrong_m: upper end of the 95 % interval of
    the calibrated arm's error, were it wrong by what the images allow.
    """

    images_std: float
    per_unit_m: float
    if_wrong_m: float

    def sentence(self, nominal_m: float, body: bool = False) -> str:
        """The findings as sentences. nominal_m: error of the nominal arm. body: whether the target is a body."""
        what, again = ("body", "across it") if body else ("sheet", "a square")
        return (
            f"All of this rests on the {what}'s stated size, which these images by themselves show to "
            f"{100.0 * self.images_std:.1f} % only: each per cent that it is off puts the tool "
            f"{10.0 * self.per_unit_m:.1f} mm off. Were it wrong, the calibrated arm could be up to "
            f"{1e3 * self.if_wrong_m:.1f} mm off (95 %), the nominal arm is {1e3 * nominal_m:.1f} mm: measure {again} "
            "once more."
        )


def rests_on(fit: CameraFit, doubted: Sequence[DoubtedStatement], q: Array, error: ToolError) -> RestsOn | None:
    """The sheet's stated size, where the images by themselves hardly show it, and what it is worth at the tool over
    postures q (M, n); None where they show it as well. error: over these postures.
    """
    doubt = next(d for d in doubted if d.what == SIZE)
    P = fit.poses.count
    x = P + 1 + LENS
    C = doubt.equations.solve(doubt.sizes).covariance()
    both = np.array([0.5, 0.5])
    free = float(np.sqrt(both @ C[x : x + 2, x : x + 2] @ both))
    held = float(np.sqrt(both @ fit.covariance[x : x + 2, x : x + 2] @ both))
    if free < _RESTS * held:
        return None
    per_unit = C[:P, x : x + 2] @ both / free**2
    moved = flange_motions(fit, q) @ per_unit
    return RestsOn(free, float(np.sqrt((moved**2).sum() / len(q))), error.if_wrong(SIZE)[2])


def tilt_and_distance(seen: Array, centre: Array) -> tuple[Array, Array]:
    """(tilt of the sheet against the line of sight [rad], its distance [m]) of T_camera_target (N, 4, 4), (N,) each."""
    at = se3.apply(seen, centre)
    away = np.linalg.norm(at, axis=1)
    cosine = np.abs(np.einsum("ni,ni->n", seen[:, :3, 2], at)) / np.maximum(away, 1e-9)
    return np.arccos(np.clip(cosine, 0.0, 1.0)), away


def covered(table: CornerTable, size: tuple[int, int]) -> float:
    """Share of the image's cells, eight by eight, that hold a corner of some image."""
    cell = np.clip((table.pixels * _GRID / np.array(size)).astype(int), 0, _GRID - 1)
    return len(np.unique(cell[:, 0] * _GRID + cell[:, 1])) / _GRID**2


def shares(fit: CameraFit, q: Array) -> dict[str, tuple[float, float]]:
    """For lens, print scale, flatness, clock and places of markers, and for all of these at once: (mean square error at
    the tool that is known [m²], the same if that thing were known exactly), over postures q (M, n).
    """
    J = flange_motions(fit, q)
    P = J.shape[2]
    C = fit.covariance
    lens = np.arange(P + 1, P + 1 + LENS)
    places = np.arange(P + 1 + COMMON, len(C))
    groups = {
        "lens": lens,
        "print scale": lens[-1] + 1 + np.arange(2),
        "flatness": lens[-1] + 3 + np.arange(3),
        "clock": np.array([P]),
        "readout": np.array([P + 1 + READOUT]),
        "places of markers": places,
        ALL_BUT_IMAGES: np.r_[lens, lens[-1] + 1 + np.arange(5), P, P + 1 + READOUT, places],
    }
    whole = mean_square(J, C[:P, :P])
    out = {}
    for name, rows in groups.items():
        rows = rows[np.diag(C)[rows] > 0.0]
        if len(rows):
            known = C[:P, :P] - C[:P][:, rows] @ np.linalg.pinv(C[np.ix_(rows, rows)], hermitian=True) @ C[rows][:, :P]
            out[name] = (whole, max(mean_square(J, known), 0.0))
    return out


def mean_square(J: Array, C: Array) -> float:
    """Mean square of motions J (M, 3, P) of parameters with covariance C (P, P)."""
    return float(np.einsum("mip,pq,miq->", J, C, J) / len(J))
