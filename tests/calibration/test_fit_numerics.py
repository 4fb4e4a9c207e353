"""A fit says whether it converged, known distances are part of its cost, and no number of it is NaN."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.calibration import fit as fits
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability, uncertainty
from modcal_core.calibration.distances import StationDistance, distance_rows
from modcal_core.calibration.known_distances import (
    common_factor,
    contradicted_together,
    contradictions,
    distances_of,
    without_distances,
)
from modcal_core.calibration.linearisation import Linearised, RowView, linearise
from modcal_core.calibration.noise import Groups, excess_sigma, row_weights, weigh
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import ALL, Effect, all_columns
from modcal_core.effects.shapes import Shape
from modcal_core.loop import calibrate
from modcal_core.robots.urdf import read_chain
from tests.cells import NOISE_M, Recorded, record, ur10
from tests.finite_differences import assert_jacobian


@pytest.fixture(scope="module")
def made() -> Recorded:
    return record(8, 80, "point")


def test_reaching_the_most_iterations_is_said(made: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    start = fit_cell(ur10(), made.samples, Cell())
    parameters = choose_parameters(start.model, views_of(made.samples)).parameters
    assert start.converged
    assert fits.identify(start.model, made.samples, parameters).converged
    monkeypatch.setattr(fits, "MAX_ITERATIONS", 1)
    assert not fits.identify(start.model, made.samples, parameters).converged


def far_apart(made: Recorded) -> StationDistance:
    """Two stations whose true distance is known from MuJoCo."""
    a, b = made.exact.reading[3], made.exact.reading[40]
    stamps = float(made.samples.stamps[3]), float(made.samples.stamps[40])
    return StationDistance(stamps, float(np.linalg.norm(a - b)), 2e-5)


def test_a_known_distance_stands_beside_what_was_found(made: Recorded) -> None:
    known = far_apart(made)
    report = calibrate(made.samples, ur10(), np.random.default_rng(0), Cell((known,)), look_for_effects=False).report
    (distance,) = report.distances
    assert distance.stated == known.distance
    assert abs(distance.residual) < 1e-4
    assert abs(distance.found - distance.stated) < 3.0 * distance.std < 2e-3
    assert not distance.contradicted
    assert report.grounds.contradictions == ()
    assert report.grounds.converged


@pytest.mark.slow
def test_a_wrong_distance_is_a_contradiction(made: Recorded) -> None:
    """5 mm too long: the fit follows the statement, but the readings by themselves say otherwise."""
    known = far_apart(made)
    wrong = StationDistance(known.stamps, known.distance + 5e-3, known.std)
    report = calibrate(made.samples, ur10(), np.random.default_rng(0), Cell((wrong,)), look_for_effects=False).report
    assert report.distances[0].contradicted
    assert report.distances[0].found == pytest.approx(known.distance, abs=2e-3)
    assert any("known distance" in sentence for sentence in report.grounds.contradictions)


@pytest.mark.parametrize("longer", [0.0, 0.02])
def test_distances_that_are_wrong_alike_are_judged_together(made: Recorded, longer: float) -> None:
    p, stamps = made.exact.reading, made.samples.stamps
    known = tuple(
        StationDistance(
            (float(stamps[a]), float(stamps[b])), (1.0 + longer) * float(np.linalg.norm(p[a] - p[b])), 1e-5
        ).met(made.samples)
        for a, b in ((3, 40), (5, 50), (7, 60), (9, 70))
    )
    start = fit_cell(ur10(), made.samples, Cell()).model
    parameters = choose_parameters(start, views_of(made.samples), (), known).parameters
    fit = fits.identify(start, made.samples, parameters, known)
    free = without_distances(fit, made.samples)
    factor, std = common_factor(free, uncertainty(free.model, made.samples, free.parameters, free), known)
    # either end is as uncertain as one reading along the distance (the statement's 1e-5 beside it), and the model adds
    # its own: of 3 N equations P are used up, so that it has P / 3 N of a reading's variance at a station
    ends = np.hypot(np.sqrt(2.0) * NOISE_M, 1e-5) / np.linalg.norm([d.distance for d in known])
    share = len(parameters) / (3 * len(made.samples))
    # on average. What equations leave tells the noise to 5 %, hence 15 %
    assert 0.85 * ends < std < 1.15 * ends * np.sqrt(1.0 + len(known) * share)  # modelled alike, they do not average
    assert factor == pytest.approx(longer / (1.0 + longer), abs=4.0 * std)
    assert bool(contradicted_together(fit, made.samples, known)) == (longer > 0.0)


def test_a_fit_with_a_distance_ends_where_the_whole_cost_is_level(made: Recorded) -> None:
    """Readings, priors and distances pull against each other; where it ends they are in balance."""
    known = (StationDistance(far_apart(made).stamps, far_apart(made).distance + 5e-3, 1e-6).met(made.samples),)
    start = fit_cell(ur10(), made.samples, Cell()).model
    parameters = choose_parameters(start, views_of(made.samples), (), known).parameters
    fit = fits.identify(start, made.samples, parameters, known, robust=False)
    assert fit.converged
    rows = distance_rows(start, parameters, fit.values, known)
    now = linearise(start, parameters, fit.values, made.samples)
    weight = row_weights(fit.weights, fit.noise, made.samples)
    prior = np.array([p.prior_std for p in parameters])
    slope = now.J @ (weight * now.residual) + (rows.J / rows.std**2) @ rows.residual - fit.values / prior**2
    assert np.abs(slope * fit.std).max() < 1e-2
    assert distances_of(fit, made.samples, known)[0].contradicted
    assert contradictions(distances_of(fit, made.samples, known))


@pytest.mark.parametrize("unknown", [0.02, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("true", [0.0, 2e-5, 1e-3])
def test_spread_where_some_deviations_are_unknown(unknown: float, true: float) -> None:
    rng = np.random.default_rng(2)
    known = np.where(rng.random(400) < unknown, 0.0, 5e-5)
    square = np.sum((np.sqrt(true**2 + known**2)[:, None] * rng.standard_normal((400, 3))) ** 2, axis=1)
    found = excess_sigma(square, known, np.ones(400), 0.0)
    assert np.isfinite(found)
    assert found == pytest.approx(true, rel=0.3, abs=1.5e-5)


def test_a_clean_arm_with_a_few_silent_readings_is_not_refused() -> None:
    made = record(3, 100, "pose")
    sigma = np.full(100, 5e-5)
    sigma[[4, 30, 77]] = np.nan
    samples = fits.Samples(**{**made.samples.__dict__, "sigma_position": sigma, "sigma_rotation": sigma})
    report = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False).report
    size = report.size_mm("final")
    assert size is not None
    assert size.rms < 0.2


def test_no_direction_is_without_a_name(made: Recorded) -> None:
    start = fit_cell(ur10(), made.samples, Cell()).model
    parameters = choose_parameters(start, views_of(made.samples)).parameters
    fit = fits.identify(start, made.samples, parameters)
    # a direction that all parameters share alike, and that the data do not show
    prior = np.array([p.prior_std for p in parameters])
    v = np.ones(len(parameters)) / np.sqrt(len(parameters))
    shared = np.eye(len(parameters)) - np.outer(v, v)
    blind = fits.Fit(**{**fit.__dict__, "information": 100.0 * shared / np.outer(prior, prior)})
    (name,) = identifiability(blind).unobservable
    assert name


def test_limits_of_zero_are_limits() -> None:
    text = """<robot name="a"><link name="b"/><link name="c"/><link name="d"/>
      <joint name="j1" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
        <limit lower="0" upper="0" effort="1" velocity="1"/></joint>
      <joint name="j2" type="revolute"><parent link="c"/><child link="d"/><axis xyz="0 0 1"/>
        <limit effort="1" velocity="1"/></joint></robot>"""
    chain = read_chain(text)
    assert (chain.lower[0], chain.upper[0]) == (0.0, 0.0)
    assert np.isinf([chain.lower[1], chain.upper[1]]).all()


@pytest.mark.parametrize("place", ["base", "tool"])
def test_derivatives_of_a_move_by_any_angle(place: str) -> None:
    made = record(5, 12, "pose")
    samples = made.exact
    at = float(0.5 * (samples.stamps[5] + samples.stamps[6]))
    effect = Effect("step", place, ALL, "time", Shape("until", {"at": at}))
    start = fit_cell(ur10(), samples, Cell()).model
    x = np.array([0.03, -0.02, 0.01, 0.5, -0.8, 0.3])

    def predicted(v: np.ndarray) -> np.ndarray:
        T = start.with_effects((effect.with_values(v),)).predict_samples(samples)
        root = np.linalg.inv(start.T_frame_base[0] @ start.chain.T_base_root)
        return np.asarray((root @ T)[:, :3, 3].T.ravel())

    model = start.with_effects((effect.with_values(x),))
    around = model.drivers(samples)
    view = RowView.of(model, samples, around)
    J = np.stack([view.moved_by(terms)[: 3 * len(samples)] for terms in all_columns(model.effects, around)], axis=1)
    assert_jacobian(predicted, J, x)


def test_a_kind_that_the_fit_follows_has_some_noise() -> None:
    """Ten poses for 40 parameters, whose positions the fit takes up: nothing left is not nothing wrong."""
    square, known, weight = np.full(10, 1e-20), np.zeros(10), np.ones(10)
    assert 5e-6 < excess_sigma(square, known, weight, 20.0) < 5e-5
    assert excess_sigma(square, known, weight, 0.0) < 2e-9  # where nothing was fitted, exact readings are exact
    assert 5e-6 < excess_sigma(square, np.full(10, 1e-6), weight, 20.0) < 5e-5


def test_no_kind_is_left_aside_because_the_fit_does_not_follow_it_yet() -> None:
    """Balls in sockets within micrometres, and wires that an arm of another size misses by 25 mm."""
    position, rows = np.zeros((3, 40)), np.arange(30, 40)
    position[:, :30], position[0, 30:] = 3e-6, 0.025
    groups = Groups(np.arange(30), {"range": rows}, np.r_[np.full(30, 3.0), np.ones(10)])
    at, none = Linearised(position, np.zeros((3, 0)), np.zeros((0, 120))), np.zeros(40)
    _, noise = weigh(at, np.zeros(40, bool), none, none[:0], groups, 5.0, None)
    assert noise.position < 1e-5
    assert noise.others["range"] < 2e-3
    position[0, 30:] = 1e-4
    at = Linearised(position, np.zeros((3, 0)), np.zeros((0, 120)))
    assert weigh(at, np.zeros(40, bool), none, none[:0], groups, 5.0, None)[1].others["range"] > 9e-5
