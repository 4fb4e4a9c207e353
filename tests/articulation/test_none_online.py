"""While it moves: what no joint type describes is "none", said and not trusted, and a joint is never called so."""

from __future__ import annotations

import numpy as np
import pytest
from articulation.objects import Array, ideal, noisy
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.online import Tracker, TrackerState

DEGREE = np.pi / 180.0


def watched(p: Array, R: Array | None) -> list[TrackerState]:
    tracker = Tracker()
    return [tracker.update(x, None if R is None else R[i], 0.05 * i) for i, x in enumerate(p)]


def waved(seed: int, n: int = 240) -> tuple[Array, Array]:
    """A hand that holds nothing, through seven places and orientations."""
    rng = np.random.default_rng(seed)
    knots, s = np.linspace(0.0, 1.0, 7), np.linspace(0.0, 1.0, n)
    p = CubicSpline(knots, rng.normal(0.0, 0.15, (7, 3)))(s) + rng.normal(0.0, 5e-4, (n, 3))
    return p, Rotation.from_rotvec(CubicSpline(knots, rng.normal(0.0, 0.4, (7, 3)))(s)).as_matrix()


@pytest.mark.slow
@pytest.mark.parametrize("oriented", [True, False])
def test_a_hand_that_waves_is_none_and_hardly_ever_trusted(oriented: bool) -> None:
    """A stretch of its way is an arc; once that has been left, trust takes as much more."""
    p, R = waved(3)
    states = watched(p, R if oriented else None)
    assert states[-1].kind == "none"
    assert states[-1].model is None
    assert states[-1].left[0] > 8e-3
    assert np.mean([s.trusted for s in states]) < 0.05


def test_a_turn_that_does_not_go_with_the_path_is_none() -> None:
    """A handle that slides along a line and tips by 40° meanwhile: no drawer, no door, no screw."""
    rng, n = np.random.default_rng(1), 200
    p = np.outer(np.linspace(0.0, 0.4, n), [1.0, 0.0, 0.0]) + rng.normal(0.0, 3e-4, (n, 3))
    R = Rotation.from_rotvec(np.outer(40.0 * DEGREE * np.sin(np.linspace(0.0, 9.0, n)), [0.0, 1.0, 0.0])).as_matrix()
    states = watched(p, R)
    assert not states[-1].trusted or not states[-1].follows
    assert not any(s.trusted and s.follows for s in states[100:])


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "far"), [("prismatic", 0.35), ("revolute", 0.9), ("screw", 1.6)])
@pytest.mark.parametrize("noise", [1e-4, 2e-3])
def test_a_joint_is_at_no_moment_none(kind: Kind, far: float, noise: float) -> None:
    rng = np.random.default_rng(5)
    seen = noisy(ideal(kind, np.linspace(0.0, far, 150), rng, 0.4, 0.08), rng, noise, 0.5 * DEGREE)
    assert "none" not in {s.kind for s in watched(seen.positions, seen.rotations)}


def _arc(degrees: float, radius: float, n: int) -> tuple[Array, Array]:
    """From the origin along y, bending towards −x, and how far it has turned."""
    a = np.linspace(0.0, np.radians(degrees), n)
    return radius * np.stack([np.cos(a) - 1.0, np.sin(a), 0.0 * a], axis=1), a


def test_a_hinge_of_two_pins_is_not_trusted_once_the_second_is_seen() -> None:
    """Each pin by itself is a hinge, and predicts; a door of the same path, and of the same noise, is trusted."""
    rng = np.random.default_rng(4)
    (first, a), (second, b) = _arc(38.0, 0.7, 110), _arc(40.0, 0.35, 80)
    turned = Rotation.from_rotvec([0.0, 0.0, a[-1]])
    p = np.concatenate([first, first[-1] + turned.apply(second)]) + rng.normal(0.0, 5e-4, (190, 3))
    R = Rotation.from_rotvec(np.outer(np.concatenate([a, a[-1] + b]), [0.0, 0.0, 1.0])).as_matrix()
    assert watched(p, R)[109].trusted
    assert not watched(p, R)[-1].trusted
    assert not watched(p, None)[-1].trusted
    whole, c = _arc(60.0, 0.6, 190)
    R = Rotation.from_rotvec(np.outer(c, [0.0, 0.0, 1.0])).as_matrix()
    assert watched(whole + rng.normal(0.0, 5e-4, (190, 3)), R)[-1].trusted


def test_a_drawer_that_bows_is_one_motion() -> None:
    """A way that bends by two millimetres, one way and back, is furniture."""
    rng, s = np.random.default_rng(2), np.linspace(0.0, 0.4, 180)
    bow = np.stack([s, 2e-3 * np.sin(np.pi * s / 0.31), 1e-3 * np.cos(np.pi * s / 0.23)], axis=1)
    assert watched(bow + rng.normal(0.0, 5e-4, (180, 3)), None)[-1].trusted


def test_a_new_grasp_half_way_is_not_trusted_until_the_tracker_is_reset() -> None:
    rng, (p, a) = np.random.default_rng(3), _arc(80.0, 0.7, 200)
    p[100:] *= 0.82
    p[100:] += p[99] - p[100]
    R = Rotation.from_rotvec(np.outer(a, [0.0, 0.0, 1.0])).as_matrix()
    p += rng.normal(0.0, 4e-4, p.shape)
    assert watched(p, R)[99].trusted
    assert not watched(p, R)[-1].trusted
    assert watched(p[100:], R[100:])[-1].trusted
