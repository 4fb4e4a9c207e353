"""Laws of every kind of reading, and what instruments are told by MuJoCo's arm comes back within three sigma."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from cells import joint_track, ur10
from finite_differences import assert_jacobian
from instruments import worlds
from instruments.worlds import Reading

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.initial import locate
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.model import Model, place_model
from modcal_core.calibration.noise import errors
from modcal_core.calibration.parameters import INSTRUMENT, ordered_candidates
from modcal_core.calibration.placing import Known
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects import ZERO
from modcal_core.effects.families import step
from modcal_core.errors import BadRecording, ModcalError, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.checks import require_usable
from modcal_core.measurements.dropouts import READINGS as READINGS_LOST
from modcal_core.measurements.dropouts import cleaned
from modcal_core.measurements.kinds.kind import frame_on_plane
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_core.measurements.samples import Samples
from modcal_core.robots.kinematics import chain_forward
from modcal_nodes.simulation.mjcf import World

ANCHOR = np.array([1.5, 0.3, 0.2])
STATION = se3.exp([3.0, -1.0, 0.5, 0.1, 0.2, 2.5])
NORMAL, OFFSET = np.array([0.1, 0.05, 1.0]), -0.3
RAY_FROM, RAY_ALONG = np.array([0.03, -0.05, 0.02]), np.array([0.1, 0.2, 1.0])
READINGS: dict[str, Reading] = {
    "range": worlds.wire(ANCHOR, 0.123),
    "bearing": worlds.theodolite(STATION),
    "touch": worlds.gauge(NORMAL, OFFSET),
    "ray": worlds.laser(RAY_FROM, RAY_ALONG, NORMAL, OFFSET),
}


def exact(kind: str, count: int = 40, seed: int = 3) -> Samples:
    """Exact readings of the nominal arm."""
    rng = np.random.default_rng(seed)
    w = worlds.world(seed, length_std=0.0, angle_std=0.0)
    facing = (RAY_FROM, RAY_ALONG, NORMAL, OFFSET)
    q = worlds.facing(w, *facing, count, rng) if kind == "ray" else worlds.postures(ur10(), count, rng)
    return worlds.samples_of(ur10(), q, w.tool_in_base(q), kind, kind, READINGS[kind], 0.0, rng)


def located(kind: str, own_target: bool = False) -> tuple[Model, Samples]:
    samples = exact(kind)
    model = locate(place_model(ur10(), samples.frames), samples, (), (kind,) if own_target else ())
    # readings that do not fit, so that residuals matter
    rng = np.random.default_rng(1)
    return model, replace(samples, reading=samples.reading + 0.01 * rng.standard_normal(samples.reading.shape))


@pytest.mark.slow
@pytest.mark.parametrize("kind", READINGS)
def test_it_is_placed_from_no_guess(kind: str) -> None:
    samples = exact(kind)
    model = locate(place_model(ur10(), samples.frames), samples)
    assert errors(model, samples).position_norm.max() < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "own_target"), [*((k, False) for k in READINGS), ("range", True), ("bearing", True)])
def test_derivatives(kind: str, own_target: bool) -> None:
    """Of what is measured along each direction, by every parameter of arm, tool, frame and instrument, and by a zero
    that stepped.
    """
    model, samples = located(kind, own_target)
    parameters = ordered_candidates(ur10(), model.frames, views_of(samples), model.instruments)
    if kind in ("range", "ray"):
        shift = step.moved(f"frame {model.frames[0]}", ZERO, float(np.median(samples.stamps)))
        model = model.with_effects((shift.started(np.zeros(1)),))
    x = 0.02 * np.random.default_rng(2).normal(size=len(parameters) + len(model.effects))
    at = linearise(model, parameters, x, samples)
    assert any(p.place == INSTRUMENT for p in parameters) == (kind in ("range", "ray") or own_target)
    N = len(samples)
    J = at.J.reshape(len(x), 3, N)
    if kind == "bearing":
        # the plane across a line of sight turns with it, so derivatives are compared through the cost
        def half_square(values: Array) -> Array:
            r = linearise(model, parameters, values, samples, jacobian=False).residual
            return np.array([0.5 * r @ r])

        assert_jacobian(half_square, -(at.J @ at.residual)[None], x)
        return

    # one number a reading: the length of the residual, along the direction that it is written in
    def measured(values: Array) -> Array:
        r = linearise(model, parameters, values, samples, jacobian=False).position
        sign = np.sign(np.einsum("in,in->n", r, at.position))
        return np.asarray(-sign * np.linalg.norm(r, axis=0))

    along = at.position / np.linalg.norm(at.position, axis=0)
    assert_jacobian(measured, np.einsum("pin,in->np", J, along), x, tolerance=1e-7)


@pytest.mark.parametrize("kind", READINGS)
def test_too_few_readings_are_refused(kind: str) -> None:
    least = kinds()[kind].least
    samples = exact(kind, least - 1)
    with pytest.raises(
        NotEnoughData, match=rf"frame '{kind}': {least - 1} readings of kind {kind}, at least {least} are"
    ):
        locate(place_model(ur10(), samples.frames), samples)


def recorded(kind: str, spoil: Callable[[Array], Array]) -> Recording:
    samples = exact(kind, 30)
    values = spoil(samples.reading[:, : kinds()[kind].width].copy())
    return Recording(
        joints=(joint_track(ur10().names, samples.stamps, samples.q),),
        readings=(ReadingTrack(kind, kind, samples.stamps, values, samples.stamps, f"/{kinds()[kind].topic}"),),
    )


def one(value: float) -> Callable[[Array], Array]:
    def spoil(values: Array) -> Array:
        values[7] = value
        return values

    return spoil


BAD: dict[str, tuple[str, Callable[[Array], Array], str]] = {
    "millimetres of wire": ("range", lambda v: 1e3 * v, "it looks like millimetres: record metres"),
    "a zero": ("range", one(0.0), r"1 of 30 ranges are zero or negative, first at stamp 1700000014.000 s"),
    "a bearing in parts": ("bearing", lambda v: 0.5 * v, "a bearing has length 0.500"),
    "a bearing of zero": ("bearing", one(0.0), r"a bearing has length 0.000 at 1700000014.000 s, 1 ± 0.001 is allowed"),
    "millimetres of height": ("touch", lambda v: 1e3 * v, "it looks like millimetres"),
    "millimetres of ray": ("ray", lambda v: 1e3 * v, "it looks like millimetres"),
    "behind the sensor": ("ray", one(-0.1), "1 of 30 ranges are zero or negative"),
}


@pytest.mark.parametrize("name", BAD)
def test_readings_that_cannot_be_are_refused(name: str) -> None:
    kind, spoil, said = BAD[name]
    require_usable(recorded(kind, lambda v: v), ur10())
    with pytest.raises(BadRecording, match=said) as refused:
        require_usable(recorded(kind, spoil), ur10())
    assert isinstance(refused.value, ModcalError)
    assert "\n" not in str(refused.value)
    assert f"/{kinds()[kind].topic} ({kind})" in str(refused.value)


@pytest.mark.parametrize(("kind", "value"), [("range", np.nan), ("ray", np.inf), ("bearing", np.nan)])
def test_readings_that_say_nothing_are_left_out(kind: str, value: float) -> None:
    """A sensor without an echo."""
    clean = cleaned(recorded(kind, one(value)), ur10().names)
    assert len(clean.recording.readings[0].stamps) == 29
    assert clean.lost == ((READINGS_LOST, 1),)
    assert f"/{kinds()[kind].topic} ({kind}): not finite in 1 of 30 messages" in clean.notes[0]
    with pytest.raises(BadRecording, match="not finite in all of 30 readings"):
        cleaned(recorded(kind, lambda v: np.full_like(v, value)), ur10().names)


ANCHORS = np.array([[1.5, 0.3, 0.2], [-1.2, 1.1, 0.1], [0.2, -1.6, 1.8]])
ZEROS = np.array([0.123, 0.05, -0.2])
STATIONS = [se3.exp([3.0, -1.0, 0.5, 0.1, 0.2, 2.5]), se3.exp([2.0, 2.5, 0.8, 0.1, -0.1, -2.0])]
T_TRACKER_BASE = se3.exp([0.5, 1.0, 0.2, 0.3, 0.4, 0.5])
HOOK = np.array([0.02, 0.01, -0.03])


@dataclass(frozen=True)
class Device:
    """One instrument of a cell, its noise in its own unit."""

    frame: str
    kind: str
    read: Reading
    noise: float


WIRES = [Device(f"wire_{i}", "range", worlds.wire(ANCHORS[i], ZEROS[i]), 5e-5) for i in range(3)]
THEODOLITES = [Device(f"station_{i}", "bearing", worlds.theodolite(T), 1e-5) for i, T in enumerate(STATIONS)]
PLANES = [
    Device(f"plane_{i}", "touch", worlds.gauge(np.array(n), o), 5e-5)
    for i, (n, o) in enumerate([((0.1, 0.05, 1.0), -0.3), ((1.0, 0.1, 0.2), 0.2), ((0.3, 1.0, 0.0), 0.5)])
]
LASER = Device("laser", "ray", worlds.laser(RAY_FROM, RAY_ALONG, NORMAL, OFFSET), 5e-5)
TRACKER = Device("tracker", "point", worlds.tracker(T_TRACKER_BASE), 2e-5)
CELLS: dict[str, tuple[list[Device], Cell]] = {
    "three wires": (WIRES, Cell()),
    "one wire": (WIRES[:1], Cell()),
    "two theodolites": (THEODOLITES, Cell()),
    "three planes": (PLANES, Cell()),
    "a ray": ([LASER], Cell()),
    "tracker, wire of its own hook, theodolite": (
        [
            TRACKER,
            Device("wire_0", "range", worlds.wire(ANCHORS[0], ZEROS[0], HOOK), 2e-4),
            Device("station_0", "bearing", THEODOLITES[0].read, 5e-5),
        ],
        Cell(own_target=("wire_0",)),
    ),
}


def postures(w: World, devices: Sequence[Device], count: int, rng: np.random.Generator) -> Array:
    if any(d.kind == "ray" for d in devices):
        return worlds.facing(w, RAY_FROM, RAY_ALONG, NORMAL, OFFSET, count, rng)
    return worlds.postures(ur10(), count, rng)


def read(w: World, devices: Sequence[Device], q: Array, rng: np.random.Generator, share: float = 1.0) -> Samples:
    """What the devices read at these postures, with this share of their noise."""
    poses = w.tool_in_base(q)
    return worlds.together(
        [worlds.samples_of(ur10(), q, poses, d.frame, d.kind, d.read, share * d.noise, rng) for d in devices]
    )


@cache
def fits(name: str, seed: int, count: int = 120) -> tuple[Fit, Fit, World]:
    """The fits of the same parameters to noisy and to exact readings."""
    devices, cell = CELLS[name]
    rng = np.random.default_rng(seed)
    w = worlds.world(seed)
    q = postures(w, devices, count, rng)
    samples, exact = read(w, devices, q, rng), read(w, devices, q, rng, 0.0)
    start = fit_cell(ur10(), samples, cell).model
    parameters = choose_parameters(start, views_of(samples), cell.kept, cell.distances).parameters
    return identify(start, samples, parameters), identify(start, exact, parameters, robust=False), w


@pytest.mark.slow
@pytest.mark.parametrize("name", CELLS)
def test_parameters_lie_within_three_sigma(name: str) -> None:
    scores = []
    for seed in range(3):
        fit, truth, _ = fits(name, seed)
        exact = {d.kind: d.noise for d in CELLS[name][0]}  # these are met, and so the values are the true ones
        assert all(found < 0.1 * exact[kind] for kind, found in truth.noise.others.items())
        known = np.array([p.of_arm for p in fit.parameters]) | (name != "two theodolites")
        scores.append(((fit.values - truth.values) / fit.std)[known])
    size = np.abs(np.concatenate(scores))
    assert np.mean(size < 3.0) >= 0.98, np.sort(size)[-5:]
    assert 0.5 < np.mean(size < 1.0) < 0.85 or name == "two theodolites"


def in_flange(w: World) -> Array:
    """The tool's pose in the flange of an arm that is as drawn."""
    return se3.inverse(chain_forward(ur10(), np.zeros(6))) @ w.tool_in_base(np.zeros(6))


