"""A recording is known again by its readings, and only by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.calibration.store import from_data, to_data
from modcal_core.evaluation import evaluate
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples, marks_of, share_of_known
from modcal_core.outcome.contents import Outcome
from modcal_core.verdict.tolerance import Asked


def read_anew(samples: Samples, rng: np.random.Generator) -> Samples:
    """The same postures, returned to as the arm does, and read once more."""
    q = samples.q + 1e-5 * rng.standard_normal(samples.q.shape)
    return replace(samples, q=q, reading=samples.reading + 2e-5 * rng.standard_normal(samples.reading.shape))


@pytest.mark.parametrize("count", [60, 5000])
@pytest.mark.parametrize("clock", [True, False])
def test_a_recording_and_its_parts_are_known(count: int, clock: bool, rng: np.random.Generator) -> None:
    chain = ur10()
    samples = Samples.from_arrays(rng.uniform(-1.5, 1.5, (count, chain.n)), points=rng.normal(size=(count, 3)))
    samples = replace(samples, clock=clock)
    marks = marks_of(samples)
    assert len(marks) == 2 * min(count, 256)
    assert share_of_known(marks, samples)[0] == 1.0
    assert share_of_known(marks, samples.select(slice(0, count // 2)))[0] == 1.0
    other = read_anew(samples, rng)
    assert share_of_known(marks, other)[0] == 0.0
    some = replace(other, **{
        name: np.concatenate([getattr(samples, name)[: count // 3], getattr(other, name)[count // 3 :]])
        for name in ("q", "reading")
    })  # fmt: skip
    assert share_of_known(marks, some)[0] == pytest.approx(1.0 / 3.0, abs=0.1)
    assert share_of_known((), samples)[0] == 0.0
    rounded = replace(
        samples, q=np.round(samples.q, 5), reading=np.round(samples.reading, 4), stamps=samples.stamps + 9
    )
    assert share_of_known(marks, rounded)[0] == 0.0
    assert share_of_known(marks, rounded, rounded=True)[0] > 0.95
    assert share_of_known(marks, other, rounded=True)[0] < 0.75


def met(report: Outcome) -> str:
    tolerance = report.with_tolerance(Asked(5.0)).tolerance
    assert tolerance is not None
    return tolerance.result


def test_a_clock_tells_measurements_that_read_the_same(rng: np.random.Generator) -> None:
    samples = record(1, 60).samples
    assert samples.clock
    assert share_of_known(marks_of(samples), replace(samples, stamps=samples.stamps + 86400.0))[0] == 0.0


def test_an_error_on_the_own_recording_is_not_held_out(rng: np.random.Generator) -> None:
    made = record(2, 80)
    shipped = from_data(to_data(calibrate(made.samples, ur10(), rng, look_for_effects=False).calibration))
    own = evaluate(shipped, made.samples, rng)
    assert own.status == "open"
    assert any("of the calibration's own recording" in said for said in own.open_because)
    assert met(own) != "PASS"
    other = evaluate(shipped, read_anew(made.exact, rng), rng)
    assert not any("own recording" in said for said in other.open_because)
    assert met(other) == "PASS"
