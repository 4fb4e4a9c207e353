"""Pictures of a calibration: errors before and after, what the data show of the parameters, stations.

Charts are small and many rather than large and few, so that a page can lay them side by side or, on a phone, one below
the other. Other pages draw with Matplotlib, which is imported only when one is drawn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from modcal_core.report.counted import counted
from modcal_core.report.page import Chart
from modcal_core.report.palette import AFTER, BAD, BEFORE, GOOD, SOFT, WARN
from modcal_core.report.panel import Panel, cross, decades, hollow, round_numbers, swatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from modcal_core.report.contents import ReportContents

MOST_POINTS = 1200  # more make the page heavy and show no more
_SETS = (("train", "circle", SOFT), ("explain", "square", GOOD), ("held_out", "triangle", AFTER))
_MOST_REJECTED = 300


def small(width: float, height: float, left: float = 0.55, bottom: float = 0.42) -> tuple[Figure, Axes]:
    """A figure [inches] with one pair of axes, labels in small print; left, bottom: room for those."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((left / width, bottom / height, 1.0 - (left + 0.08) / width, 1.0 - (bottom + 0.12) / height))
    axes.tick_params(labelsize=7.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.locator_params(nbins=4)
    return figure, axes


def label(axes: Axes, x: str, y: str) -> None:
    """Names of both axes."""
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)


def thinned(count: int, most: int) -> np.ndarray:
    """At most so many of this many rows, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)) if count else np.empty(0, int)


def error_histogram(report: ReportContents) -> Chart | None:
    """How often the tool misses by how much on the held-out set, before and after, on a logarithmic axis."""
    norms = {stage: 1e3 * report.errors[stage].position_norm for stage in ("nominal", "final")}
    if not len(norms["final"]):
        return None
    smallest = max(min(float(np.percentile(n, 1)) for n in norms.values()), 1e-5)
    largest = max(float(n.max()) for n in norms.values())
    bins = np.geomspace(0.8 * smallest, max(1.2 * largest, 2.0 * smallest), 40)
    counts = {stage: np.histogram(np.clip(n, bins[0], None), bins)[0] for stage, n in norms.items()}
    ends = bins[0] ** 1.05 / bins[-1] ** 0.05, bins[-1] ** 1.05 / bins[0] ** 0.05
    highest = 1.05 * max(1, *(int(count.max()) for count in counts.values()))
    shown = (("nominal", BEFORE, True), ("final", AFTER, False))
    said = [f"{stage}: {np.sqrt(np.mean(norms[stage] ** 2)):.3f} mm RMS" for stage, *_ in shown]
    legend = [(swatch(colour, hatched), words) for (_, colour, hatched), words in zip(shown, said, strict=True)]
    ticks = {"y": whole_numbers(highest)}
    panel = Panel(ends, (0.0, highest), 165.6, 331.2, logarithmic="x", ticks=ticks, ruled=False, legend=legend)
    for stage, colour, hatched in shown:
        seen = np.flatnonzero(counts[stage])
        top = counts[stage][seen].astype(float)
        panel.bars(np.c_[bins[seen], bins[seen + 1]], np.c_[np.zeros(len(seen)), top], colour, hatched)
    alt = f"Histogram of held-out position errors. {'; '.join(said)}."
    words = (
        "Each bar counts held-out samples with an error of this size: hatched with the nominal model, "
        "solid with the final."
    )
    return panel.chart("histogram", "position error of held-out samples, mm", "samples", alt, words)


def spread_chart(report: ReportContents) -> Chart | None:
    """How well each combination of parameters is known by the data alone."""
    seen = report.identifiability
    if seen is None or not seen.deviations:
        return None
    deviations = np.clip(np.array(seen.deviations), 1e-9, 1e3)
    count = np.arange(1, len(deviations) + 1)
    known = np.arange(len(deviations)) < seen.rank
    low, high = 0.5 * min(float(deviations.min()), 1.0), 2.0 * max(float(deviations.max()), 1.0)
    panel = Panel((0.0, len(count) + 1.0), (low, high), 144.0, 331.2, logarithmic="y", ruled=False)
    panel.ticks = {"y": decades(low, high)}
    panel.dashes(count[known], deviations[known], AFTER, 0.0, 3.0)
    panel.crosses(count[~known], deviations[~known], BAD, 1.0)
    panel.level(1.0, WARN)
    alt = f"{seen.rank} of {seen.parameters} combinations of parameters are determined by the data."
    words = (
        "Remaining uncertainty of each combination, as a share of what was expected before measuring. "
        "Crosses, above the dashed line: not shown by these stations, held near nominal."
    )
    across = "combination of parameters, best known first"
    return panel.chart("spread", across, "deviation ÷ expected", alt, words)


def timeline(report: ReportContents, share: float = 1.0) -> Chart | None:
    """The stations in the order of their time, what each was used for, and those that were left out.

    share: of the marks that it usually has.
    """
    samples = report.samples
    if not len(report.residuals) or not len(samples):
        return None
    wrong = report.wrong if len(report.wrong) == len(samples) else np.zeros(len(samples), bool)
    miss, time = 1e3 * np.maximum(report.residuals, 1e-9), (samples.stamps - samples.stamps.min()) / 60.0
    sizes = report.set_sizes()
    shown = []
    for name, shape, colour in _SETS:
        rows = getattr(report.sets, name)
        rows = rows[~wrong[rows]]
        shown.append((name, shape, colour, rows[thinned(len(rows), int(share * MOST_POINTS / 6.0))]))
    shown = [one for one in shown if len(one[3])]
    legend = [(hollow(colour, shape), f"{name.replace('_', '-')} ({sizes[name]})") for name, shape, colour, _ in shown]
    out = report.rejected_rows()[:_MOST_REJECTED]
    legend += [(cross(BAD, 1.6), f"rejected ({len(out)})")] if len(out) else []
    every = miss[np.concatenate([out, *(rows for *_, rows in shown)]).astype(int)]
    ends = 0.8 * float(every.min()), 1.25 * float(every.max())
    last = max(float(time.max()), 1e-3)
    across = (-0.03 * last, 1.03 * last)
    panel = Panel(across, ends, 165.6, 532.8, logarithmic="y", ruled=False, legend=legend)
    for _, shape, colour, rows in shown:
        panel.hollow(time[rows], miss[rows], colour, shape)
    panel.crosses(time[out], miss[out], BAD)
    over = f"{samples.stations} stations over {time.max():.1f} minutes"
    alt = f"Error of the final model at {over}; {counted(report.rejected_stations(), 'station')} rejected."
    words = "Circles fitted the model, squares chose the effects, triangles scored it; crosses were rejected."
    return panel.chart("timeline", "time since the first sample, min", "error of the final model, mm", alt, words)


def whole_numbers(high: float) -> list[tuple[float, str]]:
    """Ticks of an axis that counts, from nothing to ``high``."""
    values = round_numbers(0.0, high)[0]
    return [(float(value), str(round(value))) for value in values if value == round(value)]
