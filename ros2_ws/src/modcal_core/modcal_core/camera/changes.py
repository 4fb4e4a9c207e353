"""What corners show beyond geometry: effects of the joints, and what was moved among the images or since.

Gears, ratios, springs and backlash are looked for as with any other instrument. An image says as much of the target's
place as six numbers with a covariance; whitened, they are six rows like those of a pose reading, so the scan of other
instruments (diagnosis/evidence) serves images, with everything that the fit may change projected out. A candidate stays
where everything fitted again with it makes the images likelier by more than its price, and where a fit of most images
with it predicts the others better. Of a spring under the arm's own weight much looks like a joint's zero or a link's
length; the rest has to stand out of the noise.

A half that was moved moves the target by six numbers, another focal length scales the images by one, the same from one
image on. The images have a likelihood with these numbers drawn from what is usual, and without them, all else
integrated out. Among the images of a fit the sizes of all errors are found again for both, for a change makes the
images' own errors look large.

While the robot works, the last few images are equations about the calibrated model, with all that it knows as a prior.
Images of several cameras are judged together: joints, and a target seen from the same side, are one for all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from scipy.linalg import solve_triangular

from modcal_core.calibration import RowView
from modcal_core.camera.arm_poses import ArmPoses
from modcal_core.camera.bundle import BoardView, PrintedTarget
from modcal_core.camera.corners import POSE, CornerTable
from modcal_core.camera.equations import CameraRows, SolvedEquations
from modcal_core.camera.fit import LIKELIER, CameraFit, fit_cameras
from modcal_core.diagnosis import SIGNIFICANT, EffectChoice, Scanner, Space, choose
from modcal_core.effects import Drivers, Effect, candidates
from modcal_core.geometry import Array

_ONLY_ROUNDING = 1e-9  # of an image's information, which a direction it does not see gets


@dataclass(frozen=True)
class CameraSpace(Space):
    """Rows of images, six of each. whitened: of a motion of the tool (6, N), seen from the root, that in the image."""

    whitened: Callable[[Array], Array] = np.asarray

    def column(self, place: int, direction: int) -> Array:
        """Motion of the target in the image per unit of a direction at a place, whitened, (6, N)."""
        return self.whitened(self.view.unit_column(place, direction).reshape(6, -1))


def camera_space(fit: CameraFit, drivers: Drivers) -> CameraSpace:
    """The rows of all images of a camera fit, and what is fitted."""
    solved = fit.equations.solve(fit.sizes)
    E = solved.of_views
    N = len(E)
    size = np.einsum("nii->n", E[:, :, :POSE])
    L = np.linalg.cholesky(E[:, :, :POSE] + (_ONLY_ROUNDING * size)[:, None, None] * np.eye(POSE))
    white = np.swapaxes(L, 1, 2)
    products = np.concatenate([white, np.linalg.solve(L, E[:, :, POSE:])], axis=2)
    whole = fit.equations.cameras[0].by_all(products, len(fit.x)).transpose(1, 0, 2)
    rows, residual = whole[:, :, solved.use], whole[:, :, -1]
    # a root of all that stands beside these rows is left out below them: lens and sheet, other instruments, the prior
    scale = 1.0 / np.sqrt(np.diag(solved.H))
    root = np.linalg.cholesky(solved.H * np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
    by = (rows.reshape(POSE * N, -1) * scale).T
    Q = solve_triangular(root, by, lower=True, check_finite=False).T.reshape(POSE, N, -1)
    residual = residual - Q @ np.einsum("cNp,cN->p", Q, residual)
    now = fit.poses.model_at(fit.state.values)
    T = now.predict_samples(drivers.samples)
    view = RowView.of(now, drivers.samples, drivers)
    freedom = round(POSE * N - float(np.sum(Q**2)))

    def whitened(motion: Array) -> Array:
        return np.asarray((white @ fit.poses.as_twists(T, fit.poses.of_root(now, motion[None])))[:, :, 0].T)

    return CameraSpace(view, np.ones((POSE, N)), residual, Q, freedom, whitened=whitened)


_MAX = 6  # effects, for time
_REFUSED = 2  # choices that did not hold, before the search ends
_PARTS, _ENOUGH = 4, 6  # each of which is predicted from the others; images, of which enough for a mounting are left
_NOT_HERE = ("tracker", "base", "tool")  # lens and sheet have parameters; moves are looked for on their own


@dataclass(frozen=True)
class CameraCause:
    """An effect that was found. p_value: that noise would look as good. same_as: what explains it as well. before,
    after: what images have of their own, RMS a joint [rad, m], without it and with it. gain: of −2 log likelihood.
    """

    effect: Effect
    p_value: float
    same_as: tuple[str, ...]
    before: float
    after: float
    gain: float


def find_causes(
    fit: CameraFit, progress: Callable[[str], None] = lambda _: None
) -> tuple[CameraFit, tuple[CameraCause, ...], EffectChoice | None]:
    """(the fit with the effects that the images show, these, what is significant but could not be turned into one)."""
    drivers = fit.poses.drivers(fit.state.offset_s)
    looked_for = [e for e in candidates(drivers) if e.place not in _NOT_HERE and "time" not in e.driver]
    causes: list[CameraCause] = []
    refused: set[tuple[str, str, str, str]] = set()
    left: EffectChoice | None = None
    if not looked_for:
        return fit, (), None
    scanner = Scanner(looked_for, drivers, camera_space)
    while len(causes) < _MAX and len(refused) < _REFUSED:
        if not scanner.enough(fit):  # type: ignore[arg-type]
            break
        evidence = scanner.evidence(fit, trials=True)  # type: ignore[arg-type]
        if evidence.p_value > SIGNIFICANT:
            break
        choice = choose(evidence, scanner, fit, refused)  # type: ignore[arg-type]
        if choice is None:
            break
        progress(choice.effect.label)
        started = choice.effect.started(scanner.amplitudes(fit, choice.effect))  # type: ignore[arg-type]
        effects = (*_valued(fit), started)
        before, behind = np.split(fit.x, [len(fit.poses.parameters), fit.poses.count])[::2]
        x = np.concatenate([before, *(e.values for e in effects), behind])
        better = fit_cameras(fit.cameras.with_effects(effects), x, fit.sizes)
        gain = fit.misfit - better.misfit
        if better.converged and gain > LIKELIER and predicted(better) < predicted(fit):
            sizes = fit.sizes.joint, better.sizes.joint
            causes.append(CameraCause(started, choice.p_value, choice.same_as, *sizes, gain))
            fit, left = better, None
        else:
            refused.add(choice.effect.key)
            left = left or choice
    found = (replace(cause, effect=effect) for effect, cause in zip(_valued(fit), causes, strict=True))
    return fit, tuple(found), left


def _valued(fit: CameraFit) -> tuple[Effect, ...]:
    """The effects of a fit with their fitted values and standard deviations."""
    out, first = [], len(fit.poses.parameters)
    std = np.sqrt(np.diag(fit.covariance))
    for effect in fit.poses.model.effects:
        last = first + len(effect.values)
        out.append(effect.with_values(fit.state.values[first:last], std[first:last]))
        first = last
    return tuple(out)


def _unseen(fit: CameraFit, part: int) -> tuple[np.ndarray, CornerTable, Array]:
    """(every fourth image, mask (N,); its corners; how far these are from where a fit of the others has them [px])."""
    first = fit.cameras.first
    held = np.arange(first.table.views) % _PARTS == part
    every = (first.select(~held), *fit.cameras.every[1:])
    others = fit_cameras(replace(fit.cameras, every=every), fit.x, fit.sizes, fixed_sizes=True)
    unseen = first.select(held)
    return held, unseen.table, unseen.rows(others.state, np.empty(0, int)).pixels


def held_out(*fits: CameraFit) -> tuple[float, ...]:
    """RMS of each fit on every fourth image, fitted to the others at the same sizes [px]; NaN for too few images."""
    if fits[0].table.views < _ENOUGH:
        return (float("nan"),) * len(fits)
    return tuple(table.rms(gap) for _, table, gap in (_unseen(fit, _PARTS - 1) for fit in fits))


def predicted(fit: CameraFit) -> float:
    """Mean square of the residuals [px²] of every fourth image, and so on, predicted from fits of the others.

    Each image counts by no more than a few times the median, so that none rules alone. NaN for too few images.
    """
    if fit.table.views < _ENOUGH:
        return float("nan")
    square = np.empty(fit.table.views)
    for part in range(_PARTS):
        held, table, gap = _unseen(fit, part)
        total = np.bincount(table.view, table.weight * (gap**2).sum(1), table.views)
        square[held] = total / np.maximum(np.bincount(table.view, table.weight, table.views), 1.0)
    return float(np.minimum(square, 25.0 * np.median(square)).mean())


WORLD, TIP = "world", "tip"  # halves that may be moved: that in the world, and that on the arm
_GAIN = 20.0  # of −2 log likelihood: odds of 1 : 20 000, for some hundred places in two halves
_SCREEN = 0.0  # the same at the sizes of the fit, which take some of a change for noise; below it there is none
_EDGE = 3  # images on either side
_USUAL = np.r_[[0.01] * 3, [0.02] * 3]  # m, rad; how far something is moved that is kicked, or a joint that slips
_USUAL_FOCAL = np.array([0.02])  # relative, of a focus or zoom that was touched


@dataclass(frozen=True)
class Moved:
    """what: "camera", "target" or the name of a joint; "camera or arm", and so on, where images do not tell. since: the
    stamp, or number, of the first image after it. shift_m, turn_rad: by how much. gain: of −2 log likelihood. focal:
    relative change of the focal length, 0 where something was moved.
    """

    what: str
    since: float
    shift_m: float
    turn_rad: float
    gain: float
    focal: float = 0.0

    @property
    def by(self) -> str:
        """By how much, as text."""
        shift = f"{1e3 * self.shift_m:.1f} mm and " if self.shift_m > 0.0 else ""
        return f"{shift}{np.degrees(self.turn_rad):.2f}°"

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        return f"The {self.what} was moved by {self.by}"

    def before(self, image: str, whose: str = "") -> str:
        """The finding, and what to do. image: name of the first one after it. whose: suffix that names the camera."""
        said, do = f"The {self.what}{whose} was moved before image {image}, by {self.by}: ", ""
        if self.focal:
            said = f"The camera{whose} has another focal length from image {image} on, by {100.0 * self.focal:+.1f} %: "
            do = "switch autofocus off, leave focus and zoom alone, and "
        return f"{said}{do}calibrate from the images before, or from those after."


@dataclass(frozen=True)
class Change:
    """A change of images from one stop of the arm on. columns: by camera, what its k numbers do to twist, lens and all
    else of its images, (N, 21 + Z, k). usual: standard deviations of the numbers, (k,). order: the stops in order of
    time. name: for a person. half: world or tip, empty of what is none. places: of the tool in the images that show it,
    (N, 3).
    """

    columns: Mapping[int, Array]
    usual: Array
    order: np.ndarray
    name: str = ""
    half: str = ""
    places: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def best(self, solved: SolvedEquations, at: np.ndarray) -> tuple[float, int, Array]:
        """(gain of −2 log likelihood, first stop after it, its values) of the likeliest change.

        at: places of the first stop after it that are tried, (M,), counted in order of time.
        """
        own, cross = (part[self.order] for part in solved.equations.by_change(solved.sizes, self.columns))
        score, cross = cross[:, :, -1], cross[:, :, solved.use]
        factor = scipy.linalg.cho_factor(solved.H)
        score = score - cross @ scipy.linalg.cho_solve(factor, solved.b)
        own, cross, score = (np.cumsum(part[::-1], axis=0)[::-1][at] for part in (own, cross, score))
        back = scipy.linalg.cho_solve(factor, cross.reshape(-1, cross.shape[2]).T).reshape(-1, *cross.shape[:2])
        C = self.usual[:, None] * (own - cross @ back.transpose(1, 0, 2)) * self.usual + np.eye(len(self.usual))
        values = np.linalg.solve(C, (self.usual * score)[:, :, None])[:, :, 0]
        gains = (self.usual * score * values).sum(axis=1) - np.linalg.slogdet(C)[1]
        best = int(np.argmax(gains))
        return float(gains[best]), int(at[best]), self.usual * values[best]

    def weighed(self, fit: CameraFit, at: np.ndarray) -> tuple[float, Array]:
        """(−2 log likelihood with it, the sizes of all errors found again, and its values with these)."""
        solved, least = fit.weighed(misfit_of=lambda solved: solved.misfit() - self.best(solved, at)[0])
        return least, self.best(solved, at)[2]

    def size(self, values: Array) -> tuple[float, float]:
        """(shift [m], turn [rad]) of a half, or of a joint, that was moved by these values."""
        if not self.half:
            return 0.0, float(np.linalg.norm(values))
        shift = values[:3]
        if self.half == WORLD:
            shift = shift + np.cross(values[3:], self.places.mean(axis=0))
        return float(np.linalg.norm(shift)), float(np.linalg.norm(values[3:]))


def of_twist(rows: CameraRows, twists: Array) -> Array:
    """Columns (N, 21 + Z, k) of a change that moves the target by these twists (N, 6, k)."""
    out = np.zeros((len(twists), rows.grams.shape[1] - 1, twists.shape[2]))
    out[:, :POSE] = twists
    return out


@dataclass(frozen=True)
class _Watched:
    """Images of one camera: what it is called, the arm at them, T_frame_tool (N, 4, 4) [m], and their equations."""

    camera: str
    poses: ArmPoses
    tool: Array
    rows: CameraRows


def half_changes(seen: Sequence[_Watched], order: np.ndarray) -> list[Change]:
    """A change of each half: of every camera its own, of the target on either side one for all. order: of the stops."""
    found: dict[tuple[str, str], dict[int, Array]] = {}
    for k, one in enumerate(seen):
        for half, twists in zip((WORLD, TIP), one.poses.half_motions(one.tool), strict=True):
            name = one.camera if (half == TIP) == one.poses.camera_on_tip else "target"
            found.setdefault((half, name), {})[k] = of_twist(one.rows, twists)
    places = [one.tool[:, :3, 3] for one in seen]
    return [
        Change(moved, _USUAL, order, name, half, np.concatenate([places[k] for k in moved]))
        for (half, name), moved in found.items()
    ]


def find_change(fit: CameraFit) -> Moved | None:
    """The likeliest change among the images of the first camera, since a numbered one; None if none is beyond doubt."""
    # a camera that was moved would put the others' images of the same stops elsewhere as well
    cameras = fit.equations.cameras
    before = np.cumsum([0, *(len(one.stop) for one in cameras)])
    cameras = tuple(replace(one, stop=k + np.arange(len(one.stop))) for k, one in zip(before, cameras, strict=False))
    fit = replace(fit, equations=replace(fit.equations, cameras=cameras))
    N = fit.table.views
    if N < 2 * _EDGE:
        return None
    wider = of_twist(cameras[0], np.zeros((N, POSE, 1)))
    wider[:, POSE : POSE + 2, 0] = fit.state.lens.values[:2]
    changes = half_changes([_Watched("camera", fit.poses, fit.tool, cameras[0])], np.arange(N))
    changes.append(Change({0: wider}, _USUAL_FOCAL, np.arange(N), "camera"))
    solved, places = fit.equations.solve(fit.sizes), np.arange(_EDGE, N - _EDGE + 1)
    screened = [(one, *one.best(solved, places)[:2]) for one in changes]
    weighed = [(one, at, *one.weighed(fit, np.array([at]))) for one, gain, at in screened if gain >= _SCREEN]
    if not weighed:
        return None
    one, at, misfit, x = min(weighed, key=lambda found: found[2])
    gain = fit.weighed()[1] - misfit
    if gain < _GAIN:
        return None
    return Moved(one.name, at, *one.size(x), gain) if one.half else Moved(one.name, at, 0.0, 0.0, gain, float(x[0]))


_WINDOW = 8  # images that are looked back on
_SAME = 1e-3  # rad or m by which joints differ within a stop


@dataclass(frozen=True)
class _Seen:
    """An image. stamp: or its number. stop: number of the stop of the arm at which it was taken."""

    camera: str
    view: BoardView
    q: Array
    stamp: float
    stop: int


class CameraWatch:
    """Watches the images of a calibrated cell; give it each as it comes."""

    def __init__(self, fit: CameraFit, target: PrintedTarget) -> None:
        """fit: the calibration, of one camera or several. target: as it was calibrated with, by all of them."""
        self._fit, self._target = fit, target
        every = zip(fit.cameras.every, fit.states, fit.cameras.columns, strict=True)
        # the camera, its state, and where each value stands among those of all
        self._cameras = {one[0].given.name if k else "": one for k, one in enumerate(every)}
        known, information = fit.equations.solve(fit.sizes), np.zeros_like(fit.covariance)
        information[np.ix_(known.use, known.use)] = known.H
        known_only = replace(fit.equations, beside=None, faults=None, places=None)
        self._known = replace(known_only, offset=np.zeros(len(information)), information=information)
        self._seen: deque[_Seen] = deque(maxlen=_WINDOW * len(self._cameras))
        self._count = self._stop = 0

    def image(self, view: BoardView, q: Array, camera: str = "") -> Moved | None:
        """What was moved by this image, the arm standing at q (n,); None while nothing stands out.

        camera: of a further one its name. One that is not in the calibration says nothing.
        """
        self._count += 1
        if camera in self._cameras and len(view) >= POSE:
            if self._seen and np.abs(np.asarray(q) - self._seen[-1].q).max() > _SAME:
                self._stop += 1
            stamp = view.stamp if np.isfinite(view.stamp) else float(self._count)
            self._seen.append(_Seen(camera, view, np.asarray(q), stamp, self._stop))
        return self._judge()

    def forget(self) -> None:
        """Begin again, with the next image: after something was put right."""
        self._seen.clear()

    def _judge(self) -> Moved | None:
        stops = sorted({one.stop for one in self._seen})
        if len(stops) < 2:
            return None
        solved, changes = self._weighed(list(self._seen))
        places = np.arange(len(stops) - 1)  # a change that one stop alone shows may be a misread board
        found = sorted(((*change.best(solved, places), change) for change in changes), key=lambda f: -f[0])
        gain, first, x, change = found[0]
        if gain < _GAIN or self._least_without(change.name, stops[first:]) < 0.5 * _GAIN:
            return None
        names = [change.name, *(other.name for rival, *_, other in found[1:2] if gain - rival < LIKELIER)]
        since = next(one.stamp for one in self._seen if one.stop == stops[first])
        return Moved(" or ".join(dict.fromkeys(names)), since, *change.size(x), gain)

    def _least_without(self, name: str, after: Sequence[int]) -> float:
        """The least gain of a change before these stops that is left without any one of them: a single one may be
        misread, or its joints be of another moment, which is no move.
        """
        out = []
        for stop in after:
            seen = [one for one in self._seen if one.stop != stop]
            solved, changes = self._weighed(seen)
            same = next((one for one in changes if one.name == name), None)
            first = sum(s < after[0] for s in {one.stop for one in seen})
            out.append(same.best(solved, np.array([first]))[0] if same and len(after) > 1 else 0.0)
        return min(out)

    def _weighed(self, seen: Sequence[_Seen]) -> tuple[SolvedEquations, list[Change]]:
        """(the equations of these images, what may have been changed among them)."""
        watched: list[_Watched] = []
        for camera in dict.fromkeys(one.camera for one in seen):
            own, (known, state, columns) = [one for one in seen if one.camera == camera], self._cameras[camera]
            at = known.poses.at_postures(np.stack([one.q for one in own]))
            table = CornerTable.of([one.view for one in own], self._target)
            here = replace(known, table=table, poses=at).rows(state, columns)
            label = "camera" if len(self._cameras) == 1 else f"camera {camera}" if camera else "first camera"
            here = replace(here, stop=np.array([one.stop for one in own]))
            watched.append(_Watched(label, at, at.tool_at(state.values), here))
        rows = tuple(one.rows for one in watched)
        solved = replace(self._known, cameras=rows).solve(self._fit.sizes)
        order = np.arange(len({one.stop for one in seen}))
        changes = half_changes(watched, order)
        for j, joint in enumerate(self._fit.poses.model.chain.names):
            slipped = {k: of_twist(one, one.own[:, :, j : j + 1]) for k, one in enumerate(rows)}
            changes.append(Change(slipped, _USUAL[3:4], order, name=f"joint {joint}"))
        return solved, changes
