"""Corrected poses and their covariance, commands against truth, and a joint that drags a cable."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calibration.test_effects import EFFECTS, started
from cells import NOISE_M, NOISE_RAD, record, samples_of, slider_arm, ur10

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.covariance import Uncertainty
from modcal_core.calibration.final_fit import finalise
from modcal_core.calibration.fit import identify
from modcal_core.calibration.linearisation import Deviations, apply_deviations
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import least_change, passing_directions
from modcal_core.calibration.store import Calibration
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.correction.commander import compensate
from modcal_core.correction.correction import ArmState, Correction, Target
from modcal_core.effects.drivers import NominalArm
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import BadTable, MissingDriver, NotReachable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.dwells import Approach
from modcal_core.measurements.path import UNKNOWN, WIDTHS, ahead, went_on
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf_inertias import Inertias

T0 = 1.7e9
STEEP = Effect("gear_harmonic", "elbow_joint", AXIS, "position:elbow_joint", Shape("sine", {"cycles": 160.0}))
HEAT = SignalTrack("temperature:arm", T0 + np.arange(0.0, 600.0, 10.0), 20.0 + np.linspace(0, 9, 60)[:, None])
HOSE = SignalTrack("signal:/hose", T0 + np.arange(0.0, 600.0, 10.0), np.linspace(-0.5, 0.5, 60)[:, None])


def inertias() -> Inertias:
    rng = np.random.default_rng(1)
    return Inertias(np.array([8.0, 12.0, 5.0, 2.0, 2.0, 0.5]), rng.uniform(-0.2, 0.2, (6, 3)), np.zeros((6, 3, 3)))


def true_model(*effects: Effect, chain: Chain | None = None, seed: int = 0) -> Model:
    """An arm displaced in all directions, watched from somewhere, with a tool and these effects."""
    rng = np.random.default_rng(seed)
    chain = ur10() if chain is None else chain
    off = np.r_[[5e-4] * 3, [1e-3] * 3] * rng.standard_normal((chain.n + 1, 6))
    tool = se3.transform(so3.exp([0.3, 0.1, -0.2]), [0.05, 0.03, 0.12])
    weighed = NominalArm(chain, inertias() if chain.n == 6 else None)
    return Model(
        chain.with_origins(chain.origins @ se3.exp(off)), ("tracker",), se3.exp(rng.normal(size=(1, 6))), tool,
        tuple(effects), weighed,
    )  # fmt: skip


def calibration_of(model: Model, chain: Chain | None = None) -> Calibration:
    chain = ur10() if chain is None else chain
    seen = np.array([[-3.0] * chain.n, [3.0] * chain.n])
    nominal = replace(model, chain=chain, effects=())
    return Calibration(nominal, model, model.with_effects(()), seen, watched=(T0, T0 + 300.0))


def moment(q: Array, rng: np.random.Generator) -> ArmState:
    """Conditions under which every effect has something to act on."""
    return ArmState(
        T0 + 170.0,
        q,
        rng.uniform(-1, 1, len(q)),
        rng.choice([-1.0, 1.0], len(q)),
        np.full(len(q), np.nan),
        (HEAT, HOSE),
    )


def as_samples(q: Array, at: ArmState) -> Samples:
    samples = samples_of(ur10(), q[None], np.eye(4)[None])
    return replace(
        samples, stamps=np.array([at.stamp]), velocity=at.velocity[None], approach=at.approach[None], signals=at.signals
    )


@pytest.mark.parametrize("name", [name for name in EFFECTS if name not in ("latency", "clock")])
def test_what_a_tracker_would_show_is_what_the_fitted_model_says(name: str, rng: np.random.Generator) -> None:
    model = true_model(started(name))
    correction = Correction(calibration_of(model))
    q = rng.uniform(-2, 2, 6)
    at = moment(q, rng)
    T = correction.pose(q, at, "tool", "tracker")
    assert np.abs(T - model.predict_samples(as_samples(q, at))[0]).max() < 1e-12
    assert np.abs(T - model.with_effects(()).predict(q[None])[0]).max() > 1e-6, "the effect did nothing"


@pytest.mark.slow
@pytest.mark.parametrize(
    "outside", [{}, {"geometry_outside": True}, {"left_alone": 1e-3}], ids=["inside", "geometry", "doubted"]
)
@pytest.mark.parametrize("target", ["tip", "tool"])
def test_what_is_computed_together_is_what_is_computed_apart(
    target: Target, outside: dict[str, Any], rng: np.random.Generator
) -> None:
    """With an uncertainty, with effects of the arm, of the tool and of the load, and beyond what was seen."""
    model = true_model(*(started(name) for name in ("gear", "compliance", "bump", "settling")))
    made = calibration_of(model)
    parameters = choose_parameters(made.nominal, views_of(as_samples(np.zeros(6), moment(np.zeros(6), rng)))).parameters
    size = len(parameters) + sum(len(e.values) for e in model.effects)
    spread = rng.standard_normal((size, size))
    made = replace(made, uncertainty=Uncertainty(parameters, 1e-9 * spread @ spread.T), **outside)
    full = Correction(replace(made, geometry_outside=False, left_alone=0.0))
    for _ in range(5):
        q = rng.uniform(-2, 2, 6)
        at = moment(q, rng)
        # 0.02 rad beyond: the two models are blended
        correction = Correction(replace(made, seen=np.array([q - 1.0, q - 0.02])) if outside else made)
        T, C, joints = correction.corrected(at, target)
        assert np.array_equal(T, full.pose(q, at, target)) == (not outside), "geometry counts outside, and only there"
        assert np.array_equal(T, correction.pose(q, at, target))
        assert np.array_equal(C, correction.covariance(q, at, target))
        assert np.array_equal(joints, correction.joints(q, at))
    assert np.abs(C).max() > 1e-10
    assert np.abs(joints - q).max() > 1e-6


@pytest.mark.parametrize("name", ["latency", "clock"])
def test_a_late_tracker_moves_no_true_pose(name: str, rng: np.random.Generator) -> None:
    model = true_model(started(name))
    q = rng.uniform(-2, 2, 6)
    T = Correction(calibration_of(model)).pose(q, moment(q, rng), "tool", "tracker")
    assert np.abs(T - model.with_effects(()).predict(q[None])[0]).max() < 1e-14


def test_base_and_tool_stay_out_of_the_tip_in_the_base_link(rng: np.random.Generator) -> None:
    """A base that drifts moves neither; a bumped tool moves the tool; an elbow that gives way moves both."""
    q = rng.uniform(-2, 2, 6)
    at = moment(q, rng)
    plain = true_model()
    T = chain_forward(plain.chain, q)
    for name, moves_tip, moves_tool in (("settling", 0, 0), ("bump", 0, 1), ("scale", 0, 0), ("gear", 1, 1)):
        correction = Correction(calibration_of(true_model(started(name))))
        moved = [
            np.abs(correction.pose(q, at, "tip") - T).max() > 1e-9,
            np.abs(correction.pose(q, at, "tool") - T @ plain.T_tip_tool).max() > 1e-9,
        ]
        assert moved == [moves_tip, moves_tool], name


def test_effective_joints_on_the_corrected_arm_give_the_corrected_tip(rng: np.random.Generator) -> None:
    effects = [started(name) for name in ("gear", "backlash", "compliance", "coupling", "ratio")]
    model = true_model(*effects)
    correction = Correction(calibration_of(model))
    for q in rng.uniform(-2, 2, (10, 6)):
        at = moment(q, rng)
        assert np.abs(correction.joints(q, at) - q).max() > 1e-5
        assert np.abs(chain_forward(model.chain, correction.joints(q, at)) - correction.pose(q, at)).max() < 1e-12


@pytest.mark.parametrize("chain", [ur10(), slider_arm()], ids=["ur10", "sliders"])
def test_passing_directions_change_nothing(chain: Chain, rng: np.random.Generator) -> None:
    model = true_model(chain=chain)
    G = passing_directions(model.chain, model.T_tip_tool)
    q = rng.uniform(-1, 1, (5, chain.n))
    T, size, n = model.predict(q), 1e-5, chain.n
    column = 0
    for k in range(n):
        for d in (2, 5) if chain.revolute[k] else (0, 1, 2, 5):
            base = np.zeros((1, 6))
            base[0, d] = size if k == 0 else 0.0
            moved = apply_deviations(model, Deviations(base, size * G[:, column].reshape(n, 6))).predict(q)
            assert np.abs(moved - T).max() < 20 * size**2
            column += 1
    assert column == G.shape[1]


@pytest.mark.slow
def test_covariance_is_right_over_many_recordings() -> None:
    """Each recording gives another calibration; its errors, weighed by what it says of itself, follow a χ² law."""
    rng = np.random.default_rng(11)
    chain, effects = ur10(), (started("gear"), started("backlash"))
    truth = true_model(*effects, seed=2)
    q = rng.uniform(-2.5, 2.5, (100, 6))
    blank = replace(samples_of(chain, q, np.tile(np.eye(4), (100, 1, 1))), approach=rng.choice([-1.0, 1.0], q.shape))
    blank = replace(blank, stamps=T0 + np.arange(100.0))
    T = truth.predict_samples(blank)
    choice = choose_parameters(truth, views_of(blank))
    exact = Correction(calibration_of(least_change(truth, chain)))
    here = rng.uniform(-2, 2, (3, 6))
    scores: dict[str, list[float]] = {"tip": [], "tool": []}
    for _ in range(12):
        samples = replace(
            blank,
            reading=T[:, :3, 3] + NOISE_M * rng.standard_normal((100, 3)),
            R=T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((100, 3))),
        )
        scored = identify(replace(truth, chain=chain), samples, choice.parameters)
        made = finalise(samples, chain, choice, Cell(), inertias(), scored)
        correction = Correction(made)
        noise = np.diag([made.noise.position**2] * 3 + [made.noise.rotation**2] * 3)
        assert made.noise.position == pytest.approx(NOISE_M, rel=0.3)
        for target in ("tip", "tool"):
            for posture in here:
                at = ArmState.at_rest(posture, T0 + 50.0, np.ones(6))
                A, B = exact.pose(posture, at, target), correction.pose(posture, at, target)  # type: ignore[arg-type]
                e = np.r_[A[:3, 3] - B[:3, 3], so3.log(A[:3, :3] @ B[:3, :3].T)]
                known = correction.covariance(posture, at, target) - noise  # type: ignore[arg-type]
                scores[target].append(float(e @ np.linalg.solve(known, e)))
    # a mean of 12 independent χ²(6) is 6 ± 1; over 100 recordings it was 6.07 for the tip and 5.82 for the tool
    for target, values in scores.items():
        assert 3.5 < np.mean(values) < 8.5, (target, np.mean(values))


def test_covariance_without_a_record_of_it_is_the_scatter_alone(rng: np.random.Generator) -> None:
    made = calibration_of(true_model())
    q = rng.uniform(-1, 1, 6)
    C = Correction(made).covariance(q, moment(q, rng))
    assert np.array_equal(np.diag(C), [made.noise.position**2] * 3 + [made.noise.rotation**2] * 3)


@pytest.mark.parametrize(("target", "frame"), [("tip", ""), ("tool", ""), ("tool", "tracker"), ("tip", "tracker")])
def test_a_command_brings_the_true_pose(target: str, frame: str, rng: np.random.Generator) -> None:
    """The posture that was asked for is found again, from near it and with gears as steep as they come."""
    steep = STEEP.started(np.array([2.5e-4, 1.8e-4]))
    names = ("backlash", "compliance", "bump", "settling", "wobble", "sensor", "scale")
    correction = Correction(calibration_of(true_model(steep, *(started(name) for name in names))))
    for _ in range(12):
        q = rng.uniform(-2.0, 2.0, 6)
        q[[2, 4]] = rng.choice([-1.0, 1.0], 2) * rng.uniform(0.6, 2.0, 2)  # away from singular postures
        at = replace(moment(q + 0.03 * rng.choice([-1.0, 1.0], 6), rng), velocity=np.zeros(6))
        desired = correction.pose(q, at.arriving(q), target, frame)  # type: ignore[arg-type]
        command = compensate(correction, desired, at.q, at, target, frame)  # type: ignore[arg-type]
        reached = correction.pose(command.q, at.arriving(command.q), target, frame)  # type: ignore[arg-type]
        assert np.linalg.norm(reached[:3, 3] - desired[:3, 3]) < 1e-7
        assert np.linalg.norm(so3.log(reached[:3, :3].T @ desired[:3, :3])) < 1e-7
        assert np.abs(command.q - q).max() < 1e-6
        assert command.steps <= 6
        assert not command.singular


def test_what_cannot_be_is_refused(rng: np.random.Generator) -> None:
    correction = Correction(calibration_of(true_model(started("gear"))))
    at = ArmState.at_rest(np.array([0.3, -1.0, 1.2, -0.5, 1.0, 0.2]), T0)
    with pytest.raises(NotReachable, match="misses it by"):
        compensate(correction, se3.transform(p=[2.0, 0.0, 0.5]), at.q, at)
    with pytest.raises(BadTable, match="frame 'elsewhere'"):
        compensate(correction, se3.transform(p=[0.5, 0.0, 0.5]), at.q, at, frame="elsewhere")
    hot = Correction(calibration_of(true_model(started("sensor"))))
    with pytest.raises(MissingDriver, match="temperature:arm"):
        compensate(hot, se3.transform(p=[0.5, 0.0, 0.5]), at.q, at)
    effort = Effect("compliance", "elbow_joint", AXIS, "effort:elbow_joint", Shape("linear")).started(np.array([1e-5]))
    with pytest.raises(MissingDriver, match="effort"):
        Correction(calibration_of(true_model(effort))).require(at)


@pytest.mark.parametrize("tolerances", [(1.0, -1.0), (-1.0, 1.0)], ids=["rotation", "position"])
def test_both_tolerances_must_be_met(tolerances: tuple[float, float]) -> None:
    """A tolerance below zero is never met, in rotation or in position, whatever a machine's rounding leaves."""
    correction = Correction(calibration_of(true_model(started("gear"))))
    at = ArmState.at_rest(np.array([0.3, -1.0, 1.2, -0.5, 1.0, 0.2]), T0)
    desired = correction.pose(at.q + 0.05, at.arriving(at.q + 0.05), "tip", "")
    compensate(correction, desired, at.q, at)
    with pytest.raises(NotReachable, match="misses it by"):
        compensate(correction, desired, at.q, at, tolerance_m=tolerances[0], tolerance_rad=tolerances[1])


