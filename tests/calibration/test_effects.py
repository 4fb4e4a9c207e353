"""The error model: effects of every shape predict, differentiate, recover and survive being saved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10
from finite_differences import assert_jacobian
from robots.test_kinematics import urdf
from scipy.interpolate import BSpline

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.equations import System, normal_equations
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import ALL, AXIS, JOINTS, LENGTH, RADIAL, Effect
from modcal_core.effects.shapes import Shape, periodic
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.robots.urdf_inertias import Inertias, read_inertias

ELBOW, LIFT, WRIST = "elbow_joint", "shoulder_lift_joint", "wrist_2_joint"
T0 = 1.7e9
SPAN = {"low": -3.0, "high": 3.0}

EFFECTS: dict[str, tuple[Effect, list[float]]] = {
    "ratio": (Effect("gear_ratio", ELBOW, AXIS, f"position:{ELBOW}", Shape("linear")), [1e-4]),
    "gear": (Effect("gear_harmonic", ELBOW, AXIS, f"position:{ELBOW}", Shape("sine", {"cycles": 17.3})), [2e-4, -1e-4]),
    "strain wave": (
        Effect("gear_harmonic", ELBOW, AXIS, f"position:{ELBOW}", Shape("double", {"cycles": 17.3})),
        [2e-4, -1e-4, 1e-4, 2e-4],
    ),
    "compliance": (Effect("compliance", LIFT, AXIS, f"load:{LIFT}", Shape("linear")), [4e-6]),
    "hardening": (
        Effect("compliance", LIFT, AXIS, f"load:{LIFT}", Shape("hardening", {"scale": 80.0, "beta": 1.0})), [4e-4]
    ),
    "payload": (Effect("payload", LIFT, AXIS, f"load:{LIFT},payload:{LIFT}", Shape("several")), [4e-6, 1.2e-5]),
    "bearing": (Effect("compliance", WRIST, "across", f"moment:{WRIST}", Shape("linear")), [4e-5]),
    "backlash": (Effect("backlash", ELBOW, AXIS, f"direction:{ELBOW}", Shape("linear")), [2e-4]),
    "load backlash": (Effect("backlash", ELBOW, AXIS, f"load:{ELBOW}", Shape("sign")), [2e-4]),
    "coupling": (Effect("coupling", WRIST, AXIS, "position:wrist_1_joint", Shape("linear")), [3e-4]),
    "wobble": (
        Effect("axis_wobble", ELBOW, "across", f"position:{ELBOW}", Shape("turn", {"cycles": 2.0})), [2e-4, 0, 0, 1e-4]
    ),
    "sensor": (Effect("thermal", ELBOW, LENGTH, "temperature:arm", Shape("lagged", {"lag": -60.0})), [2e-5]),
    "late sensor": (Effect("thermal", ELBOW, "x", "temperature:arm", Shape("lagged", {"lag": 60.0})), [2e-5]),
    "settling": (
        Effect("drift", "base", ALL, "time", Shape("settle", {"since": T0, "tau": 90.0})), [2e-4, 0, -1e-4, 2e-4, 0, 1e-4]
    ),
    "ramp": (Effect("drift", WRIST, AXIS, "time", Shape("ramp", {"since": T0})), [1e-6]),
    "bump": (Effect("step", "tool", ALL, "time", Shape("step", {"at": T0 + 150.0})), [3e-4, 0, 1e-4, 0, 5e-4, 0]),
    "latency": (Effect("latency", "tracker", JOINTS, "velocity", Shape("linear")), [4e-3]),
    "clock": (Effect("latency", "tracker", JOINTS, "clock", Shape("ramp", {"since": T0 + 100.0})), [2e-5]),
    "lag": (Effect("joint_lag", ELBOW, AXIS, "velocity", Shape("linear")), [-6e-3]),
    "curve": (
        Effect("unknown", ELBOW, AXIS, f"position:{WRIST}", Shape("spline", {**SPAN, "count": 8.0})),
        [1e-4, 2e-4, 0, -1e-4, 3e-4, 0, 0, 1e-4],
    ),
    "signal": (
        Effect("unknown", ELBOW, AXIS, "signal:/hose", Shape("polynomial", {"low": -1.0, "high": 1.0, "degree": 3.0})),
        [1e-4, 2e-4, -1e-4],
    ),
    "pair": (
        Effect("unknown", ELBOW, AXIS, f"position:{ELBOW},position:{LIFT}", Shape("waves", {"order": 1.0})),
        [1e-4, 0, 2e-4, 0, 1e-4, 0, 1e-4, 0],
    ),
    "scale": (Effect("scale", "tracker", RADIAL, "reading", Shape("linear")), [1e-4]),
}  # fmt: skip


def started(name: str) -> Effect:
    effect, amplitudes = EFFECTS[name]
    return effect.started(np.array(amplitudes))


def weighed() -> Inertias:
    return read_inertias(urdf("ur10"), ur10())


def recorded(count: int = 40, seed: int = 1) -> Samples:
    """Stations with everything beside them that an effect can ask for."""
    samples = record(seed, count).samples
    rng = np.random.default_rng(seed)
    t = T0 + np.arange(0.0, 400.0)
    warm = 20.0 + 30.0 * -np.expm1(-(t - T0) / 120.0) + 3.0 * np.sin((t - T0) / 30.0)
    return replace(
        samples,
        velocity=rng.normal(size=samples.q.shape),
        acceleration=rng.normal(size=samples.q.shape),
        approach=rng.choice([-1.0, 1.0], samples.q.shape),
        signals=(
            SignalTrack("temperature:arm", t, warm[:, None]),
            SignalTrack("signal:/hose", t, np.sin((t - T0) / 17.0)[:, None]),
        ),
    )


def cell(samples: Samples, effects: tuple[Effect, ...]) -> Model:
    return fit_cell(ur10(), samples, Cell(), weighed()).model.with_effects(effects)


@pytest.mark.slow
@pytest.mark.parametrize("name", EFFECTS)
def test_derivatives(name: str) -> None:
    samples = recorded()
    model = cell(samples, (started(name),))
    values = model.effects[0].values
    at = linearise(model, [], values, samples)
    count = at.position.size

    def position(x: Array) -> Array:
        return -linearise(model, [], x, samples, jacobian=False).position.ravel()

    # scaled, so that one step suits amplitudes of 1e-6 and cycles of 20
    size = np.maximum(np.abs(values), 1e-6)
    # effects are small: a second amplitude turns the first by 1e-4 of it, and a delay bends its own course
    loose = 2e-3 if name in ("latency", "clock", "lag") else 2e-4
    assert_jacobian(lambda x: position(x * size), at.J[:, :count].T * size, values / size, 1e-3, loose)


@pytest.mark.parametrize("name", EFFECTS)
def test_predictions_and_residuals_are_one_model(name: str) -> None:
    samples = recorded()
    model = cell(samples, (started(name),))
    at = linearise(model, [], model.effects[0].values, samples, jacobian=False)
    gap = np.linalg.norm(samples.reading - model.predict_samples(samples)[:, :3, 3], axis=1)
    assert np.abs(np.linalg.norm(at.position, axis=0) - gap).max() < (1e-6 if name == "scale" else 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("block", "thinned", "points"), [(30, 100_000, 0), (2000, 1, 3), (2000, 850, 1)])
def test_normal_equations_are_those_of_the_whole_jacobian(
    block: int, thinned: int, points: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many samples are taken at once, with two curves, one or none as sparse arrays; poses, both kinds, points."""
    monkeypatch.setattr("modcal_core.calibration.equations.BLOCK", block)
    monkeypatch.setattr("modcal_core.effects.effect._MIN", thinned)
    monkeypatch.setattr("modcal_core.calibration.linearisation._AT_ONCE", 17)
    samples = recorded(100)
    if points:
        samples = replace(samples, kind=np.where(np.arange(100) % points == 0, "point", samples.kind))
    model = cell(samples, tuple(started(name) for name in ("gear", "curve", "bearing", "bump", "latency", "sensor")))
    other = Effect("curve", LIFT, AXIS, f"position:{LIFT}", Shape("spline", SPAN | {"count": 9}))
    model = model.with_effects((*model.effects, other.with_values(np.linspace(-2e-4, 3e-4, 9))))
    parameters = choose_parameters(model, views_of(samples)).parameters
    values = np.concatenate([np.zeros(len(parameters)), *(e.values for e in model.effects)])
    at = linearise(model, parameters, values, samples)
    weight = np.random.default_rng(0).uniform(0.5, 2.0, at.residual.size)
    H, g = normal_equations(model, parameters, values, samples, weight)
    expected = (at.J * weight) @ at.J.T
    size = np.sqrt(np.diag(expected))
    size[size == 0.0] = 1.0  # of points alone, whom no turn of the tool moves
    assert np.abs((H - expected) / np.outer(size, size)).max() < 1e-12
    assert np.abs(g - (at.J * weight) @ at.residual).max() < 1e-9 * np.abs(g).max()
    system = System(model, parameters, samples, model.drivers(samples))
    moved_on = values * 1.01  # residuals once curves are known as sparse arrays
    left = linearise(model, parameters, moved_on, samples, jacobian=False).residual
    assert np.abs(system.residuals(moved_on).residual - left).max() < 1e-14


