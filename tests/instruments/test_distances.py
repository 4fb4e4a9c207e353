"""Gauge blocks, frames known in others, planes alone, effects by every instrument, corrections by mixed ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from finite_differences import assert_jacobian
from instruments import worlds
from instruments.test_recovery import ANCHORS, CELLS, PLANES, T_TRACKER_BASE, THEODOLITES, TRACKER, WIRES, read
from instruments.worlds import Reading
from scipy.optimize import brentq

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability
from modcal_core.calibration.distances import StationDistance, distance_rows
from modcal_core.calibration.fit import identify
from modcal_core.calibration.placing import Known
from modcal_core.calibration.store import from_data, to_data
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.online.supervisor import Live
from modcal_core.outcome.contents import Outcome
from modcal_core.report.report import to_json_data
from modcal_nodes.simulation.mjcf import World

pytestmark = pytest.mark.slow


def blocks(seed: int) -> tuple[worlds.World, worlds.Samples, tuple[StationDistance, ...]]:
    """Two theodolites, and three distances between stations as MuJoCo has them."""
    rng = np.random.default_rng(seed)
    w = worlds.world(seed)
    q = worlds.postures(ur10(), 100, rng)
    samples = read(w, THEODOLITES, q, rng)
    p = w.tool_in_base(q)[:, :3, 3]
    t = np.unique(samples.stamps)
    known = tuple(
        StationDistance((float(t[a]), float(t[b])), float(np.linalg.norm(p[a] - p[b])), 2e-5)
        for a, b in ((3, 40), (17, 80), (55, 91))
    )
    return w, samples, known


def test_derivatives() -> None:
    _, samples, known = blocks(1)
    met = [d.met(samples) for d in known]
    start = fit_cell(ur10(), samples, Cell()).model
    parameters = choose_parameters(start, views_of(samples)).parameters
    x = 0.01 * np.random.default_rng(1).normal(size=len(parameters))
    J = distance_rows(start, parameters, x, met).J
    assert_jacobian(lambda v: -distance_rows(start, parameters, v, met).residual, J.T, x)


def test_a_few_known_lengths_give_bearings_their_scale() -> None:
    scores = []
    for seed in range(2):
        w, samples, known = blocks(seed)
        cell = Cell(distances=known).met(samples)
        start = fit_cell(ur10(), samples, cell).model
        parameters = choose_parameters(start, views_of(samples), cell.kept, cell.distances).parameters
        fit = identify(start, samples, parameters, cell.distances)
        seen = identifiability(fit)
        assert seen.rank == seen.parameters
        # lengths that were never stated: between postures that are new
        q = worlds.postures(ur10(), 50, np.random.default_rng(seed + 50))
        true, found = w.tool_in_base(q)[:, :3, 3], fit.model.predict(q)[:, :3, 3]
        ratio = np.linalg.norm(found - np.roll(found, 1, axis=0), axis=1)
        ratio /= np.linalg.norm(true - np.roll(true, 1, axis=0), axis=1)
        scores.append(float(np.median(ratio)) - 1.0)
    assert np.sqrt(np.mean(np.square(scores))) < 1e-4  # the drawing's own lengths are off by about 1e-3


def test_a_station_that_is_not_there_is_refused() -> None:
    _, samples, known = blocks(1)
    with pytest.raises(BadTable, match="no station within 0.5 s of 12.000 s"):
        replace(known[0], stamps=(12.0, known[0].stamps[1])).met(samples)


def test_an_anchor_known_in_the_trackers_frame_moves_with_it() -> None:
    """Its three numbers are then fitted no more, and the zero is known better."""
    devices = [TRACKER, WIRES[0]]
    rng = np.random.default_rng(2)
    samples = read(worlds.world(2), devices, worlds.postures(ur10(), 100, rng), rng)
    T_wire_tracker = np.eye(4)
    T_wire_tracker[:3, 3] = -(T_TRACKER_BASE[:3, :3] @ ANCHORS[0] + T_TRACKER_BASE[:3, 3])
    found = {}
    for name, cell in {"free": Cell(), "known": Cell(known=(Known("wire_0", "tracker", T_wire_tracker),))}.items():
        start = fit_cell(ur10(), samples, cell).model
        found[name] = identify(start, samples, choose_parameters(start, views_of(samples), cell.kept).parameters)
    assert len(found["free"].parameters) - len(found["known"].parameters) == 3
    zero = "instrument wire_0/zero"
    assert found["known"].deviation(zero) < 0.8 * found["free"].deviation(zero)
    assert abs(found["known"].model.instruments[0].values[0] - 0.123) < 3.0 * found["known"].deviation(zero)


def touching(w: World, height: Reading, count: int, rng: np.random.Generator) -> Array:
    """Postures (count, n) in which MuJoCo's tool lies in a plane: one joint of a random posture turned until it does."""
    out: list[Array] = []
    while len(out) < count:
        q = worlds.postures(ur10(), 1, rng)[0]
        j = int(rng.integers(0, 5))

        def at(x: float, q: Array = q, j: int = j) -> float:
            turned = q.copy()
            turned[j] = x
            return float(height(w.tool_in_base(turned))[0])

        grid = np.linspace(-3.0, 3.0, 7)
        heights = [at(x) for x in grid]
        for k in range(6):
            if heights[k] * heights[k + 1] < 0.0:
                q[j] = brentq(at, grid[k], grid[k + 1], xtol=1e-10)
                out.append(q)
                break
    return np.array(out)


