"""The one instrument of several that errs, stamps that are off in motion, and distances that were exchanged."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from cells import Recorded, samples_of, ur10
from verdict.visits import said

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.distances import Distance
from modcal_core.calibration.stated import Stated
from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples


def wires(made: Recorded, off: Array) -> Samples:
    """Ranges to three anchors, of which the second is off by so much (N,)."""
    p = made.exact.reading
    anchors = np.array([[2.0, 0.5, 0.2], [-1.5, 1.8, 1.3], [-1.0, -2.0, 0.4]])
    d = np.linalg.norm(p[:, None] - anchors, axis=2) + np.random.default_rng(7).normal(0.0, 5e-5, (140, 3))
    d[:, 1] += off
    ranges = {f"wire_{k + 1}": d[:, k] for k in range(3)}
    return Samples.from_arrays(made.samples.q, ranges=ranges, names=ur10().names)


@pytest.mark.slow
def test_the_wire_that_is_off_is_named_and_a_good_one_is_not(made: Recorded) -> None:
    straight = np.zeros(140)
    assert "instrument" not in said(wires(made, straight))
    d = wires(made, straight)
    length = d.reading[d.frame == d.frames.index("wire_2"), 0]
    bent = 2e-3 * np.minimum(length - np.median(length), 0.0)
    text = said(wires(made, bent))
    assert re.search("correlates with (its own length|where it points), as an error of 'wire_2'", text), text


@pytest.mark.slow
@pytest.mark.parametrize(("late", "open_"), [(0.0, False), (4e-3, True)])
def test_stamps_that_are_off_at_random_in_motion(made: Recorded, late: float, open_: bool) -> None:
    rng = np.random.default_rng(8)
    velocity = rng.normal(0.0, 0.2, made.samples.q.shape)
    then = made.samples.q + velocity * rng.uniform(-late, late, 140)[:, None]
    exact = samples_of(ur10(), made.samples.q, made.world.tool_in_tracker(then))
    noise = made.samples.reading - made.exact.reading
    samples = replace(exact, reading=exact.reading + noise, velocity=velocity, moving=np.ones(140, bool))
    assert ("lies along the direction of motion" in said(samples)) == open_
    known = Cell(stated=Stated(repeatability_mm=2.0, repeatability_deg=0.1, instrument_mm=0.09, instrument_deg=0.005))
    assert "direction of motion" not in said(samples, known)


@pytest.mark.slow
def test_two_stated_distances_that_stand_for_each_other(made: Recorded) -> None:
    """Readings in four frames, whose origins are known to be 0.4 and 1.2 m apart, stated the other way round."""
    origin = {"a": [0.0, 0.0, 0.0], "b": [0.4, 0.0, 0.0], "c": [0.0, 0.0, 0.1], "d": [0.0, 1.2, 0.1]}
    frame = np.arange(140) % 4
    reading = made.samples.reading - np.array(list(origin.values()))[frame]
    samples = replace(made.samples, frames=tuple(origin), frame=frame, reading=reading)
    right = Distance(("a", "b"), 0.4), Distance(("c", "d"), 1.2)
    assert "distance" not in said(samples, Cell(distances=right))
    wrong = Distance(("a", "b"), 1.2), Distance(("c", "d"), 0.4)
    with pytest.raises(BadRecording, match="between a and b and the distance between c and d look exchanged"):
        said(samples, Cell(distances=wrong))
