"""What assemblies are judged by: each measure against another way to the same number."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from modules.arms import LIBRARY, five_joints, random_assembly

from modcal_core.geometry import se3, so3
from modcal_core.modules.catalogue import Catalogue
from modcal_core.modules.coding import Coding
from modcal_core.modules.library import Assembly
from modcal_core.modules.poe import chain_of, module_frames
from modcal_core.modules.requirements import (
    dexterity,
    farthest_reach,
    joint_range,
    obstacles,
    payload,
    structure,
    upright,
)
from modcal_core.modules.targets import Target, TargetPostures, frames
from modcal_core.modules.urdf import path, urdf_of
from modcal_core.robots.bodies import chain_gravity_wrench, payload_wrench
from modcal_core.robots.kinematics import body_jacobian, chain_forward
from modcal_core.robots.urdf_inertias import read_inertias

CODING = Coding(LIBRARY)
CATALOGUE = Catalogue(CODING)


def at_random(rng: np.random.Generator, n: int = 5, count: int = 6) -> tuple[list[Assembly], TargetPostures]:
    """Some arms, each at four postures for each of two targets."""
    assemblies = [random_assembly(rng, n) for _ in range(count)]
    genomes = np.stack([CODING.genome(a) for a in assemblies])
    arms = CATALOGUE.arms(genomes)
    q = rng.uniform(arms.lower[:, None, None], arms.upper[:, None, None], (count, 2, 4, n))
    masks = ([1, 1, 0, 1, 1, 1], [0, 0, 0, 1, 1, 1])
    targets = tuple(Target.build(so3.exp(rng.normal(size=3)), rng.normal(size=3), mask) for mask in masks)
    return assemblies, TargetPostures(arms, CATALOGUE.bodies(genomes), targets, q)


def broken(*parts: tuple[str, str]) -> float:
    assembly = Assembly.build((0, 0), [(joint, 0, link, 0, 0) for joint, link in parts])
    return float(structure(CODING.genome(assembly)[None], CODING, {})[0])


def test_structure_by_the_printed_rules() -> None:
    assert structure(CODING.genome(five_joints())[None], CODING, {}) == 0.0
    assert broken(("JR", "LC"), ("JR", "LP")) == 1  # two axes in line
    assert broken(("JP", "LC"), ("JP", "LP")) == 1
    assert broken(("JR", "LC"), ("JP", "LP")) == 0
    assert broken(("JR", "LR-I"), ("JR", "LP")) == 0
    assert broken(("JR", "LC"), ("JP", "LC")) == 0  # two straight links, but the second is the last
    assert broken(("JR", "LC"), ("JP", "LC"), ("JR", "LP")) == 1
    assert broken(("JR", "LC"), ("JR", "LC"), ("JR", "LC")) == 3


def test_frames_are_those_of_the_assembly(rng: np.random.Generator) -> None:
    assemblies, at = at_random(rng)
    for i, assembly in enumerate(assemblies):
        T = chain_forward(chain_of(assembly, LIBRARY), at.q[i].reshape(-1, 5)).reshape(2, 4, 4, 4)
        assert np.abs(at.tip[i] - T).max() < 1e-13
        modules = module_frames(assembly, LIBRARY, at.q[i, 0, 0])
        assert np.abs(at.behind[i, 0, 0] - modules[1:-2:2]).max() < 1e-13


def test_joint_range_as_printed(rng: np.random.Generator) -> None:
    _, at = at_random(rng)
    limit = np.where(at.arms.revolute, 2.967, 0.06)[:, None, None]
    K = np.abs(at.q) / limit
    over, cost = joint_range(at, {})
    assert not over.any()
    assert cost == pytest.approx(np.where(K < 0.5, 0.0, np.exp(K - 0.5)).sum(axis=-1))
    beyond = TargetPostures(at.arms, at.bodies, at.targets, 1.5 * limit * np.ones_like(at.q))
    assert joint_range(beyond, {})[0] == pytest.approx(0.5)


def test_dexterity_is_the_volume_of_the_masked_jacobian(rng: np.random.Generator) -> None:
    assemblies, at = at_random(rng)
    _, cost = dexterity(at, {})
    for i, assembly in enumerate(assemblies):
        chain = chain_of(assembly, LIBRARY)
        for k, target in enumerate(at.targets):
            J = body_jacobian(chain, at.q[i, k])
            across = np.swapaxes(target.T[:3, :3], 0, 1) @ at.tip[i, k, :, :3, :3]
            rows = np.concatenate([across @ J[:, 3:], across @ J[:, :3]], axis=1)[:, target.mask]
            volume = np.linalg.svd(rows, compute_uv=False).prod(axis=1)
            assert -cost[i, k] == pytest.approx(volume, abs=1e-12)


def test_payload_as_gravity_and_the_urdf_have_it(rng: np.random.Generator) -> None:
    assemblies, at = at_random(rng)
    mass = 1.7
    over, share = payload(at, {"mass_kg": mass})
    for i, assembly in enumerate(assemblies):
        chain = chain_of(assembly, LIBRARY)
        inertias = read_inertias(urdf_of(assembly, LIBRARY), chain)
        q = at.q[i].reshape(-1, 5)
        wrench = chain_gravity_wrench(chain, inertias, q) + mass * payload_wrench(chain, q)
        row = np.where(chain.revolute, 5, 2)
        needed = np.abs(wrench[np.arange(5), row])
        effort = np.where(chain.revolute, 40.0, 400.0)
        expected = (needed / effort[:, None]).max(axis=0).reshape(2, 4)
        assert share[i] == pytest.approx(expected, rel=1e-6)
        assert over[i] == pytest.approx(np.maximum(0.0, expected - 1.0), rel=1e-6, abs=1e-9)


def test_clearance_against_points_along_the_tubes(rng: np.random.Generator) -> None:
    """Many points on the middle line of every module, straight from the library."""
    assemblies, at = at_random(rng, count=3)
    spheres = [{"center_m": [0.3, 0.2, 0.4], "radius_m": 0.1}, {"center_m": [-0.4, 0.1, 0.1], "radius_m": 0.05}]
    over, cost = obstacles(at, {"spheres": spheres, "margin_m": 0.02})
    assert np.array_equal(over, np.maximum(0.0, 0.02 + cost))
    for i, assembly in enumerate(assemblies):
        for k, s in ((0, 0), (1, 3)):
            least = np.inf
            T = module_frames(assembly, LIBRARY, at.q[i, k, s])
            for module, frame in zip(assembly.modules, T[:-1], strict=True):
                kind = LIBRARY.types[module.kind]
                corners = se3.apply(frame, path(kind, module.size))
                share = np.linspace(0.0, 1.0, 400)[:, None]
                line = np.concatenate([a + share * (b - a) for a, b in pairwise(corners)])
                for sphere in spheres:
                    away = np.linalg.norm(line - sphere["center_m"], axis=1)
                    least = min(least, float(away.min()) - float(sphere["radius_m"]) - kind.radius)
            assert -cost[i, k, s] == pytest.approx(least, abs=5e-4)


def test_upright_and_reach(rng: np.random.Generator) -> None:
    assemblies, at = at_random(rng, count=4)
    home = np.stack([chain_of(a, LIBRARY).home for a in assemblies])
    assert upright(at.arms, {})[1] == pytest.approx(np.hypot(home[:, 0, 3], home[:, 1, 3]), abs=1e-12)
    farthest = farthest_reach(at.arms)
    longest = np.linalg.norm(at.arms.origins[:, 1:, :3, 3], axis=-1).sum(axis=1) + 0.06 * (~at.arms.revolute).sum(
        axis=1
    )
    assert (farthest <= longest + 1e-9).all()
    q = rng.uniform(at.arms.lower[:, None], at.arms.upper[:, None], (4, 3000, 5))
    tip = frames(at.arms, q)[2][..., :3, 3] - at.arms.origins[:, None, 0, :3, 3]
    assert (farthest >= np.linalg.norm(tip, axis=-1).max(axis=1) - 1e-6).all()
    # two parallel links and a gripper, all in a plane: stretched out, and the heights on top of each other
    planar = Assembly.build((0, 0), [("JR", 0, "LP", 0, 0), ("JR", 0, "LP", 4, 0)])
    arm = CATALOGUE.arms(CODING.genome(planar)[None])
    height = 2 * 0.11 + 2 * 0.08 + 0.12
    assert farthest_reach(arm)[0] == pytest.approx(np.hypot(0.18 + 0.20, height), abs=1e-9)