def test_a_wire_finds_its_anchor_its_zero_and_its_hook() -> None:
    """The nominal arm, so that flange and base mean what they say."""
    name = "tracker, wire of its own hook, theodolite"
    rng = np.random.default_rng(5)
    w = worlds.world(5, length_std=0.0, angle_std=0.0)
    samples = read(w, CELLS[name][0], worlds.postures(ur10(), 120, rng), rng)
    fit = fit_cell(ur10(), samples, CELLS[name][1])
    wire = next(i for i in fit.model.instruments if i.kind == "range")
    assert abs(wire.values[0] - ZEROS[0]) < 3.0 * fit.deviation("instrument wire_0/zero") < 1e-3
    anchor = se3.inverse(fit.model.T_frame_base[fit.model.frames.index("wire_0")])[:3, 3]
    std = max(fit.deviation(f"frame wire_0/{d}") for d in "xyz")
    assert np.abs(anchor - ANCHORS[0]).max() < 3.0 * std < 1e-3
    # points do not show how the tool is turned, so the hook is compared in the flange
    assert wire.target is not None
    T, true = fit.model.T_tip_tool, in_flange(w)
    gap = (T[:3, :3] @ wire.target + T[:3, 3]) - (true[:3, :3] @ HOOK + true[:3, 3])
    std = max(fit.deviation(f"instrument wire_0/target_{d}") for d in "xyz")
    assert np.abs(gap).max() < 3.5 * std < 3e-4


