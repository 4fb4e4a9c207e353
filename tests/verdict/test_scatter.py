"""What scatters or errs far more than the rest is named: a base, a tool, a joint, an instrument, stamps."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from cells import Recorded, noisy, samples_of, ur10
from verdict.visits import judged, said

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.distances import Distance
from modcal_core.calibration.stated import Stated
from modcal_core.errors import BadRecording
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.predictable import MAX_PREDICTABLE
from modcal_nodes.simulation.mjcf import World

pytestmark = pytest.mark.slow

STAND, SEAT = "scatter of the base", "scatter of the tool"


def moved(made: Recorded, twists: Array, tool: bool) -> Samples:
    """Readings of a tool, or of a base one metre below the tracker's origin, that moves by twists (N, 6)."""
    T = made.world.tool_in_tracker(made.samples.q)
    if tool:
        T = T @ se3.exp(twists)
    else:
        at = np.eye(4)
        at[:3, 3] = T[:, :3, 3].mean(axis=0) - [0.0, 0.0, 0.5]
        T = at @ se3.exp(twists) @ se3.inverse(at) @ T
    out = made.reread(T)
    return replace(out, R=out.R @ so3.exp(2e-5 * np.random.default_rng(8).normal(size=(len(T), 3))))


def twists(turn: float, lever: Array | None = None) -> Array:
    """Turns at random [rad] about any axis, or about one with a lever [m] to the target, (140, 6)."""
    rng = np.random.default_rng(6)
    if lever is None:
        return np.concatenate([np.zeros((140, 3)), turn * rng.normal(size=(140, 3))], axis=1)
    one = np.outer(turn * rng.normal(size=140), [0.6, 0.0, 0.8])
    return np.concatenate([np.cross(one, lever), one], axis=1)


def test_a_stand_that_wobbles(made: Recorded) -> None:
    samples = moved(made, twists(5e-4), tool=False)
    text = said(samples)
    assert STAND in text, text
    known = Cell(stated=Stated(repeatability_mm=1.0, repeatability_deg=0.1, instrument_mm=0.09, instrument_deg=0.005))
    assert STAND not in said(samples, known)


def test_a_target_that_is_loose_in_its_seat(made: Recorded) -> None:
    text = said(moved(made, twists(3e-3, np.array([0.0, 0.15, 0.05])), tool=True))
    assert SEAT in text, text


@pytest.mark.parametrize("repeats", [True, False])
def test_what_returns_repeat_is_no_scatter(made: Recorded, repeats: bool) -> None:
    """A wrist that errs by 0.8 mrad at random, the same at every visit of a posture, or another."""
    rng = np.random.default_rng(9)
    visits = np.r_[np.arange(100), rng.permutation(100)[:30]]
    q, actual = made.samples.q[visits], made.samples.q[visits].copy()
    off = 8e-4 * rng.standard_normal(130)
    actual[:, 3] += off[visits] if repeats else off
    T = made.world.tool_in_tracker(actual)
    T = noisy(T, 2e-5, 2e-5, rng)
    text = said(samples_of(ur10(), q, T))
    assert ("wrist_1_joint scatters by" in text) != repeats, text
    assert ("the motion of joint wrist_1_joint" in text) or not repeats, text


def scattered(made: Recorded, sizes: list[float], kind: str = "pose") -> Samples:
    """Readings of joints that stand elsewhere than reported by these deviations [rad], another time another way."""
    q = made.samples.q + np.array(sizes) * np.random.default_rng(4).normal(size=made.samples.q.shape)
    return made.reread(made.world.tool_in_tracker(q), kind)


def test_a_loose_encoder_is_named(made: Recorded) -> None:
    samples = scattered(made, [1e-5, 1e-5, 4e-4, 1e-5, 1e-5, 1e-5])
    text = said(samples)
    size = re.search(r"Joint elbow_joint scatters by (0\.\d+) mrad RMS", text)
    assert size, text
    assert 0.3 < float(size[1]) < 0.45  # the worst stations are rejected
    known = Cell(stated=Stated(repeatability_mm=0.5, repeatability_deg=0.03, instrument_mm=0.09, instrument_deg=0.005))
    assert "scatters" not in said(samples, known)


