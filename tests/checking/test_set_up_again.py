"""Checks of a cell that was set up again: another frame, instrument and target moved at once, readings of another kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10
from checking.checks import FLOOR, Poses, Seen, checked, missed, names, postures, readings
from checking.checks import Cell as Arm

from modcal_core.calibration.cell import Cell
from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.samples import Samples
from modcal_core.public import calibrate, check
from modcal_core.report.blocks import TableBlock
from modcal_core.report.checkup import checkup_data, checkup_report
from modcal_core.robot import Robot
from modcal_core.robots.kinematics import spatial_jacobian
from modcal_nodes.simulation.mjcf import World

pytestmark = pytest.mark.slow
ELSEWHERE = se3.exp([1.8, -0.7, 0.4, 0.3, -0.5, 2.1])  # where the instrument stands the next day
ANOTHER = se3.exp([0.04, -0.02, 0.06, 0.5, 0.3, -0.8])  # the target, mounted anew


def again(target: Array | None = None, zero: Array | None = None) -> Seen:
    """The instrument elsewhere; the target and the joints' zeros as they were, or not."""
    still, hand = np.zeros(6) if zero is None else zero, np.eye(4) if target is None else target
    return lambda q, world: ELSEWHERE @ world(q + still) @ hand


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_an_unknown_frame_is_placed_and_no_change(cell: Arm, kind: str) -> None:
    first = f"zero of {ur10().names[0]}"
    found = checked(cell, again(), 1, 12, kind, frame="leica")
    assert found.status == "unchanged", found.sentence
    assert "the place of leica was found" in found.sentence
    assert found.advice.action == "refit_base"
    assert not {"base", "frame"} & {n.label for n in found.noticed}
    zeros = next(n for n in found.noticed if n.label == "joint zero")
    assert zeros.unseen == (first,)  # the frame that was placed takes it up
    assert zeros.mm < 10.0
    assert checkup_data(found)["not_noticed"] == [first]
    tables = [one.below for one in checkup_report(found, "a", "bag", {}).said if isinstance(one, TableBlock)]
    assert any(below.endswith(f"These stations do not show: {first}.") for below in tables)
    assert found.expected[0] is not None
    assert found.expected[0] < 2e3 * FLOOR
    assert found.repaired.frames == ("tracker", "leica")
    assert missed(cell, found.repaired, again(), "leica") < 1.2 * FLOOR
    assert found.report.claim.mm["p95"].ci95[1] > 1e3 * missed(cell, found.repaired, again(), "leica")


@pytest.mark.parametrize(
    ("name", "seen", "kind", "frame"),
    [
        ({("tool", "tool")}, again(ANOTHER), "pose", "leica"),
        ({("joint_zero", "elbow_joint")}, again(zero=8e-4 * np.eye(6)[2]), "pose", "leica"),
        ({("base", "base"), ("tool", "tool"), ("joint_zero", "elbow_joint")}, again(ANOTHER, 1e-3 * np.eye(6)[2]), "pose", "tracker"),
    ],
)  # fmt: skip
def test_a_change_is_named_beside_what_was_set_up_again(
    cell: Arm, name: set[tuple[str, str]], seen: Seen, kind: str, frame: str
) -> None:
    found = checked(cell, seen, 2, 20, kind, frame=frame)
    assert names(found) == name, found.sentence
    assert missed(cell, found.repaired, seen, frame) < 1.2 * FLOOR
    noted = any("a moved tool is that target" in note for note in found.notes)
    assert noted == (frame == "leica")


