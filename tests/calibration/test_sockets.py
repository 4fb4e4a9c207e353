"""One fixed point is a socket where it is stated, and a tracker that stands still where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.cell import Cell, with_sockets
from modcal_core.calibration.distances import Distance
from modcal_core.errors import BadRecording
from modcal_core.evaluation import evaluate
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import ORDER_ONLY, SOCKETS, Recording

CHAIN = ur10()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["point", "pose"])
@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_a_tracker_that_stands_still_is_refused(kind: str, noise: float) -> None:
    made = record(1, 80, kind)
    T = np.repeat(made.world.tool_in_tracker(made.samples.q[:1]), 80, axis=0)
    T[:, :3, 3] += noise * np.random.default_rng(0).normal(size=(80, 3))
    with pytest.raises(BadRecording, match=rf"/tracker/{kind} \(tracker\): readings stand still .*sockets"):
        calibrate(samples_of(CHAIN, made.samples.q, T, kind), CHAIN, np.random.default_rng(0))
    good = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    with pytest.raises(BadRecording, match="stand still"):
        evaluate(good, samples_of(CHAIN, made.samples.q, T, kind), np.random.default_rng(0))


@pytest.mark.parametrize("kind", ["point", "pose"])
def test_metres_that_were_taken_for_millimetres_do_not_stand_still(kind: str) -> None:
    """A thousandth of the way is a unit: only what does not go along with the tip is a tracker that stands still."""
    made = record(1, 80, kind)
    good = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    small = replace(made.samples, reading=1e-3 * made.samples.reading)
    with pytest.raises(BadRecording, match="metres taken for millimetres"):
        evaluate(good, small, np.random.default_rng(0))


def test_sockets_are_stated_by_the_cell_a_distance_or_the_recording() -> None:
    q = np.random.default_rng(0).uniform(-1, 1, (10, 6))
    origin = np.tile(np.eye(4), (10, 1, 1))
    samples = samples_of(CHAIN, q, origin, "point", "a")
    both = samples.followed_by(samples_of(CHAIN, q, origin, "point", "b"))
    assert with_sockets(both, Cell(sockets=("a", "b")), CHAIN).sockets == ("a", "b")
    assert with_sockets(both, Cell(distances=(Distance(("a", "b"), 0.05, 1e-4),)), CHAIN).is_same_point(1)
    assert with_sockets(replace(both, sockets=("b", "a")), Cell(), CHAIN).is_same_point(0)
    with pytest.raises(BadRecording, match=r"point \(b\)"):
        with_sockets(both, Cell(sockets=("a",)), CHAIN)


def test_a_recording_says_what_its_notes_state() -> None:
    stated = Recording(warnings=(ORDER_ONLY, f"{SOCKETS}left_hole_0, left_hole_1."))
    assert stated.sockets == ("left_hole_0", "left_hole_1")
    assert not stated.has_clock
    assert Recording(warnings=("A note.",)).has_clock
    samples = record(1, 20).samples
    assert not samples.followed_by(replace(samples, clock=False)).clock
