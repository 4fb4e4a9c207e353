"""Readings that stand beside another posture than their own, and what they are said to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.geometry.so3 import Array
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.measurements.samples import Samples

CHAIN = ur10()


@pytest.fixture(scope="module")
def clean() -> Samples:
    return record(12, 90).samples


def reordered(samples: Samples, rows: Array) -> Samples:
    return replace(samples, reading=samples.reading[rows], R=samples.R[rows])


def as_points(samples: Samples) -> Samples:
    return replace(samples, kind=np.full(len(samples), "point"), R=np.broadcast_to(np.eye(3), samples.R.shape))


def said(samples: Samples) -> str:
    found = disagreement(samples, CHAIN)
    assert found is not None
    return found.what


@pytest.mark.slow
def test_another_tool_in_a_part_is_no_other_order(clean: Samples) -> None:
    other = np.arange(90) >= 60
    tool = replace(clean, reading=clean.reading + np.where(other, 0.2, 0.0)[:, None] * clean.R[:, :, 0])
    assert disagreement(as_points(clean), CHAIN) is None
    assert "the tool (or the target on it) is displaced at stations 60 to 89" in said(tool)


@pytest.mark.slow
def test_a_part_that_slipped(clean: Samples) -> None:
    samples = as_points(clean)
    rows = np.arange(90)
    rows[50:] = rows[49:-1]
    assert "readings at stations 50 to 89 look late by 1 station" in said(reordered(clean, rows))
    q = samples.q.copy()
    q[40:-2] = q[42:]
    assert "look late by 2 stations" in said(replace(samples, q=q))


@pytest.mark.slow
def test_rows_in_another_order(clean: Samples) -> None:
    assert "in reverse order" in said(reordered(clean, np.arange(90)[::-1]))
    named = np.array(sorted(range(90), key=lambda k: str(k + 1)))
    assert "stand in the order of file names" in said(reordered(clean, named))
    assert "were put in the order of file names" in said(reordered(clean, np.argsort(named)))
    assert "two parts that are exchanged" in said(reordered(as_points(clean), np.roll(np.arange(90), 40)))
    assert "look late by 7 stations" in said(reordered(clean, np.maximum(np.arange(90) - 7, 0)))


@pytest.mark.parametrize("seed", [4, 5])
def test_rows_in_any_order(clean: Samples, seed: int) -> None:
    rows = np.random.default_rng(seed).permutation(90)
    assert "belong to other stations, in another order of rows" in said(reordered(clean, rows))
    sorted_apart = np.argsort(clean.reading[:, 0])  # each column of readings and joints by one of its own
    assert "belong to other stations" in said(reordered(clean, sorted_apart))


@pytest.mark.slow
def test_a_part_in_reverse_order_pairs_and_labels(clean: Samples) -> None:
    rows = np.arange(90)
    rows[60:] = rows[60:][::-1]
    assert "stand in reverse order of the rows" in said(reordered(clean, rows))
    rows = np.arange(90)
    for k in range(0, 90, 6):
        rows[[k, k + 1]] = rows[[k + 1, k]]
    assert "look swapped two and two" in said(reordered(clean, rows))
    rows, rng = np.arange(90), np.random.default_rng(2)
    mixed = np.sort(rng.choice(90, 24, replace=False))
    rows[mixed] = np.roll(rng.permutation(mixed), 1)
    assert "belong to other stations" in said(reordered(clean, rows))
