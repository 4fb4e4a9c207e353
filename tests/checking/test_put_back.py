"""What people put back by hand is repaired before the arm, where both move the readings alike."""

from __future__ import annotations

import numpy as np
import pytest
from cells import NOISE_M
from checking.checks import FRESH, Cell, about, checked, missed, names, rms

from modcal_core.geometry import so3
from modcal_core.report.checkup import checkup_data

FIRST, LAST = "shoulder_pan_joint", "wrist_3_joint"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joint", "place", "other", "name"), [(0, "base", "tracker", FIRST), (5, "tool", "target", LAST)]
)
def test_a_turn_about_an_outer_axis_is_put_back(cell: Cell, joint: int, place: str, other: str, name: str) -> None:
    found = checked(cell, lambda q, world: world(q + about(joint, 1e-3)))
    assert names(found) == {(place, place)}
    assert found.changes[0].same_as[:2] == (other, f"zero of {name}")
    assert found.changes[0].alike == "poses"
    assert found.status == "changed"  # the repaired poses are the same
    assert f"The {place} or the {other} has moved" in found.sentence


@pytest.mark.slow
@pytest.mark.parametrize("count", [8, 20])
def test_points_turn_no_flange(cell: Cell, count: int) -> None:
    """A target that was mounted a millimetre further round the last axis: the arm would be turned by degrees."""
    at = cell[0].world.tool_in_tracker
    angle = 1e-3 / (rms(at(FRESH + about(5, 1e-3)), at(FRESH)) / 1e-3)
    found = checked(cell, lambda q, world: world(q + about(5, angle)), 3, count, "point")
    assert names(found) == {("tool", "tool")}
    assert {"target", f"zero of {LAST}"} <= set(found.changes[0].same_as)
    assert found.changes[0].alike == "positions"
    assert "orientations" in found.sentence
    (said,) = checkup_data(found)["changes"]
    assert (said["same_at_every_posture"], said["same_orientation"]) == (True, False)
    assert found.repaired is not None
    old, new = cell[1].predict(FRESH), found.repaired.predict(FRESH)
    assert np.abs(so3.log(np.swapaxes(old[:, :3, :3], 1, 2) @ new[:, :3, :3])).max() < 1e-9
    assert missed(cell, found.repaired, lambda q, world: world(q + about(5, angle))) < 3.0 * NOISE_M
