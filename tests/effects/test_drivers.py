"""What effects act on, and curves that are computed together against the same effects one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10
from correction.test_compensation import calibration_of, moment, true_model
from scipy.integrate import solve_ivp

from modcal_core.calibration.covariance import Uncertainty
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.effects.drivers import DriverLimits, Drivers, NominalArm, delayed
from modcal_core.effects.effect import AXIS, Effect, motion
from modcal_core.effects.registry import candidates
from modcal_core.effects.shapes import KINDS, Shape
from modcal_core.effects.sizes import AxisCurves
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import SignalTrack, is_told
from modcal_core.outcome import Finding

LAG = 120.0  # s


def _warming(t: np.ndarray) -> np.ndarray:
    """A motor that warms up, and a hall whose doors open now and then."""
    return np.asarray(22.0 + 15.0 * (1.0 - np.exp(-t / 1500.0)) + 1.5 * np.sin(2.0 * np.pi * t / 900.0))


def _sensed(t: np.ndarray) -> np.ndarray:
    """What a sensor of that lag shows, by integrating its equation."""
    answer = solve_ivp(
        lambda now, x: (_warming(np.array(now)) - x) / LAG, (t[0], t[-1]), [22.0], t_eval=t, rtol=1e-8, atol=1e-8
    )
    return np.asarray(answer.y[0])


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["into the lag", "out of it"])
def test_a_lag_is_applied_or_undone(sign: float) -> None:
    t = np.arange(0.0, 3600.0, 1.0)
    given, wanted = (_warming(t), _sensed(t)) if sign > 0.0 else (_sensed(t), _warming(t))
    at = t[600:-60]
    found = delayed(t, given, sign * LAG, at)
    left = np.abs(found - np.interp(at, t, wanted)).max()
    as_it_was = np.abs(np.interp(at, t, given) - np.interp(at, t, wanted)).max()
    assert as_it_was > 1.0
    assert left < 0.05 * as_it_was


KG = "signal:/payload_kg"


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ([0.0, 2.5], True),
        ([0.0, 1.0, 2.5, 1.0, 4.0], True),
        (np.float32([0.1, 2.35, 0.1]).astype(float), True),
        ([20.1, 20.4, 20.9, 21.2, 21.6, 21.9, 22.1, 22.5, 22.7, 23.0, 23.3, 23.5, 23.8, 24.0, 24.2, 24.5], True),
        (20.0 + 0.1 * np.arange(60.0), False),  # round, and sampled so often that nothing jumps
        (np.linspace(0.0, 1.0, 7) ** 2 + 1e-5 * np.sqrt(2.0), False),  # jumps, and no round number
        ([3.0, 3.0, 3.0], False),
        ([5.0], False),
        (np.repeat([0.0, 2.0, 1.0], 200), False),  # told every second: there is nothing between two messages
    ],
)
def test_round_numbers_that_jump_are_told(values: list[float], told: bool) -> None:
    assert is_told(np.array(values)) == told


def payload(t: list[float], kg: list[float], moving: bool = False) -> list[float]:
    """The driver at stations 100 s apart."""
    samples = record(1, 6).samples
    samples = replace(
        samples, stamps=1000.0 + 100.0 * np.arange(6), moving=np.full(6, moving),
        signals=(SignalTrack(KG, np.array(t), np.array(kg)[:, None], "/payload_kg"),),
    )  # fmt: skip
    return Drivers(samples, NominalArm(ur10())).values(KG).tolist()


def test_a_payload_holds_until_the_next_message() -> None:
    assert payload([950.0, 1250.0, 1390.0], [0.0, 2.5, 1.0]) == [0.0, 0.0, 0.0, 2.5, 1.0, 1.0]
    assert payload([1250.0, 950.0], [2.5, 0.0]) == [0.0, 0.0, 0.0, 2.5, 2.5, 2.5]
    assert payload([700.0], [2.5]) == [2.5] * 6  # said once


def test_a_message_just_behind_its_station_belongs_to_it_unless_the_arm_moves() -> None:
    behind = [999.9997, 1200.0004, 1400.0004], [0.0, 2.5, 1.0]
    assert payload(*behind) == [0.0, 0.0, 2.5, 2.5, 1.0, 1.0]
    assert payload(*behind, moving=True) == [0.0, 0.0, 0.0, 2.5, 2.5, 1.0]


def test_a_signal_that_was_told_may_lag() -> None:
    """A heater that is switched on: what it heats follows."""
    samples = record(1, 6).samples
    samples = replace(
        samples, stamps=1000.0 + 100.0 * np.arange(6),
        signals=(SignalTrack("signal:/heater", np.array([900.0, 1150.0, 1600.0]), np.array([[0.0], [1.0], [0.0]]), ""),),
    )  # fmt: skip
    found = Drivers(samples, NominalArm(ur10())).values("signal:/heater", 80.0)
    since = np.maximum(samples.stamps - 1150.0, 0.0)
    np.testing.assert_allclose(found, 1.0 - np.exp(-since / 80.0), atol=2e-3)


def test_what_a_sensor_saw_is_interpolated() -> None:
    assert payload([1000.0, 1500.0], [0.123456789, 1.987654321])[1] == pytest.approx(0.4962962954)


CHAIN = ur10()


def curve(rng: np.random.Generator, joint: int, count: int, at: int | None = None) -> Effect:
    """A random curve over part of a joint's range, at the same joint or at another one."""
    low = float(rng.uniform(-2.0, -1.0))
    shape = Shape("spline", {"low": low, "high": low + float(rng.uniform(1.0, 3.0)), "count": float(count)})
    of, place = CHAIN.names[joint], CHAIN.names[joint if at is None else at]
    effect = Effect("residual", place, AXIS, f"position:{of}", shape)
    return effect.started(1e-3 * rng.standard_normal(count))


