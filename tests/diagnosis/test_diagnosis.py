"""What is left is traced to its cause, added, and predicts; a clean arm comes out clean.

The truth is MuJoCo's: effects are put into the joint angles or the tool that MuJoCo is given, by formulas written out
here and by Pinocchio's gravity, with joints that do not repeat, so that noise is far from white at the tool.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio
import pytest
from cells import record, samples_of, ur10
from cli.recordings import URDF, streams
from robots.test_kinematics import urdf
from scipy.signal import lsim

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.contents import Outcome
from modcal_core.outcome.entries import Finding
from modcal_core.preprocess import prepare
from modcal_core.report.report import to_json_data
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_nodes.ros.parameters import SIMULATED_CELL
from modcal_nodes.simulation.mjcf import World
from modcal_nodes.simulation.plant import Plant
from modcal_nodes.simulation.plant import recorded as simulated

pytestmark = pytest.mark.slow

REPEATABILITY = 2e-5  # rad
COUNT = 160
Error = Callable[[Array], Array]


def recorded(seed: int, error: Error, kind: str = "pose", tool: Array | None = None, count: int = COUNT) -> Samples:
    """Stations of an arm whose joints are off by error(q), and whose tool has moved by these twists (N, 6)."""
    made = record(seed, count, kind)
    rng = np.random.default_rng(seed + 77)
    q = made.samples.q
    T = made.world.tool_in_tracker(q + error(q) + REPEATABILITY * rng.standard_normal(q.shape))
    if tool is not None:
        T = T @ se3.exp(tool)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((count, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(3e-5 * rng.standard_normal((count, 3)))
    came = np.sign(np.diff(q, axis=0, prepend=np.zeros((1, 6))))
    return replace(samples_of(ur10(), q, T, kind), approach=came)


def report_of(samples: Samples, seed: int = 0) -> Outcome:
    return calibrate(samples, ur10(), np.random.default_rng(seed), inertias=read_inertias(urdf("ur10"), ur10())).report


def at_joint(joint: int, size: Error) -> Error:
    def error(q: Array) -> Array:
        out = np.zeros_like(q)
        out[:, joint] = size(q)
        return out

    return error


def nothing(q: Array) -> Array:
    return np.zeros_like(q)


def named(report: Outcome) -> list[tuple[str, str, str]]:
    return [(f.family, f.place, f.driver) for f in report.effects]


def only(report: Outcome) -> Finding:
    assert len(report.effects) == 1, named(report)
    return report.effects[0]


@functools.cache
def clean(seed: int, kind: str) -> Outcome:
    return report_of(recorded(seed, nothing, kind), seed)


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_clean_arms_come_out_clean(kind: str) -> None:
    for seed in range(6):
        report = clean(seed, kind)
        assert report.effects == ()
        assert report.left is None
        assert to_json_data(report)["effects"] == []


def weighed(q: Array) -> tuple[Array, Array]:
    """Torque of gravity about the shoulder's lift [N m], (N,), and moments of the arm's weight about x and y of its
    base [N m], (N, 2), by Pinocchio's own reading of the URDF.
    """
    model = pinocchio.buildModelFromXML(urdf("ur10"))
    data = model.createData()
    order = [model.joints[model.getJointId(name)].idx_q for name in ur10().names]
    torque, moments = [], []
    for posture in q:
        configuration = np.zeros(model.nq)
        configuration[order] = posture
        torque.append(-pinocchio.computeGeneralizedGravity(model, data, configuration)[order[1]])
        x, y, _ = pinocchio.centerOfMass(model, data, configuration)
        moments.append((-9.81 * data.mass[0] * y, 9.81 * data.mass[0] * x))
    return np.array(torque), np.array(moments)


LIFT, ELBOW, WRIST_2 = "shoulder_lift_joint", "elbow_joint", "wrist_2_joint"
CAUSES: dict[str, tuple[Error, tuple[str, str, str]]] = {
    "gear, 101 a turn": (
        at_joint(2, lambda q: 2e-4 * np.sin(101 * q[:, 2] + 0.3)), ("gear_harmonic", ELBOW, f"position:{ELBOW}")
    ),
    "encoder, once a turn": (
        at_joint(0, lambda q: 3e-4 * np.sin(q[:, 0] + 1.0)),
        ("gear_harmonic", "shoulder_pan_joint", "position:shoulder_pan_joint"),
    ),
    "ratio": (at_joint(4, lambda q: 2e-4 * q[:, 4]), ("gear_ratio", WRIST_2, f"position:{WRIST_2}")),
    "coupling": (at_joint(4, lambda q: 3e-4 * q[:, 3]), ("coupling", WRIST_2, "position:wrist_1_joint")),
    "backlash": (
        at_joint(2, lambda q: 2e-4 * np.sign(np.diff(q[:, 2], prepend=0.0))), ("backlash", ELBOW, f"direction:{ELBOW}")
    ),
    "compliance": (at_joint(1, lambda q: weighed(q)[0] / 2e5), ("compliance", LIFT, f"load:{LIFT}")),
}  # fmt: skip


@functools.cache
def planted(name: str) -> Outcome:
    return report_of(recorded(3, CAUSES[name][0]))


@pytest.mark.parametrize("name", CAUSES)
def test_a_planted_cause_is_named_and_removed(name: str) -> None:
    report = planted(name)
    assert named(report) == [CAUSES[name][1]], named(report)
    sound = clean(3, "pose").size_mm("final")
    final, geometric = report.size_mm("final"), report.size_mm("geometric")
    assert final is not None
    assert geometric is not None
    assert sound is not None
    assert final.rms < 1.1 * sound.rms < 0.9 * geometric.rms
    assert report.left is None


def test_sizes_are_those_planted() -> None:
    gear = only(planted("gear, 101 a turn"))
    value, std, unit = gear.parameters["cycles_per_turn"]
    assert abs(value - 101.0) < 4.0 * std < 0.1
    assert unit == "1"
    value, std, unit = gear.parameters["amplitude"]
    assert abs(value - 2e-4) < 4.0 * std
    assert unit == "rad"
    soft = only(planted("compliance"))
    value, std, unit = soft.parameters["stiffness"]
    assert abs(value - 2e5) < 4.0 * std
    assert unit == "N m/rad"


def test_two_causes_at_once() -> None:
    gear, soft = CAUSES["gear, 101 a turn"], CAUSES["compliance"]
    report = report_of(recorded(5, lambda q: gear[0](q) + soft[0](q)))
    assert sorted(named(report)) == sorted([gear[1], soft[1]])


def test_what_an_arm_stands_on_yields_in_its_own_way() -> None:
    """A table on a cantilever: it turns about one axis and sinks, and hardly bends the other way."""
    samples = recorded(9, nothing)
    moments = weighed(samples.q)[1]
    yields = 1e-6 * np.array([[0.0, 0.3], [0.0, 0.0], [0.0, 2.0], [0.5, 0.0], [0.0, 4.0], [0.0, 0.0]])
    moved = se3.exp(moments @ yields.T)
    reading = np.einsum("nij,nj->ni", moved[:, :3, :3], samples.reading) + moved[:, :3, 3]
    report = report_of(replace(samples, reading=reading, R=moved[:, :3, :3] @ samples.R))
    assert named(report) == [("compliance", "base", "load:shoulder_pan_joint")]
    sound, final = clean(9, "pose").size_mm("final"), report.size_mm("final")
    assert sound is not None
    assert final is not None
    assert final.rms < 1.15 * sound.rms
    value, std, _ = report.effects[0].parameters["compliance"]
    assert value == pytest.approx(np.linalg.norm(yields[3:], 2), abs=5.0 * std + 2e-7)


def test_what_has_no_name_is_still_placed() -> None:
    """A hose: the elbow errs by a function of two joints that is no product and no sum of plain ones."""
    error = at_joint(2, lambda q: 3e-4 * np.tanh(2.0 * np.sin(q[:, 2] + 0.7 * q[:, 4])))
    report = report_of(recorded(6, error, count=240))
    unknown = [f for f in report.effects if f.family == "unknown"]
    assert unknown
    assert all(f.place == ELBOW for f in unknown)
    assert {f.driver for f in unknown} <= {f"position:{ELBOW}", f"position:{WRIST_2}"}
    final, geometric = report.size_mm("final"), report.size_mm("geometric")
    assert final is not None
    assert geometric is not None
    assert final.rms < 0.7 * geometric.rms


def with_signal(samples: Samples, name: str, seed: int) -> tuple[Samples, Array]:
    """The samples with a signal that wanders, and its values at the samples."""
    rng = np.random.default_rng(seed)
    t = samples.stamps[0] + np.arange(0.0, np.ptp(samples.stamps) + 1.0)
    wander = np.cumsum(rng.normal(size=len(t)))
    wander = (wander - wander.mean()) / wander.std()
    track = SignalTrack(name, t, wander[:, None], "/any/topic")
    return replace(samples, signals=(track,)), np.interp(samples.stamps, t, wander)


def test_any_recorded_signal_can_be_the_driver() -> None:
    """A hose whose pressure pulls at the elbow; its topic is in no contract."""
    bare, pressure = with_signal(recorded(3, nothing), "signal:/hose/pressure", 5)
    pulled = recorded(3, at_joint(2, lambda q: 2e-4 * pressure))
    found = only(report_of(replace(pulled, signals=bare.signals)))
    assert (found.family, found.place, found.driver) == ("unknown", ELBOW, "signal:/hose/pressure")
    value, std, _ = found.parameters["axis"]
    assert abs(value - 2e-4) < 4.0 * std


def test_a_link_that_grows_with_its_temperature() -> None:
    """The upper arm, 612 mm along −x of its frame, by 0.1 mm for a unit of temperature."""
    made = record(4, COUNT)
    bare, warm = with_signal(made.samples, "temperature:upper_arm_link", 6)
    T = np.array([grown(made.world, q, 1e-4 * x) for q, x in zip(made.samples.q, warm, strict=True)])
    T[:, :3, 3] += 2e-5 * np.random.default_rng(1).standard_normal((COUNT, 3))
    found = only(report_of(replace(samples_of(ur10(), made.samples.q, T), signals=bare.signals)))
    assert (found.family, found.driver) == ("thermal", "temperature:upper_arm_link")
    assert found.place == ELBOW
    size, std, unit = next(iter(found.parameters.values()))
    assert abs(abs(size) - 1e-4) < 4.0 * std
    assert unit == "m/K"


def grown(world: World, q: Array, more: float) -> Array:
    """The tool in the tracker when MuJoCo's forearm stands further out along the upper arm."""
    body = world.model.body("body_elbow_joint").id
    pos = world.model.body_pos[body].copy()
    world.model.body_pos[body] = pos + more * pos / np.linalg.norm(pos)
    try:
        return world.tool_in_tracker(q)
    finally:
        world.model.body_pos[body] = pos


