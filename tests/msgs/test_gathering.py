"""Bags in many small chunks are read as those in few large ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from modcal_core.measurements.recording import Recording
from modcal_msgs_py import mcap_read
from modcal_msgs_py.mcap_walk import HEAD, PADDING, Block
from modcal_msgs_py.messages import gathered

ROOT = Path(__file__).resolve().parents[2]
BAG = ROOT / "bags" / "ur10_cell"


def arrays(recording: Recording) -> list[NDArray[np.float64]]:
    out = []
    for track in (*recording.joints, *recording.readings):
        out += [
            track.stamps,
            track.received,
            *(getattr(track, name) for name in ("position", "values") if hasattr(track, name)),
        ]
    return out


def test_the_recording_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the last bit, warnings and the order of tracks included."""
    merged = mcap_read.read_recording(BAG)
    monkeypatch.setattr(mcap_read, "gathered", lambda blocks: blocks)
    apart = mcap_read.read_recording(BAG)
    assert [track.topic for track in merged.joints] == [track.topic for track in apart.joints]
    assert [track.topic for track in merged.readings] == [track.topic for track in apart.readings]
    assert (merged.warnings, merged.robot_description) == (apart.warnings, apart.robot_description)
    pairs = list(zip(arrays(merged), arrays(apart), strict=True))
    assert len(pairs) == 6
    assert all(a.tobytes() == b.tobytes() for a, b in pairs)


def test_a_channel_that_is_new_is_met_where_it_was() -> None:
    """Else topics would be met in the order of their channels, and not of their first messages."""

    def block(*channels: int) -> Block:
        heads = np.zeros(len(channels), HEAD)
        heads["channel"] = channels
        places = np.arange(len(channels), dtype=np.int64)
        return Block(bytes(len(channels)) + PADDING, heads, places, places + 1)

    found = [
        b.heads["channel"].tolist() for b in gathered([block(7), block(7), block(7, 3), block(3), block(7), block(1)])
    ]
    assert found == [[7], [7], [7, 3], [3, 7], [1]]