def test_one_temperature_is_enough(rng: np.random.Generator) -> None:
    """A value that was heard once holds, whatever the lag."""
    correction = Correction(calibration_of(true_model(started("late sensor"))))
    q = rng.uniform(-1, 1, 6)
    once = SignalTrack("temperature:arm", np.array([T0 + 5.0]), np.array([[30.0]]))
    ever = SignalTrack("temperature:arm", T0 + np.arange(100.0), np.full((100, 1), 30.0))
    poses = [correction.pose(q, replace(moment(q, rng), signals=(track,))) for track in (once, ever)]
    assert np.abs(poses[0] - poses[1]).max() < 1e-12
    assert np.abs(poses[0] - chain_forward(correction.chain, q)).max() > 1e-4


def test_drifts_are_not_continued_for_ever_and_not_before_they_were_seen(rng: np.random.Generator) -> None:
    q = rng.uniform(-1, 1, 6)
    for name in ("ramp", "settling"):
        correction = Correction(calibration_of(true_model(started(name))))
        at = {
            t: correction.pose(q, ArmState.at_rest(q, t), "tool", "tracker")
            for t in (5.0, T0, T0 + 300.0, T0 + 600.0, T0 + 1e6)
        }
        assert np.array_equal(at[5.0], at[T0]), "a clock that began at zero"
        assert np.array_equal(at[T0 + 300.0], at[T0 + 1e6]), "days later it is as it was when the recording ended"
        assert not np.array_equal(at[T0 + 300.0], at[T0 + 600.0]), "the session goes on"
        assert correction.unwatched(5.0)
        assert not correction.unwatched(T0 + 500.0)
        assert correction.unwatched(T0 + 1e6)
    assert not Correction(calibration_of(true_model(started("gear")))).unwatched(5.0)


