"""The kind of a joint is told rightly, or not at all, however the track lies, and on real furniture."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import ideal, noisy, real

from modcal_core.articulation.choice import choose
from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.track import Track

pytestmark = pytest.mark.slow

DEGREE = np.pi / 180.0


@pytest.mark.parametrize(
    ("kind", "oriented"), [("prismatic", True), ("revolute", False), ("screw", False), ("screw", True)]
)
def test_clear_tracks(kind: Kind, oriented: bool) -> None:
    rng = np.random.default_rng(0)
    a = np.linspace(0.0, {"prismatic": 0.4, "revolute": 1.3, "screw": 2.6}[kind], 60)
    seen = noisy(ideal(kind, a, rng, 0.4, 0.08 if kind == "screw" else 0.0), rng, 1e-3, 0.3 * DEGREE)
    choice = choose(Track(seen.positions, seen.rotations if oriented else None))
    assert choice.kind == kind, choice.why
    assert choice.enough
    assert sum(choice.probabilities.values()) == pytest.approx(1.0)
    assert kind in choice.why


def test_the_whole_turn_is_told() -> None:
    """A joint of 140° whose ends lie 0.3 mm off its circle, six times its noise: they belong to the turn."""
    rng = np.random.default_rng(6)
    a = np.linspace(0.0, 140.0 * DEGREE, 150)
    seen = noisy(ideal("revolute", a, rng, 0.1), rng, 5e-5, 0.02 * DEGREE)
    ends = 3e-4 * np.abs(np.linspace(-1.0, 1.0, 150)) ** 12
    seen = Track(seen.positions + ends[:, None] * [0.0, 0.0, 1.0], None)
    assert "it turned 140°" in choose(seen).why


@pytest.mark.parametrize(("radius", "angle", "noise"), [(5e-3, 6.0, 2e-6), (5e-3, 2.0, 2e-6), (0.4, 0.32, 1e-4)])
def test_a_small_turn_that_is_seen_well_is_neither_rest_nor_line(
    radius: float, angle: float, noise: float, rng: np.random.Generator
) -> None:
    """About an axis 5 mm away, seen to 2 µm, and by a bow of 5 mm; positions alone."""
    choice = choose(Track(noisy(ideal("revolute", np.linspace(0.0, angle, 80), rng, radius), rng, noise).positions))
    assert choice.kind == "revolute", choice.why
    assert choice.fit.model.radius == pytest.approx(radius, rel=0.02)


def test_what_wanders_within_play_is_no_joint(rng: np.random.Generator) -> None:
    """A handle that is moved about in its play of 2 mm, seen to 2 µm."""
    along = np.linspace(0.0, 1.0, 120)[:, None]
    for _ in range(3):
        waves = [rng.normal(0.0, 2e-3 / m, 3) * np.sin(m * np.pi * along + rng.uniform(0.0, 6.0, 3)) for m in (1, 2, 3)]
        choice = choose(Track(sum(waves) + 2e-6 * rng.normal(size=(120, 3))))
        assert choice.kind == "rigid" or not choice.enough, choice.why


@pytest.mark.parametrize("oriented", [True, False])
def test_a_handle_that_does_not_move(oriented: bool, rng: np.random.Generator) -> None:
    seen = noisy(ideal("rigid", np.zeros(80), rng), rng, 1e-3, 0.3 * DEGREE)
    choice = choose(Track(seen.positions, seen.rotations if oriented else None))
    assert choice.kind == "rigid"


def test_a_short_track_of_points_is_not_enough() -> None:
    """Four centimetres of a door, 1 mm noise: a bow of half a millimetre tells nobody anything."""
    rng = np.random.default_rng(4)
    seen = noisy(ideal("revolute", np.linspace(0.0, 0.1, 60), rng, 0.4), rng, 1e-3)
    choice = choose(Track(seen.positions))
    assert not choice.enough
    assert choice.why.startswith("not ")


def test_a_drawer_seen_by_a_distorted_eye_is_no_door_of_five_metres() -> None:
    """A bow of 5 mm over 45 cm: how large smooth errors of a camera are, nobody knows beforehand."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        seen = noisy(ideal("prismatic", np.linspace(0.0, 0.45, 80), rng), rng, 5e-4)
        along = np.linspace(0.0, 1.0, 80)
        side = np.linalg.svd(seen.axis[None])[2][1]
        choice = choose(Track(seen.positions + 5e-3 * np.outer(4.0 * along * (1.0 - along), side)))
        assert choice.kind == "prismatic", choice.why


def test_a_grasp_that_turns_in_the_hand_does_not_hide_the_door(rng: np.random.Generator) -> None:
    """Held by a ball, the tool keeps its orientation while the door turns."""
    seen = noisy(ideal("revolute", np.linspace(0.0, 1.2, 80), rng, 0.5), rng, 5e-4)
    kept = noisy(ideal("rigid", np.zeros(80), rng), rng, 0.0, 0.2 * DEGREE)
    choice = choose(Track(seen.positions, kept.rotations))
    assert choice.kind == "revolute"
    assert not choice.follows
    assert choice.fit.model.radius == pytest.approx(0.5, abs=0.01)


@pytest.mark.slow
def test_flawed_tracks_are_told_rightly_or_not_at_all() -> None:
    """Bows, jitter, outliers and dwells of an independent make: at most one in thirty is told wrongly."""
    wrong, sure = [], 0
    for kind in ("prismatic", "revolute"):
        for seed in range(15):
            seen = real(kind, np.random.default_rng(seed))
            choice = choose(Track(seen.positions, None))
            sure += choice.enough
            if choice.enough and choice.kind != kind:
                wrong.append((kind, seed, choice.why))
    assert len(wrong) <= 1, wrong
    assert sure >= 24


@pytest.mark.slow
def test_real_furniture(furniture: dict[str, tuple[Kind, Track]]) -> None:
    """Of every fourth track of points one may be wrong, of poses none; none is said with certainty to be wrong.

    All of them: `make bench NAME=articulated`.
    """
    told = {name: (kind, choose(track)) for name, (kind, track) in list(furniture.items())[::4]}
    wrong = [name for name, (kind, choice) in told.items() if choice.kind != kind]
    assert len([name for name in wrong if not name.startswith("pose")]) <= 1, wrong
    assert not [name for name in wrong if name.startswith("pose")]
    assert not [name for name in wrong if told[name][1].enough]
    assert not [name for name, (_, choice) in told.items() if choice.kind == "screw"]


@pytest.mark.parametrize(
    ("kind", "samples", "oriented"),
    [("prismatic", 4, False), ("prismatic", 7, True), ("revolute", 4, True), ("revolute", 7, False)],
)
def test_a_few_samples_are_told_with_their_probability_and_never_with_certainty(
    kind: Kind, samples: int, oriented: bool
) -> None:
    rng = np.random.default_rng(8)
    a = np.linspace(0.0, 0.4 if kind == "prismatic" else 1.2, samples)
    seen = noisy(ideal(kind, a, rng, 0.5), rng, 5e-4, 3e-3)
    choice = choose(Track(seen.positions, seen.rotations if oriented else None))
    assert choice.kind == kind, choice.why
    assert choice.probabilities[kind] > 0.5
    assert not choice.enough
    assert choice.why.startswith(("not sure yet", "not enough motion yet"))
