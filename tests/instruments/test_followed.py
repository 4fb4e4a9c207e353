"""A calibration from mixed instruments is followed by its positions, and corrects with the covariance that it has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from instruments import worlds
from instruments.test_recovery import THEODOLITES, TRACKER, WIRES, read

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.store import from_data, to_data
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.loop import calibrate
from modcal_core.online.supervisor import Live


@pytest.mark.slow
def test_positions_are_followed_and_the_rest_is_passed_over() -> None:
    rng = np.random.default_rng(2)
    w = worlds.world(2)
    devices = [TRACKER, replace(WIRES[0], noise=2e-4), THEODOLITES[0]]
    samples = read(w, devices, worlds.postures(ur10(), 100, rng), rng)
    alone = samples.select(np.flatnonzero(samples.kind == "point"))
    alone = replace(alone, frames=("tracker",))
    made = {
        name: from_data(
            to_data(calibrate(s, ur10(), np.random.default_rng(0), Cell(), look_for_effects=False).calibration)
        )
        for name, s in (("mixed", samples), ("alone", alone))
    }
    live = Live(made["mixed"])
    new = read(w, devices, worlds.postures(ur10(), 60, rng), rng)
    for i in range(len(new)):
        live.add(new.select(np.array([i])))
    assert live.strange == 120
    assert live.estimator.taken == 60
    assert live.estimator.rejected == 0
    assert live.changed is None
    # the tracker says most; the others can only add to what it knows of the arm
    q = worlds.postures(ur10(), 1, rng)[0]
    none = np.zeros(6)
    now = ArmState(float(new.stamps[-1]), q, none, none, np.full(6, np.nan))
    size = {name: float(np.trace(Correction(c).covariance(q, now)[:3, :3])) for name, c in made.items()}
    assert 0.5 * size["alone"] < size["mixed"] < 1.2 * size["alone"]
