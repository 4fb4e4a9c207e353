"""Effects that one scan shows are those that are there; stand-ins are replaced; small curves are learned and never named."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from calibration.test_identify import fit_all
from cells import record, samples_of, ur10
from diagnosis.test_diagnosis import at_joint, recorded

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import Uncertainty, likely_sizes, uncertainty, without
from modcal_core.calibration.fit import FITTED, Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import as_normal, errors, squared_residuals
from modcal_core.calibration.starts import fit_geometry
from modcal_core.calibration.store import Calibration
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.diagnosis.choice import EffectChoice, choose
from modcal_core.diagnosis.evidence import Evidence, Scanner
from modcal_core.diagnosis.pruning import is_nothing, joint_size, needless
from modcal_core.diagnosis.residual_curves import with_residual_curves
from modcal_core.diagnosis.rounds import chosen_together, surely_worth
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.registry import candidates, claimed, with_companions
from modcal_core.effects.shapes import Shape
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.report.report import to_json_data

PAN, ELBOW, WRIST_2 = 0, 2, 4
STALE = {PAN: 3e-4, ELBOW: 4e-4, WRIST_2: 3e-4}  # rad, of the side that each comes from


def backlash_in_three_joints(count: int) -> Samples:
    """Stations of an arm of which three joints have backlash."""
    made = record(8, count)
    rng = np.random.default_rng(4)
    q = made.samples.q
    came = np.sign(np.diff(q, axis=0, prepend=np.zeros((1, 6))))
    actual = q + 2e-5 * rng.standard_normal(q.shape)
    for joint, size in STALE.items():
        actual[:, joint] += size * came[:, joint]
    T = made.world.tool_in_tracker(actual)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
    return replace(samples_of(ur10(), q, T), approach=came)


@dataclass(frozen=True)
class Scanned:
    """A fit of geometry, what its scan shows, and stations that were not fitted."""

    fit: Fit
    scanner: Scanner
    evidence: Evidence
    first: EffectChoice
    fitted: Samples
    others: Samples


@pytest.fixture(scope="module")
def scanned() -> Scanned:
    """An arm of which three joints have backlash."""
    samples = backlash_in_three_joints(240)
    fitted, others = samples.select(slice(None, 160)), samples.select(slice(160, None))
    fit = fit_all(ur10(), fitted)
    drivers = fit.model.drivers(fitted)
    scanner = Scanner(list(candidates(drivers)), drivers)
    evidence = scanner.evidence(fit, trials=True)
    first = choose(evidence, scanner, fit, set())
    assert first is not None
    return Scanned(fit, scanner, evidence, first, fitted, others)


def fit_with(s: Scanned, *effects: Effect) -> Fit:
    start = s.fit.start.with_effects(effects)
    return identify(start, s.fitted, s.fit.parameters, tolerance=FITTED, begin=s.fit.values)


def backlash(s: Scanned, joint: int) -> Effect:
    found = next(e for e in s.scanner.effects if (e.family, e.place) == ("backlash", ur10().names[joint]))
    return found.started(np.array([1e-4]))


def test_what_is_there_stands(scanned: Scanned) -> None:
    fitted = fit_with(scanned, *(backlash(scanned, joint) for joint in STALE))
    assert scanned.scanner.evidence(fitted, trials=True).p_value > 0.01


def test_one_scan_shows_all_that_are_there(scanned: Scanned) -> None:
    s = scanned
    chosen = chosen_together(s.first, s.evidence, s.scanner, s.fit, set(), 30)
    names = ur10().names
    assert {(c.started.family, c.started.place) for c in chosen} == {("backlash", names[j]) for j in STALE}
    for one in chosen:  # with what each is, beside the others
        size = STALE[names.index(one.started.place)]
        np.testing.assert_allclose(np.abs(one.started.amplitudes), size, rtol=0.3)
    assert len(chosen_together(s.first, s.evidence, s.scanner, s.fit, set(), 2)) == 2


def test_what_is_not_there_is_not_worth_having(scanned: Scanned) -> None:
    """Of effects that are fitted together those that predict are told from one that does not."""
    s = scanned
    chosen = [c.started for c in chosen_together(s.first, s.evidence, s.scanner, s.fit, set(), 30)]
    absent = next(e for e in s.evidence.effects if (e.family, e.place) == ("backlash", ur10().names[5]))
    new = (*chosen[:1], absent.started(np.array([1e-4])), *chosen[1:])
    start = s.fit.start.with_effects(new)
    fit = identify(start, s.fitted, s.fit.parameters, tolerance=FITTED, begin=s.fit.values)

    def missed_by(model: Model) -> float:
        return float(np.mean(squared_residuals(errors(model, s.others), s.others, s.fit.noise)))

    known = uncertainty(fit.model, s.fitted, fit.parameters, fit)
    worth = surely_worth(fit.model, known, 0, missed_by(s.fit.model), missed_by)
    assert worth == [0, *range(2, len(new))]
    alone = identify(s.fit.start.with_effects(chosen[:1]), s.fitted, s.fit.parameters, tolerance=FITTED)
    first = without(fit.model, known, range(1, len(new)))
    assert missed_by(first) == pytest.approx(missed_by(alone.model), rel=0.05)


def test_a_difference_that_the_parameters_can_take_up_is_not_weighed() -> None:
    """The base stands 0.1 mm elsewhere at the held-out stations: that is no candidate's to explain."""
    made = record(3, 160, "point")
    rows = np.arange(len(made.samples))
    fit = fit_all(ur10(), made.samples.select(rows[:80]))
    held_out = made.samples.select(rows[80:])
    moved = replace(held_out, reading=se3.apply(se3.exp([1e-4, 0, 0, 0, 0, 0]), held_out.reading))
    left = []
    for samples in (held_out, moved):
        drivers = fit.model.drivers(samples)
        space = Scanner([], drivers).space_of(fit)
        left.append(float(np.sum(space.residual**2)))
        along = np.einsum("cNp,cN->p", space.Q, space.residual)
        assert np.sum(along**2) < 1e-3 * np.sum(space.residual**2)
    # without that the 0.1 mm, five times the noise, would be 25 / 3 times as much
    assert left[1] < 1.5 * left[0]


