"""A bag that is read in pieces gives the stations that it gives whole."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import ur10
from cli.recordings import START, streams

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import Recording, SignalTrack
from modcal_core.preprocess import Prepared, prepare, prepare_pieces
from modcal_msgs_py import mcap_read
from modcal_msgs_py.mcap_read import read_pieces, read_recording
from modcal_msgs_py.recording_write import write_recording


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of an hour's fifth, with a temperature beside it."""
    recording = streams(200)
    t = np.arange(START, START + recording.duration, 2.0)
    warmth = SignalTrack("temperature:forearm_link", t, 20.0 + 0.01 * (t - START)[:, None], "/temperature")
    folder = tmp_path_factory.mktemp("long") / "bag"
    write_recording(replace(recording, signals=(warmth,)), folder)
    return folder


def prepared_in(bag: Path, most: int | None) -> tuple[Prepared, int]:
    pieces = list(read_pieces(bag, most))
    return prepare_pieces(pieces, ur10()), len(pieces)


@pytest.mark.slow
def test_pieces_give_the_stations_of_the_whole(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = prepare(read_recording(bag), ur10()).samples
    joint_states = len(read_recording(bag).joints[0].stamps)
    monkeypatch.setattr(mcap_read, "OVERLAP", 12.0)
    prepared, count = prepared_in(bag, joint_states // 7)
    assert count > 4
    pieces = prepared.samples
    assert len(pieces) == len(whole) == 200
    # stations that stand where pieces meet are found once; their edges lie as they lay to a message
    assert np.abs(pieces.stamps - whole.stamps).max() < 0.1
    assert np.abs(pieces.q - whole.q).max() < 1e-9
    assert np.abs(pieces.reading - whole.reading).max() < 1e-5
    assert np.array_equal(pieces.approach[1:], whole.approach[1:])
    assert len(np.unique(pieces.station)) == 200
    (warmth,), (known,) = pieces.signals, whole.signals
    assert np.array_equal(warmth.stamps, known.stamps)
    assert np.array_equal(warmth.values, known.values)


def test_nothing_is_cut_where_a_clock_was_set_back() -> None:
    recording = streams(60)
    assert mcap_read._border(recording) is not None
    joints = recording.joints[0]
    later = joints.stamps > np.median(joints.stamps)
    back = replace(recording, joints=(replace(joints, stamps=joints.stamps - 3600.0 * later),))
    assert mcap_read._border(back) is None


@pytest.mark.slow
def test_a_piece_without_a_station_is_passed_over(bag: Path) -> None:
    (whole,) = read_pieces(bag, None)
    blind = replace(whole, recording=replace(whole.recording, readings=()))
    both = prepare_pieces([blind, whole], ur10())
    assert len(both.samples) == 200
    assert any("left out" in note for note in both.notes)
    with pytest.raises(BadRecording, match="tracker"):
        prepare_pieces([blind, blind], ur10())
    with pytest.raises(BadRecording, match="no message was received"):
        prepare_pieces(list[Recording](), ur10())  # type: ignore[arg-type]
