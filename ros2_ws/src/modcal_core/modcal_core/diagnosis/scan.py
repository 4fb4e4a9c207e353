"""Where the residual sits and on what it depends, judged without assuming that noise is white.

A candidate is a place, a direction there, and a driver: its columns are the derivative of the readings with respect to
a twist at that place, times the driver's functions. The fitted geometry is projected out of residual and candidates, so
that nothing is found that the geometry could still explain.

Noise is not white in a tracker's frame: a joint that does not repeat throws the tool along its own columns. What can be
relied on is that stations are independent and their noise is as likely to point one way as the other. So the residual
vectors of whole stations are given random signs, everything is scanned again, and the best candidate found in such a
recording of pure noise is noted (wild bootstrap; Wu 1986, Liu 1988). A finding counts when the real best beats all but
one in two hundred of those: this corrects for the thousands of candidates looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from modcal_core.calibration.identify import Fit
from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.parameters import Parameter
from modcal_core.diagnosis.drivers import Driver, periodic_position, smooth_position, smooth_time
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

SIGNIFICANT = 0.005
FLIPS = 999
_MOST_SAMPLES = 300  # enough to find what matters; a dense recording is thinned evenly
_MEMORY = 0.5  # s
_LEAST_FREEDOM = 20  # rows beyond the geometry's parameters, below which nothing can be said
_ALIKE = 0.98  # share of the best candidate's explained squares that makes another one as good


@dataclass(frozen=True)
class Candidate:
    """A place ("base", a joint, "tool"), a direction there, and a driver."""

    place: str
    direction: str
    driver: Driver
    parameter: Parameter

    @property
    def label(self) -> str:
        """For people and for ``same_as``."""
        cycles = "" if self.driver.cycles is None else f" ({self.driver.cycles:g} cycles a turn)"
        return f"{self.place} {self.direction} by {self.driver.name}{cycles}"


@dataclass(frozen=True)
class Finding:
    """The best candidate and how sure it is. size: RMS of the motion it explains at the tool [m]. p_value: that pure
    noise would give as good a best. same_as: other candidates that explain it as well.
    """

    place: str
    direction: str
    driver: str
    cycles: float | None
    size: float
    p_value: float
    same_as: tuple[str, ...]


def scan(fit: Fit, samples: Samples, rng: np.random.Generator, flips: int = FLIPS) -> Finding | None:
    """The most telling dependence of what the fit leaves over on these samples, or None when it may be noise."""
    rows = np.unique(np.linspace(0, len(samples) - 1, min(len(samples), _MOST_SAMPLES)).astype(int))
    samples = samples.select(rows)
    candidates = list(_candidates(fit, samples))
    parameters = [*fit.parameters, *dict.fromkeys(c.parameter for c in candidates)]
    at = linearise(fit.model, parameters, np.zeros(len(parameters)), samples)
    weight = _row_weight(fit, samples)
    residual = at.residual * weight
    J = (at.J * weight).T
    geometry, rest = J[:, : len(fit.parameters)], J[:, len(fit.parameters) :]
    project = _projector(geometry, np.array([p.prior_std for p in fit.parameters]))
    freedom = len(residual) - round(project.lost)
    if freedom < _LEAST_FREEDOM or not candidates:
        return None
    column = dict(zip(parameters[len(fit.parameters) :], rest.T, strict=True))
    row_sample = _row_sample(samples)

    bases, owners = [], []
    for i, candidate in enumerate(candidates):
        block = column[candidate.parameter][:, None] * candidate.driver.columns[row_sample]
        bases.append(_independent(block, project))
        owners += [i] * bases[-1].shape[1]
    U, owner = np.concatenate(bases, axis=1), np.array(owners)
    sizes = np.bincount(owner, minlength=len(candidates))

    # What the training set got wrong of the geometry lies in the geometry's own columns: it must not be given signs,
    # or it would join the noise and hide how uneven that is.
    residual = project(residual[:, None])[: len(residual), 0]
    unit = independent_unit(samples)
    signs = rng.choice([-1.0, 1.0], (flips, unit.max() + 1))
    trials = np.concatenate([residual[None], residual * signs[:, unit[row_sample]]])
    trials = project(trials.T).T
    explained = np.zeros((flips + 1, len(candidates)))
    np.add.at(explained.T, owner, ((trials @ U) ** 2).T)
    score = _score(explained, np.sum(trials**2, axis=1), sizes, freedom)
    best = score.max(axis=1)
    p_value = float((best[1:] >= best[0]).sum() + 1) / (flips + 1)
    if p_value > SIGNIFICANT:
        return None
    return _finding(candidates, explained[0], score[0], bases, trials[0], fit, samples, p_value)


def independent_unit(samples: Samples) -> np.ndarray:
    """For each sample the number of the unit whose noise is independent of the others', (N,).

    A station; in motion, where noise has a memory, all samples of half a second.
    """
    key = np.where(samples.moving, np.floor(samples.stamps / _MEMORY), samples.station)
    return np.unique(np.stack([samples.moving, key]), axis=1, return_inverse=True)[1].ravel()


def _candidates(fit: Fit, samples: Samples) -> Iterator[Candidate]:
    chain = fit.model.chain
    positions = [smooth_position(samples, j) for j in range(chain.n)]
    time = smooth_time(samples)
    slow = [time] if time is not None else []
    for j, name in enumerate(chain.names):
        # place 0 stands in front of the first joint once for every frame; one frame's is as good as another's
        frame = 0 if j == 0 and len(fit.model.frames) == 1 else -1
        if j == 0 and frame < 0:
            continue
        turns = bool(chain.revolute[j])
        axis = Parameter(f"{name}/axis", j, 5 if turns else 2, frame)
        for driver in [*(p for p in positions if p is not None), *slow]:
            yield Candidate(name, "axis", driver, axis)
        for driver in periodic_position(samples, j) if turns else []:
            yield Candidate(name, "axis", driver, axis)
        for direction, label in ((3, "across x"), (4, "across y")):
            across = Parameter(f"{name}/{label}", j, direction, frame)
            for driver in (p for p in positions if p is not None):
                yield Candidate(name, label, driver, across)
    labels = ("x", "y", "z", "rx", "ry", "rz")
    for driver in slow:
        for d in range(6 if samples.is_pose.any() else 3):
            yield Candidate("tool", labels[d], driver, Parameter(f"tool/{labels[d]}", chain.n, d))
        if len(fit.model.frames) == 1:
            for d in range(6):
                yield Candidate("base", labels[d], driver, Parameter(f"base/{labels[d]}", 0, d, 0))


def _row_weight(fit: Fit, samples: Samples) -> Array:
    position = 1.0 / np.sqrt(fit.spread.position**2 + np.nan_to_num(samples.sigma_position) ** 2)
    pose = samples.is_pose
    rotation = 1.0 / np.sqrt(fit.spread.rotation**2 + np.nan_to_num(samples.sigma_rotation[pose]) ** 2)
    return np.concatenate([np.tile(position, 3), np.tile(rotation, 3)])


def _row_sample(samples: Samples) -> np.ndarray:
    """The sample of each row of a linearisation."""
    return np.concatenate([np.tile(np.arange(len(samples)), 3), np.tile(np.flatnonzero(samples.is_pose), 3)])


@dataclass(frozen=True)
class _Projector:
    """Takes out of columns (rows, k) what the geometry can explain. lost: degrees of freedom that this costs.

    The geometry is held by its prior, as extra rows that ask every parameter to stay: without them a direction that the
    readings hardly show, such as the scale of an arm whose ball rests in sockets, would explain anything by metres.
    """

    Q: Array
    rows: int

    @property
    def lost(self) -> float:
        return float(np.sum(self.Q[: self.rows] ** 2))

    def __call__(self, columns: Array) -> Array:
        """The columns with their prior rows (zero before projection) below them, (rows + P, k)."""
        below = np.zeros((len(self.Q) - self.rows, columns.shape[1]))
        return np.concatenate([columns, below]) - self.Q @ (self.Q[: self.rows].T @ columns)


def _projector(geometry: Array, prior_std: Array) -> _Projector:
    held = np.diag(1.0 / prior_std)
    scale = np.maximum(np.linalg.norm(geometry, axis=0), 1e-300)
    return _Projector(np.linalg.qr(np.concatenate([geometry, held]) / scale)[0], len(geometry))


def _independent(block: Array, project: _Projector) -> Array:
    """Orthonormal columns that span what a candidate adds to the geometry, with prior rows, (rows + P, m or fewer)."""
    block = block / np.maximum(np.linalg.norm(block, axis=0), 1e-300)
    U, s, _ = np.linalg.svd(project(block), full_matrices=False)
    return U[:, s > 0.05]  # below, the geometry explains all but a few per cent: noise would be blown up


def _score(explained: Array, total: Array, sizes: np.ndarray, freedom: int) -> Array:
    """How unlikely each candidate's share would be of white noise, −log10 p: makes any sizes comparable."""
    m = np.maximum(sizes, 1)
    rest = np.maximum(total[:, None] - explained, 1e-300) / np.maximum(freedom - m, 1)
    out = -f_distribution.logsf(explained / m / rest, m, np.maximum(freedom - m, 1)) / np.log(10.0)
    return np.where(sizes > 0, out, 0.0)


