"""What is left, against every joint, time and temperature: before and after each thing that was added."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.score import Errors
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.thinning import spread_rows
from modcal_core.report.contents import ReportContents
from modcal_core.report.figures import MAX_POINTS
from modcal_core.report.page import Chart
from modcal_core.report.palette import AFTER, BEFORE, OF_AXES
from modcal_core.report.panel import Panel

_MAX_STEPS = 5  # that are drawn; more effects are drawn together
_MAX_TEMPERATURES = 4
_MAX_DRAWN = 14_000  # dots of a page before and after its steps, which are folded


@dataclass(frozen=True)
class Against:
    """One horizontal axis. words: for people, with the unit. values: at the scored samples, (N,)."""

    name: str
    words: str
    values: Array


@dataclass(frozen=True)
class ChartGroup:
    """Charts of what one step removed, or of the final residual. opened: shown at once."""

    title: str
    text: str
    charts: tuple[Chart, ...]
    opened: bool = False


def comparisons(report: ReportContents, share: float = 1.0) -> tuple[ChartGroup, ...]:
    """Before and after geometry, before and after each effect, and what is left at the end.

    share: of the dots that charts usually have.
    """
    if not len(report.scored):
        return ()
    along = axes_of(report)
    pairs = _pairs(report)
    most = max(min(MAX_POINTS // 3, _MAX_DRAWN // (6 * len(along) * len(pairs))), 40)
    most = max(int(share * most), 20)
    rows = spread_rows(len(report.scored), most)
    out = []
    for k, (added, before, after) in enumerate(pairs):
        sizes = f"{_rms(before):.3f} to {_rms(after):.3f} mm RMS"
        text = "Dashes: before. Dots: after. All three components of the residual, on one scale."
        charts = tuple(_before_after(a, before, after, rows, f"step{k}-{i}", added) for i, a in enumerate(along))
        out.append(ChartGroup(f"Adding {added.replace(':', ' of ')}: {sizes}", text, charts))
    final = report.errors["final"]
    rows = spread_rows(len(report.scored), max(int(share * MAX_POINTS / 3.0), 20))
    charts = tuple(_left(a, final, rows, f"left-{i}") for i, a in enumerate(along))
    text = (
        "The residual of the final model: x as circles, y as triangles, z as squares. "
        "A pattern here is an effect that the model lacks."
    )
    return (*out, ChartGroup(f"Residual: {_rms(final):.3f} mm RMS", text, charts, opened=True))


def axes_of(report: ReportContents) -> list[Against]:
    """Each joint, time since the first sample, and the recorded temperatures."""
    scored = report.scored
    joints = [Against(name, f"{name}, rad or m", scored.q[:, j]) for j, name in enumerate(scored.names)]
    if report.model is not None:
        turning = report.model.chain.revolute
        joints = [Against(a.name, f"{a.name}, {'rad' if turning[j] else 'm'}", a.values) for j, a in enumerate(joints)]
    time = Against("time", "time, min", (scored.stamps - report.samples.stamps.min()) / 60.0)
    heat = []
    if report.model is not None:
        at = report.model.drivers(scored)
        names = [name for name in at.signal_names() if name.startswith("temperature:")][:_MAX_TEMPERATURES]
        heat = [Against(name, f"temperature of {name.partition(':')[2]}, °C", at.values(name)) for name in names]
    return [*joints, time, *heat]


def _pairs(report: ReportContents) -> list[tuple[str, Errors, Errors]]:
    """What was added, and the errors before and after."""
    stages = [report.errors["nominal"], *(step.errors for step in report.steps)]
    names = [step.added for step in report.steps]
    if len(names) > _MAX_STEPS:
        rest = len(names) - _MAX_STEPS + 1
        names = [*names[: _MAX_STEPS - 1], f"{rest} more effects"]
        stages = [*stages[:_MAX_STEPS], stages[-1]]
    return [(name, stages[k], stages[k + 1]) for k, name in enumerate(names)]


def _rms(errors: Errors) -> float:
    size = errors.size_mm()
    return 0.0 if size is None else size.rms


def _before_after(a: Against, before: Errors, after: Errors, rows: np.ndarray, name: str, added: str) -> Chart:
    x = np.repeat(a.values[rows], 3)
    first, second = (1e3 * e.position[rows].ravel() for e in (before, after))
    panel = _panel(x, first)
    panel.dashes(x, first, BEFORE, 0.012, 1.1)
    panel.dashes(x, second, AFTER, 0.0, 2.2)
    alt = f"Residual against {a.name}, before and after {added}: {_rms(before):.3f} and {_rms(after):.3f} mm RMS."
    return panel.chart(name, a.words, "residual, mm", alt, f"against {a.name.replace(':', ' of ')}")


def _left(a: Against, errors: Errors, rows: np.ndarray, name: str) -> Chart:
    left = 1e3 * errors.position[rows]
    panel = _panel(a.values[rows], left.ravel())
    for k, (colour, shape) in enumerate(zip(OF_AXES, ("circle", "triangle", "square"), strict=True)):
        panel.hollow(a.values[rows], left[:, k], colour, shape)
    alt = f"Residual against {a.name}: {_rms(errors):.3f} mm RMS."
    return panel.chart(name, a.words, "residual, mm", alt, f"against {a.name.replace(':', ' of ')}")


def _panel(x: Array, y: Array) -> Panel:
    """An empty one with limits that a few far samples do not stretch."""
    reach = 1.15 * max(float(np.percentile(np.abs(y), 99.5)), 1e-6)
    low, high = float(x.min()), float(x.max())
    margin = 0.04 * max(high - low, 1e-6)
    return Panel((low - margin, high + margin), (-reach, reach))