def test_joints_outside_what_was_seen_are_named() -> None:
    correction = Correction(calibration_of(true_model()))
    assert correction.unseen(np.array([0.0, 3.05, -3.3, 0.0, 0.0, 6.0])) == ("elbow_joint", "wrist_3_joint")


def test_efforts_follow_the_weight_to_where_the_arm_goes(rng: np.random.Generator) -> None:
    """The actuators hold the arm up: what they exert there is predicted from what they exert here."""
    by_effort = Effect("compliance", "elbow_joint", AXIS, "effort:elbow_joint", Shape("linear")).started(
        np.array([1e-5])
    )
    by_load = Effect("compliance", "elbow_joint", AXIS, "load:elbow_joint", Shape("linear")).started(np.array([-1e-5]))
    model = true_model(by_effort)
    q, there = rng.uniform(-1, 1, (2, 6))
    load = Correction(calibration_of(true_model(by_load)))
    assert model.arm is not None
    weight = ArmState.at_rest(q, T0).samples(ur10(), q[None], model.arm)
    torque = model.drivers(weight).gravity[:, 5, 0]
    at = replace(ArmState.at_rest(q, T0), effort=-torque)
    T = Correction(calibration_of(model)).pose(there, at)
    assert np.abs(T - load.pose(there, ArmState.at_rest(there, T0))).max() < 1e-12


