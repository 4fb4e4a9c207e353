"""What one sample more costs: of the running calibration, of its watch, and of an articulated object."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from articulation.objects import ideal, noisy
from cells import record, ur10
from timing import Row, median_ms, pair_ms

from modcal_core.articulation.online import Tracker
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.identify import identify
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.diagnosis.evidence import Scanner
from modcal_core.effects.registry import candidates
from modcal_core.online.change_detector import ChangeDetector
from modcal_core.online.estimator import Estimator

ROWS = 256
STATIONS = 160


def rows() -> Iterator[Row]:
    """Against a batch fit of all samples; its solution and the running one are checked to be the same."""
    samples = record(1, 1_000, "pose").samples
    start = fit_cell(ur10(), samples, Cell()).model
    parameters = choose_parameters(start, views_of(samples)).parameters
    fit = identify(start, samples, parameters, robust=False)
    single = [samples.select(np.array([i])) for i in range(len(samples))]
    running = Estimator(start, parameters, fit.noise, robust=False)
    for row in single:
        running.update(row)
    running.relinearise()
    apart = float(np.abs((running.values - fit.values) / fit.std).max())
    if apart > 1e-2:
        raise SystemExit(f"the running estimate is {apart:.2g} standard deviations from the batch")
    estimator = Estimator(fit.model, fit.parameters, fit.noise, fit.covariance)
    watch = ChangeDetector(fit.model, fit.parameters, fit.covariance, fit.noise)
    batch = lambda: identify(fit.model, samples, parameters)  # noqa: E731
    ours, other = pair_ms(lambda: [estimator.update(row) for row in single[:ROWS]], batch, 5)
    yield Row("online", "recursive update, one pose", ours / ROWS, "batch fit of 1000", other)
    yield Row("online", "watch, one pose", median_ms(lambda: [watch.add(row) for row in single[:ROWS]], 3) / ROWS)

    rng = np.random.default_rng(1)
    seen = noisy(ideal("revolute", np.linspace(0.0, 1.2, ROWS), rng, 0.4), rng, 5e-4, 0.003)

    def follow(oriented: bool) -> None:
        tracker = Tracker()
        for i, p in enumerate(seen.positions):
            tracker.update(p, seen.rotations[i] if oriented and seen.rotations is not None else None, 0.01 * i)

    for name in ("pose", "point"):
        ms = median_ms(lambda n=name: follow(n == "pose"), 3) / ROWS
        yield Row("online", f"articulation update, one {name}", ms, remark=f"mean of {ROWS}")


def diagnosis() -> Iterator[Row]:
    """The whole dictionary on 160 stations: to set up, and to weigh with random signs."""
    samples = record(2, STATIONS, "pose").samples
    start = fit_cell(ur10(), samples, Cell()).model
    fit = identify(start, samples, choose_parameters(start, views_of(samples)).parameters)

    def scan() -> int:
        at = fit.model.drivers(samples)
        effects = list(candidates(at))
        Scanner(effects, at).evidence(fit, np.random.default_rng(0))
        return len(effects)

    ms = median_ms(scan, 3)
    yield Row("diagnosis", f"scan, {STATIONS} stations", ms, remark=f"{scan()} candidates, significance included")
