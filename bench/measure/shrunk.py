"""What few stations of a grid tell when curves of all joints are taken in at once and held as small as they are likely.

    python bench/measure/shrunk.py --divisions 2 --random 2

A search takes an effect in or leaves it out, and fits what it takes in freely. Here nothing is chosen: beside the
geometry every joint errs about its axis by a smooth curve of its position, the tool by a smooth drift, and each joint
by the side from which it comes. How large and how smooth each of them is follows from the likelihood of the same
stations (empirical Bayes); where stations say little of a curve it stays near zero. The answer is the mean of a
Gaussian process (Rasmussen & Williams 2006, chapter 2 and section 5.4), linearised about the fitted geometry. What
modcal does after its search is close to it, with splines (``diagnosis/residual_curves.py``); this is to compare with.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import time  # noqa: E402
from dataclasses import dataclass  # noqa: E402

import numpy as np  # noqa: E402
import scipy  # noqa: E402
from replay import divided, ur5  # noqa: E402

from modcal_core.calibration.linearise import RowView, geometry_rows  # noqa: E402
from modcal_core.geometry.so3 import Array  # noqa: E402
from modcal_core.measurements.samples import Samples  # noqa: E402
from modcal_core.measuring.refit import Refit, refit  # noqa: E402

LENGTH = 0.15  # rad over which a curve changes; within a factor of e, as its prior has it
BEGUN = 20  # random stations whose geometry says what others would tell
WIDE = 1e-3  # m or rad by which the fitted geometry may still be off
BEGIN = {
    "curve": 3e-5,
    "noise": 2e-5,
    "drift": 1e-5,
    "lasts": 0.2,
    "side": 1e-6,
}  # rad, m, m, share of the recording, rad
BOUNDS = {
    "curve": (1e-7, 1e-3), "length": (0.02, 2.0), "noise": (5e-6, 2e-4), "drift": (1e-7, 1e-3), "lasts": (0.02, 1.0),
    "side": (1e-8, 1e-3),
}  # fmt: skip


@dataclass(frozen=True)
class Rows:
    """Residuals r (3 N,) [m] of points about a geometry, and what moves them: A (n, N, 3) a turn of each joint, J
    (3 N, P) the geometry. q (N, n), t (N,) as a share of the recording, side (N, n): of the stations.
    """

    r: Array
    A: Array
    J: Array
    q: Array
    t: Array
    side: Array


def rows(found: Refit, samples: Samples, span: float) -> Rows:
    """Of samples about the geometry that was found. span: of the whole recording [s]."""
    model, parameters = found.calibration.calibrated, found.scored.parameters
    view, chain, N = RowView.of(model, samples, model.drivers(samples)), model.chain, len(samples)
    A = [view.unit_column(chain.first_place + j, 5)[: 3 * N].reshape(3, N).T for j in range(chain.n)]
    J = geometry_rows(view, model, parameters, np.zeros(len(parameters)))[:, : 3 * N]
    J = J.reshape(len(parameters), 3, N).transpose(2, 1, 0).reshape(3 * N, -1)
    return Rows(view.position.T.ravel(), np.stack(A), J, samples.q, samples.stamps / span, samples.approach)


def covariance(h: Array, a: Rows, b: Rows) -> Array:
    """Of two sets of rows, (3 N, 3 M), without noise. h: logarithms of size and length of each joint's curve, of the
    noise, of drift and how long it lasts, and of what a side makes.
    """
    n, one = len(a.A), np.eye(3)
    size, length, (_, drift, lasts, side) = np.exp(h[: 2 * n : 2]), np.exp(h[1 : 2 * n : 2]), np.exp(h[2 * n :])
    K = np.einsum("ij,cd->icjd", drift**2 * np.exp(-0.5 * ((a.t[:, None] - b.t) / lasts) ** 2), one)
    for j in range(n):
        k = size[j] ** 2 * np.exp(-0.5 * ((a.q[:, j, None] - b.q[:, j]) / length[j]) ** 2)
        k += side**2 * np.outer(a.side[:, j], b.side[:, j])
        K += np.einsum("ic,ij,jd->icjd", a.A[j], k, b.A[j])
    return K.reshape(a.r.size, b.r.size) + WIDE**2 * (a.J @ b.J.T)


def likely(a: Rows, steps: int) -> Array:
    """The most likely sizes and lengths, as of :func:`covariance`."""
    n = len(a.A)

    def cost(h: Array) -> float:
        K = covariance(h, a, a)
        K[np.diag_indices(len(K))] += np.exp(2.0 * h[2 * n])
        try:
            L = scipy.linalg.cholesky(K, lower=True, overwrite_a=True, check_finite=False)
        except scipy.linalg.LinAlgError:
            return 1e9
        z = scipy.linalg.solve_triangular(L, a.r, lower=True, check_finite=False)
        return float(0.5 * z @ z + np.log(np.diag(L)).sum() + 0.5 * np.sum((h[1 : 2 * n : 2] - np.log(LENGTH)) ** 2))

    begin = [BEGIN["curve"], LENGTH] * n + [BEGIN[k] for k in ("noise", "drift", "lasts", "side")]
    bounds = [BOUNDS[k] for k in ("curve", "length")] * n + [BOUNDS[k] for k in ("noise", "drift", "lasts", "side")]
    options = {"maxiter": steps}
    return np.asarray(scipy.optimize.minimize(cost, np.log(begin), bounds=np.log(bounds), options=options).x)


def left(h: Array, a: Rows, b: Rows) -> float:
    """RMS distance [m] that is left at b by what a says."""
    K = covariance(h, a, a)
    K[np.diag_indices(len(K))] += np.exp(2.0 * h[2 * len(a.A)])
    e = b.r - covariance(h, b, a) @ scipy.linalg.solve(K, a.r, assume_a="pos")
    return float(np.sqrt(np.mean(np.sum(e.reshape(-1, 3) ** 2, axis=1))))


def chosen(a: Rows, count: int) -> Array:
    """Numbers of so many stations, each where the ones before it tell least, with sizes as the search begins."""
    n = len(a.A)
    h = np.log([BEGIN["curve"], LENGTH] * n + [BEGIN[k] for k in ("noise", "drift", "lasts", "side")])
    K, noise = covariance(h, a, a), BEGIN["noise"] ** 2 * np.eye(3)
    free, picked = np.ones(len(a.q), bool), []
    for _ in range(count):
        unknown = np.where(free, np.diagonal(K).reshape(-1, 3).sum(axis=1), -1.0)
        i = int(np.argmax(unknown))
        rows = slice(3 * i, 3 * i + 3)
        told = np.linalg.solve(np.linalg.cholesky(K[rows, rows] + noise), K[rows])
        K = K - told.T @ told
        free[i] = False
        picked.append(i)
    return np.sort(picked)


def main() -> None:
    """The UR5's grid: errors at stations that are never offered."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--divisions", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="the first division's seed")
    parser.add_argument("--random", type=int, default=2, help="random sets of stations of each division")
    parser.add_argument("--steps", type=int, default=12, help="of the search for sizes")
    parser.add_argument("--searched", action="store_true", help="modcal's own search beside it; minutes")
    asked = parser.parse_args()
    grid = ur5()
    span, mechanism = float(np.ptp(grid.samples.stamps)), grid.robot.mechanism
    for seed in range(asked.first, asked.first + asked.divisions):
        offered, scored = divided(grid, seed)
        count = int(grid.limit * len(offered))
        first = offered.select(np.sort(np.random.default_rng([seed, 99]).choice(len(offered), BEGUN, replace=False)))
        begun = refit(first, mechanism, seed, None, grid.robot.inertias, effects=False)
        sets = {"chosen": chosen(rows(begun, offered, span), count)}
        for k in range(asked.random):
            drawn = np.random.default_rng([seed, 100 + k]).choice(len(offered), count, replace=False)
            sets[f"random {k}"] = np.sort(drawn)
        for name, numbers in sets.items():
            began = time.process_time()
            some = offered.select(numbers)
            found = refit(some, mechanism, seed, None, grid.robot.inertias, effects=False)
            a, b = rows(found, some, span), rows(found, scored, span)
            h = likely(a, asked.steps)
            alone = np.sqrt(np.mean(np.sum(b.r.reshape(-1, 3) ** 2, axis=1)))
            print(
                f"division {seed}, {name}: {count} of {len(offered)} stations, geometry {1e3 * alone:.4f} mm, "
                f"curves held {1e3 * left(h, a, b):.4f} mm, all stations with the same sizes "
                f"{1e3 * left(h, rows(found, offered, span), b):.4f} mm; {time.process_time() - began:.0f} s",
                flush=True,
            )
            if asked.searched:
                from replay import rms
                from replay_bound import searched

                for what, samples in (("these", some), ("all", offered)):
                    error = rms(searched(grid, samples, seed).calibration.calibrated, scored)
                    print(f"  searched by {what}: {1e3 * error:.4f} mm", flush=True)


if __name__ == "__main__":
    main()