def test_a_loose_encoder_is_named_beside_what_is_predictable(made: Recorded) -> None:
    names = ur10().names
    wave = 7e-4 * np.sin(4.0 * made.samples.q[:, 0])
    for joint, size in ((4, 1.2e-3), (4, 1e-5)):
        sizes = np.full(6, 1e-5)
        sizes[joint] = size
        off = sizes * np.random.default_rng(4).normal(size=made.samples.q.shape)
        off[:, 0] += wave
        text = said(made.reread(made.world.tool_in_tracker(made.samples.q + off)))
        assert "can be predicted" in text
        assert (f"Joint {names[joint]} scatters by 1." in text) == (size > 1e-3), text
        assert text.count(" scatters by ") == (size > 1e-3), text


@pytest.mark.parametrize("bounded", [False, True])
def test_a_scatter_whose_largest_readings_were_rejected_is_told_apart(made: Recorded, bounded: bool) -> None:
    """Where none of them had to be rejected, what scatters may meet a tolerance."""
    rng, q = np.random.default_rng(4), made.samples.q.copy()
    q[:, 2] += rng.uniform(-7e-4, 7e-4, len(q)) if bounded else 3e-4 * rng.standard_t(3, len(q))
    verdict = judged(made.reread(made.world.tool_in_tracker(q)))
    kinds = [r.kind for r in verdict.reasons if "scatters by" in r.sentence]
    assert kinds == ["predictable" if bounded else "cut_off"]


@pytest.mark.parametrize(("kind", "sizes"), [("pose", [3e-4, 1e-4, 1e-4, 1e-4, 2e-4, 1e-4]), ("point", [1e-5] * 6)])
def test_joints_that_are_alike_are_not(made: Recorded, kind: str, sizes: list[float]) -> None:
    assert "scatter" not in said(scattered(made, sizes, kind))


@pytest.mark.parametrize("how", ["across", "by angles"])
def test_a_tracker_that_scatters_is_no_joint_and_no_body(made: Recorded, how: str) -> None:
    """By its angle about one axis, much as the first joint of an arm on one side, and by all its angles."""
    p, rng = made.samples.reading, np.random.default_rng(5)
    about = rng.normal(size=(len(p), 1)) * [0.0, 0.0, 1.0] if how == "across" else rng.normal(size=p.shape)
    off = np.cross(about, p)
    assert "scatter" not in said(replace(made.samples, reading=p + 3e-4 * off))


def wires(made: Recorded, off: Array) -> Samples:
    """Ranges to three anchors, of which the second is off by so much (N,)."""
    p = made.exact.reading
    anchors = np.array([[2.0, 0.5, 0.2], [-1.5, 1.8, 1.3], [-1.0, -2.0, 0.4]])
    d = np.linalg.norm(p[:, None] - anchors, axis=2) + np.random.default_rng(7).normal(0.0, 5e-5, (140, 3))
    d[:, 1] += off
    ranges = {f"wire_{k + 1}": d[:, k] for k in range(3)}
    return Samples.from_arrays(made.samples.q, ranges=ranges, names=ur10().names)


def test_the_wire_that_is_off_is_named_and_a_good_one_is_not(made: Recorded) -> None:
    straight = np.zeros(140)
    assert "instrument" not in said(wires(made, straight))
    d = wires(made, straight)
    length = d.reading[d.frame == d.frames.index("wire_2"), 0]
    bent = 2e-3 * np.minimum(length - np.median(length), 0.0)
    text = said(wires(made, bent))
    assert re.search("correlates with (its own length|where it points), as an error of 'wire_2'", text), text