def gear_in_mujoco(seed: int) -> tuple[Fit, float, float]:
    """The fit of a gear's effect to an arm in MuJoCo whose elbow errs by sines of the angle it was told."""
    made = record(seed, 160)
    q = made.samples.q
    off = np.zeros_like(q)
    off[:, 2] = 2e-4 * np.sin(101.0 * q[:, 2]) + 1e-4 * np.cos(101.0 * q[:, 2])
    T = made.world.tool_in_tracker(q + off)
    rng = np.random.default_rng(seed + 5)
    T[:, :3, 3] += 5e-5 * rng.standard_normal((160, 3))
    samples = samples_of(ur10(), q, T, "point")
    nominal = fit_cell(ur10(), samples, Cell()).model
    choice = choose_parameters(nominal, views_of(samples))
    effect = Effect("gear_harmonic", ELBOW, AXIS, f"position:{ELBOW}", Shape("sine", {"cycles": 101.1}))
    return identify(nominal.with_effects((effect.started(np.zeros(2)),)), samples, choice.parameters), 2e-4, 1e-4


@pytest.mark.slow
def test_a_planted_gear_is_recovered_within_three_sigma() -> None:
    scores = []
    for seed in range(15):
        fit, sine, cosine = gear_in_mujoco(seed)
        effect = fit.model.effects[0]
        scores.append((effect.values - np.array([sine, cosine, 101.0])) / effect.std)
    z = np.abs(np.array(scores))
    assert (z < 3.0).mean() > 0.97
    assert 0.5 < (z < 1.0).mean() < 0.85


