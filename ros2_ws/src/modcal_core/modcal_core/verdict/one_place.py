"""A base or a tool that stands a little elsewhere at each station: a loose stand, a target loose in its seat.

Nothing predicts such scatter, and returns take it for what the arm does not repeat. But it is one motion of one body:
carried to where that body stands, its covariance is the same at all stations. Maps between places of a rigid motion
keep volumes, so the place where the scatter has the smallest covariance determinant is the likeliest. Where that is the
base or the tool, it has to beat what joints and instrument can scatter, by likelihood (random effects, by the EM
algorithm; Laird & Ware 1982).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import RowView
from modcal_core.effects import place_index
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import Chain, is_serial_arm
from modcal_core.verdict.case import Case

_MAX = 240  # samples, for time; more are thinned evenly
_MIN = 40  # samples; a covariance of a body has 21 numbers
_BEYOND_DOUBT = 50.0  # difference of log-likelihoods, as of conventions
_PARAMETERS = 21  # of a body's covariance, at the price of half the logarithm of the samples each (BIC)
_MOSTLY = 0.5  # share of the squared position error: most of what is left
_ROUNDS = 60  # of the EM algorithm
_FARTHEST = 6.0  # times the median size; no sample may rule alone


@dataclass(frozen=True)
class OnePlace:
    """who: what moves. moved [m], turned [rad]: RMS over space that it moves the target by. share: of the squares."""

    who: str
    moved: float
    turned: float
    share: float

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        return (
            f"Most of what is left ({self.share:.0%} of the squared position error) is scatter of {self.who}, which "
            f"stands elsewhere at each station ({1e3 * self.moved:.2g} mm and {np.degrees(self.turned):.2g}° RMS at "
            "the target) in a way that neither joints nor the instrument scatter. See how it is fixed; if the cell is "
            "like that, state its repeatability."
        )


def one_place(case: Case) -> OnePlace | None:
    """The base or the tool, where most of what a case leaves is its scatter; None where neither does."""
    rows = np.flatnonzero(~case.wrong) if case.fitted else case.held_out
    rows = rows[~case.samples.moving[rows] & case.samples.is_pose[rows]]
    rows = rows[spread_rows(len(rows), _MAX)]
    chain = case.model.chain
    if len(rows) < _MIN or not is_serial_arm(chain) or not is_direct(case.samples.kinds):
        return None
    samples = case.samples.select(rows)
    if samples.sockets:
        return None
    view = RowView.of(case.model, samples, case.model.drivers(samples))
    residual = np.concatenate([view.position, view.rotation]).T  # (N, 6)
    size = np.linalg.norm(residual / np.maximum(_by_kind(residual), 1e-12), axis=1)
    residual = residual * np.minimum(1.0, _FARTHEST * float(np.median(size)) / np.maximum(size, 1e-300))[:, None]
    unit = _by_kind(residual)
    if not (unit > 0.0).all():
        return None
    residual = residual / unit
    bodies = {"the base (or the tracker's stand)": 0, "the tool (or the target in its seat)": chain.tool_place}
    columns = {who: np.stack([_column(view, p, d) for d in range(6)], axis=2) for who, p in bodies.items()}
    here = _spread(residual * unit)
    gains = {who: 0.5 * len(rows) * (here - _spread(_carried(J, residual * unit))) for who, J in columns.items()}
    who = max(gains, key=lambda k: gains[k])
    if gains[who] < _BEYOND_DOUBT:
        return None
    known = _known(chain, view, unit)
    before, _ = _likelihood(residual, known, None)
    J = columns[who] / unit[None, :, None]
    J = J / np.sqrt(np.mean(np.sum(J**2, axis=1), axis=0))
    after, covariance = _likelihood(residual, known, J)
    if after - before - 0.5 * _PARAMETERS * np.log(len(rows)) < _BEYOND_DOUBT or covariance is None:
        return None
    made = np.einsum("nip,pq,niq->ni", J, covariance, J) * unit**2
    moved, turned = (float(np.sqrt(made[:, part].sum(axis=1).mean())) for part in (slice(0, 3), slice(3, 6)))
    share = moved**2 / max(float(np.mean(np.sum((residual * unit)[:, :3] ** 2, axis=1))), 1e-300)
    return OnePlace(who, moved, turned, min(share, 1.0)) if share > _MOSTLY else None


def _by_kind(residual: Array) -> Array:
    """RMS of positions and of orientations (N, 6), each for its three components, (6,)."""
    square = np.mean(residual**2, axis=0)
    return np.sqrt(np.repeat([square[:3].mean(), square[3:].mean()], 3))


def _column(view: RowView, place: int, direction: int) -> Array:
    """What a unit of a twist at a place does to a pose, (N, 6)."""
    return np.asarray(view.unit_column(place, direction).reshape(6, -1).T)


def _carried(J: Array, residual: Array) -> Array:
    """The twists (N, 6) of a body that would make the residual."""
    return np.asarray(np.linalg.solve(J, residual[..., None])[..., 0])


def _spread(x: Array) -> float:
    """Logarithm of the determinant of the covariance of x (N, 6) about zero."""
    size = np.sqrt(np.mean(x**2, axis=0))
    return float(np.linalg.slogdet(x.T @ x / len(x) / np.outer(size, size))[1] + 2.0 * np.log(size).sum())


def _known(chain: Chain, view: RowView, unit: Array) -> list[Array]:
    """What else may scatter, each by one number: (N, 6, d) for the joints, distances, angles, places and turns."""
    places = [
        _column(view, place_index(name, chain), 5 if turns else 2)
        for name, turns in zip(chain.names, chain.revolute, strict=True)
    ]
    x = view.expected.T  # from the instrument, along the root's axes
    N = len(x)
    out = [(column / unit)[..., None] for column in places]
    sight, across = np.zeros((N, 6, 1)), np.zeros((N, 6, 3))
    sight[:, :3, 0] = x / unit[:3]
    across[:, :3] = np.stack([np.cross(axis, x) for axis in np.eye(3)], axis=2) / unit[:3, None]
    alone = np.zeros((2, N, 6, 3))
    alone[0, :, :3], alone[1, :, 3:] = np.eye(3), np.eye(3)
    return [z / np.sqrt(np.mean(np.sum(z**2, axis=1))) for z in (*out, sight, across, *alone)]


def _likelihood(residual: Array, known: list[Array], body: Array | None) -> tuple[float, Array | None]:
    """Log-likelihood of residuals (N, 6) with a variance of each known part, and a covariance of a body, (6, 6)."""
    variance = np.full(len(known), 1.0 / len(known))
    products = np.stack([z @ np.swapaxes(z, 1, 2) for z in known])
    covariance = None if body is None else np.eye(6) / 6.0
    best, kept = -np.inf, covariance
    for _ in range(_ROUNDS):
        S = np.tensordot(variance, products, axes=1) + 1e-9 * np.eye(6)
        if body is not None and covariance is not None:
            S = S + body @ covariance @ np.swapaxes(body, 1, 2)
        inverse = np.linalg.inv(S)
        u = (inverse @ residual[..., None])[..., 0]
        value = -0.5 * float(np.sum(np.linalg.slogdet(S)[1]) + np.einsum("ni,ni->", u, residual))
        if value > best:
            best, kept = value, covariance
        if body is not None and covariance is not None:
            b = (np.swapaxes(body, 1, 2) @ u[..., None])[..., 0] @ covariance
            inner = np.swapaxes(body, 1, 2) @ inverse @ body
            covariance = covariance + b.T @ b / len(b) - covariance @ inner.mean(axis=0) @ covariance
        for k, z in enumerate(known):
            seen = np.einsum("nid,ni->nd", z, u)
            trace = np.einsum("nid,nij,njd->", z, inverse, z)
            count = z.shape[0] * z.shape[2]
            variance[k] += variance[k] ** 2 * (float(np.sum(seen**2)) - float(trace)) / count
    return best, kept
