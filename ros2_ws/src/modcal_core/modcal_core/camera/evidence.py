"""How much each candidate effect would explain of what a camera fit leaves over.

An image says as much of the target's place as six numbers with a covariance, whose noise is what its corners have and
what the image has of its own; whitened, they are six rows like those of a pose reading. Lens and sheet move them too,
and are told by the corners beside each other as well: what that tells stands beside the prior. So the scan of other
instruments (diagnosis/evidence) serves images, with everything that the fit may change projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve_triangular

from modcal_core.calibration.linearise import RowView
from modcal_core.calibration.model import Model
from modcal_core.camera.corners import POSE
from modcal_core.camera.fit import CameraFit, equations_at
from modcal_core.diagnosis.evidence import Scanner
from modcal_core.diagnosis.number_banks import NumberBank
from modcal_core.diagnosis.space import Space
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Effect
from modcal_core.geometry.so3 import Array

_ONLY_ROUNDING = 1e-9  # of an image's information, which a direction it does not see gets


@dataclass(frozen=True)
class WithModel:
    """A camera fit with further effects in its model, their values as they are there."""

    fit: CameraFit
    model: Model


@dataclass(frozen=True)
class CameraSpace(Space):
    """Rows of images: of each six, whitened. now: the model. T: T_frame_tool, (N, 4, 4). white: (N, 6, 6)."""

    fit: CameraFit | None = None
    now: Model | None = None
    T: Array = field(default_factory=lambda: np.empty((0, 4, 4)))
    white: Array = field(default_factory=lambda: np.empty((0, 6, 6)))

    def column(self, place: int, direction: int) -> Array:
        """Motion of the target in the image per unit of a direction at a place, whitened, (6, N)."""
        assert self.fit is not None
        assert self.now is not None
        N = len(self.T)
        motion = self.fit.poses.of_root(self.now, self.view.unit_column(place, direction).reshape(1, 6, N))
        return np.asarray((self.white @ self.fit.poses.as_twists(self.T, motion))[:, :, 0].T)


class CameraScanner(Scanner):
    """Candidates weighed against what a camera fit leaves over."""

    def __init__(self, effects: Sequence[Effect], drivers: Drivers) -> None:
        """effects: the candidates. drivers: at the images."""
        super().__init__(effects, drivers)
        self._known: tuple[WithModel, CameraSpace] | None = None

    def space_of(self, fit: WithModel) -> CameraSpace:  # type: ignore[override]
        """The rows of all images, and what is fitted."""
        if self._known is None or self._known[0] is not fit:
            self._known = fit, _space(fit, self.drivers)
        return self._known[1]

    def information(self, fit: WithModel, effect: Effect) -> float:
        """What the images say of an effect's one amplitude, as the inverse of a variance, all else being fitted."""
        space = self.space_of(fit)
        keys, numbers = self._factor(effect)
        gram, _ = self._gram(NumberBank((effect,), keys, numbers[None]), space)
        return max(float(gram[0, 0, 0]), 0.0)


def _space(asked: WithModel, drivers: Drivers) -> CameraSpace:
    fit = asked.fit
    if len(asked.model.effects) > len(fit.poses.model.effects):  # more than were fitted: to look ahead
        poses = fit.poses.with_effects(asked.model.effects)
        parameters, own = np.split(fit.state.values, [len(poses.parameters)])[0], fit.state.values[fit.poses.of_model :]
        values = np.concatenate([parameters, *(e.values for e in asked.model.effects), own])
        state = fit.state.with_values(values)
        fit = replace(fit, poses=poses, state=state, equations=equations_at(fit.table, poses, fit.prior, state))
    eq, solved = fit.equations, fit.equations.solve(fit.sizes)
    E = solved.E
    N, K = len(E), eq.moved.shape[2]
    size = np.einsum("nii->n", E[:, :POSE, :POSE])
    L = np.linalg.cholesky(E[:, :POSE, :POSE] + (_ONLY_ROUNDING * size)[:, None, None] * np.eye(POSE))
    white = np.swapaxes(L, 1, 2)
    beside = np.linalg.solve(L, E[:, :POSE, POSE:])  # by lens and sheet, and the residual
    J = np.concatenate([white @ eq.moved, beside[:, :, :-1]], axis=2)[:, :, solved.use]
    held = solved.P.copy()
    common = (E[:, POSE:-1, POSE:-1] - np.swapaxes(beside, 1, 2)[:, :-1] @ beside[:, :, :-1]).sum(axis=0)
    place = np.searchsorted(solved.use, K)
    which = solved.use[place:] - K
    held[place:, place:] += common[np.ix_(which, which)]
    if eq.beside is not None or eq.others:  # what others say stands beside the prior too
        held += eq.of_others(fit.sizes)[0][np.ix_(solved.use, solved.use)]
    rows = J.transpose(1, 0, 2).reshape(POSE * N, -1)
    Q = _orthonormal(rows, held).reshape(POSE, N, -1)
    residual = np.asarray(beside[:, :, -1].T)
    residual = residual - Q @ np.einsum("cNp,cN->p", Q, residual)
    now = fit.poses.model_at(fit.state.values)
    T = now.predict_samples(drivers.samples)
    view = RowView.of(now, drivers.samples, drivers)
    freedom = round(POSE * N - float(np.sum(Q**2)))
    return CameraSpace(view, np.ones((POSE, N)), residual, Q, freedom, fit=fit, now=now, T=T, white=white)


def _orthonormal(J: Array, held: Array) -> Array:
    """Orthonormal columns of J (m, P) with a root of the information ``held`` (P, P) below it, left out again."""
    H = J.T @ J + held
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    L = np.linalg.cholesky(H * np.outer(scale, scale) + 1e-12 * np.eye(len(H)))
    return np.asarray(solve_triangular(L, (J * scale).T, lower=True, check_finite=False).T)