def test_a_saved_calibration_predicts_the_same() -> None:
    samples = recorded()
    model = cell(samples, tuple(started(name) for name in EFFECTS))
    calibration = Calibration(model, model, model.with_effects(()), np.zeros((2, 6)), rivals=((started("gear"),),))
    again = from_data(to_data(calibration))
    assert np.array_equal(again.calibrated.predict_samples(samples), model.predict_samples(samples))
    assert again.rivals_of(0)[0].key == started("gear").key
    assert again.rivals_of(3) == ()


def test_what_a_recording_does_not_carry_is_not_applied() -> None:
    samples = replace(recorded(), signals=())
    model = cell(samples, (started("sensor"), started("signal")))
    bare = model.with_effects(())
    assert np.abs(model.predict_samples(samples) - bare.predict_samples(samples)).max() < 1e-15


def test_frozen_effects_stay() -> None:
    samples = recorded(80)
    model = cell(samples, (started("gear"),))
    choice = choose_parameters(model, views_of(samples))
    fit = identify(model, samples, choice.parameters, keep_effects=True)
    assert np.array_equal(fit.model.effects[0].values, model.effects[0].values)
    assert len(fit.values) == len(choice.parameters)
    assert np.abs(se3.log(se3.inverse(fit.model.T_tip_tool) @ model.T_tip_tool)).max() < 5e-3


@pytest.mark.parametrize("count", [4, 5, 12])
def test_splines_are_cubic_and_uniform(count: int, rng: np.random.Generator) -> None:
    """Against SciPy's, on knots that go on beyond the range by three."""
    low, high = -1.3, 2.4
    step = (high - low) / (count - 3)
    knots = low + step * np.arange(-3, count + 1)
    x = np.r_[rng.uniform(low, high, 50), low - 5.0, high + 5.0]
    expected = [BSpline.basis_element(knots[k : k + 5], extrapolate=False)(x) for k in range(count)]
    basis = Shape("spline", {"count": count, "low": low, "high": high}).basis(x)
    assert np.allclose(basis, np.nan_to_num(expected), atol=1e-14)
    assert np.allclose(basis[:, :50].sum(axis=0), 1.0)


@pytest.mark.parametrize("kind", ["sine", "double"])
def test_long_scans_of_cycles_are_the_waves_one_by_one(kind: str) -> None:
    x = np.random.default_rng(0).uniform(-3.0, 3.0, 40)
    cycles = np.arange(4.0, 400.15, 0.15)
    for scanned in (cycles, np.r_[cycles, 401.0]):  # evenly spaced, and not
        one_by_one = np.stack([Shape(kind, {"cycles": float(c)}).basis(x) for c in scanned])
        np.testing.assert_allclose(periodic(kind, scanned, x), one_by_one, atol=1e-11)


def test_a_spring_that_gets_stiffer_passes_smoothly_into_one_that_gets_softer() -> None:
    x, step = np.linspace(-2.0, 2.0, 9), 1e-5
    y = [Shape("hardening", {"scale": 1.0, "beta": beta}).basis(x)[0] for beta in (-step, 0.0, step, 2.0 * step)]
    slopes = np.diff(y, axis=0) / step
    np.testing.assert_allclose(y[1], x)
    np.testing.assert_allclose(slopes, np.tile(-(x**3), (3, 1)), atol=0.01)