def effects_of(rng: np.random.Generator) -> tuple[Effect, ...]:
    """Curves of one joint and of several, and between them what is none."""
    side = Effect("residual", CHAIN.names[1], AXIS, f"direction:{CHAIN.names[1]}", Shape("linear"))
    curves = [curve(rng, j, count, at) for j, count, at in ((1, 4, None), (1, 31, None), (4, 60, None), (0, 12, 2))]
    return (curves[0], side.started(np.array([2e-4])), *curves[1:])


def test_they_move_as_one_by_one(rng: np.random.Generator) -> None:
    """Within the range, in the margin where they fade, beyond it, at its ends, and at a position that is not known."""
    effects = effects_of(rng)
    curves = AxisCurves.among(effects, CHAIN)
    assert curves.of == (0, 2, 3, 4)
    q = rng.uniform(-4.0, 4.0, (400, 6))
    q[0, 1], q[1, 4], q[2] = effects[0].shape.settings["low"], effects[3].shape.settings["high"], 1e9
    q[3, 4] = np.nan
    around = Drivers(samples_of(CHAIN, q, np.tile(np.eye(4), (400, 1, 1))), NominalArm(CHAIN))
    wanted, _ = motion(effects, around)
    found, _ = motion([effects[1]], around)
    curves.add_to(found, q)
    assert found.keys() == wanted.keys()
    for place, twist in wanted.items():
        assert np.allclose(found[place], twist, rtol=0.0, atol=1e-18, equal_nan=True)
    assert np.isnan(found[CHAIN.first_place + 4][5, 3])
    assert np.abs(np.nan_to_num(found[CHAIN.first_place + 1])).max() > 1e-4


@pytest.mark.slow
def test_a_covariance_is_that_of_each_amplitude(rng: np.random.Generator) -> None:
    """By differences: what a unit of each amplitude moves, squared and summed."""
    effects = effects_of(rng)
    model = true_model(*effects)
    size = sum(len(e.values) for e in effects)
    std = rng.uniform(0.5, 1.5, size) * 1e-5
    made = calibration_of(model)
    known = replace(made, uncertainty=Uncertainty((), np.diag(std**2)))
    for q in rng.uniform(-2.5, 2.5, (4, 6)):
        at = moment(q, rng)
        C = Correction(known).covariance(q, at) - Correction(made).covariance(q, at)
        assert np.allclose(C, _by_differences(effects, std, at), rtol=1e-3, atol=1e-14)
        assert np.trace(C) > 1e-11


