"""Full calibration, against SciPy's least squares and other packages; its growth, and its memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import harness
import numpy as np
from cells import NOISE_M, NOISE_RAD, record, samples_of, ur10
from peers import ask
from scipy.optimize import least_squares
from timing import Row, median_ms, spent_ms

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.linearisation import apply_deviations, deviations, linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.geometry import so3
from modcal_core.measurements.samples import Samples

URDF = harness.ROOT / "examples" / "robots" / "ur10.urdf"
HELD = 500  # postures at which ours and FIGAROH's are judged
WORSE = 0.05  # of our error there; two that differ by less are called equal
# How FIGAROH chooses parameters, what the table calls it, and the most samples it is asked for
METHODS = (("excitation", "FIGAROH, excitation", 10_000), ("structural", "FIGAROH, its default set", 1_000))
SAME = 1e-2  # standard deviations that two solutions of the same samples may differ by
# Milliseconds of others that are not to be had from an index of Python packages, on the machine they were taken on:
# Ceres with numeric differences and a dense QR (positions), industrial_calibration (poses), a NumPy prototype
PUBLISHED = {
    ("point", 100): {"Ceres": 15.5, "prototype": 1.05},
    ("point", 1_000): {"Ceres": 121.0, "prototype": 1.67},
    ("point", 10_000): {"Ceres": 1275.0, "prototype": 10.5},
    ("pose", 100): {"industrial_calibration": 34.0, "prototype": 1.10},
    ("pose", 1_000): {"industrial_calibration": 236.0, "prototype": 4.25},
    ("pose", 10_000): {"industrial_calibration": 2373.0, "prototype": 29.0},
}


def located(samples: Samples) -> tuple[Model, tuple[ModelParameter, ...]]:
    """The nominal arm, with base and tool found from a hundred samples, and its parameters."""
    start = fit_cell(ur10(), samples.select(np.arange(min(len(samples), 100))), Cell()).model
    return start, tuple(choose_parameters(start, views_of(samples)).parameters)


def many(count: int, kind: str, seed: int = 1) -> Samples:
    """Samples of a displaced arm. From 20 000 on by this suite's own kinematics, for MuJoCo takes its time."""
    if count <= 20_000:
        return record(seed, count, kind).samples
    model, parameters = located(record(seed, 200, kind).samples)
    rng, sizes = np.random.default_rng(seed), [1e-3 if p.turns else 5e-4 for p in parameters]
    off = rng.normal(size=len(parameters)) * sizes
    true, q = apply_deviations(model, deviations(model, parameters, off)), rng.uniform(-3.0, 3.0, (count, 6))
    parts = np.array_split(np.arange(count), max(count // 50_000, 1))
    T = np.concatenate([true.predict(q[rows]) for rows in parts])
    T[:, :3, 3] += NOISE_M * rng.standard_normal((count, 3))
    for rows in parts if kind == "pose" else ():
        T[rows, :3, :3] = T[rows, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((len(rows), 3)))
    return samples_of(ur10(), q, T, kind)


def scipy_fit(model: Model, parameters: tuple[ModelParameter, ...], samples: Samples) -> Callable[[], Any]:
    """The same least squares by SciPy, with derivatives by differences."""
    residual = lambda x: linearise(model, parameters, x, samples, jacobian=False).residual  # noqa: E731
    count = len(parameters)
    return lambda: least_squares(residual, np.zeros(count), x_scale=np.full(count, 1e-3), method="trf")


def require_same(ours: Fit, values: Any, what: str) -> None:
    """Exits where two solutions differ by more than hundredths of their uncertainty."""
    apart = float(np.abs((values - ours.values) / ours.std).max())
    if apart > SAME:
        raise SystemExit(f"{what}: another optimum, {apart:.2g} standard deviations away")


def rows(scale: float, most: int) -> Iterator[Row]:
    """The fits. scale: of this machine. most: samples."""
    for kind, count in [(kind, count) for kind in ("point", "pose") for count in (100, 1_000, 10_000, 100_000)]:
        if count > most:
            continue
        samples = many(count, kind)
        start, parameters = located(samples)

        def fit(m: Model = start, s: Samples = samples, p: Any = parameters, robust: bool = False) -> Fit:
            # a new view of the samples, so that nothing is remembered of them
            return identify(m, replace(s), p, robust=robust)

        found, work = fit(), f"fit, {kind}, N = {count}"
        robust = median_ms(lambda f=fit: f(robust=True), 5)
        ms = median_ms(fit, 7 if count < 100_000 else 3)
        published = PUBLISHED.get((kind, count), {}).items()
        said = [f"robust {robust:.1f} ms", *(f"{other} {theirs * scale / ms:.1f} x" for other, theirs in published)]
        yield Row(work, ms, remark="; ".join(said), size=count)
        if count <= 1_000:
            peer = scipy_fit(start, parameters, samples)
            if kind == "point":  # poses weigh two units against each other, which SciPy is not told
                require_same(found, peer().x, f"{work}, SciPy")
            yield Row(work, ms, "SciPy least_squares", spent_ms(peer), "numeric derivatives", count)
        if kind == "point":
            if count == 100:
                yield against_pybotics(found, samples, work, ms)
            yield from against_figaroh(found, samples, work, ms)
        if count == 10_000:
            J_ms = median_ms(lambda m=start, s=samples, p=parameters: linearise(m, p, np.zeros(len(p)), s), 5)
            yield Row(f"Jacobian of all parameters, {kind}, N = {count}", J_ms, size=count)


def against_pybotics(fit: Fit, samples: Samples, work: str, ms: float) -> Row:
    """The same readings fitted by pybotics from the same start, in its own environment."""
    start = fit.start
    told = {"q": samples.q, "position": samples.reading, "frame": start.T_frame_base[0], "tool": start.T_tip_tool}
    answer = ask("pybotics", seconds=60.0, arrays=told)
    said = answer.remark
    if answer.found:
        left = fit.model.predict(samples.q)[:, :3, 3] - samples.reading
        ours = 1e3 * float(np.sqrt(np.mean(left**2)))
        # the same least squares, so no less may be left than rounding and our priors make
        if answer.found[0] < (1.0 - SAME) * ours:
            raise SystemExit(f"pybotics: {answer.found[0]:.6f} mm left, ours {ours:.6f} mm")
        said += f", ours {1e3 * ours:.1f} um" + (": a worse optimum" if answer.found[0] > (1.0 + SAME) * ours else "")
    return Row(work, ms, "pybotics", answer.ms, said, samples.q.shape[0])


def against_figaroh(fit: Fit, samples: Samples, work: str, ms: float, seed: int = 1) -> Iterator[Row]:
    """Rows of FIGAROH with the parameters it can be told to choose, and with those it chooses untold.

    It does not always choose as many as the points can tell, so that residuals would compare little: what counts is how
    well postures are predicted that neither has seen, against MuJoCo's own positions. seed: of the samples' recording.
    """
    world = record(seed, 1, "point").world  # the arm is drawn before the postures: it is the same at any count
    q = np.random.default_rng([seed, HELD]).uniform(-np.pi, np.pi, (HELD, samples.q.shape[1]))
    truth = world.tool_in_tracker(q)[:, :3, 3]
    told = {"names": np.array(samples.names), "q": samples.q, "position": samples.reading, "held": q}
    off = lambda p: 1e3 * float(np.linalg.norm(p - truth, axis=1).mean())  # noqa: E731
    ours = off(fit.model.predict(q)[:, :3, 3])
    for method, name, most in METHODS:
        if len(samples) <= most:
            answer = ask("figaroh", str(URDF), method, seconds=120.0, arrays=told)
            remark = answer.remark
            if answer.found:
                theirs = off(np.reshape(answer.found, (-1, 3)))
                remark += f"; held out {theirs:.4f} mm, ours {ours:.4f} mm"
                remark += ": a worse optimum" if theirs > (1.0 + WORSE) * ours else ""
            yield Row(work, ms, name, answer.ms, remark, len(samples))


def million(count: int = 1_000_000) -> Iterator[Row]:
    """Growth to a million points, and what the fit takes in memory beside the samples."""
    samples = many(count, "point")
    start, parameters = located(samples)
    ms = spent_ms(lambda: identify(start, replace(samples), parameters, robust=False))
    tracemalloc.start()
    identify(start, replace(samples), parameters, robust=False)
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    remark = f"{peak:.0f} MB beside the samples, {1e6 * peak / count:.0f} bytes each"
    yield Row(f"fit, point, N = {count}", ms, remark=remark, size=count)
