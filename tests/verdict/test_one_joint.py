"""A joint that scatters by far more than the others is named; what an instrument or all joints scatter is not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from cells import Recorded, samples_of, ur10
from verdict.visits import judged, said

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.stated import Stated
from modcal_core.measurements.samples import Samples


def scattered(made: Recorded, sizes: list[float], kind: str = "pose") -> Samples:
    """Readings of joints that stand elsewhere than reported by these deviations [rad], another time another way."""
    q = made.samples.q + np.array(sizes) * np.random.default_rng(4).normal(size=made.samples.q.shape)
    moved = samples_of(ur10(), made.samples.q, made.world.tool_in_tracker(q), kind)
    noise = made.samples.reading - made.exact.reading
    return replace(moved, reading=moved.reading + noise)


@pytest.mark.slow
@pytest.mark.parametrize("joint", [2])
def test_a_loose_encoder_is_named(made: Recorded, joint: int) -> None:
    sizes = [1e-5] * 6
    sizes[joint] = 4e-4
    samples = scattered(made, sizes)
    text = said(samples)
    size = re.search(rf"Joint {ur10().names[joint]} scatters by (0\.\d+) mrad RMS", text)
    assert size, text
    assert 0.3 < float(size[1]) < 0.45  # the worst stations are rejected
    known = Cell(stated=Stated(repeatability_mm=0.5, repeatability_deg=0.03, instrument_mm=0.09, instrument_deg=0.005))
    assert "scatters" not in said(samples, known)


@pytest.mark.slow
def test_a_loose_encoder_is_named_beside_what_is_predictable(made: Recorded) -> None:
    names = ur10().names
    wave = 7e-4 * np.sin(4.0 * made.samples.q[:, 0])
    for joint, size in ((4, 1.2e-3), (4, 1e-5)):
        sizes = np.full(6, 1e-5)
        sizes[joint] = size
        off = sizes * np.random.default_rng(4).normal(size=made.samples.q.shape)
        off[:, 0] += wave
        moved = samples_of(ur10(), made.samples.q, made.world.tool_in_tracker(made.samples.q + off))
        text = said(replace(moved, reading=moved.reading + made.samples.reading - made.exact.reading))
        assert "can be predicted" in text
        assert (f"Joint {names[joint]} scatters by 1." in text) == (size > 1e-3), text
        assert text.count(" scatters by ") == (size > 1e-3), text


@pytest.mark.slow
@pytest.mark.parametrize("bounded", [False, True])
def test_a_scatter_whose_largest_readings_were_rejected_is_told_apart(made: Recorded, bounded: bool) -> None:
    """Where none of them had to be rejected, what scatters may meet a tolerance."""
    rng, q = np.random.default_rng(4), made.samples.q.copy()
    q[:, 2] += rng.uniform(-7e-4, 7e-4, len(q)) if bounded else 3e-4 * rng.standard_t(3, len(q))
    moved = samples_of(ur10(), made.samples.q, made.world.tool_in_tracker(q))
    verdict = judged(replace(moved, reading=moved.reading + made.samples.reading - made.exact.reading))
    kinds = [r.kind for r in verdict.reasons if "scatters by" in r.sentence]
    assert kinds == ["predictable" if bounded else "cut_off"]


@pytest.mark.slow
def test_two_loose_encoders_are_named(made: Recorded) -> None:
    text = said(scattered(made, [1e-5, 5e-4, 1e-5, 5e-4, 1e-5, 1e-5]))
    names = ur10().names
    assert f"Joints {names[1]} and {names[3]} scatter by at least" in text or f"Joint {names[1]} scatters" in text, text


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "sizes"), [("pose", [3e-4, 1e-4, 1e-4, 1e-4, 2e-4, 1e-4]), ("point", [1e-5] * 6)])
def test_joints_that_are_alike_are_not(made: Recorded, kind: str, sizes: list[float]) -> None:
    assert "scatter" not in said(scattered(made, sizes, kind))


@pytest.mark.slow
@pytest.mark.parametrize("how", ["to one side", "across", "by angles"])
def test_a_tracker_that_scatters_is_no_joint_and_no_body(made: Recorded, how: str) -> None:
    """Along one axis, by its angle about one, much as the first joint of an arm on one side, and by all its angles."""
    p, rng = made.samples.reading, np.random.default_rng(5)
    side = np.cross(p, [0.0, 0.0, 1.0]) if how == "across" else np.tile([0.0, 1.0, 0.0], (len(p), 1))
    off = rng.normal(size=(len(p), 1)) * side if how != "by angles" else np.cross(rng.normal(size=p.shape), p)
    assert "scatter" not in said(replace(made.samples, reading=p + 3e-4 * off))
