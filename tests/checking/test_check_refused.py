"""Stations that no check can be made of, or that say less than their number: refused, left out or told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, Recorded, record, ur10
from checking.checks import FLOOR, Poses, checked, readings

from modcal_core.calibration.store import Calibration
from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.public import check
from modcal_nodes.simulation.world import World

pytestmark = pytest.mark.slow


def test_another_arm_is_refused_or_not_explained(cell: tuple[Recorded, Calibration]) -> None:
    other = record(9, 10, length_std=0.03, angle_std=0.05).samples
    other = replace(other, frames=cell[1].frames)
    with pytest.raises(BadRecording, match="misses them by"):
        check(cell[1], other)
    alike = replace(record(9, 10).samples, frames=cell[1].frames)  # the same make, and base and tool elsewhere
    assert check(cell[1], alike).status == "unexplained"


@pytest.mark.parametrize("wrong", ["mm", "quaternion", "degrees", "swapped"])
def test_another_convention_is_refused(cell: tuple[Recorded, Calibration], wrong: str) -> None:
    rng = np.random.default_rng(4)
    q = rng.uniform(-2.5, 2.5, (10, 6))
    T = cell[0].world.tool_in_tracker(q)
    if wrong == "mm":
        T[:, :3, 3] *= 1e3
    if wrong == "quaternion":
        x = so3.to_quaternion(T[:, :3, :3])
        T[:, :3, :3] = so3.from_quaternion(np.roll(x, 1, axis=1))
    if wrong == "degrees":
        q = np.degrees(q)
    if wrong == "swapped":
        q = q[:, [1, 0, 2, 3, 4, 5]]
    samples = Samples.from_arrays(q, poses=T, names=ur10().names)
    with pytest.raises(BadRecording):
        check(cell[1], samples)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("x reversed", "positions look mirrored (a left-handed frame: two columns swapped, or one of the other sign)"),
        ("y and z swapped", "positions look mirrored (a left-handed frame: two columns swapped, or one of the other"),
        ("a joint stands", "joint elbow_joint: stands at the same position at all 10 stations"),
    ],
)
def test_points_are_refused_for_what_they_show(cell: tuple[Recorded, Calibration], wrong: str, words: str) -> None:
    """Of a left-handed frame points alone do not show which sign or which columns, so neither is claimed."""
    rng = np.random.default_rng(4)
    q = rng.uniform(-2.5, 2.5, (10, 6))
    p = cell[0].world.tool_in_tracker(q)[:, :3, 3]
    if wrong == "x reversed":
        p[:, 0] *= -1.0
    if wrong == "y and z swapped":
        p = p[:, [0, 2, 1]]
    if wrong == "a joint stands":
        q[:, 2] = q[0, 2]
    with pytest.raises(BadRecording) as refused:
        check(cell[1], Samples.from_arrays(q, points=p, names=ur10().names))
    assert words in str(refused.value)


def test_inverse_poses_are_undone(cell: tuple[Recorded, Calibration]) -> None:
    rng = np.random.default_rng(2)
    q = rng.uniform(-2.5, 2.5, (10, 6))
    seen = readings(q, cell[0].world.tool_in_tracker(q), rng)
    poses = se3.inverse(se3.transform(seen.R, seen.reading))
    found = check(cell[1], Samples.from_arrays(q, poses=poses, names=ur10().names))
    assert found.convention == "pose inverted"
    assert found.status == "unchanged"


def test_too_few_stations_are_refused(cell: tuple[Recorded, Calibration]) -> None:
    with pytest.raises(NotEnoughData, match="measure ten"):
        checked(cell, lambda q, world: world(q), count=4)


def test_angles_that_are_none_are_refused_with_their_joint(cell: tuple[Recorded, Calibration]) -> None:
    wander = np.random.default_rng(3)

    def seen(q: Array, world: Poses) -> Array:
        return world(q + np.outer(0.25 * wander.standard_normal(len(q)), np.eye(6)[5]))

    with pytest.raises(BadRecording, match="angles of wrist_3_joint: differ from those of the calibrated arm by 1"):
        checked(cell, seen)


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_an_arm_of_other_lengths_in_the_same_cell_is_refused(cell: tuple[Recorded, Calibration], kind: str) -> None:
    """Base and tool stand where they stood; the forearm is five centimetres longer, or all links a tenth."""
    rng = np.random.default_rng(3)
    base, tool = se3.exp(rng.normal(size=6)), se3.exp(np.r_[0.05, 0.03, 0.12, rng.normal(size=3)])
    q = np.random.default_rng(21).uniform(-2.5, 2.5, (10, 6))
    for stretch in (np.where(np.arange(7) == 3, 1.09, 1.0), np.full(7, 1.1)):
        origins = ur10().origins.copy()
        origins[:, :3, 3] *= stretch[:, None]
        other = World(ur10().with_origins(origins), np.random.default_rng(22), T_tracker_base=base, T_tip_tool=tool)
        seen = readings(q, other.tool_in_tracker(q), np.random.default_rng(23))
        if kind == "point":
            seen = Samples.from_arrays(q, points=seen.reading, names=ur10().names, stamps=seen.stamps)
        with pytest.raises(BadRecording, match="misses them by"):
            check(cell[1], seen)


def test_stations_at_one_posture_are_one(cell: tuple[Recorded, Calibration]) -> None:
    q = np.repeat(np.random.default_rng(1).uniform(-2.5, 2.5, (4, 6)), 3, axis=0)
    jitter = 1e-5 * np.random.default_rng(2).standard_normal(q.shape)
    with pytest.raises(NotEnoughData, match="12 stations at 4 postures"):
        check(cell[1], readings(q + jitter, cell[0].world.tool_in_tracker(q), np.random.default_rng(0)))


def test_stations_close_together_do_not_say_that_nothing_changed(cell: tuple[Recorded, Calibration]) -> None:
    rng = np.random.default_rng(8)
    q = rng.uniform(-2.0, 2.0, 6) + 0.05 * rng.standard_normal((10, 6))
    found = check(cell[1], readings(q, cell[0].world.tool_in_tracker(q), rng))
    assert found.status == "unchanged"
    assert found.sentence == "No change is seen, by 10 stations that say as much as 1.0 far apart."


def test_a_recording_that_is_not_later_is_said(cell: tuple[Recorded, Calibration]) -> None:
    q = np.random.default_rng(5).uniform(-2.5, 2.5, (10, 6))
    seen = readings(q, cell[0].world.tool_in_tracker(q), np.random.default_rng(6))
    watched = cell[1].watched
    assert watched is not None
    for begin, said in (
        (watched[0] - 1e5, "is older"),
        (watched[0] + 1.0, "own recording"),
        (watched[1] + 1e5, ""),
        (10.0, ""),  # a simulation's clock is no date
    ):
        found = check(cell[1], replace(seen, stamps=begin + np.arange(10.0)))
        notes = [note for note in found.notes if note.startswith("By its stamps")]
        assert bool(notes) == bool(said)
        assert not said or said in notes[0]


def test_stations_where_a_learned_curve_was_not_seen_are_left_out(cell: tuple[Recorded, Calibration]) -> None:
    shape = Shape("spline", {"low": -1.0, "high": 1.0, "count": 7.0})
    curve = Effect("unknown", "elbow_joint", "axis", "position:elbow_joint", shape, np.zeros(7), np.full(7, 1e-5))
    seen = np.array(cell[1].seen)
    seen[:, 2] = -1.0, 1.0
    narrow = replace(
        cell[1], calibrated=cell[1].calibrated.with_effects((curve,)), seen=seen, uncertainty=None, rivals=((),)
    )
    found, q, _ = checked((cell[0], narrow), lambda q, world: world(q), count=30)
    assert found.stations == int((np.abs(q[:, 2]) < 1.05).sum()) < 30
    assert any("learned curves have not been seen" in note for note in found.notes)
    assert any("keeps no covariance" in note for note in found.notes)


def test_neighbours_are_not_ten_witnesses(cell: tuple[Recorded, Calibration]) -> None:
    """An error that all stations of one place share, as large as what the model leaves elsewhere, is no change."""
    rng = np.random.default_rng(6)
    for seed in range(3):
        q = rng.uniform(-2.0, 2.0, 6) + 0.03 * rng.standard_normal((10, 6))
        for size, status in ((2.0, "unchanged"), (100.0, None)):
            own = np.zeros((10, 6))
            own[:, 3] = size * NOISE_M * (1.0 + 0.1 * np.sin(20.0 * q[:, 3]))  # [rad], at a metre or less
            T = cell[0].world.tool_in_tracker(q + own)
            found = check(cell[1], readings(q, T, np.random.default_rng([seed, 12])))
            assert (found.status == "unchanged") == (status == "unchanged"), (size, found.sentence)
            assert any("stand close together" in note for note in found.notes)
            assert min(n.mm for n in found.noticed if n.label == "base") > 5e3 * FLOOR
