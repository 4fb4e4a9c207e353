"""Outside the joint ranges that were seen: no worse than geometry alone, no jump on the way there, also when commanded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cells import samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell, free_cell
from modcal_core.calibration.final_fit import as_used, finalise
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.model import BLEND
from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.calibration.structure import ParameterChoice, choose_parameters, views_of
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.robots.kinematics import chain_forward

ELBOW, LOW, HIGH = 2, -1.6, 0.0
WRIST, SWING = 3, 2e-3  # rad
CURVE = Effect(
    "gear_harmonic",
    "elbow_joint",
    AXIS,
    "position:elbow_joint",
    Shape("spline", {"low": LOW, "high": HIGH, "count": 12.0}),
)

TURNS = Effect("gear_harmonic", "wrist_1_joint", AXIS, "position:wrist_1_joint", Shape("sine", {"cycles": 5.0}))

Curve = Callable[[Array], Array]


def ripple(q: Array) -> Array:
    """Quicker than the functions of the curve are apart: followed wrongly, it leads the geometry astray."""
    return np.asarray(2e-4 * np.sin(20.0 * q + 1.0))


def bend(q: Array) -> Array:
    """Slow enough for the curve; geometry alone takes its mean for a joint zero."""
    return np.asarray(4e-4 * np.cos(1.3 * q))


def readings(
    rng: np.random.Generator, low: float, high: float, count: int, curve: Curve = ripple, wrist: float = 0.0
) -> Samples:
    """Exact poses of an arm whose elbow is off by a curve, and whose wrist by a sine [rad], at random postures."""
    chain = ur10()
    q = rng.uniform(-1.5, 1.5, (count, 6))
    q[:, ELBOW] = rng.uniform(low, high, count)
    bent = q.copy()
    bent[:, ELBOW] += curve(q[:, ELBOW])
    bent[:, WRIST] += wrist * np.sin(5.0 * q[:, WRIST])
    base, tool = se3.exp([1.0, 2.0, 0.3, 0.2, -0.4, 1.0]), se3.exp([0.05, 0.03, 0.12, 0.2, 0.0, 0.3])
    return samples_of(chain, q, base @ chain_forward(chain, bent) @ tool)


def calibrated(curve: Curve, wrist: float = 0.0) -> Calibration:
    """The calibration with a curve over the elbow, of twelve functions, from half of its range; and with the wrist's."""
    samples, choice, full, _ = fits(curve, wrist)
    return finalise(samples, ur10(), choice, Cell(), None, full)


def fits(curve: Curve, wrist: float = 0.0) -> tuple[Samples, ParameterChoice, Fit, Fit]:
    """Samples from half of the elbow's range, what is free of geometry, the fit with the curve, and that without."""
    samples = readings(np.random.default_rng(0), LOW, HIGH, 150, curve, wrist)
    nominal = fit_cell(ur10(), samples, Cell())
    choice = choose_parameters(nominal.model, views_of(samples))
    choice = replace(choice, parameters=free_cell(choice.parameters, Cell()))
    effects = (CURVE.started(np.zeros(12)), *((TURNS.with_values(np.array([wrist, 0.0, 5.0])),) if wrist else ()))
    full, alone = (identify(nominal.model.with_effects(e), samples, choice.parameters) for e in (effects, ()))
    return samples, choice, full, alone


@pytest.fixture(scope="module")
def made() -> Calibration:
    return calibrated(ripple)


def missed(T: Array, samples: Samples) -> float:
    """RMS [mm]."""
    return 1e3 * float(np.sqrt(np.mean(np.sum((T[:, :3, 3] - samples.reading) ** 2, axis=1))))


@pytest.mark.slow
def test_outside_geometry_alone_counts_where_it_is_better(made: Calibration, rng: np.random.Generator) -> None:
    outside = readings(rng, HIGH + BLEND + 0.01, 1.5, 60)
    alone = missed(made.geometric.predict_samples(outside), outside)
    assert missed(made.calibrated.predict_samples(outside), outside) > 3.0 * alone
    assert missed(made.predict(outside.q), outside) == pytest.approx(alone)
    report = evaluate(made, outside, rng)
    final, geometric = (report.size_mm(stage) for stage in ("final", "geometric"))
    assert final.rms == pytest.approx(geometric.rms)
    assert any("geometry alone counts" in note for note in report.notes)