CHAIN = ur10()
J, SIZE, SCALE = 2, 5e-4, 0.4  # elbow, rad, rad


def dragged(path: Array, state: float = 0.0) -> Array:
    """State of the cable, −1 … 1, at each position of a path (T,) that is gone in straight lines."""
    out = np.full(len(path), state)
    for k, way in enumerate(np.diff(path)):
        steps = int(np.ceil(abs(way) / (0.02 * SCALE)))
        for _ in range(steps):
            along = np.sign(way * state)
            state += way / steps / SCALE * (1.0 - abs(state) ** 1.3 * (0.6 * along + 0.4))
        out[k + 1] = state
    return out


def off(q: Array, state: Array) -> Array:
    """Where the joints truly are."""
    there = q.copy()
    there[:, J] -= SIZE * state
    return there


def test_followers_are_those_of_one_step_after_the_other_and_forget_where_they_began() -> None:
    path = np.cumsum(np.random.default_rng(0).normal(0.0, 0.1, (500, 2)), axis=0)
    rows = np.array([0, 7, 250, 499])
    whole = ahead(path, WIDTHS, rows)
    now, seen, live = np.tile(UNKNOWN, (2, 1, 1)), [], Approach()
    for way, q in zip(np.diff(path, axis=0, prepend=path[:1]), path, strict=True):
        now = went_on(now, way)
        seen.append(now)
        live.update(q)
    assert np.abs(whole - np.array(seen)[rows]).max() < 1e-12
    assert np.abs(live.path - whole[-1]).max() < 1e-12
    swept = np.ptp(path, axis=0)[:, None] >= 2.0 * WIDTHS
    assert (np.abs(np.diff(whole[-1], axis=1)[:, 0][swept]) < 1e-12).all()


