"""Rotations, or positions, in another convention: named while the handle moves as on a whole track, and only then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from articulation.furniture_tracks import recorded
from articulation.objects import Array, Seen, ideal, noisy
from scipy.spatial.transform import Rotation

from modcal_core.articulation.choice import choose
from modcal_core.articulation.conventions import require_convention
from modcal_core.articulation.online import Tracker, TrackerState
from modcal_core.articulation.track import Track
from modcal_core.errors import BadRecording

pytestmark = pytest.mark.slow

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "articulation"
MIRROR = {axis: np.where(np.arange(3) == i, -1.0, 1.0) for i, axis in enumerate("xyz")}


def w_first(p: Array, R: Array) -> tuple[Array, Array]:
    """What is read as x y z w was written w x y z."""
    return p, Rotation.from_quat(Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]).as_matrix()


def inverse(p: Array, R: Array) -> tuple[Array, Array]:
    return p, np.swapaxes(R, 1, 2)


def left_handed(p: Array, R: Array) -> tuple[Array, Array]:
    return p * MIRROR["y"], R


def watched(p: Array, R: Array, measured: bool = True) -> list[TrackerState]:
    tracker = Tracker(measured=measured)
    return [tracker.update(x, R[i], 0.02 * i) for i, x in enumerate(p)]


def door(seed: int, far: float = 1.2) -> Seen:
    rng = np.random.default_rng(seed)
    return noisy(ideal("revolute", np.linspace(0.0, far, 200), rng, 0.5), rng, 5e-4, 4e-3)


def upright(hold: Rotation, seed: int = 0) -> tuple[Array, Array]:
    """A door about the frame's z, as most are."""
    rng, a = np.random.default_rng(seed), np.linspace(0.0, 1.2, 160)
    p = np.stack([0.7 * np.cos(a), 0.7 * np.sin(a), 1.0 + 0.0 * a], axis=1) + rng.normal(0.0, 5e-4, (160, 3))
    sway = Rotation.from_rotvec(rng.normal(0.0, 4e-3, (160, 3)))
    return p, (Rotation.from_rotvec(np.outer(a, [0.0, 0.0, 1.0])) * hold * sway).as_matrix()


@pytest.mark.parametrize(
    ("written", "words"),
    [(w_first, "read as w x y z"), (inverse, "read as their inverses"), (left_handed, "sign of y reversed")],
)
def test_another_convention_is_named_while_the_door_turns(written, words: str) -> None:  # type: ignore[no-untyped-def]
    seen = door(11)
    last = watched(*written(seen.positions, seen.rotations))[-1]
    assert f"{words}" in last.written.said
    assert "a revolute one" in last.written.said
    assert not last.trusted


@pytest.mark.parametrize("kind", ["revolute", "screw"])
def test_nothing_is_said_of_poses_that_are_as_they_should_be(kind: str) -> None:
    rng = np.random.default_rng(13)
    seen = noisy(
        ideal(kind, np.linspace(0.0, 0.4 if kind == "prismatic" else 1.4, 200), rng, 0.4, 0.08), rng, 5e-4, 4e-3
    )
    states = watched(seen.positions, seen.rotations)
    assert not any(state.written for state in states)
    assert states[-1].trusted


def test_nothing_is_said_of_a_hand_that_keeps_its_orientation_or_turns_half_as_far() -> None:
    for share in (0.0, 0.5):
        seen = door(14)
        a = share * np.linspace(0.0, 1.2, 200)
        sway = np.random.default_rng(1).normal(0.0, 0.01, (200, 3))
        R = Rotation.from_rotvec(np.outer(a, seen.axis)) * Rotation.from_matrix(seen.rotations[0])
        states = watched(seen.positions, (R * Rotation.from_rotvec(sway)).as_matrix())
        assert not any(state.written for state in states)


@pytest.mark.skipif(not DATA.is_dir(), reason="recorded tracks are not beside this checkout")
def test_nothing_is_said_of_recorded_furniture() -> None:
    for title, (_, track) in recorded(DATA).items():
        if track.rotations is not None:
            states = watched(track.positions[::8], track.rotations[::8])
            assert not any(state.written for state in states), title


def test_an_arm_s_own_poses_are_in_no_other_convention() -> None:
    seen = door(11)
    assert not any(s.written for s in watched(*left_handed(seen.positions, seen.rotations), measured=False))


@pytest.mark.parametrize(
    ("hold", "wrong", "named"),
    [
        (Rotation.from_euler("x", 90.0, degrees=True), "x", ["sign of"]),
        (Rotation.identity(), "x", ["sign of", "read as their inverses"]),
    ],
)
def test_what_cannot_be_told_apart_is_named_together(hold: Rotation, wrong: str, named: list[str]) -> None:
    """A door about z: a reversed x and a reversed y are alike, so neither is claimed; nor is an inverse, where that is."""
    p, R = upright(hold)
    p = p * MIRROR[wrong]
    track = Track(p, R)
    with pytest.raises(BadRecording) as refused:
        require_convention(track, choose(track))
    live = watched(p, R)[-1].written
    assert live is not None
    for said in (str(refused.value), str(live)):
        assert "x or y" in said or "y or x" in said
        assert "which of these, the track does not tell" in said
        assert all(words in said for words in named)
        assert ("read as their inverses" in said) == ("read as their inverses" in named)
