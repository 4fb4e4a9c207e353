"""What a check names, by readings that MuJoCo makes of an arm in which one thing has changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, Recorded, record, ur10

from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.checking.repair import nearest_covariance
from modcal_core.checkup import Checked
from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.public import calibrate, check
from modcal_core.robot import Robot
from modcal_nodes.simulation.world import World

pytestmark = pytest.mark.slow
FLOOR = np.sqrt(3.0) * NOISE_M


@pytest.fixture(scope="module")
def cell() -> tuple[Recorded, Calibration]:
    """A world, and what was calibrated from eighty stations of it."""
    recorded = record(3, 80)
    return recorded, calibrate(Robot(ur10()), recorded.samples, geometry_only=True).calibration


Poses = Callable[[Array], Array]


def readings(q: Array, T: Array, rng: np.random.Generator, noise: float = 1.0) -> Samples:
    """Poses (N, 4, 4) with the instrument's noise."""
    T = T.copy()
    T[:, :3, 3] += noise * NOISE_M * rng.standard_normal((len(q), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(noise * NOISE_RAD * rng.standard_normal((len(q), 3)))
    return Samples.from_arrays(q, poses=T, names=ur10().names, stamps=1e6 + 5.0 * np.arange(len(q)))


def checked(
    cell: tuple[Recorded, Calibration],
    seen: Callable[[Array, Poses], Array],
    seed: int = 0,
    count: int = 10,
    noise: float = 1.0,
) -> tuple[Checked, Array, Array]:
    """A check by stations at random postures, these, and where the tool truly was."""
    rng = np.random.default_rng([seed, 11])
    q = rng.uniform(-2.5, 2.5, (count, 6))
    T = seen(q, cell[0].world.tool_in_tracker)
    return check(cell[1], readings(q, T, rng, noise)), q, T


def twist(size: float, way: tuple[float, ...]) -> Array:
    """A small motion (4, 4)."""
    return se3.exp(size * np.array(way))


def names(found: Checked) -> set[tuple[str, str]]:
    """What was named."""
    return {(c.kind, c.place) for c in found.changes}


def test_nothing_is_named_while_nothing_has_changed(cell: tuple[Recorded, Calibration]) -> None:
    for seed in range(8):
        found, _, _ = checked(cell, lambda q, world: world(q), seed)
        assert found.status == "unchanged", found.sentence
        assert found.advice.action == "nothing"
        assert found.repaired is None
        assert all(3.0 * n.mm > 1e3 * FLOOR / 3.0 for n in found.noticed)  # ten stations do not show what is far below


@pytest.mark.parametrize(
    ("name", "seen"),
    [
        (("base", "base"), lambda q, world: twist(1.5e-4, (1, -1, 1, 0.5, 1, -0.5)) @ world(q)),
        (("tool", "tool"), lambda q, world: world(q) @ twist(2e-4, (1, 0.5, -1, 1, -1, 1))),
        (("joint_zero", "elbow_joint"), lambda q, world: world(q + 5e-4 * np.eye(6)[2])),
        (("tracker_scale", "tracker"), lambda q, world: scaled(world(q), 1.0 + 4e-4)),
    ],
)
def test_a_change_is_named_and_repaired(
    cell: tuple[Recorded, Calibration], name: tuple[str, str], seen: Callable[[Array, Poses], Array]
) -> None:
    for seed in range(3):
        found, _, _ = checked(cell, seen, seed)
        assert names(found) == {name}, found.sentence
        change = found.changes[0]
        assert change.moved_mm[1] <= change.moved_mm[0] <= change.moved_mm[2]
        assert found.repaired is not None
        # against the world, at postures that the check has not seen
        q = np.random.default_rng(77).uniform(-2.5, 2.5, (100, 6))
        truth = seen(q, cell[0].world.tool_in_tracker)
        before, after = (rms(model.predict(q), truth) for model in (cell[1], found.repaired))
        if name[0] != "tracker_scale":  # predictions are where the tool is, not what a wrong metre reads
            assert after < 0.5 * before
            assert after < 0.8 * FLOOR


def test_a_turn_that_moves_nothing_is_told_in_degrees(cell: tuple[Recorded, Calibration]) -> None:
    found, _, _ = checked(cell, lambda q, world: world(q) @ twist(2e-3, (0, 0, 0, 0, 0, 1)))
    (change,) = found.changes
    assert change.turned_deg is not None
    assert change.turned_deg == pytest.approx(np.degrees(2e-3), rel=0.1)
    assert f"{change.turned_deg:.3f}° RMS at the tool" in change.sentence


def scaled(T: Array, factor: float) -> Array:
    """The poses with their positions times a factor."""
    out = T.copy()
    out[:, :3, 3] *= factor
    return out


def rms(a: Array, b: Array) -> float:
    """Of distances between poses [m]."""
    return float(np.sqrt(np.mean(np.sum((a[:, :3, 3] - b[:, :3, 3]) ** 2, axis=1))))


def test_a_size_lies_in_its_interval(cell: tuple[Recorded, Calibration]) -> None:
    zero = 6e-4
    inside = 0
    for seed in range(10):
        found, _, _ = checked(cell, lambda q, world: world(q + zero * np.eye(6)[1]), seed)
        (size,) = found.changes[0].sizes
        assert size.unit == "mrad"
        inside += size.low <= 1e3 * zero <= size.high
    assert inside >= 8  # of ten intervals of 95 %, fewer once in ninety times


def test_what_is_known_of_a_repair_is_what_it_misses_by(cell: tuple[Recorded, Calibration]) -> None:
    move = twist(2e-4, (1, -1, 1, 0.5, 1, -0.5))
    told, true = [], []
    fresh = np.random.default_rng(79).uniform(-2.5, 2.5, (100, 6))
    truth = move @ cell[0].world.tool_in_tracker(fresh)
    for seed in range(8):
        found, _, _ = checked(cell, lambda q, world: move @ world(q), seed)
        assert found.accuracy is not None
        assert found.repaired is not None
        told.append(found.accuracy.repaired)
        true.append(rms(found.repaired.predict(fresh), truth))
        assert found.accuracy.before < found.accuracy.repaired
        assert found.accuracy.more  # six numbers by ten stations, the others by eighty
        assert f"{found.accuracy.more} more stations" in found.accuracy.sentence
    assert 0.7 < np.sqrt(np.mean(np.square(true))) / np.sqrt(np.mean(np.square(told))) < 1.4


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


def test_of_two_curves_of_one_gear_the_one_that_grew_is_repaired(cell: tuple[Recorded, Calibration]) -> None:
    waves = [
        Effect(
            "gear_harmonic", "elbow_joint", "axis", "position:elbow_joint", shape, values, 1e-6 * np.ones(len(values))
        )
        for shape, values in (
            (Shape("turn", {"cycles": 1.0}), np.array([1e-3, 0.0])),
            (Shape("turn", {"cycles": 2.0}), np.array([5e-4, 2e-4])),
        )
    ]
    known = cell[1].uncertainty
    assert known is not None
    known = replace(known, covariance=np.pad(known.covariance, (0, 4)))
    two = replace(cell[1], calibrated=cell[1].calibrated.with_effects(tuple(waves)), rivals=((), ()), uncertainty=known)

    def seen(q: Array, world: Poses) -> Array:
        turn = 1e-3 * np.sin(q[:, 2]) + 1.8 * (5e-4 * np.sin(2.0 * q[:, 2]) + 2e-4 * np.cos(2.0 * q[:, 2]))
        return world(q + np.outer(turn, np.eye(6)[2]))

    found, _, _ = checked((cell[0], two), seen)
    assert names(found) == {("gear", "elbow_joint")}
    assert found.repaired is not None
    grown = [np.linalg.norm(e.amplitudes) for e in found.repaired.calibrated.effects]
    assert grown[0] == pytest.approx(1e-3)
    assert grown[1] == pytest.approx(1.8 * np.hypot(5e-4, 2e-4), rel=0.1)


def test_a_zero_about_the_base_axis_may_as_well_be_the_base(cell: tuple[Recorded, Calibration]) -> None:
    found, _, _ = checked(cell, lambda q, world: world(q + 5e-4 * np.eye(6)[0]))
    assert names(found) == {("joint_zero", "shoulder_pan_joint")}
    assert found.changes[0].same_as == ("base",)
    assert found.changes[0].everywhere
    assert found.status == "changed"  # the repaired poses are the same


def test_a_gear_is_named_and_its_wave_found(cell: tuple[Recorded, Calibration]) -> None:
    def seen(q: Array, world: Poses) -> Array:
        return world(q + np.outer(1e-3 * np.sin(101 * q[:, 3] + 0.4), np.eye(6)[3]))

    found, _, _ = checked(cell, seen)
    assert names(found) == {("gear", "wrist_1_joint")}
    assert found.repaired is not None
    (wave,) = found.repaired.calibrated.effects
    assert wave.shape.settings["cycles"] == pytest.approx(101.0, abs=0.3)
    q = np.random.default_rng(78).uniform(-2.5, 2.5, (100, 6))
    truth = seen(q, cell[0].world.tool_in_tracker)
    assert rms(found.repaired.predict(q), truth) < 0.5 * rms(cell[1].predict(q), truth)


def test_a_curve_without_a_form_asks_for_stations_along_it(cell: tuple[Recorded, Calibration]) -> None:
    wander = np.random.default_rng(5)  # another error at every posture

    found, q, _ = checked(
        cell, lambda q, world: world(q + np.outer(8e-4 * wander.standard_normal(len(q)), np.eye(6)[3]))
    )
    assert names(found) == {("gear", "wrist_1_joint")}
    assert found.advice.action == "add_stations"
    assert found.repaired is None
    assert np.ptp(found.advice.stations[:, 3]) > np.ptp(q[:, 3])


def test_noise_is_not_taken_for_a_move(cell: tuple[Recorded, Calibration]) -> None:
    for seed in range(4):
        found, _, _ = checked(cell, lambda q, world: world(q), seed, noise=3.0)
        assert names(found) == {("tracker_noise", "tracker")}, found.sentence
        assert found.advice.action == "check_instrument"


def test_two_changes_are_both_named(cell: tuple[Recorded, Calibration]) -> None:
    move = twist(4e-4, (1, -1, 1, 0.5, 1, -0.5))
    found, _, _ = checked(cell, lambda q, world: move @ world(q + 8e-4 * np.eye(6)[2]), count=14)
    assert names(found) == {("base", "base"), ("joint_zero", "elbow_joint")}, (found.sentence, found.status)


def test_a_large_move_is_named(cell: tuple[Recorded, Calibration]) -> None:
    move = se3.exp([0.2, -0.1, 0.05, 0.3, 0.2, -0.4])
    found, _, _ = checked(cell, lambda q, world: move @ world(q))
    assert names(found) == {("base", "base")}
    assert found.advice.action == "refit_base"
    assert found.after[0] is not None
    assert found.after[0] < 2e3 * FLOOR


def test_one_wrong_reading_is_set_aside(cell: tuple[Recorded, Calibration]) -> None:
    def seen(q: Array, world: Poses) -> Array:
        T = world(q)
        T[4, :3, 3] += [2e-3, -1e-3, 1e-3]
        return T

    found, _, _ = checked(cell, seen)
    assert found.status == "unchanged"
    assert len(found.aside) == 1


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


def test_a_repaired_calibration_is_read_back_and_checks_clean(cell: tuple[Recorded, Calibration]) -> None:
    tool = twist(3e-4, (1, 0.5, -1, 1, -1, 1))
    found, _, _ = checked(cell, lambda q, world: world(q) @ tool)
    assert found.repaired is not None
    again = from_data(to_data(found.repaired))
    after, _, _ = checked((cell[0], again), lambda q, world: world(q) @ tool, seed=5)
    assert after.status == "unchanged", after.sentence
    # what ten stations say of a tool is less than what eighty did, and the covariance says so
    assert again.uncertainty is not None
    assert cell[1].uncertainty is not None
    assert again.uncertainty.covariance.trace() > cell[1].uncertainty.covariance.trace()


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


def test_a_gear_that_moves_readings_as_far_as_another_robot_is_named(cell: tuple[Recorded, Calibration]) -> None:
    """Five degrees of a gear, which base and tool fitted again leave more of than any arm of the same make."""
    for joint in (0, 5):

        def seen(q: Array, world: Poses, j: int = joint) -> Array:
            return world(q + np.outer(np.radians(5.0) * np.sin(100 * q[:, j] + 0.3), np.eye(6)[j]))

        found, q, T = checked(cell, seen)
        assert names(found) == {("gear", ur10().names[joint])}, found.sentence
        moved = rms(cell[0].world.tool_in_tracker(q), T)
        assert found.changes[0].moved_mm[0] == pytest.approx(1e3 * moved, rel=0.05)


def test_zeros_that_were_set_anew_are_named(cell: tuple[Recorded, Calibration]) -> None:
    found, _, _ = checked(cell, lambda q, world: world(q + np.radians(3.0) * (np.eye(6)[1] + np.eye(6)[4])))
    assert names(found) == {("joint_zero", "shoulder_lift_joint"), ("joint_zero", "wrist_2_joint")}


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


def test_a_covariance_with_a_direction_below_nothing_becomes_the_nearest_that_has_none(
    rng: np.random.Generator,
) -> None:
    """One that may be stays as it is."""
    root = rng.standard_normal((6, 6)) * np.array([1e-4, 1e-3, 1e-2, 1.0, 1.0, 1.0])[:, None]
    good = root @ root.T
    assert nearest_covariance(good) == pytest.approx(good, rel=1e-9, abs=1e-18)
    bad = good - 1.2 * np.outer(root[:, 0], root[:, 0]) / (root[:, 0] @ np.linalg.solve(good, root[:, 0]))
    scale = np.sqrt(np.diag(good))
    assert np.linalg.eigvalsh(bad / np.outer(scale, scale))[0] < 0.0
    restored = nearest_covariance(bad) / np.outer(scale, scale)
    assert np.linalg.eigvalsh(restored)[0] > -1e-9
