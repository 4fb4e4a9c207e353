"""Stations that no check can be made of, that contradict each other, or that say less than their number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, ur10
from checking.checks import FLOOR, Cell, Poses, checked, postures, readings

from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.public import check
from modcal_nodes.simulation.mjcf import World

pytestmark = pytest.mark.slow
STEP = se3.exp(np.array([4e-3, -3e-3, 2e-3, 1e-3, 2e-3, -1e-3]))


@pytest.mark.parametrize(
    ("wrong", "kind", "words"),
    [
        ("degrees", "pose", "degrees"),
        ("quaternion", "pose", "quaternions look like"),
        ("x reversed", "point", r"positions look mirrored \(a left-handed frame: two columns swapped, or one of the other"),
    ],
)  # fmt: skip
def test_another_convention_is_refused_by_its_name(cell: Cell, wrong: str, kind: str, words: str) -> None:
    """Of a left-handed frame points alone do not show which sign or which columns, so neither is claimed."""
    q = postures(4)
    T = cell[0].world.tool_in_tracker(q)
    if wrong == "degrees":
        q = np.degrees(q)
    elif wrong == "quaternion":
        T[:, :3, :3] = so3.from_quaternion(np.roll(so3.to_quaternion(T[:, :3, :3]), 1, axis=1))
    else:
        T[:, 0, 3] *= -1.0
    with pytest.raises(BadRecording, match=words):
        check(cell[1], readings(q, T, np.random.default_rng(4), kind=kind))


def test_inverse_poses_are_undone(cell: Cell) -> None:
    q = postures(2)
    T = se3.inverse(cell[0].world.tool_in_tracker(q))
    found = check(cell[1], readings(q, T, np.random.default_rng(2), 0.3))
    assert found.convention == "pose inverted"
    assert found.status == "unchanged"


def test_an_arm_of_other_lengths_in_the_same_cell_is_refused(cell: Cell) -> None:
    """Base and tool stand where they stood; the forearm is five centimetres longer."""
    base, tool, q = cell[0].world.T_tracker_base, cell[1].calibrated.T_tip_tool, postures(21)
    origins = ur10().origins.copy()
    origins[3, :3, 3] *= 1.09
    other = World(ur10().with_origins(origins), np.random.default_rng(22), T_tracker_base=base, T_tip_tool=tool)
    with pytest.raises(BadRecording, match="misses them by"):
        check(cell[1], readings(q, other.tool_in_tracker(q), np.random.default_rng(23)))


@pytest.mark.parametrize(("what", "after", "kind"), [("base", 4, "point"), ("tool", 7, "pose")])
def test_what_moved_between_two_stations_is_refused(cell: Cell, what: str, after: int, kind: str) -> None:
    q = postures(0, 12)
    T = cell[0].world.tool_in_tracker(q)
    T[after:] = STEP @ T[after:] if what == "base" else T[after:] @ STEP
    with pytest.raises(BadRecording, match=rf"^the {what} .* moved between stations {after} and {after + 1} of this"):
        check(cell[1], readings(q, T, np.random.default_rng(0), kind=kind))


def test_readings_of_other_stations_are_refused(cell: Cell) -> None:
    q, rows = postures(5, 12), np.arange(12)
    rows[3:8] = [4, 5, 6, 7, 3]
    T = cell[0].world.tool_in_tracker(q)[rows]
    with pytest.raises(
        BadRecording, match=r"stations 4 to 8 belong to other stations.* \(that at station 4 to station 5"
    ):
        check(cell[1], readings(q, T, np.random.default_rng(5), kind="point"))


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_what_changed_before_all_stations_and_one_wrong_reading_are_no_contradiction(cell: Cell, kind: str) -> None:
    moved, seed = ("base", 1) if kind == "pose" else ("tool", 0)
    q = postures(seed, 12)
    T = cell[0].world.tool_in_tracker(q)
    T = STEP @ T if moved == "base" else T @ STEP
    T[5, :3, 3] += (0.0, 0.02, 0.0)
    found = check(cell[1], readings(q, T, np.random.default_rng(seed), kind=kind))
    assert found.status == "changed", found.sentence
    assert {c.kind for c in found.changes} == {moved}


def test_a_gear_of_any_course_is_no_contradiction(cell: Cell) -> None:
    """A curve that no form was found for is none of the model's; base or tool of two parts have 12 or 6 numbers to
    please 30 readings of points with.
    """

    def seen(q: Array, world: Poses) -> Array:
        return world(q + 2e-3 * np.outer(np.sin(13.0 * q[:, 4]), np.eye(6)[4]))

    found = checked(cell, seen, 11, kind="point")
    assert [(c.kind, c.place) for c in found.changes] == [("gear", ur10().names[4])], found.sentence


def test_too_few_stations_and_stations_at_one_posture_are_refused(cell: Cell) -> None:
    with pytest.raises(NotEnoughData, match="measure ten"):
        checked(cell, lambda q, world: world(q), count=4)
    q = np.repeat(postures(1, 4), 3, axis=0)
    jitter = 1e-5 * np.random.default_rng(2).standard_normal(q.shape)
    with pytest.raises(NotEnoughData, match="12 stations at 4 postures"):
        check(cell[1], readings(q + jitter, cell[0].world.tool_in_tracker(q), np.random.default_rng(0)))


def test_a_recording_that_is_not_later_is_said(cell: Cell) -> None:
    q = postures(5)
    seen = readings(q, cell[0].world.tool_in_tracker(q), np.random.default_rng(6))
    watched = cell[1].watched
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


def test_stations_where_a_learned_curve_was_not_seen_are_left_out(cell: Cell) -> None:
    shape = Shape("spline", {"low": -1.0, "high": 1.0, "count": 7.0})
    curve = Effect("unknown", "elbow_joint", "axis", "position:elbow_joint", shape, np.zeros(7), np.full(7, 1e-5))
    seen = np.array(cell[1].seen)
    seen[:, 2] = -1.0, 1.0
    narrow = replace(
        cell[1], calibrated=cell[1].calibrated.with_effects((curve,)), seen=seen, uncertainty=None, rivals=((),)
    )
    found = checked((cell[0], narrow), lambda q, world: world(q), count=30)
    assert found.stations == int((np.abs(postures(0, 30)[:, 2]) < 1.05).sum()) < 30
    assert any("learned curves have not been seen" in note for note in found.notes)
    assert any("keeps no covariance" in note for note in found.notes)


def test_neighbours_are_not_ten_witnesses(cell: Cell) -> None:
    """An error that all stations of one place share, as large as what the model leaves elsewhere, is no change."""
    rng = np.random.default_rng(6)
    q = rng.uniform(-2.0, 2.0, 6) + 0.03 * rng.standard_normal((10, 6))
    for size, unchanged in ((0.0, True), (2.0, True), (100.0, False)):
        own = np.zeros((10, 6))
        own[:, 3] = size * NOISE_M * (1.0 + 0.1 * np.sin(20.0 * q[:, 3]))  # [rad], at a metre or less
        T = cell[0].world.tool_in_tracker(q + own)
        found = check(cell[1], readings(q, T, np.random.default_rng([0, 12])))
        assert (found.status == "unchanged") == unchanged, (size, found.sentence)
        assert not unchanged or found.sentence.endswith("10 stations that say as much as 1.0 far apart.")
        assert any("stand close together" in note for note in found.notes)
        assert min(n.mm for n in found.noticed if n.label == "base") > 5e3 * FLOOR
