"""Laws that every kind of reading keeps: exact derivatives, a start that needs no guess, refusals that say why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from finite_differences import assert_jacobian
from instruments import worlds
from instruments.worlds import Reading

from modcal_core.calibration.initial import locate
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.model import Model, place_model
from modcal_core.calibration.noise import errors
from modcal_core.calibration.parameters import INSTRUMENT, ordered_candidates
from modcal_core.calibration.structure import views_of
from modcal_core.effects import ZERO
from modcal_core.effects.families import step
from modcal_core.errors import BadRecording, ModcalError, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.checks import require_usable
from modcal_core.measurements.dropouts import READINGS as READINGS_LOST
from modcal_core.measurements.dropouts import cleaned
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording
from modcal_core.measurements.samples import Samples

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
    nothing = np.full_like(samples.q, np.nan)
    values = spoil(samples.reading[:, : kinds()[kind].width].copy())
    return Recording(
        joints=(JointTrack(ur10().names, samples.stamps, samples.q, nothing, nothing, samples.stamps),),
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