@pytest.mark.parametrize(("late", "open_"), [(0.0, False), (4e-3, True)])
def test_stamps_that_are_off_at_random_in_motion(made: Recorded, late: float, open_: bool) -> None:
    rng = np.random.default_rng(8)
    velocity = rng.normal(0.0, 0.2, made.samples.q.shape)
    then = made.samples.q + velocity * rng.uniform(-late, late, 140)[:, None]
    samples = replace(made.reread(made.world.tool_in_tracker(then)), velocity=velocity, moving=np.ones(140, bool))
    assert ("lies along the direction of motion" in said(samples)) == open_
    known = Cell(stated=Stated(repeatability_mm=2.0, repeatability_deg=0.1, instrument_mm=0.09, instrument_deg=0.005))
    assert "direction of motion" not in said(samples, known)


def test_two_stated_distances_that_stand_for_each_other(made: Recorded) -> None:
    """Readings in four frames, whose origins are known to be 0.4 and 1.2 m apart, stated the other way round."""
    origin = {"a": [0.0, 0.0, 0.0], "b": [0.4, 0.0, 0.0], "c": [0.0, 0.0, 0.1], "d": [0.0, 1.2, 0.1]}
    frame = np.arange(140) % 4
    reading = made.samples.reading - np.array(list(origin.values()))[frame]
    samples = replace(made.samples, frames=tuple(origin), frame=frame, reading=reading)
    right = Distance(("a", "b"), 0.4), Distance(("c", "d"), 1.2)
    assert "distance" not in said(samples, Cell(distances=right))
    wrong = Distance(("a", "b"), 1.2), Distance(("c", "d"), 0.4)
    with pytest.raises(BadRecording, match="between a and b and the distance between c and d look exchanged"):
        said(samples, Cell(distances=wrong))


def seen_by_both(
    seed: int, scale: float = 1.0, target: float = 0.0, kind: str = "point", unrelated: bool = False
) -> Samples:
    """Two of five stations by a second instrument. scale: of its readings; target: how far off its own target is [m]."""
    rng = np.random.default_rng(seed)
    world = World(ur10(), rng, 5e-4, 1e-3, se3.exp(rng.normal(size=6)), se3.exp([0.05, 0.03, 0.12, 0.3, 0.1, 0.2]))
    q = rng.uniform(-2.5, 2.5, (100, 6))
    T = world.tool_in_tracker(q)
    second = np.arange(100) % 5 < 2
    elsewhere = se3.exp([2.0, 1.0, 0.4, 0.3, -0.8, 1.1])
    T[second] = elsewhere @ T[second] @ se3.exp([target, 0.0, 0.0, 0.0, 0.0, 0.0])
    T[second, :3, 3] *= scale
    T[:, :3, 3] += 3e-5 * rng.standard_normal((100, 3))
    if unrelated:
        T[second] = se3.exp(rng.normal(size=(int(second.sum()), 6)))
    samples = samples_of(ur10(), q, T, kind)
    return replace(samples, frames=("tracker", "camera"), frame=second.astype(int))


@pytest.mark.parametrize("fault", [{"scale": 1.001}, {"target": 4e-4}])
def test_instruments_that_do_not_agree_are_named(fault: dict[str, float]) -> None:
    report = calibrate(seen_by_both(1, **fault), ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.status == "open"
    said = " ".join(report.open_because)
    assert "which instrument reads it: those in frames 'tracker' and 'camera' do not agree" in said


def test_instruments_that_agree_are_not() -> None:
    report = calibrate(seen_by_both(2), ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.judged.predictable.lower99 < MAX_PREDICTABLE
    assert "instrument reads" not in " ".join(report.open_because)


def test_an_instrument_of_few_readings_is_not_asked() -> None:
    samples = seen_by_both(2)
    keep = (samples.frame == 0) | (np.cumsum(samples.frame) <= 8)
    report = calibrate(
        samples.select(np.flatnonzero(keep)), ur10(), np.random.default_rng(0), look_for_effects=False
    ).report
    asked = [n for n in report.judged.not_asked if "camera" in n.what]
    assert [n.needs for n in asked] == ["12 readings of each"]


def test_an_instrument_whose_readings_fit_nowhere_is_refused_by_name() -> None:
    samples = seen_by_both(1, kind="pose", unrelated=True)
    with pytest.raises(BadRecording, match=r"frame 'camera': .*of its 40 readings agree with no place.*left-handed"):
        calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)