def test_a_bumped_tool_is_dated() -> None:
    stamps = recorded(7, nothing).stamps
    after = np.arange(COUNT) >= 97
    tool = after[:, None] * np.array([3e-4, -1e-4, 2e-4, 4e-4, 0.0, -3e-4])
    bump = only(report_of(recorded(7, nothing, tool=tool)))
    assert (bump.family, bump.place, bump.driver) == ("step", "tool", "time")
    assert stamps[96] < bump.parameters["at"][0] < stamps[97]
    for name, planted in (("x", 3e-4), ("z", 2e-4), ("rx", 4e-4)):
        value, std, _ = bump.parameters[name]
        assert abs(value - planted) < 5.0 * std + 1e-5


def test_wrong_readings_are_said_and_left_out() -> None:
    samples = recorded(8, nothing)
    position = samples.reading.copy()
    position[[11, 60, 121]] += [[2e-3, 0, 0], [0, 1e-3, 0], [0, 0, -3e-3]]
    report = report_of(replace(samples, reading=position))
    assert named(report) == [("outliers", "tracker", "constant")]
    assert report.effects[0].parameters["stations"][0] == 3.0


def test_an_effect_that_shows_at_few_stations_is_no_outlier() -> None:
    """Backlash of a joint that comes from the other side at every eighth station: these are rejected at first."""
    rare = np.arange(COUNT) % 8 == 5
    samples = recorded(6, at_joint(2, lambda q: np.where(rare, 8e-4, 0.0)))
    approach = samples.approach.copy()
    approach[:, 2] = np.where(rare, -1.0, 1.0)
    report = report_of(replace(samples, approach=approach))
    assert named(report) == [("backlash", ELBOW, f"direction:{ELBOW}")]
    value, std, _ = next(iter(report.effects[0].parameters.values()))
    assert abs(value - 8e-4) < 4.0 * std


