"""Single wrong joint states and readings do not decide what the clocks' offset is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from cli.recordings import streams, with_joints, with_reading

from modcal_core.errors import BadRecording
from modcal_core.measurements.alignment import clock_offset
from modcal_core.robots.kinematics import chain_forward


@pytest.mark.parametrize("late", [0.0, 0.12])
def test_glitches_do_not_move_the_clock(late: float, rng: np.random.Generator) -> None:
    """Eight joint states and eight readings are far off, as after a flipped bit; the delay is still found."""
    recording = streams(30, late=late)
    q, values = recording.joints[0].position.copy(), recording.readings[0].values.copy()
    for changed in (q, values):
        rows = rng.choice(len(changed), 8, replace=False)
        changed[rows, 1] += rng.choice([-1.0, 1.0], 8) * 10.0 ** rng.uniform(0.0, 6.0, 8)
    spoiled = with_reading(with_joints(recording, position=q), values=values)
    chain = ur10()
    order = [spoiled.joints[0].names.index(name) for name in chain.names]
    found = clock_offset(spoiled.readings[0], spoiled.joints[0].stamps, q[:, order], lambda p: chain_forward(chain, p))
    assert found is not None
    assert found.offset == pytest.approx(late, abs=0.004)


def test_joint_states_that_are_noted_twice_do_not_matter() -> None:
    """The median time between messages is zero then."""
    recording = streams(20, late=0.12)
    track, chain = recording.joints[0], ur10()
    q = track.position[:, [track.names.index(name) for name in chain.names]]
    twice = np.repeat(track.stamps, 2), np.repeat(q, 2, axis=0)
    found = clock_offset(recording.readings[0], *twice, lambda p: chain_forward(chain, p))
    assert found is not None
    assert found.offset == pytest.approx(0.12, abs=0.004)


@pytest.mark.parametrize("seconds", [1.5, 3.0, 4.9])
def test_a_recording_shorter_than_the_lags_looked_for(seconds: float) -> None:
    """As a calibrator that was just started holds one; it may know no offset, but it says no wrong one."""
    recording = streams(4)
    track, reading = recording.joints[0], recording.readings[0]
    begin = float(track.stamps[0]) + 0.5
    j = (track.stamps >= begin) & (track.stamps < begin + seconds)
    r = (reading.stamps >= begin) & (reading.stamps < begin + seconds)
    chain = ur10()
    order = [track.names.index(name) for name in chain.names]
    q = track.position[j][:, order]
    found = clock_offset(reading.rows(r), track.stamps[j], q, lambda p: chain_forward(chain, p))
    assert found is None or abs(found.offset) < 0.02


def test_a_clock_that_is_set_while_recording() -> None:
    recording = streams(80)
    track, reading = recording.joints[0], recording.readings[0]
    chain = ur10()
    q = track.position[:, [track.names.index(name) for name in chain.names]]
    middle = float(np.median(reading.stamps))
    jumped = reading.stamps + np.where(reading.stamps < middle, 1.4, 0.0)
    with pytest.raises(BadRecording, match=r"jumps by -1\.(39|40|41) s"):
        clock_offset(replace(reading, stamps=jumped), track.stamps, q, lambda p: chain_forward(chain, p))
