"""Rows of a track that grow; what was handed out of them stays as it is."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from modcal_msgs_py.track_rows import TrackRows

WIDTH = 3


@given(
    steps=st.lists(st.tuples(st.sampled_from(["extend", "look", "forget"]), st.integers(0, 70)), max_size=30),
    expected=st.sampled_from([0, 1, 40, 10**9]),
)
def test_rows_are_those_that_were_added(steps: list[tuple[str, int]], expected: int) -> None:
    """In their order, whatever number was expected; also what was looked at before more came."""
    rows, truth = TrackRows(WIDTH, expected), np.empty((0, 2 + WIDTH))
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    count = 0
    for what, n in steps:
        new = 10.0 * np.arange(count, count + n)[:, None] + np.arange(2 + WIDTH)
        if what == "extend":
            rows.extend(new[:, 0], new[:, 1], new[:, 2:3].astype(">f8"), new[:, 3:].astype(np.float32))
            truth, count = np.vstack([truth, new]), count + n
        elif what == "look":
            stamps, received, values = rows.columns()
            seen.append((np.column_stack([stamps, received, values]), truth))
            seen.append((values, truth[:, 2:]))  # the same memory as the rows'
        elif len(truth):
            border = truth[len(truth) // 2, 1]
            rows.forget_before(border)
            truth = truth[truth[:, 1] >= border]
        assert len(rows) == len(truth)
    stamps, received, values = rows.columns()
    assert values.shape == (len(truth), WIDTH)
    seen.append((np.column_stack([stamps, received, values]), truth))
    assert all(np.array_equal(there, then) for there, then in seen)


def test_a_number_that_was_wrongly_expected_takes_no_memory() -> None:
    rows = TrackRows(1, expected=10**15)
    rows.extend(np.zeros(100), np.zeros(100), np.zeros((100, 1)))
    values = rows.columns()[2]
    assert values.base is not None
    assert np.asarray(values.base).nbytes < 100_000