def test_what_is_scored_is_what_would_be_used(rng: np.random.Generator) -> None:
    """Of fits to half of the elbow's range, at postures in all of it."""
    samples, _, full, alone = fits(ripple)
    at = readings(rng, LOW, 1.5, 60)
    inside, beyond = at.q[:, ELBOW] < samples.q[:, ELBOW].max(), at.q[:, ELBOW] > HIGH + BLEND
    used, fully, plainly = (
        m.predict_samples(at) for m in (as_used(full, alone, samples, at, ()), full.model, alone.model)
    )
    np.testing.assert_array_equal(used[inside], fully[inside])
    np.testing.assert_allclose(used[beyond], plainly[beyond], atol=1e-12)
    assert as_used(full, alone, samples, at.select(inside), ()) is full.model


def test_elsewhere_the_full_model_goes_on(rng: np.random.Generator) -> None:
    """What it knows of the wrist is worth more beyond the elbow's range than what its curve for the elbow lacks there."""
    both, outside = calibrated(bend, SWING), readings(rng, HIGH + BLEND + 0.01, 1.5, 60, bend, SWING)
    assert not both.geometry_outside
    alone = missed(both.geometric.predict_samples(outside), outside)
    assert missed(both.predict(outside.q), outside) < 0.5 * alone


@pytest.mark.xfail(strict=True, reason="the curve's own covariance outside: 0.350 mm, where the full model has 0.092")
def test_a_bend_that_goes_on_outside_is_worth_the_full_model(rng: np.random.Generator) -> None:
    """The price of doubt: nothing but the curve over the elbow is there, and geometry alone is four times worse."""
    bent, outside = calibrated(bend), readings(rng, HIGH + BLEND + 0.01, 1.5, 60, bend)
    assert not bent.geometry_outside
    alone = missed(bent.geometric.predict_samples(outside), outside)
    assert missed(bent.predict(outside.q), outside) < 0.5 * alone


def test_nothing_jumps_on_the_way_out(made: Calibration) -> None:
    q = np.tile([0.3, -1.2, 0.0, 0.4, 0.8, 0.1], (401, 1))
    q[:, ELBOW] = np.linspace(HIGH - 0.1, HIGH + 0.1, 401)
    # where it is, less what the joint's own motion does: 0.5 mrad more or less of a step is a micrometre
    off = made.predict(q)[:, :3, 3] - made.geometric.predict(q)[:, :3, 3]
    step = np.linalg.norm(np.diff(off, axis=0), axis=1)
    way = float(np.linalg.norm(off[0]))
    assert way > 1e-5
    assert np.abs(off[-1]).max() < 1e-12
    assert step.max() < 0.1 * way  # of a hundred steps


@pytest.mark.parametrize("frame", ["", "tracker"])
def test_commands_follow_the_same_models(made: Calibration, frame: str) -> None:
    correction = Correction(made)
    q = np.tile([0.3, -1.2, 0.0, 0.4, 0.8, 0.1], (5, 1))
    q[:, ELBOW] = [HIGH - 0.2, HIGH + 0.02, HIGH + 0.04, HIGH + 0.06, 1.0]
    at = ArmState.at_rest(q[0], 0.0)
    T = correction.poses(q, at, "tool", frame)
    expected = made.predict(q)
    if not frame:
        expected = se3.inverse(made.calibrated.T_frame_base[0]) @ expected
    np.testing.assert_allclose(T, expected, atol=1e-12)
    tip = correction.poses(q, at, "tip", frame) @ made.calibrated.T_tip_tool
    np.testing.assert_allclose(tip, expected, atol=1e-12)
    assert correction.joints(q[-1], at)[ELBOW] == q[-1, ELBOW]  # no curve turns the joint any more


def test_what_is_better_outside_is_kept_with_the_calibration(made: Calibration) -> None:
    q = np.array([[0.3, -1.2, 1.0, 0.4, 0.8, 0.1]])
    unknown = replace(made, left_alone=0.0)
    np.testing.assert_allclose(unknown.predict(q), made.calibrated.predict(q), atol=1e-12)
    alone = replace(unknown, geometry_outside=True)
    np.testing.assert_allclose(alone.predict(q), made.geometric.predict(q), atol=1e-12)
    for calibration in (made, unknown, alone):
        kept = from_data(to_data(calibration))
        assert kept.geometry_outside == calibration.geometry_outside
        assert kept.left_alone == calibration.left_alone
        np.testing.assert_allclose(kept.predict(q), calibration.predict(q), atol=1e-12)