def _finding(
    candidates: list[Candidate],
    explained: Array,
    score: Array,
    bases: list[Array],
    residual: Array,
    fit: Fit,
    samples: Samples,
    p_value: float,
) -> Finding:
    top = int(np.argmax(score))
    alike = [
        i
        for i in range(len(candidates))
        if i == top or (explained[i] >= _ALIKE * explained[top] and bases[i].shape[1] <= bases[top].shape[1])
    ]
    best = min(alike, key=lambda i: (_far_fetched(candidates[i]), i != top))
    winner = candidates[best]
    weight = _row_weight(fit, samples)
    motion = (bases[best] @ (bases[best].T @ residual))[: len(weight)] / weight
    tool = motion[: 3 * len(samples)].reshape(3, -1)
    name = (winner.place, winner.direction, winner.driver.name)
    same = [c.label for c in (candidates[i] for i in alike) if (c.place, c.direction, c.driver.name) != name]
    return Finding(
        *name,
        winner.driver.cycles,
        float(np.sqrt(np.mean(np.sum(tool**2, axis=0)))),
        p_value,
        tuple(same),
    )


def _far_fetched(candidate: Candidate) -> int:
    """Of candidates that explain the same, the one with the plainest cause: a joint about its own axis by itself."""
    own = candidate.driver.name == f"position:{candidate.place}"
    return 2 * (candidate.direction != "axis") + (not own)
