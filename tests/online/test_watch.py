"""A change is noticed, and named; what is no change is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from cells import noisy, record, samples_of, ur10
from cli.recordings import URDF
from numpy.random import Generator

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.online.supervisor import ChangeDetector, find_change
from modcal_nodes.simulation.mjcf import World

NOISE_M, NOISE_RAD = 5e-5, 5e-5


def trusted(seed: int, kind: str = "pose") -> tuple[World, Fit]:
    cell = record(seed, 80, kind)
    model = fit_cell(cell.world.nominal, cell.samples, Cell()).model
    return cell.world, identify(model, cell.samples, choose_parameters(model, views_of(cell.samples)).parameters)


def watch_of(fit: Fit) -> ChangeDetector:
    return ChangeDetector(fit.model, fit.parameters, fit.covariance, fit.noise)


def readings(world: World, q: Array, T: Array, rng: Generator, kind: str = "pose") -> Samples:
    T = noisy(T, NOISE_M, NOISE_RAD, rng)
    return samples_of(world.nominal, q, T, kind)


def rows(samples: Samples) -> list[Samples]:
    return [samples.select(np.array([i])) for i in range(len(samples))]


def after(detector: ChangeDetector, samples: Samples) -> tuple[int, float] | None:
    """(samples needed, since when) of an alarm."""
    for i, row in enumerate(rows(samples)):
        if (since := detector.add(row)) is not None:
            return i + 1, since
    return None


def sagging(q: Array, mass: float, compliance: Array) -> Array:
    """Joint positions of an elastic UR10 with a mass in its hand, by Pinocchio."""
    model = pin.buildModelFromUrdf(str(URDF))
    data = model.createData()
    out = q.copy()
    for i, posture in enumerate(q):
        J = pin.computeFrameJacobian(model, data, posture, model.getFrameId("tool0"), pin.LOCAL_WORLD_ALIGNED)
        out[i] += compliance * (J[:3].T @ [0.0, 0.0, -9.81 * mass])
    return out


CHANGES = ["tool", "base", "joint", "link", "payload"]


def changed(what: str, world: World, q: Array) -> Array:
    """Exact poses of the tool after something has changed."""
    T = world.tool_in_tracker(q)
    if what == "tool":
        return T @ se3.exp([4e-4, -3e-4, 2e-4, 0.0, 1e-3, 0.0])
    if what == "base":
        return se3.exp([5e-4, 3e-4, -6e-4, 0.0, 0.0, 2e-4]) @ T
    if what == "joint":
        slipped = q.copy()
        slipped[:, 2] += 6e-4
        return world.tool_in_tracker(slipped)
    if what == "link":
        longer = World(ur10(), np.random.default_rng(0), 0.0, 0.0)
        stretched = ur10()
        origins = stretched.origins.copy()
        origins[2, 0, 3] -= 8e-4  # the upper arm, which lies along −x
        grown = World(stretched.with_origins(origins), np.random.default_rng(0), 0.0, 0.0)
        moved = grown.tool_in_tracker(q) @ se3.inverse(longer.tool_in_tracker(q))
        root = world.T_tracker_base
        return root @ moved @ se3.inverse(root) @ T
    return world.tool_in_tracker(sagging(q, 5.0, np.array([4e-6, 4e-6, 5e-6, 8e-6, 8e-6, 8e-6])))


EXPECTED = {"tool": "tool", "base": "base", "joint": "elbow_joint", "link": "elbow_joint", "payload": None}


@pytest.mark.slow
@pytest.mark.parametrize(("what", "seed"), list(zip(CHANGES, (1, 3, 1, 3, 1), strict=True)))
def test_a_change_is_noticed_and_named(what: str, seed: int) -> None:
    world, fit = trusted(seed)
    rng = np.random.default_rng(50 + seed)
    q = rng.uniform(-1.5, 1.5, (70, 6))
    detector = watch_of(fit)
    assert after(detector, readings(world, q[:40], world.tool_in_tracker(q[:40]), rng)) is None
    late = readings(world, q[40:], changed(what, world, q[40:]), rng)
    late = replace(late, stamps=late.stamps + 1000.0)
    alarms = [(i + 1, since) for i, row in enumerate(rows(late)) if (since := detector.add(row)) is not None]
    needed, since = alarms[0]
    assert needed <= 20
    first = float(late.stamps[0])
    # samples are two seconds apart; a payload shows in some postures only
    assert abs(since - first) <= (20.0 if what == "payload" else 6.0)
    hypothesis = find_change(detector, first)
    if what == "payload":
        assert hypothesis.driver.startswith("load:")
    else:
        assert hypothesis.place == EXPECTED[what]
        assert hypothesis.driver == "time (at once)"
    if what == "tool":
        assert hypothesis.size == pytest.approx(np.linalg.norm([4e-4, -3e-4, 2e-4]), rel=0.25)
    if what == "link":
        assert hypothesis.direction == "length"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "point"])
def test_where_nothing_happens_nothing_is_said(kind: str) -> None:
    rng = np.random.default_rng(9)
    for seed in (1, 2):
        world, fit = trusted(seed, kind)
        detector = watch_of(fit)
        q = rng.uniform(-1.5, 1.5, (600, 6))
        assert after(detector, readings(world, q, world.tool_in_tracker(q), rng, kind)) is None
        assert detector.largest < 45.0


def test_a_glint_is_no_change() -> None:
    world, fit = trusted(4)
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.5, 1.5, (200, 6))
    T = world.tool_in_tracker(q)
    T[::25, :3, 3] += 0.01 * rng.standard_normal((8, 3))
    assert after(watch_of(fit), readings(world, q, T, rng)) is None


def test_a_slow_creep_is_noticed() -> None:
    world, fit = trusted(6)
    rng = np.random.default_rng(6)
    q = rng.uniform(-1.5, 1.5, (200, 6))
    T = world.tool_in_tracker(q)
    T[:, :3, 3] += np.outer(np.linspace(0.0, 1e-3, 200), [0.6, 0.8, 0.0])
    alarm = after(watch_of(fit), readings(world, q, T, rng))
    assert alarm[0] < 80


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "place", "other"), [(0, "base", "tracker"), (5, "tool", "target")])
def test_a_turn_about_an_outer_axis_is_what_people_put_back(joint: int, place: str, other: str) -> None:
    world, fit = trusted(4)
    rng = np.random.default_rng(60)
    q = rng.uniform(-1.5, 1.5, (30, 6))
    detector = watch_of(fit)
    late = readings(world, q, world.tool_in_tracker(q + 1e-3 * np.eye(6)[joint]), rng)
    assert any([detector.add(row) is not None for row in rows(late)])
    hypothesis = find_change(detector, float(late.stamps[0]))
    assert hypothesis.place == place
    assert {other, f"zero of {ur10().names[joint]}"} <= set(hypothesis.same_as)
    assert f"The {place} or the {other} has moved" in hypothesis.sentence