def test_bearings_alone_leave_the_scale_open_and_say_so() -> None:
    """All lengths may grow together; each is then known no better than an arm is expected to be drawn."""
    fit, _, _ = fits("two theodolites", 1)
    seen = identifiability(fit)
    assert seen.rank == seen.parameters - 1
    assert len(seen.unobservable) == 1
    assert fit.deviation("frame station_0/x") > 5e-3
    mixed, _, _ = fits("tracker, wire of its own hook, theodolite", 1)
    assert mixed.deviation("frame station_0/x") < 2e-4


def test_the_ray_is_found_where_the_plane_is_known() -> None:
    """A plane measured by the tracker; the nominal arm, so that ray and tool mean what they say."""
    rng = np.random.default_rng(3)
    w = worlds.world(3, length_std=0.0, angle_std=0.0)
    q = worlds.facing(w, RAY_FROM, RAY_ALONG, NORMAL, OFFSET, 80, rng)
    samples = read(w, [TRACKER, LASER], q, rng)
    n = NORMAL / np.linalg.norm(NORMAL)
    T_plane_tracker = frame_on_plane(n, OFFSET) @ se3.inverse(T_TRACKER_BASE)
    cell = Cell(known=(Known("laser", "tracker", T_plane_tracker),))
    fit = fit_cell(ur10(), samples, cell)
    names = [p.name for p in fit.parameters]
    assert not [name for name in names if name.startswith("frame laser")]
    ray = fit.model.instruments[0].values
    # points do not show how the tool is turned, so the ray is compared in the flange
    T, true = fit.model.T_tip_tool, in_flange(w)
    gap = T[:3, :3] @ ray[:3] + T[:3, 3] - (true[:3, :3] @ RAY_FROM + true[:3, 3])
    tilt = T[:3, :3] @ ray[3:] - true[:3, :3] @ (RAY_ALONG / np.linalg.norm(RAY_ALONG))
    assert np.abs(gap).max() < 3.5 * max(fit.deviation(f"instrument laser/ray_{d}") for d in "xyz") < 3e-4
    assert np.abs(tilt).max() < 3.5 * max(fit.deviation(f"instrument laser/ray_tilt_{i}") for i in (1, 2)) < 5e-4