def _by_differences(effects: tuple[Effect, ...], std: Array, at: ArmState) -> Array:
    rows, step = [], 1e-6
    pose = Correction(calibration_of(true_model(*effects))).pose(at.q, at)
    for i, effect in enumerate(effects):
        for k in range(len(effect.values)):
            values = effect.values + step * (np.arange(len(effect.values)) == k)
            moved = (*effects[:i], effect.started(values), *effects[i + 1 :])
            T = Correction(calibration_of(true_model(*moved))).pose(at.q, at)
            rows.append(np.r_[T[:3, 3] - pose[:3, 3], so3.log(T[:3, :3] @ pose[:3, :3].T)] / step)
    J = np.array(rows)
    return np.asarray(J.T @ (std[:, None] ** 2 * J))


SETTINGS = {"cycles": 7.3, "tau": 40.0, "since": -1.0, "beta": 0.3, "scale": 2.0, "lag": 0.0}
STATED = [(kind, name) for kind, known in KINDS.items() for name in known.slopes]


@pytest.mark.parametrize(("kind", "name"), STATED)
def test_they_are_those_of_small_steps(kind: str, name: str) -> None:
    x = np.linspace(-3.0, 2.0, 60)
    shape = Shape(kind, SETTINGS)
    step = 1e-6 * SETTINGS[name]
    ahead, behind = (shape.with_settings({name: SETTINGS[name] + d}).basis(x) for d in (step, -step))
    slope = KINDS[kind].slopes[name](x, shape.settings, shape.basis(x))
    np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * step), atol=1e-6 * np.abs(slope).max())


def test_waves_say_theirs() -> None:
    assert {("sine", "cycles"), ("double", "cycles")} <= set(STATED)


SIZES = {"x": (1e-3, 1e-5, "m")}


def test_rivals_are_in_the_sentence_and_no_more_than_two() -> None:
    found = Finding("step", "base", "all", "time", SIZES, 1e-9, 1e-3, 1e-4, ("tool", "joint_1", "joint_2", "joint_3"))
    assert found.sentence.startswith("One of these, which the readings do not tell apart: base moves")
    assert "; tool; joint_1; 2 more. The error is" in found.sentence
    assert "One of these" not in replace(found, same_as=()).sentence


@pytest.mark.parametrize(("clock", "words"), [(True, "(stamp "), (False, "(row 60)")])
def test_a_table_without_a_clock_has_rows_and_no_seconds(clock: bool, words: str) -> None:
    made = record(3, 120)
    late = np.arange(120) >= 60
    samples = replace(made.samples, reading=made.samples.reading + np.outer(late, [0.0, 2e-3, 0.0]))
    samples = replace(samples, stamps=10.0 * np.arange(1.0, 121.0), clock=clock)
    report = calibrate(samples, ur10(), np.random.default_rng(0)).report
    (step,) = (e for e in report.effects if e.family == "step")
    assert words in step.sentence
    assert step.parameters["at"][2] == ("s" if clock else "rows")


@pytest.mark.parametrize("ended", [0.0, 1e4])
def test_nothing_grows_where_no_time_passes(ended: float) -> None:
    """Long after a recording the clock of its effects stands: what settled since then would be beyond all numbers."""
    samples = record(1, 40, "point").samples
    end = float(samples.stamps.max()) - ended
    drivers = Drivers(samples, NominalArm(ur10(), limits=DriverLimits((end - 600.0, end))))
    by_time = [effect for effect in candidates(drivers) if effect.driver == "time"]
    assert bool(by_time) == (ended == 0.0)