def recorded(w: World, rng: np.random.Generator) -> Samples:
    parts = []
    for k, plane in enumerate(PLANES):
        q = touching(w, plane.read, 60, rng)
        part = worlds.samples_of(ur10(), q, w.tool_in_base(q), plane.frame, "touch", lambda _: np.zeros(1), 3e-5, rng)
        parts.append(replace(part, stamps=part.stamps + 1000.0 * k))
    return parts[0].followed_by(parts[1]).followed_by(parts[2])


def apart(a: Array, b: Array) -> tuple[float, float]:
    """(by how much a must grow to be b, RMS distance then left), for points (N, 3), wherever they are placed."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    growth = float(S.sum() / np.sum(a**2))
    return growth, float(np.sqrt(np.mean(np.sum((b - growth * a @ (U @ Vt).T) ** 2, axis=1))))


def test_contact_alone_shows_the_shape_of_the_arm() -> None:
    w = worlds.world(1)
    samples = recorded(w, np.random.default_rng(1))
    start = fit_cell(ur10(), samples, Cell()).model
    fit = identify(start, samples, choose_parameters(start, views_of(samples)).parameters)
    assert 2e-5 < fit.noise.others["touch"] < 4e-5
    q = worlds.postures(ur10(), 200, np.random.default_rng(9))
    true = w.tool_in_base(q)[:, :3, 3]
    growth, left = apart(fit.model.predict(q)[:, :3, 3], true)
    _, before = apart(start.predict(q)[:, :3, 3], true)
    assert left < 5e-5 < 0.05 * before
    assert abs(growth - 1.0) < 3e-3  # no better than the drawing's lengths, which is what is expected of them
    seen = identifiability(fit)
    assert (seen.parameters - seen.rank, len(seen.unobservable)) == (1, 1)


def test_positions_are_followed_and_the_rest_is_passed_over() -> None:
    rng = np.random.default_rng(2)
    w = worlds.world(2)
    devices = [TRACKER, replace(WIRES[0], noise=2e-4), THEODOLITES[0]]
    samples = read(w, devices, worlds.postures(ur10(), 100, rng), rng)
    alone = samples.select(np.flatnonzero(samples.kind == "point"))
    alone = replace(alone, frames=("tracker",))
    made = {
        name: from_data(
            to_data(calibrate(s, ur10(), np.random.default_rng(0), Cell(), look_for_effects=False).calibration)
        )
        for name, s in (("mixed", samples), ("alone", alone))
    }
    live = Live(made["mixed"])
    new = read(w, devices, worlds.postures(ur10(), 60, rng), rng)
    for i in range(len(new)):
        live.add(new.select(np.array([i])))
    assert live.strange == 120
    assert live.estimator.taken == 60
    assert live.estimator.rejected == 0
    assert live.changed is None
    # the tracker says most; the others can only add to what it knows of the arm
    q = worlds.postures(ur10(), 1, rng)[0]
    none = np.zeros(6)
    now = ArmState(float(new.stamps[-1]), q, none, none, np.full(6, np.nan))
    size = {name: float(np.trace(Correction(c).covariance(q, now)[:3, :3])) for name, c in made.items()}
    assert 0.5 * size["alone"] < size["mixed"] < 1.2 * size["alone"]


REPEATABILITY = 2e-5  # rad
COUNT = 120
ELBOW = "elbow_joint"


def gear(q: Array) -> Array:
    """The elbow's gear, 0.3 mrad, 101 times a turn."""
    out = np.zeros_like(q)
    out[:, 2] = 3e-4 * np.sin(101.0 * q[:, 2] + 0.4)
    return out


def report_of(name: str, seed: int, planted: bool) -> Outcome:
    devices, cell = CELLS[name]
    rng = np.random.default_rng(seed)
    w = worlds.world(seed)
    q = worlds.postures(ur10(), COUNT, rng)
    poses = w.tool_in_base(q + planted * gear(q) + REPEATABILITY * rng.standard_normal(q.shape))
    samples: Samples = worlds.together(
        [worlds.samples_of(ur10(), q, poses, d.frame, d.kind, d.read, d.noise, rng) for d in devices]
    )
    return calibrate(samples, ur10(), np.random.default_rng(0), cell).report


@pytest.mark.parametrize("name", ["three wires", "tracker, wire of its own hook, theodolite"])
def test_a_clean_recording_comes_out_clean(name: str) -> None:
    report = report_of(name, 3, planted=False)
    assert report.effects == ()
    assert report.left is None
    nominal, final = report.size_mm("nominal"), report.size_mm("final")
    assert final.rms < 0.2 * nominal.rms


@pytest.mark.parametrize("name", ["three wires", "two theodolites"])
def test_a_planted_gear_is_found(name: str) -> None:
    report = report_of(name, 3, planted=True)
    assert [(f.family, f.place, f.driver) for f in report.effects] == [("gear_harmonic", ELBOW, f"position:{ELBOW}")]
    found = report.effects[0].parameters
    for name_of, planted in (("amplitude", 3e-4), ("cycles_per_turn", 101.0)):
        value, std, _ = found[name_of]
        assert abs(value - planted) < 4.0 * std
    assert report.left is None


def test_bearings_come_out_clean_and_the_report_says_what_they_cannot_see() -> None:
    report = report_of("two theodolites", 3, planted=False)
    assert report.effects == ()
    data = to_json_data(report)
    said = " ".join(data["notes"])
    assert data["claim_mm"]["open"] == "the scale"
    assert "One known distance shows it" in data["claim_mm"]["remedy"]
    assert "scatter about the model by" in said
    assert data["recording"]["measurement"] == "bearing"
    assert data["identifiability"]["rank"] == data["identifiability"]["parameters"] - 1
    assert data["noise_floor_mm"] is None
