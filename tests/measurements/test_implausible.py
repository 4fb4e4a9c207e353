"""One message that cannot be, or half of a recording at another time: counted and said; most of them, and it is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cells import ur10
from cli.recordings import stations, streams, with_joints, with_reading

from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dropouts import BEYOND, ELSEWHEN, IMPLAUSIBLE, cleaned, elsewhen
from modcal_core.measurements.inspection import inspect
from modcal_core.measurements.recording import Recording, SignalTrack
from modcal_core.preprocess import Prepared, prepare

AT = 17  # the message that is spoiled
Spoil = Callable[[Recording], Recording]


def changed(which: str, name: str, value: Any, rows: Any = AT) -> Spoil:
    """One column of the joint states, or of the readings, with a value set in some rows."""

    def spoil(recording: Recording) -> Recording:
        track: Any = getattr(recording, which)[0]
        column: Array = (
            np.zeros_like(getattr(track, name)) if name in ("effort", "velocity") else getattr(track, name).copy()
        )
        place = (rows, 2) if column.ndim == 2 and name != "values" else (rows, 1) if column.ndim == 2 else rows
        column[place] = value
        return (with_joints if which == "joints" else with_reading)(recording, **{name: column})

    return spoil


def short(recording: Recording) -> Recording:
    values = recording.readings[0].values.copy()
    values[AT, 3:] *= 0.3
    return with_reading(recording, values=values)


ONE: dict[str, tuple[Spoil, str]] = {
    "1e16 m": (changed("readings", "values", 1e16), IMPLAUSIBLE),
    "60 m": (changed("readings", "values", 60.0), IMPLAUSIBLE),
    "a quaternion of length 0.3": (short, IMPLAUSIBLE),
    "a reading's stamp below zero": (changed("readings", "stamps", -2e9), f"readings {ELSEWHEN}"),
    "a reading's stamp of 2038": (changed("readings", "stamps", 2147483647.0), f"readings {ELSEWHEN}"),
    "a joint state's stamp of 1970": (changed("joints", "stamps", 0.3), f"joint states {ELSEWHEN}"),
    "1e9 rad": (changed("joints", "position", 1e9), BEYOND),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", ONE)
def test_one_message_that_cannot_be_costs_itself(case: str) -> None:
    spoil, reason = ONE[case]
    whole = stations(40)
    prepared = prepare(spoil(whole), ur10())
    assert dict(prepared.dropped)[reason] == 1
    assert sum("in 1 of 40 messages" in note and "left out" in note for note in prepared.notes) == 1
    rest = prepare(whole, ur10()).samples
    rest = rest.select(np.arange(len(rest)) != AT)
    assert (prepared.samples.stamps == rest.stamps).all()
    assert (prepared.samples.reading == rest.reading).all()
    assert (prepared.samples.q == rest.q).all()
    moved = prepare(spoil(streams(6)), ur10())
    assert dict(moved.dropped)[reason] == 1
    assert len(moved.samples) == 6


@pytest.mark.parametrize("what", ["effort", "velocity"])
@pytest.mark.parametrize("value", [np.inf, np.nan, -1e300])
def test_one_effort_or_velocity_that_cannot_be_is_stood_in_for(what: str, value: float) -> None:
    prepared = prepare(changed("joints", what, value)(stations(40)), ur10())
    assert len(prepared.samples) == 40
    assert (getattr(prepared.samples, what) == 0.0).all()
    assert any(f"the {what} of elbow_joint is not finite, or cannot be, in 1 of 40" in n for n in prepared.notes)
    often = cleaned(changed("joints", what, value, slice(0, 8))(stations(40)), ur10().names, ur10()).recording
    column = getattr(often.joints[0], what)
    assert np.isnan(column[:8, 2]).all()
    assert (column[8:] == 0.0).all()


def test_one_covariance_that_cannot_be_leaves_the_statement_as_it_is() -> None:
    whole = streams(8)
    said = np.full((len(whole.readings[0].stamps), 2), 2e-5)
    spoilt = said.copy()
    spoilt[AT] = np.nan  # what a negative or unfinished covariance becomes when it is read

    def stated(own: Array) -> Prepared:
        return prepare(with_reading(whole, stated=own), ur10())

    assert stated(spoilt).stated == stated(said).stated
    assert stated(said).stated.instrument_mm is not None


def test_what_is_wrong_with_all_of_them_is_named() -> None:
    whole = stations(40)
    values = whole.readings[0].values
    metres = values * np.r_[np.full(3, 1000.0), np.ones(4)]
    with pytest.raises(BadRecording, match="looks like millimetres"):
        prepare(with_reading(whole, values=metres), ur10())
    site = (values + np.r_[4321.0, 8765.0, 12.0, np.zeros(4)]).astype(np.float32).astype(float)
    with pytest.raises(
        BadRecording, match=r"9773 m from the origin: coordinates of a site, in single precision, .* 0\.98 mm"
    ):
        prepare(with_reading(whole, values=np.c_[site[:, :3], values[:, 3:]]), ur10())
    with pytest.raises(BadRecording, match="looks like degrees"):
        prepare(with_joints(whole, position=np.degrees(whole.joints[0].position)), ur10())
    with pytest.raises(BadRecording, match=r"a quaternion has length 0\.500"):
        prepare(with_reading(whole, values=values * np.r_[np.ones(3), np.full(4, 0.5)]), ur10())
    small = 0.2 * whole.joints[0].position  # of an arm that hardly moves, some degrees are below the limit in rad
    with pytest.raises(BadRecording, match="looks like degrees"):
        prepare(with_joints(whole, position=np.degrees(small)), ur10())
    with pytest.raises(BadRecording, match="looks like degrees"):
        prepare(changed("joints", "position", 1e9, slice(0, 30))(whole), ur10())


def test_up_to_half_of_the_readings_are_left_out_and_more_than_single_ones_doubted() -> None:
    whole = stations(40)
    assert prepare(changed("readings", "values", 1e16, slice(0, 2))(whole), ur10()).doubts == ()
    few = prepare(changed("readings", "values", 1e16, slice(0, 3))(whole), ur10())
    assert len(few.samples) == 37
    (said,) = few.doubts
    assert "too far away, or not of unit length, in 3 of 40 messages" in said
    assert len(prepare(changed("readings", "values", 1e16, slice(0, 20))(whole), ur10()).samples) == 20
    with pytest.raises(BadRecording, match="millimetres"):
        prepare(changed("readings", "values", 1e16, slice(0, 21))(whole), ur10())


@pytest.mark.slow
def test_what_is_left_out_too_often_makes_the_verdict_open() -> None:
    from modcal_core.loop import calibrate

    prepared = prepare(changed("readings", "values", 1e16, slice(0, 8))(stations(60)), ur10())
    samples = replace(prepared.samples, origin=replace(prepared.samples.origin, doubts=prepared.doubts))
    judged = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False).report.judged
    assert judged.status == "open"
    assert any("in 8 of 60 messages" in reason and "left out" in reason for reason in judged.open_because)


def test_a_tracker_that_jumps_while_the_arm_stands_is_doubted() -> None:
    whole = streams(6)
    track = whole.readings[0]
    assert prepare(whole, ur10()).doubts == ()
    values = track.values.copy()
    values[::9, 0] += 0.002
    (said,) = prepare(with_reading(whole, values=values), ur10()).doubts
    assert "readings taken at rest lie far from the others of their station and were left out (11%" in said


@pytest.mark.parametrize("rows", [slice(0, 12), slice(20, 39)])
def test_a_part_of_the_cells_in_millimetres_is_named(rows: slice) -> None:
    """Where a few large numbers are left out, small ones in the same unit would be taken for metres."""
    whole = stations(40)
    values = whole.readings[0].values.copy()
    values[:, 0] += 3.0  # of a tracker that stands some way off
    values[rows, 0] *= 1e3
    said = rf"units are mixed: {rows.stop - rows.start} of 40 readings hold numbers in x that look like millimetres"
    with pytest.raises(BadRecording, match=said):
        prepare(with_reading(whole, values=values), ur10())


def test_recordings_of_several_days_are_kept() -> None:
    t = np.concatenate([1.7e9 + np.arange(1000.0), 1.7e9 + 3 * 86_400.0 + np.arange(100.0)])
    assert not elsewhen(t).any()
    assert elsewhen(np.r_[t[:1000], 3.0]).tolist() == [False] * 1000 + [True]


def test_a_signal_is_not_lost_to_one_value() -> None:
    track = SignalTrack("temperature:a", np.arange(50.0), np.full((50, 1), 20.0))
    values = track.values.copy()
    values[7] = np.nan
    clean = cleaned(replace(stations(10), signals=(replace(track, values=values),)), ur10().names, ur10())
    assert clean.recording.signals[0].stamps.tolist() == [t for t in track.stamps if t != 7.0]


HOUR, DAY = 3600.0, 86_400.0


def set_on_the_way(recording: Recording, seconds: float, share: float = 0.5) -> Recording:
    """The recording of a tracker whose clock is set by so much after a share of it."""
    stamps = recording.readings[0].stamps
    begin, end = stamps.min(), stamps.max()
    return with_reading(recording, stamps=np.where(stamps > begin + share * (end - begin), stamps + seconds, stamps))


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [HOUR, -DAY])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_clock_that_was_set_is_doubted(seconds: float, share: float) -> None:
    spoilt = set_on_the_way(streams(8), seconds, share)
    (said,) = prepare(spoilt, ur10()).doubts
    assert "are stamped before or after all joint states and were left out" in said
    assert "see whether a clock was set while recording" in said
    assert said in inspect(spoilt, ur10()).findings


def test_a_tracker_that_ran_longer_or_paused_is_not() -> None:
    whole = streams(8)
    track = whole.joints[0]
    some = track.stamps < np.quantile(track.stamps, 0.6)
    longer = whole.readings[0].stamps.max()
    fewer = replace(whole, joints=(track.rows(some),))
    assert longer > fewer.joints[0].stamps.max() + 5.0
    assert prepare(fewer, ur10()).doubts == ()
    stamps = whole.readings[0].stamps
    low, high = np.quantile(stamps, [0.3, 0.6])
    paused = whole.readings[0].rows((stamps < low) | (stamps > high))
    assert prepare(replace(whole, readings=(paused,)), ur10()).doubts == ()
