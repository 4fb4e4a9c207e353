"""Learned residuals: geometry first, then a regressor of what it leaves on the joints, as the papers of 2025 do."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from league import geometry
from league.arm import Array
from league.task import Answer, Task

SEED = 0
MOST = 800  # rows of a Gaussian process: its cost is cubic


def _features(q: Array) -> Array:
    return np.concatenate([q, np.sin(q), np.cos(q)], axis=1)


def _learned(task: Task, predictor: Callable[[Array, Array, Array], tuple[Array, Array | None]]) -> Answer:
    """predictor: rows, residuals in units of their size, all rows → residuals and standard deviations (N, 3)."""
    found = geometry.fit(task)
    T = found.predict(task.q)[0]
    size = max(float(found.left.std()), 1e-9)
    guess, std = predictor(_features(task.q[task.train]), found.left / size, _features(task.q))
    T[:, :3, 3] += size * guess
    radius = None if std is None else size * np.sqrt(geometry.CHI95 * (std**2).mean(axis=1))
    return Answer(T, radius95=radius)


def network(task: Task) -> Answer:
    """Mean of five networks with two layers of 32, each stopped where rows of its own get no better."""
    from sklearn.neural_network import MLPRegressor
    from sklearn.preprocessing import StandardScaler

    def predictor(x: Array, y: Array, at: Array) -> tuple[Array, None]:
        scaler = StandardScaler().fit(x)
        told = {"hidden_layer_sizes": (32, 32), "activation": "tanh", "alpha": 1e-2, "early_stopping": True}
        told |= {"validation_fraction": 0.2, "n_iter_no_change": 40, "max_iter": 2000, "learning_rate_init": 3e-3}
        nets = [MLPRegressor(random_state=SEED + k, **told).fit(scaler.transform(x), y) for k in range(5)]
        return np.mean([net.predict(scaler.transform(at)) for net in nets], axis=0), None

    return _learned(task, predictor)


def trees(task: Task) -> Answer:
    """Boosted trees, a model an axis, the number of trees by cross-validation in blocks."""
    from lightgbm import LGBMRegressor
    from sklearn.model_selection import GroupKFold

    def predictor(x: Array, y: Array, at: Array) -> tuple[Array, None]:
        told = {"learning_rate": 0.05, "num_leaves": 15, "min_child_samples": max(3, len(x) // 50), "n_jobs": 1}
        told |= {"subsample": 0.8, "subsample_freq": 1, "random_state": SEED, "verbose": -1}
        groups = np.arange(len(x)) // task.block
        folds = list(GroupKFold(min(4, len(np.unique(groups)))).split(x, y, groups))
        out = np.empty((len(at), 3))
        for axis in range(3):
            missed = {0: float(np.mean(y[:, axis] ** 2))}
            for count in (20, 50, 100, 200, 400):
                fits = [(LGBMRegressor(n_estimators=count, **told).fit(x[a], y[a, axis]), b) for a, b in folds]
                missed[count] = float(np.mean(np.concatenate([(m.predict(x[b]) - y[b, axis]) ** 2 for m, b in fits])))
            best = min(missed, key=missed.__getitem__)
            model = LGBMRegressor(n_estimators=best, **told).fit(x, y[:, axis]) if best else None
            out[:, axis] = 0.0 if model is None else model.predict(at)
        return out, None

    return _learned(task, predictor)


def gaussian_process(task: Task) -> Answer:
    """Matérn kernel with a length of each feature's own, white noise; at most so many rows."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
    from sklearn.preprocessing import StandardScaler

    def predictor(x: Array, y: Array, at: Array) -> tuple[Array, Array]:
        scaler = StandardScaler().fit(x)
        rows = np.random.default_rng(SEED).permutation(len(x))[:MOST]
        lengths = np.full(x.shape[1], 3.0)
        kernel = ConstantKernel(0.5) * Matern(lengths, (0.05, 1e3), nu=2.5) + WhiteKernel(0.5, (1e-4, 2.0))
        parts = []
        few = rows[:250]  # the kernel's lengths are found on these
        for axis in range(3):
            first = GaussianProcessRegressor(kernel, random_state=SEED).fit(scaler.transform(x[few]), y[few, axis])
            full = GaussianProcessRegressor(first.kernel_, optimizer=None).fit(scaler.transform(x[rows]), y[rows, axis])
            parts.append(full.predict(scaler.transform(at), return_std=True))
        means, stds = zip(*parts, strict=True)
        return np.stack(means, axis=1), np.stack(stds, axis=1)

    return _learned(task, predictor)
