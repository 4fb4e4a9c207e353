"""Collision by a description's shapes: against distances of balls, worked out here from the nominal kinematics."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from measuring.shaped import with_spheres
from nodes.processes import ROOT

from modcal_core.errors import BadRobot
from modcal_core.geometry import se3
from modcal_core.planning.site import Ball, Site, clearance, spheres_of
from modcal_core.robots.urdf import read_chain
from modcal_nodes.measuring.collision import CollisionModel

URDF = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()
RADIUS = 0.06


def test_the_arm_touches_itself_where_balls_at_its_joints_do(rng: np.random.Generator) -> None:
    """Balls of links that are no neighbours: MuJoCo's contacts against distances by modcal's kinematics. Pairs that
    touch wherever the arm is are drawn that way, and are not looked at."""
    chain, radius = read_chain(URDF), 0.15
    model = CollisionModel(with_spheres(URDF, radius), chain.names, Site())
    behind = {j.get("name"): j.find("child").get("link") for j in ET.fromstring(URDF).findall("joint")}  # type: ignore[union-attr]
    links = [behind[name] for name in chain.names]
    pairs = [(i, j) for i, j in itertools.combinations(range(chain.n), 2) if j > i + 1]
    near, found = [], []
    for q in rng.uniform(-np.pi, np.pi, (150, chain.n)):
        T, at = np.eye(4), []
        for k in range(chain.n):
            T = T @ chain.origins[k] @ se3.exp(np.r_[np.zeros(3), chain.axes[k] * q[k]])
            at.append(T[:3, 3])
        near.append([np.linalg.norm(at[i] - at[j]) < 2.0 * radius for i, j in pairs])
        touching = {frozenset((t.one, t.other)) for t in model.touches(q)}
        found.append([frozenset((links[i], links[j])) in touching for i, j in pairs])
    expected = np.array(near)
    expected[:, expected.mean(axis=0) > 0.9] = False
    assert (np.array(found) == expected).all()
    assert expected.any(axis=1).sum() > 8


def test_floor_boxes_and_balls_are_kept_out_of() -> None:
    chain = read_chain(URDF)
    site = Site(
        floor=-0.5,
        boxes=(np.array([[0.5, -0.2, 0.0], [0.8, 0.2, 0.4]]),),
        obstacles=(Ball(np.array([0.0, 0.9, 0.6]), 0.2),),
        margin=0.01,
    )
    model = CollisionModel(with_spheres(URDF, RADIUS), chain.names, site)
    up = np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0])
    assert model.free(up[None]).tolist() == [True]
    down = np.array([0.0, 1.2, 0.0, 0.0, 0.0, 0.0])
    assert "world" in {name for t in model.touches(down) for name in (t.one, t.other)}


def test_spheres_keep_out_of_boxes_as_well(rng: np.random.Generator) -> None:
    chain = read_chain(URDF)
    box = np.array([[0.2, -0.3, 0.1], [0.9, 0.3, 0.7]])
    site, bare = Site(boxes=(box,), link_radius=0.05), Site(link_radius=0.05)
    spheres = spheres_of(chain, site)
    q = rng.uniform(-np.pi, np.pi, (200, chain.n))
    with_box, without = clearance(spheres, site, q), clearance(spheres, bare, q)
    assert (with_box <= without + 1e-12).all()
    assert (with_box < without - 0.05).any()


def test_a_mesh_that_is_not_there_is_named(tmp_path: Path) -> None:
    text = with_spheres(URDF).replace('<sphere radius="0.05" />', '<mesh filename="package://ur/meshes/base.stl" />', 1)
    with pytest.raises(BadRobot, match=r"package://ur/meshes/base\.stl: is not a file"):
        CollisionModel(text, read_chain(URDF).names, Site(), tmp_path)
