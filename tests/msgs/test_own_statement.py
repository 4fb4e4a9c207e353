"""Covariances in messages are believed where the readings bear them out, and said not to be where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from cli.recordings import stations, streams, with_reading

from modcal_core.calibration.cell import own_statement
from modcal_core.calibration.stated import Stated
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import Recording
from modcal_core.preprocess import prepare
from modcal_msgs_py.readings import deviations

NAMES = ur10().names
TRUE_M = np.sqrt(3.0) * 2e-5  # of cli.recordings.streams: 20 µm along each axis


@pytest.fixture(scope="module")
def recording() -> Recording:
    return streams(12)


def stating(recording: Recording, metres: float, radians: float = np.nan) -> Recording:
    n = len(recording.readings[0].stamps)
    return with_reading(recording, stated=np.tile([metres, radians], (n, 1)))


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_what_the_readings_bear_out_is_used(recording: Recording, factor: float) -> None:
    own = own_statement(stating(recording, factor * TRUE_M), NAMES)
    assert own.stated.instrument_mm == pytest.approx(1e3 * factor * TRUE_M)
    assert own.stated.instrument_deg is None
    assert "which agrees with it" in own.notes[0]
    scatter = float(own.notes[0].partition("scatter by ")[2].split()[0])
    assert scatter == pytest.approx(1e3 * TRUE_M, rel=0.1)  # of some hundreds of readings


@pytest.mark.parametrize("factor", [0.1, 30.0, 1e6])
def test_what_the_readings_contradict_is_not_used_and_said(recording: Recording, factor: float) -> None:
    """Too small by invention, or ten millimetres out of a default: a floor made of it would call anything good."""
    own = own_statement(stating(recording, factor * TRUE_M), NAMES)
    assert own.stated == Stated()
    assert "not used, because its readings scatter by" in own.notes[0]


def test_what_cannot_be_compared_is_not_used_and_said() -> None:
    own = own_statement(stating(stations(40), 1e-5), NAMES)
    assert own.stated == Stated()
    assert "does not stand still long enough to compare" in own.notes[0]


def test_prepare_hands_it_on_and_a_persons_word_is_stronger(recording: Recording) -> None:
    prepared = prepare(stating(recording, TRUE_M), ur10())
    assert prepared.stated.instrument_mm == pytest.approx(1e3 * TRUE_M)
    assert any("agrees with it" in note for note in prepared.notes)
    assert Stated(instrument_mm=0.5).over(prepared.stated).instrument_mm == 0.5


@pytest.mark.parametrize(
    ("diagonal", "expected"),
    [
        ([1e-6, 4e-6, 4e-6, 1e-4, 0, 0], [3e-3, 1e-2]),
        ([0, 0, 0, 0, 0, 0], [np.nan, np.nan]),
        ([-1, 0, 0, 1e-4, 0, 0], [np.nan, 1e-2]),
        ([np.nan, 1, 1, np.inf, 1, 1], [np.nan, np.nan]),
    ],
)
def test_covariances_as_deviations(diagonal: list[float], expected: Array) -> None:
    assert np.allclose(deviations(np.diag(diagonal).ravel()[None])[0], expected, equal_nan=True)
    assert replace(stations(2).readings[0]).stated is None
