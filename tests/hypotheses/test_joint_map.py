"""Joint positions that are linear mixtures of what they should be, and readings that follow another link."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10
from scipy.spatial.transform import Rotation

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.measurements.samples import Samples
from modcal_core.robots.kinematics import frames

CHAIN = ur10()
NAMES = CHAIN.names


@pytest.fixture(scope="module")
def clean() -> Samples:
    return record(12, 90).samples


def points(samples: Samples) -> Samples:
    return replace(samples, kind=np.full(len(samples), "point"))


def reported(samples: Samples, B: Array, c: Array | float = 0.0) -> Samples:
    return replace(samples, q=samples.q @ np.asarray(B, dtype=float).T + c)


def mixed(i: int, j: int, values: list[list[float]]) -> Array:
    B = np.eye(6)
    B[np.ix_((i, j), (i, j))] = values
    return B


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pair", "values"),
    [((0, 3), [[0.5, 0.5], [-0.5, 0.5]]), ((4, 5), [[1, 0.4], [0, 1]])],
)
def test_two_joints_that_are_mixed(clean: Samples, pair: tuple[int, int], values: list[list[float]]) -> None:
    found = disagreement(reported(clean, mixed(*pair, values)), CHAIN)
    assert found is not None
    named = {name for name in NAMES if f"{name} =" in found.what}
    assert named == {NAMES[pair[0]], NAMES[pair[1]]} - ({NAMES[pair[1]]} if values[1] == [0, 1] else set())


@pytest.mark.slow
def test_sum_and_difference_is_said_in_fractions_and_seen_by_points(clean: Samples) -> None:
    found = disagreement(points(reported(clean, mixed(2, 3, [[1, 1], [1, -1]]))), CHAIN)
    assert found is not None
    a, b = NAMES[2:4]
    assert f"{a} = 0.5 {a} + 0.5 {b}; {b} = 0.5 {a} - 0.5 {b}" in found.what


def test_joints_of_other_scales_and_zeros(clean: Samples) -> None:
    found = disagreement(reported(clean, np.diag([1, 1, 1, 1.25, 1, 0.8])), CHAIN)
    assert found is not None
    assert f"{NAMES[3]} = 0.8 {NAMES[3]}; {NAMES[5]} = 1.25 {NAMES[5]}" in found.what
    found = disagreement(reported(clean, np.eye(6), np.radians([0, 0, 25.0, -15.0, 0, 0])), CHAIN)
    assert found is not None
    assert f"{NAMES[2]} by -25.0° and {NAMES[3]} by 14.9°" in found.what  # an arm of its own small errors


@pytest.mark.parametrize(
    ("link", "of"), [((0, 2), points), ((0, 5), lambda s: s), ((1, 6), lambda s: s), ((3, 6), points), ((2, 5), points)]
)
def test_readings_of_another_link(clean: Samples, link: tuple[int, int], of) -> None:  # type: ignore[no-untyped-def]
    f = frames(CHAIN, clean.q)
    first, last = (f.transform(k) for k in link)
    stand = se3.transform(Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix(), [2.0, 0.5, 0.3])
    tool = se3.exp(np.array([0.1, 0.05, 0.2, 0.4, 0.3, -0.2]))
    T = stand @ se3.inverse(first) @ last @ tool
    rng = np.random.default_rng(1)
    seen = of(replace(clean, reading=T[:, :3, 3] + rng.normal(0, 2e-5, (len(clean), 3)), R=T[:, :3, :3]))
    found = disagreement(seen, CHAIN)
    assert found is not None
    if link[0]:
        assert f"the link behind {NAMES[link[0] - 1]}" in found.what
    if link[1] < 6:
        assert f"the link before {NAMES[link[1]]} (" in found.what
    if link[0] == 0:
        assert f"{NAMES[-1]} do" in found.what


@pytest.mark.slow
def test_a_part_follows_another_link_or_has_other_columns(clean: Samples) -> None:
    f, half = frames(CHAIN, clean.q), len(clean) // 2
    stand = se3.transform(Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix(), [2.0, 0.5, 0.3])
    T = stand @ f.transform(3) @ se3.exp(np.array([0.1, 0.05, 0.2, 0.4, 0.3, -0.2]))
    p, R = clean.reading.copy(), clean.R.copy()
    p[half:], R[half:] = T[half:, :3, 3], T[half:, :3, :3]
    found = disagreement(replace(clean, reading=p, R=R), CHAIN)
    assert found is not None
    assert found.what.startswith("readings follow")
    assert f"the link before {NAMES[3]} (" in found.what
    q = reported(clean, mixed(4, 5, [[1, 1], [1, -1]])).q
    found = disagreement(replace(clean, q=np.where(np.arange(len(clean))[:, None] < half, clean.q, q)), CHAIN)
    assert found is not None
    assert f"{NAMES[4]} = 0.5 {NAMES[4]} + 0.5 {NAMES[5]}" in found.what