JOINT = "elbow_joint"
TRUE = Effect("gear_harmonic", JOINT, AXIS, f"position:{JOINT}", Shape("turn", {"cycles": 2.0}))
NOTHING = Effect("coupling", "wrist_1_joint", AXIS, f"position:{JOINT}", Shape("linear"))
TWIN = Effect("gear_harmonic", JOINT, AXIS, f"position:{JOINT}", Shape("turn", {"cycles": 2.0}))


def test_effects_that_are_nothing_or_stand_twice_are_taken_out() -> None:
    samples = recorded(3, at_joint(2, lambda q: 4e-4 * np.sin(2.0 * q[:, 2])))
    train, explain = samples.select(np.arange(100)), samples.select(np.arange(100, 160))
    cell = fit_cell(ur10(), train, Cell())
    choice = choose_parameters(cell.model, views_of(samples))
    started = tuple(e.started(np.full(n, 1e-4)) for e, n in ((TRUE, 2), (NOTHING, 1), (TWIN, 2)))
    fit = identify(cell.model.with_effects(started), train, choice.parameters)
    pruned, gone = needless(fit, train, explain, fit.noise)
    assert 1 in gone
    assert len(gone) == 2
    (left,) = pruned.model.effects
    assert left.key == TRUE.key
    assert abs(np.hypot(*left.amplitudes) - 4e-4) < 5e-5
    known = uncertainty(pruned.model, train, pruned.parameters, pruned)
    removed = errors(without(pruned.model, known, [0]), explain).position_norm
    refitted = errors(identify(cell.model, train, choice.parameters).model, explain).position_norm
    assert abs(np.mean(removed**2) / np.mean(refitted**2) - 1.0) < 0.15
    assert needless(fit, train, explain, fit.noise, keep=3)[1] == ()


