"""What choosing stations can be worth at all: information matrices of the best and of random stations, geometry alone.

An arm whose model lacks nothing, measured with the noise of the cells: the error that N stations leave, and from it how
many random stations the proof then takes. The least sum over N is the fewest that any rule could do with that knows the
noise and what is missing beforehand, so its ratio is a bound for what a measurement can show that has to find both out.
"""

from __future__ import annotations

import numpy as np
from cells import REPEATS, Bench
from recordings import NOISE_MM, NOISE_MRAD

from modcal_core.calibration.distributions import quantile_chi2
from modcal_core.measuring.proof import Proof, share
from modcal_core.planning.criteria import ACCURACY, criterion
from modcal_core.planning.exchange import exchange
from modcal_core.planning.posture_pool import survey
from modcal_core.planning.rows import StationRows
from modcal_core.planning.site import Noise, Site

CANDIDATES, RANDOM_SETS = 400, 15
AXES = 1.5  # directions that errors vary like, in the middle of what the proof allows for
CAUTION = 0.3  # as the advice takes the noise


def bound(goal: float, noise: float) -> None:
    """Print, for every arm and kind of reading, the fewest stations with the proof, and what random ones are worth."""
    ratios, fits = [], []
    for robot in ("ur10", "panda", "xarm7"):
        for kind in ("point", "pose"):
            bench = Bench(robot, "none", 1, kind)
            read = Noise(1e-3 * noise * NOISE_MM, 0.0, 1e-3 * noise * NOISE_MRAD, REPEATS)
            site = Site(limits=bench.site.limits, noise=read)
            pool = survey(bench.chain, site, np.random.default_rng(5), kind, (), CANDIDATES)
            gamma, P, c = pool.workspace.gamma, pool.rows.J.shape[2], pool.rows.J.shape[1]
            spread = 3.0 * read.position**2 + float(np.mean(pool.workspace.repeat))
            good = criterion(ACCURACY, gamma)
            first = int(np.ceil(P / c))
            best: dict[str, tuple[float, int]] = {}
            for N in range(first, 3 * first):
                chosen = exchange(pool.rows, N, good, np.random.default_rng(1), 1, 2).chosen
                drawn = [np.random.default_rng(k).choice(len(pool.q), N, replace=False) for k in range(RANDOM_SETS)]
                error = {"planned": left(pool.rows, chosen, gamma)}
                error["random"] = float(np.median([left(pool.rows, d, gamma) for d in drawn]))
                for name, e in error.items():
                    best[name] = min(best.get(name, (np.inf, 0)), (N + proof(goal, spread, e, c * N - P), N))
                if len(drawn[0]) == 2 * first:
                    efficiency = (error["planned"] / error["random"]) ** 2
            (one, own), (other, theirs) = best["planned"], best["random"]
            ratios.append(one / other)
            fits.append(own / theirs)
            print(
                f"{robot} {kind}: {P} parameters; with the proof {one:.0f} planned ({own} of them to fit), {other:.0f} "
                f"random ({theirs}), ratio {one / other:.2f}; at {2 * first} stations random ones are "
                f"{efficiency:.0%} as efficient (I)",
                flush=True,
            )
    print(
        f"bound, goal {1e3 * goal:g} mm, {noise:g} times the noise: ratio {min(ratios):.2f} to {max(ratios):.2f}, of "
        f"the stations to fit alone {min(fits):.2f} to {max(fits):.2f}"
    )


def left(rows: StationRows, chosen: np.ndarray, gamma: np.ndarray) -> float:
    """RMS error of the tool [m] that a fit to these stations leaves."""
    return float(np.sqrt(np.sum(rows.covariance(chosen) * gamma)))


def proof(goal: float, spread: float, error: float, freedom: int) -> float:
    """Random stations that the proof takes. spread: mean square of readings that no model explains [m²]."""
    n = max(float(freedom), 1.0)
    stated = float(np.sqrt(n / quantile_chi2(CAUTION, n) * spread + error**2))
    begun = Proof(np.zeros(0), stated, share(0.05, 0), AXES)
    return float(np.ceil(begun.more(goal, float(np.sqrt(spread + error**2)))))
