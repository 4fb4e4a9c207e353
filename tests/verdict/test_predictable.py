"""What a regressor without physics predicts: nothing on a good arm, whatever its noise, and faults of every kind."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from cells import noisy, ur10
from verdict.visits import moved_by, tour, visited

from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import PART, SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.case import Case, fitted_case
from modcal_core.verdict.predictable import MAX_PREDICTABLE, predictable

pytestmark = pytest.mark.slow


@cache
def fitted(kind: str, stations: int) -> Case:
    samples = visited(3, stations, 0, kind)
    result = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)
    report = result.report
    none = np.zeros(len(samples), bool)
    errors = {stage: report.errors[stage] for stage in ("nominal", "geometric", "final")}
    return fitted_case(result.scored, samples, report.sets, none, errors)


def with_noise(case: Case, rng: np.random.Generator, kind: str) -> Case:
    """The case with readings that the model reproduces but for noise of this kind."""
    N = len(case.samples)
    T = case.model.predict_samples(case.samples)
    size = {"normal": np.ones(N), "heavy tails": 1.0 / np.sqrt(rng.chisquare(3, N) / 3.0)}.get(kind)
    if size is None:  # joints that do not repeat
        q = case.samples.q + 3e-5 * rng.standard_normal(case.samples.q.shape)
        T = case.model.predict_samples(replace(case.samples, q=q))
        size = np.full(N, 0.1)
    T = noisy(T, 2e-5 * size[:, None], 3e-5 * size[:, None], rng)
    R = T[:, :3, :3] if case.samples.is_pose.all() else case.samples.R
    return replace(case, samples=replace(case.samples, reading=T[:, :3, 3], R=R))


@pytest.mark.parametrize(
    ("kind", "draws", "noise"), [("point", 12, "heavy tails"), ("point", 12, "joints"), ("pose", 6, "normal")]
)
def test_noise_is_not_predictable(kind: str, draws: int, noise: str) -> None:
    """Thirty recordings in all; one of a hundred may be called open."""
    case = fitted(kind, 60)
    rng = np.random.default_rng(17)
    shares = [predictable(with_noise(case, rng, noise)).both for _ in range(draws)]
    assert sum(share is not None and share.lower99 > MAX_PREDICTABLE for share in shares) == 0


@pytest.mark.parametrize(("changed", "said"), [("length", "changed"), ("scale", "changed"), ("creep", "before")])
def test_what_changes_on_the_way_is_predictable(changed: str, said: str) -> None:
    """A length of the arm or the scale of the readings half-way, or a soft target that still hangs as it did before."""
    case = fitted("pose", 60)
    case = with_noise(case, np.random.default_rng(3), "normal")
    late = case.samples.stamps > np.median(case.samples.stamps)
    if changed == "length":
        frames = se3.exp(np.eye(6)[2] * 3e-4)  # the forearm's far end, out of the plane of elbow and shoulder
        origins = case.model.chain.origins.copy()
        origins[3] = origins[3] @ frames
        T = replace(case.model, chain=replace(case.model.chain, origins=origins)).predict_samples(case.samples)
        more = T[:, :3, 3] - case.model.predict_samples(case.samples)[:, :3, 3]
    elif changed == "scale":
        more = 4e-4 * case.samples.reading
    else:
        order, R = np.argsort(case.samples.stamps), case.model.predict_samples(case.samples)[:, :3, :3]
        more = np.zeros((len(R), 3))
        for last, now in pairwise(order):  # the world's z axis in the target, then and now
            more[now] = 2e-4 * (R[now] @ R[last].T - np.eye(3))[:, 2]
        late[:] = True
    samples = replace(case.samples, reading=case.samples.reading + late[:, None] * more)
    found = predictable(replace(case, samples=samples))
    assert found.both.lower99 > MAX_PREDICTABLE
    assert said in found.source


def faulty(fault: str, seed: int = 5, stations: int = 120) -> Samples:
    """Readings of an arm in MuJoCo with 0.1 mm that no geometry explains, on 0.02 mm of noise."""
    made, q, _ = tour(seed, stations, 0)
    rng = np.random.default_rng(seed)
    step = np.diff(q, axis=0, prepend=q[:1])
    sent, signals = q.copy(), ()
    angle = 1e-4 / 0.7
    if fault == "low ripple":
        sent[:, 2] += angle * np.sqrt(2.0) * np.sin(3.0 * q[:, 2] + 0.4)
    if fault == "fast ripple":
        sent[:, 2] += angle * np.sqrt(2.0) * np.sin(101.0 * q[:, 2] + 0.4)
    if fault == "backlash":
        sent[:, 2] += angle * np.sign(step[:, 2])
    if fault == "payload":
        torque = np.cos(q[:, 1]) + 0.9 * np.cos(q[:, 1] + q[:, 2])
        sent[:, 1] += angle * torque / torque.std()
    if fault == "two joints":
        sent[:, 2] += 2.0 * angle * np.sin(q[:, 1]) * np.cos(q[:, 3])
    if fault == "signal":
        heat = rng.standard_normal(len(q))
        signals = (SignalTrack("signal:/x", 1.7e9 + 2.0 * np.arange(len(q)), heat[:, None], "/x"),)
        sent[:, 2] += angle * heat
    T = made.world.tool_in_tracker(sent)
    if fault == "drift":
        T[:, 0, 3] += 1.4e-4 * np.sin(np.linspace(0.0, 8.0, len(q)))
    if fault == "another arm":  # its weight tilts what both stand on
        other = rng.uniform(-np.pi, np.pi, (len(q), 4))
        signals = tuple(
            SignalTrack(f"signal:/joint_states{PART}joint left_{j}", made.samples.stamps, column[:, None], "/x")
            for j, column in enumerate(other.T)
        )
        reach = np.cos(other[:, 1]) + 0.5 * np.cos(other[:, 1] + other[:, 2])
        tilt = 1e-4 * reach[:, None] * np.stack([-np.sin(other[:, 0]), np.cos(other[:, 0]), 0.0 * reach], axis=1)
        base = made.world.tool_in_tracker(np.zeros((1, 6)))[0, :3, 3]
        turn = so3.exp(tilt)
        T[:, :3, :3] = turn @ T[:, :3, :3]
        T[:, :3, 3] = base + (turn @ (T[:, :3, 3] - base)[..., None])[..., 0]
    T = noisy(T, 2e-5 / np.sqrt(3.0), 2e-5, rng)
    return replace(made.samples, reading=T[:, :3, 3], R=T[:, :3, :3], signals=signals)


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("low ripple", "own position"),
        ("fast ripple", "waves of the joint positions"),
        ("backlash", "arrived"),
        ("payload", "load"),
        ("two joints", "waves of the joint positions"),
        ("signal", "what was recorded of"),
        ("drift", "order of the stations"),
        ("another arm", "single waves of the positions of left_0, left_1, left_2, left_3"),
    ],
)
def test_faults_that_the_model_lacks_are_open(fault: str, named: str) -> None:
    judged = calibrate(faulty(fault), ur10(), np.random.default_rng(0), look_for_effects=False).report.judged
    assert judged.status == "open"
    reason = next(r for r in judged.reasons if r.kind == "predictable")
    assert named in reason.sentence
    assert judged.predictable.share > 0.5


def test_a_frozen_model_is_not_open_for_its_own_error() -> None:
    """A calibration from 40 stations misses 300 others by what its parameters do not know, and by nothing else."""
    few = visited(6, 40, 0)
    calibration = calibrate(few, ur10(), np.random.default_rng(0), look_for_effects=False).calibration
    made, _, _ = tour(6, 40, 0)
    rng = np.random.default_rng(8)
    q = rng.uniform(-np.pi, np.pi, (300, 6))
    T = made.world.tool_in_tracker(q)
    T = noisy(T, 2e-5, 3e-5, rng)
    again = replace(
        few.select(np.zeros(300, int)),
        q=q,
        stamps=1.7e9 + 2.0 * np.arange(300),
        station=np.arange(300),
        reading=T[:, :3, 3],
        R=T[:, :3, :3],
    )
    good = evaluate(calibration, again, np.random.default_rng(0)).judged
    assert good.status == "cannot_tell", good.open_because
    rows = {row.what: row.value for row in good.account_mm2}
    assert rows["estimation"] > 0.1 * 3.0 * (1e3 * 2e-5) ** 2
    bumped = moved_by(again, np.array([6e-5, 0.0, 0.0]))
    assert evaluate(calibration, bumped, np.random.default_rng(0)).judged.status == "open"
