"""Drivers at the same samples are made once where they are remembered, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

from cells import record, ur10

from modcal_core.calibration.model import place_model
from modcal_core.effects.drivers import _LAST, remembered


def test_drivers_are_remembered_within_the_context_alone() -> None:
    """Of the same samples and the same arm; other samples of the same numbers are others."""
    samples = record(0, 20).samples
    model = place_model(ur10(), samples.frames)
    with remembered():
        first = model.drivers(samples)
        assert model.drivers(samples) is first
        assert model.drivers(replace(samples)) is not first
        assert place_model(ur10(), samples.frames).drivers(samples) is not first
        for _ in range(_LAST):
            model.drivers(replace(samples))
        assert model.drivers(samples) is not first  # memory holds but the last few
    assert model.drivers(samples) is not model.drivers(samples)