def test_a_late_tracker_is_named_not_hidden() -> None:
    """Stamps 4 ms late in a recording without a stop."""
    samples = prepare(streams(60, dwell=0.0, late=0.004), ur10()).samples
    late = only(report_of(samples))
    assert (late.family, late.driver) == ("latency", "velocity")
    assert late.parameters["delay"][0] == pytest.approx(0.004, abs=5e-5)


def test_a_clock_that_drifts_is_one_cause() -> None:
    """Two crystals that differ by 150 ppm; the arm has nothing."""
    clean = streams(60, dwell=0.0)
    (track,) = clean.readings
    late = 1.5e-4 * (track.stamps - track.stamps.mean())
    samples = prepare(replace(clean, readings=(replace(track, stamps=track.stamps + late),)), ur10()).samples
    report = report_of(samples)
    assert {family for family, *_ in named(report)} == {"latency"}  # what is late in the middle may stand beside it
    found = next(e for e in report.effects if e.driver == "time")
    assert found.parameters["drift"][0] == pytest.approx(1.5e-4, rel=0.05)
    assert "drifts against that of the joints by 15" in found.sentence


@pytest.mark.parametrize(("place", "direction"), [("tracker", "radial"), ("base", "all")])
def test_a_tracker_or_a_stand_that_follows_a_temperature(place: str, direction: str) -> None:
    bare, warm = with_signal(recorded(3, nothing), "temperature:hall", 5)
    samples = replace(recorded(3, nothing), signals=bare.signals)
    by = samples.reading * 4e-5 if place == "tracker" else np.array([0.0, 0.0, 1e-4])
    found = only(report_of(replace(samples, reading=samples.reading + warm[:, None] * by)))
    assert (found.family, found.driver) == ("thermal", "temperature:hall")
    assert f"{place} {direction} by temperature:hall" in (
        f"{found.place} {found.direction} by {found.driver}",
        *found.same_as,
    )