def test_amplitudes_that_trade_with_geometry_are_judged_together() -> None:
    """Two amplitudes of which only the sum is known: nothing each, and together ten standard deviations."""
    effect = replace(TRUE.started(np.array([1e-4, 1e-4])), std=np.full(2, 1e-3))
    known = Uncertainty((), 1e-6 * np.array([[1.0, -1.0], [-1.0, 1.0]]) + 1e-10 * np.ones((2, 2)))
    assert joint_size((effect,), 0, known) == pytest.approx(as_normal(100.0, 2), rel=1e-2)
    assert not is_nothing((effect,), 0, known)
    small = effect.with_values(np.array([1e-4, -1e-4]), effect.std)
    assert is_nothing((small,), 0, known)


NOISE_M = 2e-5
STATIONS, TRAIN = 260, 200


class Weak:
    """Every joint errs by a sum of sines of its own, of so many rad RMS: at the tool less than the noise, each."""

    def __init__(self, seed: int, size: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.world = record(seed, 10, "point").world
        self._orders = self.rng.uniform(1.0, 6.0, (6, 4))
        self._phases = self.rng.uniform(0.0, 6.28, (6, 4))
        self._size = size / np.sqrt(2.0)

    def at(self, count: int, noise: float = 0.0) -> Samples:
        """Points at random postures within a radian."""
        q = self.rng.uniform(-1.0, 1.0, (count, 6))
        bent = self._size * np.sin(q[:, :, None] * self._orders + self._phases).sum(axis=2)
        T = self.world.tool_in_tracker(q + bent)
        T[:, :3, 3] += noise * self.rng.standard_normal((count, 3))
        return samples_of(ur10(), q, T, "point")


def geometry(samples: Samples) -> Fit:
    nominal = fit_cell(ur10(), samples, Cell())
    choice = choose_parameters(nominal.model, views_of(samples), (), ())
    return fit_geometry(nominal.model, samples, choice.parameters, Cell())


def rms(model: Model, samples: Samples) -> float:
    return float(np.sqrt(np.mean(errors(model, samples).position_norm ** 2)))


def divided(samples: Samples) -> tuple[Samples, Samples]:
    rows = np.arange(len(samples))
    return samples.select(rows < TRAIN), samples.select(rows >= TRAIN)


@pytest.mark.parametrize("seed", [11, 12])
def test_weak_curves_of_all_joints_are_learned_together(seed: int) -> None:
    arm = Weak(seed, 2.5e-5)
    train, explain = divided(arm.at(STATIONS, NOISE_M))
    unseen = arm.at(300)
    fit = geometry(train)
    held = with_residual_curves(fit, train, explain)
    assert held is not fit
    assert held.converged
    assert rms(held.model, unseen) < 0.8 * rms(fit.model, unseen)
    assert not any(map(claimed, held.model.effects))
    # numbers that the prior tells are not taken from the equations: the noise is the readings'
    assert held.noise.position == pytest.approx(NOISE_M, rel=0.15)
    assert all(0.0 < e.freedom <= len(e.values) for e in held.model.effects)
    assert sum(e.freedom for e in held.model.effects) < 0.7 * sum(len(e.values) for e in held.model.effects)


@pytest.mark.parametrize("seed", range(21, 25))
def test_a_clean_arm_stays_as_it_is(seed: int) -> None:
    train, explain = divided(Weak(seed, 0.0).at(STATIONS, NOISE_M))
    fit = geometry(train)
    assert with_residual_curves(fit, train, explain) is fit


def test_readings_in_motion_are_left_alone() -> None:
    train, explain = divided(Weak(11, 2.5e-5).at(STATIONS, NOISE_M))
    fit = geometry(train)
    train.moving.flags.writeable = True
    train.moving[0] = True
    assert with_residual_curves(fit, train, explain) is fit


def test_a_report_counts_them_and_names_none(tmp_path: Path) -> None:
    arm = Weak(16, 4e-5)
    done = calibrate(arm.at(180, NOISE_M), ur10(), np.random.default_rng(0))
    effects = done.calibration.calibrated.effects
    small = [i for i, e in enumerate(effects) if not claimed(e)]
    assert small
    data = to_json_data(done.report)
    named = {(e["place"], e["driver"]) for e in data["effects"]}
    assert "residual" not in {e["family"] for e in data["effects"]}
    account = data["account_mm2"]
    nominal = data["error_mm"]["nominal"]["rms"] ** 2
    assert sum(row["value"] for row in account) == pytest.approx(nominal, abs=1e-9)
    of_their_own = [i for i in small if (effects[i].place, effects[i].driver) not in named]
    assert any(row["what"] == "effect:small curves" for row in account) == bool(of_their_own)
    assert any("None of them is claimed as a cause" in note for note in done.report.notes) == bool(of_their_own)
    done.calibration.save(tmp_path / "calibration.yaml")
    again = Calibration.load(tmp_path / "calibration.yaml")
    unseen = arm.at(50)
    assert rms(again.calibrated, unseen) == pytest.approx(rms(done.calibration.calibrated, unseen), rel=1e-9)
    assert [e.held for e in again.calibrated.effects] == [e.held for e in effects]


def test_what_follows_the_same_driver_goes_with_a_named_effect() -> None:
    train, explain = divided(Weak(11, 2.5e-5).at(STATIONS, NOISE_M))
    held = with_residual_curves(geometry(train), train, explain)
    one = held.model.effects[0]
    named = one.__class__("unknown", one.place, one.direction, one.driver, one.shape)
    together = with_companions((named, *held.model.effects), (0,))
    assert {held.model.effects[i - 1].key[1:] for i in together[1:]} == {named.key[1:]}
    assert len(together) > 1


def _evidence(J: Array, r: Array, groups: list[np.ndarray], sizes: tuple[float, ...], noise: float) -> float:
    """Minus twice the logarithm of the likelihood, from the covariance of all residuals."""
    C = noise**2 * np.eye(len(r))
    for own, size in zip(groups, sizes, strict=True):
        C += size**2 * J[own].T @ J[own]
    return float(np.linalg.slogdet(C)[1] + r @ np.linalg.solve(C, r))


def test_sizes_are_those_that_make_the_data_most_likely() -> None:
    rng = np.random.default_rng(4)
    J = rng.standard_normal((45, 300))
    groups = [np.arange(0, 20), np.arange(20, 40), np.arange(40, 45)]
    x = np.r_[0.5 * rng.standard_normal(20), 0.1 * rng.standard_normal(20), np.zeros(5)]
    r = x @ J + 2.0 * rng.standard_normal(300)
    found = likely_sizes(J @ J.T, J @ r, float(r @ r), 300.0, np.ones(45), groups, [0.2, 0.2, 0.2])
    best = _evidence(J, r, groups, found.sizes, found.noise)
    for factors in product((0.7, 1.0, 1.4), repeat=2):
        others = tuple(s * f for s, f in zip(found.sizes, (*factors, 1.0), strict=True))
        assert _evidence(J, r, groups, others, found.noise) > best - 0.1
    assert found.sizes[2] < 0.1
    assert found.noise == pytest.approx(2.0, rel=0.1)
    assert found.sizes[0] == pytest.approx(0.5, rel=0.4)


def test_groups_that_explain_nothing_and_residuals_of_nothing_end_at_nothing() -> None:
    groups = [np.arange(0, 3), np.arange(3, 6)]
    H = np.diag([0.0, 0.0, 0.0, 4.0, 4.0, 4.0])
    for g, square in ((np.zeros(6), 0.0), (np.zeros(6), 50.0), (np.full(6, np.nan), 0.0)):
        found = likely_sizes(H, g, square, 40.0, np.ones(6), groups, [0.2, 0.2])
        assert found.sizes == (0.0, 0.0)
