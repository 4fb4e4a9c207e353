"""A gauge block whose ends the tool touched gives bearings their scale; frames known in others are held to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from finite_differences import assert_jacobian
from instruments import worlds
from instruments.test_recovery import ANCHORS, T_TRACKER_BASE, THEODOLITES, TRACKER, WIRES, read

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability
from modcal_core.calibration.distances import StationDistance, distance_rows
from modcal_core.calibration.fit import identify
from modcal_core.calibration.initial import Known
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import BadTable


def blocks(seed: int) -> tuple[worlds.World, worlds.Samples, tuple[StationDistance, ...]]:
    """Two theodolites, and three distances between stations as MuJoCo has them."""
    rng = np.random.default_rng(seed)
    w = worlds.world(seed)
    q = worlds.postures(ur10(), 100, rng)
    samples = read(w, THEODOLITES, q, rng)
    p = w.tool_in_base(q)[:, :3, 3]
    t = np.unique(samples.stamps)
    known = tuple(
        StationDistance((float(t[a]), float(t[b])), float(np.linalg.norm(p[a] - p[b])), 2e-5)
        for a, b in ((3, 40), (17, 80), (55, 91))
    )
    return w, samples, known


@pytest.mark.slow
def test_derivatives() -> None:
    _, samples, known = blocks(1)
    met = [d.met(samples) for d in known]
    start = fit_cell(ur10(), samples, Cell()).model
    parameters = choose_parameters(start, views_of(samples)).parameters
    x = 0.01 * np.random.default_rng(1).normal(size=len(parameters))
    J = distance_rows(start, parameters, x, met).J
    assert_jacobian(lambda v: -distance_rows(start, parameters, v, met).residual, J.T, x)


@pytest.mark.slow
def test_a_few_known_lengths_give_bearings_their_scale() -> None:
    scores = []
    for seed in range(2):
        w, samples, known = blocks(seed)
        cell = Cell(distances=known).met(samples)
        start = fit_cell(ur10(), samples, cell).model
        parameters = choose_parameters(start, views_of(samples), cell.kept, cell.distances).parameters
        fit = identify(start, samples, parameters, cell.distances)
        seen = identifiability(fit)
        assert seen.rank == seen.parameters
        # lengths that were never stated: between postures that are new
        q = worlds.postures(ur10(), 50, np.random.default_rng(seed + 50))
        true, found = w.tool_in_base(q)[:, :3, 3], fit.model.predict(q)[:, :3, 3]
        ratio = np.linalg.norm(found - np.roll(found, 1, axis=0), axis=1)
        ratio /= np.linalg.norm(true - np.roll(true, 1, axis=0), axis=1)
        scores.append(float(np.median(ratio)) - 1.0)
    assert np.sqrt(np.mean(np.square(scores))) < 1e-4  # the drawing's own lengths are off by about 1e-3


def test_a_station_that_is_not_there_is_refused() -> None:
    _, samples, known = blocks(1)
    with pytest.raises(BadTable, match="no station within 0.5 s of 12.000 s"):
        replace(known[0], stamps=(12.0, known[0].stamps[1])).met(samples)


def test_an_anchor_known_in_the_trackers_frame_moves_with_it() -> None:
    """Its three numbers are then fitted no more, and the zero is known better."""
    devices = [TRACKER, WIRES[0]]
    rng = np.random.default_rng(2)
    samples = read(worlds.world(2), devices, worlds.postures(ur10(), 100, rng), rng)
    T_wire_tracker = np.eye(4)
    T_wire_tracker[:3, 3] = -(T_TRACKER_BASE[:3, :3] @ ANCHORS[0] + T_TRACKER_BASE[:3, 3])
    found = {}
    for name, cell in {"free": Cell(), "known": Cell(known=(Known("wire_0", "tracker", T_wire_tracker),))}.items():
        start = fit_cell(ur10(), samples, cell).model
        found[name] = identify(start, samples, choose_parameters(start, views_of(samples), cell.kept).parameters)
    assert len(found["free"].parameters) - len(found["known"].parameters) == 3
    zero = "instrument wire_0/zero"
    assert found["known"].deviation(zero) < 0.8 * found["free"].deviation(zero)
    assert abs(found["known"].model.instruments[0].values[0] - 0.123) < 3.0 * found["known"].deviation(zero)