def test_a_dragged_cable_is_named_and_made_up_for_forth_and_back() -> None:
    made, rng = record(4, 130), np.random.default_rng(5)
    q, world = made.samples.q, made.world
    T = world.tool_in_tracker(off(q, dragged(q[:, J])))
    T[:, :3, 3] += NOISE_M * rng.standard_normal((len(q), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((len(q), 3)))
    found = calibrate(Samples.from_arrays(q, poses=T, names=CHAIN.names), CHAIN, np.random.default_rng(0))
    assert [(e.family, e.place) for e in found.report.effects] == [("hysteresis", CHAIN.names[J])]
    correction, way, now = Correction(found.calibration), Approach(), q[-1]
    for each in q:
        way.update(each)
    goals = np.tile([0.3, -1.0, 1.2, -0.5, 1.0, 0.2], (60, 1))
    goals[:, J] += 0.7 * np.sin(np.arange(60) / 4.0)  # forth and back, never far enough to forget
    desired, went, states, gaps = world.tool_in_tracker(goals), q[:, J].tolist(), dragged(q[:, J]), []
    last, plain = states[-1], []
    for goal, T_goal in zip(goals, desired, strict=True):
        at = ArmState.at_rest(now, 1.7e9)
        for path, missed in ((way.path, gaps), (np.empty((0, 0, 0)), plain)):
            sent = compensate(correction, T_goal, goal, replace(at, path=path), "tool", "tracker").q
            reached = dragged(np.array([now[J], sent[J]]), last)[-1:]
            missed.append(np.linalg.norm(world.tool_in_tracker(off(sent[None], reached))[0, :3, 3] - T_goal[:3, 3]))
            if missed is gaps:
                new, state = sent, reached[0]
        now, last = new, state
        way.update(now)
        went.append(now[J])
    rms, without = (float(np.sqrt(np.mean(np.square(x)))) for x in (gaps, plain))
    assert rms < 0.3 * without
    assert rms < 3.0 * NOISE_M