def test_a_clean_motion_comes_out_clean() -> None:
    report = report_of(prepare(streams(60, dwell=0.0), ur10()).samples)
    assert report.effects == ()
    assert report.left is None


def test_the_report_tells_a_technician() -> None:
    report = planted("gear, 101 a turn")
    data, size = to_json_data(report), only(report).parameters["amplitude"][0]
    assert f"repeats 101 times a turn with {1e3 * size:.3g} mrad" in data["story"][0]
    effect = data["effects"][0]
    assert effect["rms_mm_after"] < effect["rms_mm_before"]
    assert effect["p_value"] < 1e-6
    low, high = data["error_mm"]["final"]["rms_ci95"]
    assert low < data["error_mm"]["final"]["rms"] < high
    assert data["unexplained"] is None


def test_an_effect_is_not_drowned_by_readings_whose_own_scatter_is_all_there_is() -> None:
    """Averaged readings say how uncertain they are; nothing is left beside that, and a growing link must still show."""
    chain = ur10()
    world = World(chain, np.random.default_rng(5), 5e-4, 1e-3, T_tip_tool=se3.exp([0.05, 0.0, 0.1, 0.3, 0.0, 0.0]))
    rng = np.random.default_rng(2)
    before, after = 52 + int(rng.integers(15)), 40 + int(rng.integers(15))
    t = 1000.0 + 1.2 * np.arange(before + after)
    growth = 4e-4 * (1.0 - np.exp(-np.maximum(t - t[before], 0.0) / 15.0))
    q = rng.uniform(-1.2, 1.2, (len(t), 6))
    # the forearm: from the elbow on, everything is pushed along it
    T = world.tool_in_tracker(q)
    forearm = np.linalg.norm(chain.origins[3, :3, 3])
    along = np.stack([_forearm(world, posture) for posture in q])
    T[:, :3, 3] += growth[:, None] * along + 5e-6 * rng.standard_normal((len(t), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(1.2e-5 * rng.standard_normal((len(t), 3)))
    clock = np.arange(t[0], t[-1], 1.0)
    warm = 20.0 + np.interp(clock, t, growth) / (23e-6 * forearm) + 0.05 * rng.standard_normal(len(clock))
    samples = replace(
        samples_of(chain, q, T),
        stamps=t,
        sigma_position=np.full(len(t), 5e-6),
        sigma_rotation=np.full(len(t), 1.2e-5),
        signals=(SignalTrack("temperature:forearm", clock, warm[:, None], "/temperature"),),
    )
    report = calibrate(samples, chain, np.random.default_rng(0)).report
    assert [(f.family, f.driver) for f in report.effects] == [("thermal", "temperature:forearm")]
    size = report.size_mm("final")
    assert size is not None
    assert size.rms < 0.012


def _forearm(world: World, q: Array) -> Array:
    """Unit vector along the true forearm, as the tracker sees it: how far the tool goes when wrist 1 is pushed out."""
    step = 1e-4
    chain = world.nominal
    origins = chain.origins.copy()
    origins[3, :3, 3] *= 1.0 + step / np.linalg.norm(origins[3, :3, 3])
    places = [World(c, np.random.default_rng(0), 0.0, 0.0) for c in (chain, chain.with_origins(origins))]
    moved = np.subtract(*(place.tool_in_tracker(q)[:3, 3] for place in places[::-1])) / step
    return np.asarray(world.T_tracker_base[:3, :3] @ moved)


@pytest.mark.parametrize(("repeatability", "returns"), [(2e-5, 6), (8e-5, 0)])
def test_what_an_arm_does_not_repeat_is_a_floor_only_where_it_is_seen(repeatability: float, returns: int) -> None:
    """Stations that scatter by less within than among themselves: only postures that are come back to tell why."""
    chosen = {name: parameter.default for name, parameter in SIMULATED_CELL.items()}
    chosen |= {"urdf": str(URDF), "stations": 70, "repeatability_rad": repeatability, "joint_rate_hz": 50.0}
    chosen |= {"returns": returns}
    report = report_of(prepare(simulated(Plant(chosen), chosen, []), ur10()).samples)
    data = to_json_data(report)
    rms = data["error_mm"]["final"]["rms"]
    assert report.effects == ()
    assert rms > 1.2 * data["reading_scatter_mm"]
    assert data["status"] == ("at_floor" if returns else "cannot_tell"), data["open_because"]
    assert data["unexplained"] is None
    assert (data["noise_floor_mm"] is not None) == (returns > 0)
    if returns:
        assert (
            0.6 * rms < data["noise_floor_mm"] < 1.6 * rms
        )  # of six returns, and of a fit that has an error of its own


@pytest.mark.parametrize("place", [ELBOW, "tool"])
def test_what_stays_behind_as_it_is_accelerated_is_named(place: str) -> None:
    """An elbow that winds up by 3 mrad per rad/s², or a target that swings by 1 mm per m/s², without a stop."""
    rng = np.random.default_rng(4)
    rate, phase = rng.uniform(0.4, 1.4, (2, 3, 6))
    t, taken = np.arange(0.0, 60.0, 0.01), np.arange(4.0, 59.5, 0.04)

    def course(at: Array) -> Array:
        return np.asarray(0.4 * np.sin(rate * at[:, None, None] + 6.0 * phase).sum(axis=1))

    def behind(x: Array, gives: float) -> Array:
        """Of a mass on a spring and a damper, at rest at first, (N, k)."""
        spring = ([1.0, 0.0, 0.0], [1.0, 0.3 / np.sqrt(gives), 1.0 / gives])
        columns = [lsim(spring, one - one[0], t)[1] for one in x.T]
        return np.stack([np.interp(taken, t, one) for one in columns], axis=1)

    world, posture = record(4, 1).world, course(taken)
    if place == ELBOW:
        posture[:, 2:3] -= behind(course(t)[:, 2:3], 3e-3)
    position = world.tool_in_tracker(posture)[:, :3, 3] + 3e-5 * rng.standard_normal((len(taken), 3))
    if place == "tool":
        position -= behind(world.tool_in_tracker(course(t))[:, :3, 3], 1e-3)
    q = course(t) + 1e-5 * rng.standard_normal((len(t), 6))
    joints = JointTrack(ur10().names, t, q, np.full_like(q, np.nan), np.full_like(q, np.nan), t)
    recording = Recording((joints,), (ReadingTrack("point", "tracker", taken, position, taken),))
    report = report_of(prepare(recording, ur10()).samples)
    wanted = {f"acceleration:{ELBOW}"} if place == ELBOW else {f"tip_acceleration_{axis}" for axis in "xyz"}
    assert set(named(report)) == {("compliance", place, driver) for driver in wanted}
    for found in report.effects:
        value, _, unit = found.parameters["wind_up"]
        assert value == pytest.approx(3e-3 if place == ELBOW else 1e-3, rel=0.05)
        assert unit == ("rad/(rad/s^2)" if place == ELBOW else "m/(m/s^2)")
        delay, _, unit = found.parameters["delay"]
        assert (delay, unit) == (pytest.approx(0.3 * np.sqrt(value), rel=0.2), "s")
        assert "stays behind as it is accelerated" in found.sentence
