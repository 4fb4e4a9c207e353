"""Readings that are written in another way than those of the calibration: no base moved, and no joint bent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from online.test_supervisor import BUMP, calibrated, feed, later
from scipy.spatial.transform import Rotation

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.online.supervisor import SUSPECTED, Policy, Supervisor

FLIP = np.diag([1.0, -1.0, 1.0])


def w_first(s: Samples) -> tuple[Array, Array]:
    return s.reading, Rotation.from_quat(Rotation.from_matrix(s.R).as_quat()[:, [3, 0, 1, 2]]).as_matrix()


def inverse(s: Samples) -> tuple[Array, Array]:
    R = np.swapaxes(s.R, 1, 2)
    return -np.einsum("nij,nj->ni", R, s.reading), R


def left_handed(s: Samples) -> tuple[Array, Array]:
    return s.reading @ FLIP, s.R


def left_handed_in_all(s: Samples) -> tuple[Array, Array]:
    return s.reading @ FLIP, FLIP @ s.R @ FLIP


def millimetres(s: Samples) -> tuple[Array, Array]:
    return 1e3 * s.reading, s.R


def followed(samples: Samples) -> Supervisor:
    supervisor = Supervisor(Policy(after_change=20))
    supervisor.trust(calibrated())
    feed(supervisor, samples)
    return supervisor


@pytest.mark.parametrize(
    ("written", "words"),
    [
        (w_first, "quaternions look like w x y z"),
        (inverse, "readings look like inverse poses"),
        (left_handed_in_all, "or a left-handed frame"),
        (millimetres, "positions look like millimetres"),
    ],
)
def test_what_is_written_in_another_way_is_named_and_not_solved(written, words: str) -> None:  # type: ignore[no-untyped-def]
    good = later(40)
    position, R = written(good)
    supervisor = followed(replace(good, reading=position, R=R))
    assert supervisor.state == SUSPECTED
    assert supervisor.hypothesis is not None
    assert words in supervisor.hypothesis.sentence
    assert supervisor.hypothesis.place == "tracker"
    assert not supervisor.wants_solve()


def test_a_few_readings_leave_it_open() -> None:
    good = later(40)
    position, R = left_handed(good)
    few = followed(replace(good, reading=position, R=R).select(np.arange(4)))
    assert few.hypothesis is not None
    assert "It may as well be readings in another unit or convention" in few.hypothesis.sentence


@pytest.mark.parametrize(
    ("bump", "place"), [(BUMP, "tool"), (se3.exp(np.array([0.0, 0.1, 0.2, 0.0, 0.0, 1.2])), "tool")]
)
def test_a_tool_that_moved_is_a_tool_however_far(bump: Array, place: str) -> None:
    supervisor = followed(later(40, bump=bump))
    assert supervisor.hypothesis is not None
    assert (supervisor.hypothesis.place, supervisor.hypothesis.mistake) == (place, False)
    assert supervisor.wants_solve()


def test_a_tool_that_was_turned_over_is_said_with_its_angle() -> None:
    supervisor = followed(later(40, bump=se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))))
    assert supervisor.hypothesis is not None
    assert supervisor.hypothesis.sentence.startswith("The tool or the target has moved: ")
    assert " and 28." in supervisor.hypothesis.sentence
