"""Where an arm may go and be seen, against cases by hand and against kinematics taken joint by joint."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from cells import slider_arm, ur10
from planning.arms import irb1410
from planning.sites import ground, hall

from modcal_core.errors import BadTable, NotPlannable
from modcal_core.planning.pool import one_turn, survey, with_limits
from modcal_core.planning.site import clearance, site_from_data, spheres_of, visible
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward, frames
from modcal_core.robots.mechanism import random_postures


def site(**parts: Any) -> Any:
    return site_from_data(parts, "test")


@pytest.mark.parametrize("chain", [ur10(), slider_arm(), irb1410()], ids=["ur10", "sliders", "irb1410"])
def test_given_spheres_stand_in_the_frames_of_their_joints(chain: Chain) -> None:
    """Against the arm cut off behind each joint: its tip is then the frame that a URDF gives the link."""
    centre = [0.1, -0.07, 0.05]
    links = ("base", *chain.names)
    given = site(arm={"spheres": [{"link": link, "center_m": centre, "radius_m": 0.01} for link in links]})
    q = random_postures(chain, 5, np.random.default_rng(0))
    at = spheres_of(chain, given).at(frames(chain, q))
    for k in range(chain.n + 1):
        if k == 0:
            expected = np.tile(centre, (5, 1))
        else:
            cut = Chain.build(
                chain.names[:k],
                np.concatenate([chain.origins[:k], np.eye(4)[None]]),
                chain.axes[:k],
                chain.revolute[:k],
            )
            expected = (chain_forward(cut, q[:, :k]) @ np.array([*centre, 1.0]))[:, :3]
        assert np.abs(at[k].T - expected).max() < 1e-12


def test_clearance_is_the_least_distance_pair_by_pair() -> None:
    chain = irb1410()
    here = site(
        arm={"link_radius_m": 0.08, "margin_m": 0.01},
        surroundings={"floor_m": 0.05, "spheres": [{"center_m": [0.9, 0.2, 0.5], "radius_m": 0.2}]},
    )
    spheres = spheres_of(chain, here)
    q = random_postures(chain, 40, np.random.default_rng(1))
    at = spheres.at(frames(chain, q))
    for i in range(40):
        p = at[..., i]
        least = np.inf
        for a in range(len(p)):
            if spheres.link[a] > 0:
                least = min(least, np.linalg.norm(p[a] - [0.9, 0.2, 0.5]) - 0.28)
            if spheres.link[a] > 1:
                least = min(least, p[a, 2] - 0.08 - 0.05)
            for b in range(a):
                if spheres.link[a] != spheres.link[b] and abs(spheres.along[a] - spheres.along[b]) > 0.32:
                    least = min(least, np.linalg.norm(p[a] - p[b]) - 0.16)
        assert clearance(spheres, here, q[i : i + 1])[0] == pytest.approx(least - 0.01, abs=1e-12)


def one_joint() -> Chain:
    """One joint about z; the tip 1 m out along x, its x axis outwards."""
    tip = np.eye(4)
    tip[0, 3] = 1.0
    return Chain.build(["turn"], [np.eye(4), tip], lower=[-np.pi], upper=[np.pi])


TARGET = {"position_m": [0.0, 0.0, 0.0], "axis": [1, 0, 0], "half_angle_deg": 60}


@pytest.mark.parametrize(
    ("tracker", "angle", "seen"),
    [
        ({"position_m": [3, 0, 0]}, 0.0, True),
        ({"position_m": [3, 0, 0]}, 0.5 * np.pi, False),  # the target looks along y
        ({"position_m": [3, 0, 0], "range_m": [0.1, 1.5]}, 0.0, False),
        ({"position_m": [3, 0, 0], "axis": [-1, 0, 0], "half_angle_deg": 10}, 0.0, True),
        ({"position_m": [3, 0, 0], "axis": [0, 1, 0], "half_angle_deg": 45}, 0.0, False),
        ({"position_m": [3, 0, 0], "axis": [-1, 0, 0], "half_angle_deg": 5}, 0.3, False),  # 8 degrees aside
        ({"position_m": [3, 0, 0], "axis": [-1, 0, 0], "half_angle_deg": 9}, 0.3, True),
    ],
)
def test_what_the_tracker_sees(tracker: dict[str, Any], angle: float, seen: bool) -> None:
    here = site(tracker=tracker, target=TARGET, arm={"link_radius_m": 0.02})
    assert visible(spheres_of(one_joint(), here), here, np.array([[angle]]))[0] == seen


CAMERA = {"on_tool": True, "position_m": [0.1, 0, 0], "axis": [1, 0, 0], "half_angle_deg": 20, "range_m": [0.5, 1.5]}
BOARD = {"position_m": [2.0, 0, 0], "axis": [-1, 0, 0], "half_angle_deg": 50, "radius_m": 0.2}


@pytest.mark.parametrize(
    ("camera", "board", "angle", "seen"),
    [
        ({}, {}, 0.0, True),
        ({}, {}, 0.05, True),  # 6.4 degrees aside, beside 12.8 of the board itself
        ({}, {"radius_m": 0.0}, 0.1, True),
        ({}, {}, 0.1, False),  # its edge is outside the image
        ({}, {"position_m": [2.7, 0, 0]}, 0.0, False),  # too far
        ({}, {"axis": [-0.7, 0.7, 0]}, 0.0, True),  # by 45
        ({"axis": [0, 0, 1]}, {}, 0.0, False),  # looks up
    ],
)
def test_what_a_camera_on_the_tool_sees_of_a_board(
    camera: dict[str, Any], board: dict[str, Any], angle: float, seen: bool
) -> None:
    here = site(tracker={**CAMERA, **camera}, target={**BOARD, **board}, arm={"link_radius_m": 0.02})
    assert visible(spheres_of(one_joint(), here), here, np.array([[angle]]))[0] == seen


def test_what_stands_in_between_hides_the_target() -> None:
    chain = one_joint()
    behind = {"tracker": {"position_m": [-3, 0, 0]}, "target": {"position_m": [0.0, 0.0, 0.0]}}
    # from behind, the arm itself stands before its tip; turned away it does not
    here = site(**behind, arm={"link_radius_m": 0.05})
    assert list(visible(spheres_of(chain, here), here, np.array([[0.0], [1.5]]))) == [False, True]
    front = site(
        tracker={"position_m": [3, 0, 0]},
        target=TARGET,
        surroundings={"spheres": [{"center_m": [2, 0.1, 0], "radius_m": 0.2}]},
    )
    assert not visible(spheres_of(chain, front), front, np.zeros((1, 1)))[0]


def test_what_is_chosen_from_is_within_limits_free_and_seen() -> None:
    here, there = hall(), ground()
    q = there.pool.q
    assert len(q) == 300
    assert (q >= ur10().lower).all()
    assert (q <= ur10().upper).all()
    assert (np.ptp(q, axis=0) <= 2 * np.pi).all()
    spheres = spheres_of(ur10(), here)
    assert (clearance(spheres, here, q) >= 0.0).all()
    assert visible(spheres, here, q).all()
    T = chain_forward(ur10(), q)
    p = T[:, :3, 3] + T[:, :3, :3] @ here.target.position
    way = p - here.tracker.position
    assert (np.linalg.norm(way, axis=1) < 8.0).all()
    toward = -way / np.linalg.norm(way, axis=1)[:, None]
    assert (np.einsum("nc,nc->n", T[:, :3, 2], toward) >= np.cos(np.radians(80.0)) - 1e-12).all()
    assert (toward[:, 0] >= np.cos(np.radians(40.0)) - 1e-12).all()
    assert not visible(spheres, here, there.pool.roadmap).all()


def test_one_turn_is_cut_where_the_arm_cannot_be() -> None:
    """The shoulder of an arm that stands on a floor: straight down at π/2, so the turn goes from there over the top."""
    here = site(surroundings={"floor_m": 0.0}, limits={"wrist_3_joint": [-6.0, 6.0]})
    chain = one_turn(spheres_of(with_limits(ur10(), here), here), here, np.random.default_rng(0))
    width = chain.upper - chain.lower
    assert np.allclose(width[:5], 2 * np.pi)
    assert width[5] == pytest.approx(12.0)
    assert (chain.lower >= ur10().lower).all()
    assert (chain.upper <= ur10().upper).all()
    T = chain_forward(ur10(), np.array([0.0, chain.lower[1], 0.0, 0.0, 0.0, 0.0]))
    assert T[2, 3] < 0.0


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"traker": {}}, "unknown key traker; known are arm, limits, modcal_site"),
        ({"tracker": {"position_m": [1, 2, 3], "range_m": [2, 1]}}, "2 is not below 1"),
        ({"target": {"axis": [0, 0, 0], "half_angle_deg": 20}}, "its cone has no axis or no angle"),
        ({"noise": {"position_m": -1e-5}}, "noise: position_m: -1e-05 is out of range, at least 0 is allowed"),
    ],
)
def test_sites_that_make_no_sense(parts: dict[str, Any], words: str) -> None:
    with pytest.raises(BadTable, match=words):
        site_from_data(parts, "site.yaml")


@pytest.mark.parametrize(
    ("parts", "words", "kind"),
    [
        ({"arm": {"spheres": [{"link": "arm", "center_m": [0, 0, 0], "radius_m": 0.1}]}}, "no such link", BadTable),
        ({"limits": {"joint_9": [0, 1]}}, "no such joint", BadTable),
        ({"limits": {"joint_2": [2.0, 3.0]}}, "leave no part of the robot's own limits", BadTable),
        ({"tracker": {"position_m": [50, 0, 0], "range_m": [0, 8]}}, "none is seen by the tracker", NotPlannable),
        ({"surroundings": {"floor_m": 5.0}}, "none touches nothing", NotPlannable),
        ({"workspace": {"box_m": [[5, 6], [0, 1], [0, 1]]}}, "no allowed posture", NotPlannable),
    ],
)
def test_sites_that_leave_nothing(parts: dict[str, Any], words: str, kind: type[Exception]) -> None:
    with pytest.raises(kind, match=words):
        survey(irb1410(), site_from_data(parts, "site.yaml"), np.random.default_rng(0), candidates=20)
