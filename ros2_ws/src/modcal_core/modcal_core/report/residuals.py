"""What is left, against every joint, time and temperature: before and after each thing that was added."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from modcal_core.calibration.score import Errors
from modcal_core.geometry.so3 import Array
from modcal_core.report.figures import MOST_POINTS, label, small, thinned
from modcal_core.report.page import Chart, chart
from modcal_core.report.palette import LIGHT, OF_AXES
from modcal_core.report.report import Report

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    Panel = tuple[Figure, Axes]

_MOST_STEPS = 5  # that are drawn; more effects are drawn together
_MOST_TEMPERATURES = 4
_MOST_DRAWN = 40_000  # dots of a page


@dataclass(frozen=True)
class Against:
    """One horizontal axis. words: for people, with the unit. values: at the scored samples, (N,)."""

    name: str
    words: str
    values: Array


@dataclass(frozen=True)
class Comparison:
    """Charts of what one step took away, or of what is left in the end. opened: shown at once."""

    title: str
    text: str
    charts: tuple[Chart, ...]
    opened: bool = False


def comparisons(report: Report) -> tuple[Comparison, ...]:
    """Before and after geometry, before and after each effect, and what is left at the end."""
    if not len(report.scored):
        return ()
    along = axes_of(report)
    pairs = _pairs(report)
    most = max(min(MOST_POINTS // 3, _MOST_DRAWN // (6 * len(along) * len(pairs))), 40)
    rows = thinned(len(report.scored), most)
    panel = small(3.0, 1.75, left=0.62)  # one for all: making axes takes longer than drawing on them
    out = []
    for k, (added, before, after) in enumerate(pairs):
        sizes = f"{_rms(before):.3f} to {_rms(after):.3f} mm RMS"
        text = "Dashes: before. Dots: after. All three components of the residual, on one scale."
        charts = tuple(_before_after(panel, a, before, after, rows, f"step{k}-{i}", added) for i, a in enumerate(along))
        out.append(Comparison(f"Adding {added.replace(':', ' of ')}: {sizes}", text, charts))
    final = report.errors["final"]
    charts = tuple(_left(panel, a, final, rows, f"left-{i}") for i, a in enumerate(along))
    text = (
        "The residual of the final model: x as circles, y as triangles, z as squares. "
        "A pattern here is an effect that the model lacks."
    )
    return (*out, Comparison(f"What is left: {_rms(final):.3f} mm RMS", text, charts, opened=True))


def axes_of(report: Report) -> list[Against]:
    """Each joint, time since the first sample, and the recorded temperatures."""
    scored = report.scored
    joints = [Against(name, f"{name}, rad or m", scored.q[:, j]) for j, name in enumerate(scored.names)]
    if report.model is not None:
        turning = report.model.chain.revolute
        joints = [Against(a.name, f"{a.name}, {'rad' if turning[j] else 'm'}", a.values) for j, a in enumerate(joints)]
    time = Against("time", "time, min", (scored.stamps - report.samples.stamps.min()) / 60.0)
    heat = []
    if report.model is not None:
        at = report.model.circumstances(scored)
        names = [name for name in at.signal_names() if name.startswith("temperature:")][:_MOST_TEMPERATURES]
        heat = [Against(name, f"temperature of {name.partition(':')[2]}, °C", at.driver(name)) for name in names]
    return [*joints, time, *heat]


def _pairs(report: Report) -> list[tuple[str, Errors, Errors]]:
    """What was added, and the errors before and after."""
    stages = [report.errors["nominal"], *(step.errors for step in report.steps)]
    names = [step.added for step in report.steps]
    if len(names) > _MOST_STEPS:
        rest = len(names) - _MOST_STEPS + 1
        names = [*names[: _MOST_STEPS - 1], f"{rest} more effects"]
        stages = [*stages[:_MOST_STEPS], stages[-1]]
    return [(name, stages[k], stages[k + 1]) for k, name in enumerate(names)]


def _rms(errors: Errors) -> float:
    size = errors.size_mm()
    return 0.0 if size is None else size.rms


def _before_after(
    panel: Panel, a: Against, before: Errors, after: Errors, rows: np.ndarray, name: str, added: str
) -> Chart:
    figure, axes = panel
    x = np.repeat(a.values[rows], 3)
    first, second = (1e3 * e.position[rows].ravel() for e in (before, after))
    _frame(axes, x, first)
    _marks(axes, x, first, LIGHT["before"], 0.012 * float(np.diff(axes.get_xlim())[0]), 1.1)
    _marks(axes, x, second, LIGHT["after"], 0.0, 2.2)
    label(axes, a.words, "residual, mm")
    alt = f"Residual against {a.name}, before and after {added}: {_rms(before):.3f} and {_rms(after):.3f} mm RMS."
    return chart(figure, name, alt, f"against {a.name}")


def _left(panel: Panel, a: Against, errors: Errors, rows: np.ndarray, name: str) -> Chart:
    figure, axes = panel
    left = 1e3 * errors.position[rows]
    _frame(axes, a.values[rows], left.ravel())
    for k, (colour, marker) in enumerate(zip(OF_AXES, "o^s", strict=True)):
        axes.plot(a.values[rows], left[:, k], marker, ms=2.4, mfc="none", mew=0.7, color=colour)
    label(axes, a.words, "residual, mm")
    return chart(figure, name, f"What is left against {a.name}: {_rms(errors):.3f} mm RMS.", f"against {a.name}")


def _frame(axes: Axes, x: Array, y: Array) -> None:
    """An empty frame with limits that a few far samples do not stretch."""
    for artist in [*axes.lines, *axes.patches]:
        artist.remove()
    reach = 1.15 * max(float(np.percentile(np.abs(y), 99.5)), 1e-6)
    low, high = float(x.min()), float(x.max())
    margin = 0.04 * max(high - low, 1e-6)
    axes.set_xlim(low - margin, high + margin)
    axes.set_ylim(-reach, reach)
    axes.axhline(0.0, color=LIGHT["line"], lw=0.8, zorder=0)


def _marks(axes: Axes, x: Array, y: Array, colour: str, half: float, wide: float) -> None:
    """A dash of this half length, or a dot, at every point, as one path: a third of what markers take."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    ends = np.stack([np.c_[x - half, y], np.c_[x + half + 1e-9, y]], axis=1).reshape(-1, 2)
    path = Path(ends, np.tile([Path.MOVETO, Path.LINETO], len(x)))
    path.should_simplify = False
    axes.add_patch(PathPatch(path, fill=False, edgecolor=colour, linewidth=wide, capstyle="round", joinstyle="round"))
