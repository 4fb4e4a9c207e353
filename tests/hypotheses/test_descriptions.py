"""Joints in any order, joints of another type, parts with a base of their own, readings that were computed in part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.geometry import se3
from modcal_core.hypotheses.computed_part import computed_in_part
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import forward

CHAIN = ur10()


@pytest.fixture(scope="module")
def clean() -> Samples:
    return record(11, 80).samples


@pytest.mark.parametrize(("kind", "order"), [("pose", (1, 2, 3, 4, 5, 0)), ("point", (3, 1, 5, 0, 2, 4))])
def test_joints_in_any_order_are_named_one_by_one(clean: Samples, kind: str, order: tuple[int, ...]) -> None:
    """Column k holds the position of joint order[k]: the right order is the inverse."""
    samples = replace(clean, q=clean.q[:, list(order)], kind=np.full(80, kind, clean.kind.dtype))
    said = disagreement(samples, CHAIN)
    assert said is not None
    for k, joint in enumerate(order):
        if joint != k:
            assert f"{CHAIN.names[joint]} under the name {CHAIN.names[k]}" in said.what
    assert ("all by 1 place" in said.what) == (order[0] == 1)


def test_an_order_and_a_sign_together(clean: Samples) -> None:
    q = clean.q[:, [3, 1, 5, 0, 2, 4]] * [1.0, 1.0, -1.0, 1.0, 1.0, 1.0]
    said = disagreement(replace(clean, q=q), CHAIN)
    assert said is not None
    assert "wrist_3_joint looks reversed" in said.what


@pytest.mark.parametrize("j", [1, 3])
def test_a_joint_that_slides_in_the_description_and_turns(clean: Samples, j: int) -> None:
    revolute = CHAIN.revolute.copy()
    revolute[j] = False
    said = disagreement(clean, replace(CHAIN, revolute=revolute))
    assert said is not None
    assert f"joint {CHAIN.names[j]} is prismatic" in said.what


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_a_tracker_that_is_set_to_zero_three_times(clean: Samples, kind: str) -> None:
    T = se3.transform(clean.R, clean.reading)
    for a, b in ((0, 22), (22, 51), (51, 80)):
        T[a:b] = se3.inverse(T[a]) @ T[a:b]
    kinds = np.full(80, kind, clean.kind.dtype)
    said = disagreement(replace(clean, reading=T[:, :3, 3], R=T[:, :3, :3], kind=kinds), CHAIN)
    assert said is not None
    assert "tracker" in said.what
    assert "tool" not in said.what
    assert "stations 0 to 21, 22 to 50, 51 to 79" in said.what


def test_a_target_that_is_mounted_anew(clean: Samples) -> None:
    T = se3.transform(clean.R, clean.reading)
    T[30:60] = T[30:60] @ se3.exp([0.05, 0.02, 0.0, 0.3, 0.0, 0.4])
    T[60:] = T[60:] @ se3.exp([0.0, 0.0, 0.08, 0.0, -0.5, 0.0])
    said = disagreement(replace(clean, reading=T[:, :3, 3], R=T[:, :3, :3]), CHAIN)
    assert said is not None
    assert said.what.startswith("the tool")


@pytest.mark.parametrize("rows", [np.arange(20, 40), np.arange(0, 80, 4)])
def test_poses_that_the_controller_filled_in(clean: Samples, rows: np.ndarray) -> None:
    """With any base and tool; a micrometre more than instruments resolve is a measurement again."""
    base, tool = se3.exp([1.0, 0.4, 0.2, 0.1, -0.3, 2.0]), se3.exp([0.02, 0.05, 0.1, 0.4, 0.1, 0.0])
    T = base @ forward(CHAIN, clean.q[rows]) @ tool
    reading, R = clean.reading.copy(), clean.R.copy()
    reading[rows], R[rows] = T[:, :3, 3], T[:, :3, :3]
    filled = replace(clean, reading=reading, R=R)
    (said,) = computed_in_part(filled, CHAIN)
    assert "20 of 80 stations" in said
    assert "computed from the joints" in said
    reading[rows] += np.random.default_rng(2).normal(0.0, 2e-5, (20, 3))
    assert computed_in_part(replace(filled, reading=reading), CHAIN) == ()


def test_points_that_the_controller_filled_in_while_the_target_was_hidden(clean: Samples) -> None:
    rows = np.arange(30, 62)
    reading = clean.reading.copy()
    reading[rows] = se3.apply(se3.exp([1.0, 0.4, 0.2, 0.1, -0.3, 2.0]) @ forward(CHAIN, clean.q[rows]), np.ones(3) / 9)
    points = replace(clean, reading=reading, kind=np.full(80, "point", clean.kind.dtype))
    (said,) = computed_in_part(points, CHAIN)
    assert "stations 30 to 61" in said
