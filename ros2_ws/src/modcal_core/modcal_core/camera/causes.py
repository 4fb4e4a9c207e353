"""Effects beyond geometry that corners show: gears, ratios, springs, backlash, looked for as with any other instrument.

The scan says which candidate explains most of what the fit leaves over, and how likely noise explains as much. It stays
where everything fitted again with it makes the images likelier by more than its price, and where a fit of most images
with it predicts the others better than one without.

An image says as much of the target's place as six numbers with a covariance, whose noise is what its corners have and
what the image has of its own; whitened, they are six rows like those of a pose reading. Lens and sheet move them too,
and are told by the corners beside each other as well: what that tells stands beside the prior. So the scan of other
instruments (diagnosis/evidence) serves images, with everything that the fit may change projected out.

A spring under the arm's own weight bends the arm by little and smoothly, and much of that looks like a joint's zero or
a link's length. What is left of it, beside all that is fitted, has to stand out of the noise of the images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from modcal_core.calibration import RowView
from modcal_core.camera.corners import POSE, CornerTable
from modcal_core.camera.fit import LIKELIER, CameraFit, fit_cameras
from modcal_core.diagnosis import SIGNIFICANT, EffectChoice, Scanner, Space, choose
from modcal_core.effects import Drivers, Effect, candidates
from modcal_core.geometry import Array

_ONLY_ROUNDING = 1e-9  # of an image's information, which a direction it does not see gets


@dataclass(frozen=True)
class CameraSpace(Space):
    """Rows of images, six of each. whitened: of a motion of the tool, seen from the root (6, N), that of the target in
    the image, white, (6, N).
    """

    whitened: Callable[[Array], Array] = np.asarray

    def column(self, place: int, direction: int) -> Array:
        """Motion of the target in the image per unit of a direction at a place, whitened, (6, N)."""
        return self.whitened(self.view.unit_column(place, direction).reshape(6, -1))


class CameraScanner(Scanner):
    """Candidates weighed against what a camera fit leaves over."""

    _known: tuple[CameraFit, CameraSpace] | None = None

    def space_of(self, fit: CameraFit) -> CameraSpace:  # type: ignore[override]
        """The rows of all images, and what is fitted."""
        if self._known is None or self._known[0] is not fit:
            self._known = fit, _space(fit, self.drivers)
        return self._known[1]


def _space(fit: CameraFit, drivers: Drivers) -> CameraSpace:
    solved = fit.equations.solve(fit.sizes)
    moved = fit.equations.cameras[0].moved
    E = solved.of_views
    N = len(E)
    size = np.einsum("nii->n", E[:, :, :POSE])
    L = np.linalg.cholesky(E[:, :, :POSE] + (_ONLY_ROUNDING * size)[:, None, None] * np.eye(POSE))
    white = np.swapaxes(L, 1, 2)
    beside = np.linalg.solve(L, E[:, :, POSE:])  # by lens and sheet, and the residual
    rows = np.zeros((N, POSE, len(fit.x)))
    rows[:, :, fit.equations.cameras[0].columns] = np.concatenate([white @ moved, beside[:, :, :-1]], axis=2)
    rows = rows[:, :, solved.use].transpose(1, 0, 2)
    # a root of all that stands beside these rows is left out below them: lens and sheet, other instruments, the prior
    scale = 1.0 / np.sqrt(np.diag(solved.H))
    root = np.linalg.cholesky(solved.H * np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
    by = (rows.reshape(POSE * N, -1) * scale).T
    Q = solve_triangular(root, by, lower=True, check_finite=False).T.reshape(POSE, N, -1)
    residual = np.asarray(beside[:, :, -1].T)
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
    scanner = CameraScanner(looked_for, drivers)
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
