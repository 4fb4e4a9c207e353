"""What choosing among recorded stations could be worth: the model of all stations known beforehand, and less than that.

    python bench/measure/replay_bound.py ur5 --divisions 3
    python bench/measure/replay_bound.py ipa --divisions 1

From the share of stations that is claimed, chosen by the information of the model of all of them or at random, are
fitted: that model's effects, which are given, or those that a search finds by these stations alone. Errors are at the
stations that are never offered, over the error of the model of all. The first is for a rule that would know the end
before it begins; what it leaves is what so few stations cannot tell of so many values. What a search leaves more is
effects that so few stations do not show.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from replay import Grid, divided, ipa, rms, ur5

from modcal_core.calibration.identify import identify
from modcal_core.measurements.samples import Samples
from modcal_core.measuring.outlook import outlook
from modcal_core.measuring.pool import of_recording
from modcal_core.measuring.refit import Refit, refit


def known(whole: Refit, samples: Samples) -> object:
    """The model with the effects of the whole, fitted to these samples from where that fit began."""
    scored = whole.scored
    start = scored.start.with_effects(whole.calibration.calibrated.effects)
    return identify(start, samples, scored.parameters, begin=scored.values).model


def searched(grid: Grid, samples: Samples, seed: int) -> Refit:
    """The model that these samples give by themselves."""
    return refit(samples, grid.robot.mechanism, seed, None, grid.robot.inertias)


def by_information(whole: Refit, offered: Samples, count: int, seed: int) -> np.ndarray:
    """Numbers of the stations that tell most of the whole's model, with nothing measured before them."""
    where = of_recording(offered.q, np.random.default_rng(seed)).where
    view = outlook(whole, where, whole.spread, np.random.default_rng(seed))
    J = view.rows(offered.q, offered.approach)
    return np.sort(view.best(J, np.ones(len(J)), count, np.eye(len(view.H)))[0])


def bound(grid: Grid, seed: int, random: int) -> None:
    """Print the errors of one division of a grid."""
    offered, scored = divided(grid, seed)
    began = time.process_time()
    whole = searched(grid, offered, seed)
    error = rms(whole.calibration.calibrated, scored)
    count = int(grid.limit * len(offered))
    effects = len(whole.calibration.calibrated.effects)
    print(
        f"{grid.name}, division {seed}: {len(offered)} stations leave {1e3 * error:.4f} mm, {effects} effects, "
        f"{time.process_time() - began:.0f} s; of {count} stations",
        flush=True,
    )
    sets = [("by its information", by_information(whole, offered, count, seed))]
    for k in range(random):
        drawn = np.random.default_rng([seed, 100 + k]).choice(len(offered), count, replace=False)
        sets.append((f"random {k}", np.sort(drawn)))
    for name, chosen in sets:
        some = offered.select(chosen)
        told = rms(known(whole, some), scored) / error
        found = searched(grid, some, seed)
        alone = rms(found.calibration.calibrated, scored) / error
        more = rms(known(found, offered), scored) / error
        print(
            f"  {name}: effects known {told:.3f}; searched {alone:.3f} ({len(found.calibration.calibrated.effects)} "
            f"effects, which fitted to all stations leave {more:.3f})",
            flush=True,
        )


def main() -> None:
    """The grids that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grid", choices=("ur5", "ipa"))
    parser.add_argument("--divisions", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="the first division's seed")
    parser.add_argument("--random", type=int, default=3, help="random sets of stations of each division")
    asked = parser.parse_args()
    grid = ur5() if asked.grid == "ur5" else ipa()
    for seed in range(asked.first, asked.first + asked.divisions):
        bound(grid, seed, asked.random)


if __name__ == "__main__":
    main()