@pytest.mark.parametrize(("name", "device"), [("one wire", "wire_0"), ("a ray", "laser")])
def test_a_zero_that_shifts_and_comes_back_is_no_joint_that_moved(name: str, device: str) -> None:
    rng = np.random.default_rng(8)
    w, devices = worlds.world(8), CELLS[name][0]
    samples = read(w, devices, postures(w, devices, 160, rng), rng)
    row = np.unique(samples.stamps, return_inverse=True)[1]
    off = (row >= 50) & (row < 120) & (samples.frame == samples.frames.index(device))
    samples = replace(samples, reading=samples.reading + 2e-3 * off[:, None] * np.eye(3)[0])
    effects = calibrate(samples, ur10(), np.random.default_rng(0)).report.effects
    assert {(e.family, e.place, e.direction) for e in effects} == {("step", f"frame {device}", "zero")}
    (shift,), stamps = effects, np.unique(samples.stamps)
    for name, at in (("since", 50), ("at", 120)):
        assert stamps[at - 1] < shift.parameters[name][0] < stamps[at]
    size, std, _ = shift.parameters["zero"]
    assert abs(size - 2e-3) < 4.0 * std < 1e-4
    assert shift.sentence.startswith(f"the zero of {device} was off by ")


def test_two_sensors_that_look_at_one_plane_share_it() -> None:
    other = worlds.laser(np.array([-0.04, 0.03, 0.0]), np.array([-0.1, 0.1, 1.0]), NORMAL, OFFSET)
    second = Device("laser_2", "ray", other, 5e-5)
    rng = np.random.default_rng(6)
    w = worlds.world(6)
    q = worlds.facing(w, RAY_FROM, RAY_ALONG, NORMAL, OFFSET, 100, rng)
    samples = read(w, [LASER, second], q, rng)
    cell = Cell(known=(Known("laser_2", "laser", np.eye(4)),))
    start = fit_cell(ur10(), samples, cell).model
    fit = identify(start, samples, choose_parameters(start, views_of(samples), cell.kept).parameters)
    assert not [p.name for p in fit.parameters if p.name.startswith("frame laser_2")]
    assert np.array_equal(fit.model.T_frame_base[0], fit.model.T_frame_base[1])
    assert 4e-5 < fit.noise.others["ray"] < 6e-5
    # how the two rays stand to each other does not hang on where tool and plane are taken to be
    rays = [i.values for i in fit.model.instruments]
    between = np.linalg.norm(rays[0][:3] - rays[1][:3])
    assert abs(between - np.linalg.norm(RAY_FROM - [-0.04, 0.03, 0.0])) < 1e-4
    angle = np.arccos(rays[0][3:] @ rays[1][3:])
    a, b = RAY_ALONG / np.linalg.norm(RAY_ALONG), np.array([-0.1, 0.1, 1.0]) / np.sqrt(1.02)
    assert abs(angle - np.arccos(a @ b)) < 2e-4
