"""What is found has a name: no direction is printed blank, and the column of a lagging joint is that joint's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability
from modcal_core.calibration.fit import identify
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import PART, SignalTrack
from modcal_core.report.as_json import to_json_data


def test_no_direction_is_printed_blank() -> None:
    """Where many parameters share what is not shown, each being a small part of it, some are named all the same."""
    samples = record(1, 60).samples
    nominal = fit_cell(ur10(), samples, Cell())
    fit = identify(nominal.model, samples, choose_parameters(nominal.model, views_of(samples)).parameters)
    prior = np.array([p.prior_std if np.isfinite(p.prior_std) else 1.0 for p in fit.parameters])
    for count in (2, 5, len(prior)):
        blind = np.zeros(len(prior))
        blind[:count] = 1.0 / np.sqrt(count)
        seen = 100.0 * (np.eye(len(prior)) - np.outer(blind, blind))
        found = identifiability(replace(fit, information=seen / np.outer(prior, prior)))
        assert found.rank == len(prior) - 1
        (said,) = found.unobservable
        assert said
        named = said.split(" with ")
        assert set(named) <= {p.name for p in fit.parameters[:count]}
        assert len(named) == min(count, 3 if count > 11 else count)


@pytest.mark.slow
def test_the_column_of_a_lagging_joint_names_the_joint() -> None:
    """A topic tells by how much each joint misses its goal, and one joint is logged where it was to be: 1 rad/rad."""
    samples, rng = record(3, 140).samples, np.random.default_rng(0)
    missed = rng.normal(0.0, 2e-3, samples.q.shape)
    q = samples.q.copy()
    q[:, 2] -= missed[:, 2]
    columns = tuple(
        SignalTrack(f"signal:/joint_errors{PART}{name}", samples.stamps, missed[:, [k]], "/joint_errors")
        for k, name in enumerate(samples.names)
    )
    report = calibrate(replace(samples, q=q, signals=columns), ur10(), np.random.default_rng(0)).report
    found = [
        effect for effect in to_json_data(report)["effects"] if effect["driver"].startswith("signal:/joint_errors")
    ]
    assert [(effect["place"], effect["direction"]) for effect in found] == [("elbow_joint", "axis")]
    size = found[0]["parameters"]["axis"]
    assert abs(size["value"] - 1.0) < 3.0 * size["std"] + 0.005
    assert size["std"] < 0.01
