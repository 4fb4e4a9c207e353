"""Readings that became no part of a sample are counted by reason, and none is counted twice or forgotten."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from cli.recordings import stations, streams, with_reading

from modcal_core.measurements.dropouts import ALONE, BETWEEN, GLITCHES, OUTSIDE, UNKNOWN, dropped, together, unexpected
from modcal_core.measurements.dwells import StationRules, find_dwells
from modcal_core.measurements.recording import Recording
from modcal_core.measurements.samples import cut_stations


def counts(recording: Recording) -> dict[str, int]:
    return dict(dropped(recording, cut_stations(recording, ur10().names)))


def test_finished_stations_lose_nothing() -> None:
    assert counts(stations(20)) == {}


def test_readings_without_a_joint_state_are_counted() -> None:
    whole = stations(30)
    t = whole.readings[0].stamps.copy()
    t[[4, 11]] += 0.5  # between two joint states, two seconds apart
    t[-1] += 100.0
    assert counts(with_reading(whole, stamps=t, received=t)) == {ALONE: 2, OUTSIDE: 1}


def test_of_a_stream_all_readings_are_in_a_dwell_between_them_or_wrong() -> None:
    whole = streams(12)
    track, joints = whole.readings[0], whole.joints[0]
    dwells = find_dwells(joints.stamps, joints.position, StationRules())
    inside = np.array([((track.stamps >= a) & (track.stamps < b)).any() for a, b in dwells])
    assert inside.all()
    in_dwell = np.zeros(len(track.stamps), bool)
    for a, b in dwells:
        in_dwell |= (track.stamps >= a) & (track.stamps < b)
    between = int((~in_dwell & (track.stamps >= joints.stamps[0]) & (track.stamps <= joints.stamps[-1])).sum())
    plain = counts(whole)
    outside = int(((track.stamps < joints.stamps[0]) | (track.stamps > joints.stamps[-1])).sum())
    assert plain.get(GLITCHES, 0) == 0
    assert plain[BETWEEN] == between
    assert plain.get(OUTSIDE, 0) == outside
    spoiled = track.values.copy()
    rows = np.flatnonzero(in_dwell)[[5, 40, 41]]
    spoiled[rows, 0] += 0.2  # a glitch of the tracker
    assert counts(with_reading(whole, values=spoiled))[GLITCHES] == 3
    assert unexpected(dropped(whole, cut_stations(whole, ur10().names))) == outside


def test_an_unknown_kind_is_counted() -> None:
    whole = stations(20)
    strange = replace(whole.readings[0], kind="smell", frame="nose")
    assert counts(replace(whole, readings=(*whole.readings, strange))) == {UNKNOWN: 20}


def test_pieces_add_up() -> None:
    whole = streams(12)
    samples = cut_stations(whole, ur10().names)
    middle = float(np.median(whole.joints[0].stamps))
    parts = [dropped(whole, samples, since=-np.inf, until=middle), dropped(whole, samples, since=middle)]
    assert dict(together(parts))[BETWEEN] == pytest.approx(counts(whole)[BETWEEN], abs=2)