def held(world: World, frame: str, zero: Array, rng: np.random.Generator, count: int = 14) -> Samples:
    """Joints that MuJoCo's arm has with its ball in one socket, to a tenth of the noise. zero: what joints report more
    than they are [rad].
    """
    chain, q = ur10(), rng.uniform(-1.2, 1.2, (1, 6)) + rng.uniform(-0.7, 0.7, (4 * count, 6))
    socket = world.tool_in_tracker(q[:1])[0, :3, 3]
    for _ in range(60):
        gap = socket - world.tool_in_tracker(q)[:, :3, 3]
        J = spatial_jacobian(
            chain, q
        )  # of the drawing, with the ball where it is: near enough to come closer each time
        p = world.tool_in_tracker(q)[:, :3, 3]
        Jp = J[:, :3] + np.cross(J[:, 3:], p[:, :, None], axis=1)
        step = np.swapaxes(Jp, 1, 2) @ np.linalg.solve(Jp @ np.swapaxes(Jp, 1, 2) + 1e-6 * np.eye(3), gap[..., None])
        q = q + np.clip(step[..., 0], -0.3, 0.3)
    q = q[np.linalg.norm(gap, axis=1) < 1e-6][:count]
    assert len(q) == count
    q = q + zero + 2e-5 * rng.standard_normal(q.shape)
    T = np.tile(np.eye(4), (count, 1, 1))
    return replace(samples_of(chain, q, T, "point", frame), sockets=(frame,))


def together(parts: list[Samples]) -> Samples:
    out = parts[0]
    for part in parts[1:]:
        out = out.followed_by(part)
    return out


def test_sockets_of_another_place_are_placed_and_the_arm_is_checked() -> None:
    """A ball in sockets: the next day the plate lies elsewhere, and its sockets have other names."""
    rng = np.random.default_rng(9)
    world = World(ur10(), rng, T_tip_tool=se3.transform(p=[0.03, 0.02, 0.15]))
    still, zero = np.zeros(6), np.zeros(6)
    zero[2] = 1.5e-3
    before = together([held(world, f"left_{k}", still, rng) for k in range(4)])
    known = Cell(sockets=before.frames)
    calibration = calibrate(Robot(ur10()), before, cell=known, geometry_only=True).calibration
    for moved, status in ((still, "unchanged"), (zero, "changed")):
        after = together([held(world, f"right_{k}", moved, rng) for k in range(3)])
        found = check(calibration, after, cell=Cell(sockets=after.frames))
        assert (found.status == "unchanged") == (status == "unchanged"), found.sentence
        labels = {label for c in found.changes for label in (c.label, *c.same_as)}
        assert not moved.any() or "zero of elbow_joint" in labels, found.sentence


def test_beyond_the_calibrated_ranges_scatter_may_be_the_calibration(cell: Arm) -> None:
    narrow = replace(cell[1], seen=np.array([np.full(6, -0.5), np.full(6, 0.5)]))
    tool = se3.exp(3e-4 * np.array([1, 0.5, -1, 1, -1, 1]))

    def moved(q: Array, world: Poses) -> Array:
        return world(q) @ tool

    for noise, seen, kind in ((4.0, lambda q, world: world(q), "tracker_noise"), (1.0, moved, "tool")):
        for calibration, doubted in ((cell[1], False), (narrow, kind == "tracker_noise")):
            found = checked((cell[0], calibration), seen, 5, 14, noise=noise)
            assert [c.kind for c in found.changes] == [kind], found.sentence
            assert ("beyond the joint ranges" in found.sentence) == doubted
            assert (found.advice.action == "add_stations") == doubted
            if doubted:
                assert found.status == "ambiguous"
                assert np.isin(found.advice.stations, calibration.postures).all()


def test_readings_that_place_no_frame_are_refused(cell: Arm) -> None:
    q = postures(0)
    samples = readings(q, cell[0].world.tool_in_tracker(q), np.random.default_rng(0), frame="wire")
    ranges = replace(samples, kind=np.full(10, "range", dtype=KIND_NAMES), reading=np.full((10, 3), 1.5))
    with pytest.raises(BadTable, match="such readings do not place it"):
        check(cell[1], ranges, cell=Cell())


def test_another_arm_of_the_make_is_not_explained_by_setting_up_again(cell: Arm) -> None:
    other = replace(record(10, 14).samples, frames=("leica",))
    assert check(cell[1], other).status == "unexplained"
