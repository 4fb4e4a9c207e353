"""Identification against MuJoCo: what was displaced is recovered, error bars are right, and what a fit says of itself is so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, Recorded, record, samples_of, slider_arm, ur10
from finite_differences import assert_jacobian

from modcal_core.calibration import fit as fits
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability, uncertainty
from modcal_core.calibration.distances import StationDistance, distance_rows
from modcal_core.calibration.fit import Fit, identify, require_enough
from modcal_core.calibration.known_distances import (
    common_factor,
    contradicted_together,
    contradictions,
    distances_of,
    without_distances,
)
from modcal_core.calibration.linearisation import Linearised, RowView, linearise
from modcal_core.calibration.noise import Groups, errors, excess_sigma, row_weights, weigh
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import ALL, Effect, all_columns
from modcal_core.effects.shapes import Shape
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import so3
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.outcome import Outcome
from modcal_core.robots.chain import Chain


def fit_all(chain: Chain, samples: Samples, cell: Cell | None = None) -> Fit:
    cell = cell or Cell()
    start = fit_cell(chain, samples, cell).model
    return identify(start, samples, choose_parameters(start, views_of(samples), cell.fixed).parameters)


def position_rms(fit: Fit, q: np.ndarray, T: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((fit.model.predict(q)[:, :3, 3] - T[:, :3, 3]) ** 2, axis=1))))


@pytest.mark.parametrize(("chain", "kind"), [(ur10(), "point"), (slider_arm(), "pose")], ids=["ur10", "sliders"])
def test_exact_readings_leave_nothing(chain: Chain, kind: str) -> None:
    made = record(3, 120, kind, chain)
    fit = fit_all(chain, made.exact)
    q = made.samples.q[::-1] * 0.7
    assert position_rms(fit, q, made.world.tool_in_tracker(q)) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("count", [100, 3000])
def test_error_on_new_postures_follows_the_law(count: int) -> None:
    """σ √(P / N) for P parameters and N point readings, within 20 %: nothing is wasted and nothing biased."""
    ratios = []
    for seed in range(6):
        made = record(seed, count, "point")
        fit = fit_all(ur10(), made.samples)
        q = np.random.default_rng(seed + 100).uniform(-np.pi, np.pi, (300, 6))
        law = NOISE_M * np.sqrt(len(fit.parameters) / count)
        ratios.append(position_rms(fit, q, made.world.tool_in_tracker(q)) / law)
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "point"])
def test_parameters_lie_within_three_sigma(kind: str) -> None:
    """Over 40 cells, 1 200 values, at least 99 % of the parameters; and 68 % within one sigma: bars are not just wide."""
    scores = []
    for seed in range(40):
        made = record(seed, 100, kind)
        start = fit_cell(ur10(), made.samples, Cell()).model
        parameters = choose_parameters(start, views_of(made.samples)).parameters
        fit = identify(start, made.samples, parameters)
        truth = identify(start, made.exact, parameters, robust=False)
        met = errors(truth.model, made.exact).position_norm  # the exact readings, so these are the true values
        assert met.max() < 1e-8
        scores.append((fit.values - truth.values) / fit.std)
    size = np.abs(np.concatenate(scores))
    assert np.mean(size < 3.0) >= 0.99
    assert 0.62 < np.mean(size < 1.0) < 0.74


def test_a_joint_that_never_moved_is_named() -> None:
    made = record(1, 150)
    q = made.samples.q.copy()
    q[:, 5] = 0.3
    T = made.world.tool_in_tracker(q)
    fit = fit_all(ur10(), samples_of(ur10(), q, T))
    seen = identifiability(fit)
    assert seen.rank < seen.parameters
    assert any("wrist_3_joint" in name or "tool" in name for name in seen.unobservable)
    assert np.abs(fit.values).max() < 0.05  # weak directions are held, not let go


def test_too_few_stations_are_refused() -> None:
    made = record(2, 4)
    with pytest.raises(
        NotEnoughData, match="4 stations for 30 parameters: they give 24 equations, at least 30 are needed"
    ):
        fit_all(ur10(), made.samples)


def test_minimal_numbers_of_parameters() -> None:
    """4 per revolute and 2 per sliding joint, 6 at the tool for poses and 3 for points."""
    counts = {}
    for name, chain in {"ur10": ur10(), "sliders": slider_arm()}.items():
        for kind in ("pose", "point"):
            made = record(4, 60, kind, chain)
            start = fit_cell(chain, made.samples, Cell()).model
            counts[name, kind] = len(choose_parameters(start, views_of(made.samples)).parameters)
    assert counts == {("ur10", "pose"): 30, ("ur10", "point"): 27, ("sliders", "pose"): 22, ("sliders", "point"): 19}


def test_fixed_places_stay() -> None:
    made = record(6, 150)
    fit = fit_all(ur10(), made.samples, Cell(fixed=("elbow_joint", "wrist_1_joint/x")))
    names = [p.name for p in fit.parameters]
    assert not [n for n in names if n.startswith("elbow_joint/") or n == "wrist_1_joint/x"]
    assert np.array_equal(fit.model.chain.origins[2], ur10().origins[2])


@pytest.mark.slow
def test_what_is_left_counts_what_the_parameters_took() -> None:
    # 18 poses give 108 rows for 30 parameters: without their degrees of freedom the spread would come out at 0.85
    fits = [fit_all(ur10(), record(seed, 18).samples) for seed in range(40)]
    assert np.mean([f.noise.position for f in fits]) == pytest.approx(NOISE_M, rel=0.06)
    assert np.mean([f.noise.rotation for f in fits]) == pytest.approx(NOISE_RAD, rel=0.06)


def test_the_information_is_that_of_the_data_alone() -> None:
    made = record(1, 60, "point")
    still = made.samples.q.copy()
    still[:, 5] = 0.3  # the last joint never moves, so data alone leaves a direction open
    T = made.world.tool_in_tracker(still)
    noise = NOISE_M * np.random.default_rng(2).standard_normal((60, 3))
    fit = fit_all(ur10(), replace(made.samples, q=still, reading=T[:, :3, 3] + noise))
    prior = np.array([p.prior_std for p in fit.parameters])
    # with the prior added it is the inverse of the covariance; in units of the prior, so that sizes compare
    unit = np.outer(prior, prior)
    together = fit.information * unit + np.eye(len(prior))
    assert (fit.covariance / unit) @ together == pytest.approx(np.eye(len(prior)), abs=1e-4)
    seen = np.linalg.eigvalsh(fit.information * unit)
    assert seen[0] < 1e-6 * seen[-1]
    assert seen[0] < 0.5  # less than the prior says


def orientation_error(fit: Fit, made: Recorded) -> float:
    q = np.random.default_rng(99).uniform(-np.pi, np.pi, (200, 6))
    true, said = made.world.tool_in_tracker(q), fit.model.predict(q)
    return float(np.linalg.norm(so3.log(said[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)), axis=1).mean())


def test_an_orientation_that_says_it_scatters_is_believed_less() -> None:
    rough = 100.0 * NOISE_RAD
    half, all_ = [], []
    for seed in range(5):
        made = record(seed, 80)
        bad = np.arange(80) % 2 == 0
        noise = so3.exp(rough * np.random.default_rng(seed + 50).standard_normal((80, 3)))
        R = np.where(bad[:, None, None], made.samples.R @ noise, made.samples.R)
        told = replace(made.samples, R=R, sigma_rotation=np.where(bad, rough, 0.0))
        half.append(orientation_error(fit_all(ur10(), made.samples.select(~bad)), made))
        all_.append(orientation_error(fit_all(ur10(), told), made))
    # more readings, so no worse than the good half alone; believed alike, the bad ones would make it many times worse
    assert np.mean(all_) < 1.2 * np.mean(half)


@pytest.mark.slow
@pytest.mark.parametrize("known", [0, 8])
def test_known_distances_stand_for_readings(known: int) -> None:
    samples = record(0, 6).samples  # 36 equations
    require_enough(samples, 36 + known, known)
    with pytest.raises(NotEnoughData):
        require_enough(samples, 37 + known, known)


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


def with_distance(made: Recorded, known: StationDistance) -> Outcome:
    return calibrate(made.samples, ur10(), np.random.default_rng(0), Cell((known,)), look_for_effects=False).report


def test_a_known_distance_stands_beside_what_was_found(made: Recorded) -> None:
    known = far_apart(made)
    report = with_distance(made, known)
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
    report = with_distance(made, replace(known, distance=known.distance + 5e-3))
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
    apart = far_apart(made)
    known = (replace(apart, distance=apart.distance + 5e-3, std=1e-6).met(made.samples),)
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


@pytest.mark.parametrize(("unknown", "true"), [(0.02, 0.0), (0.5, 1e-3), (1.0, 2e-5)])
def test_spread_where_some_deviations_are_unknown(unknown: float, true: float) -> None:
    rng = np.random.default_rng(2)
    known = np.where(rng.random(400) < unknown, 0.0, 5e-5)
    square = np.sum((np.sqrt(true**2 + known**2)[:, None] * rng.standard_normal((400, 3))) ** 2, axis=1)
    found = excess_sigma(square, known, np.ones(400), 0.0)
    assert np.isfinite(found)
    assert found == pytest.approx(true, rel=0.3, abs=1.5e-5)


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
    position, rows, none = np.zeros((3, 40)), np.arange(30, 40), np.zeros(40)
    position[:, :30], position[0, 30:] = 3e-6, 0.025
    dimensions = np.r_[np.full(30, 3.0), np.ones(10)]
    groups = Groups(np.arange(30), {"range": rows}, dimensions, none > 0.0, none, none[:0])
    at = Linearised(position, np.zeros((3, 0)), np.zeros((0, 120)))
    _, noise = weigh(at, groups, 5.0, None)
    assert noise.position < 1e-5
    assert noise.others["range"] < 2e-3
    position[0, 30:] = 1e-4
    at = Linearised(position, np.zeros((3, 0)), np.zeros((0, 120)))
    assert weigh(at, groups, 5.0, None)[1].others["range"] > 9e-5
