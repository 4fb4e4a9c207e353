"""Pictures of a calibration: errors before and after, residuals against what may drive them, shapes, stations.

Matplotlib is imported only when one is drawn. Charts are small and many rather than large and few, so that a page can
lay them side by side or, on a phone, one below the other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.thinning import spread_rows
from modcal_core.report.counted import counted
from modcal_core.report.page import Chart, chart
from modcal_core.report.palette import LIGHT
from modcal_core.report.panel import round_numbers

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch
    from matplotlib.ticker import Locator

    from modcal_core.report.contents import ReportContents

MOST_POINTS = 1200  # more make the page heavy and show no more
_SETS = (("train", "o", "soft"), ("explain", "s", "good"), ("held_out", "^", "after"))
_MOST_REJECTED = 300
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


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


def bars(edges: Array, height: Array, **style: Any) -> PathPatch:
    """Bars from zero between edges (k + 1,), as one path: a patch for each takes longer than all the rest."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    seen = np.flatnonzero(height)
    left, right, top, zero = edges[seen], edges[seen + 1], height[seen], np.zeros(len(seen))
    corners = np.stack(
        [np.c_[left, zero], np.c_[right, zero], np.c_[right, top], np.c_[left, top], np.c_[left, zero]], 1
    )
    codes = np.tile([Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY], len(seen))
    return PathPatch(Path(corners.reshape(-1, 2), codes), linewidth=0.8, **style)


_STEPS: tuple[tuple[float, ...], ...] = (  # of a decade, tried in turn until two numbers stand on the axis
    (1.0,),
    (1.0, 3.0),
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
)


def in_decades(axis: Axis) -> None:
    """Write a logarithmic axis as powers of ten in plain letters: setting them as formulas takes half of a picture."""
    axis.set_major_formatter(lambda value, _: "10" + f"{round(np.log10(value)):d}".translate(_RAISED))


def in_numbers(axis: Axis, low: float, high: float) -> None:
    """Write a logarithmic axis from low to high in plain numbers, at least two of them where it can be."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for steps in _STEPS:
        ticks = np.outer(decades, steps).ravel()
        ticks = ticks[(ticks >= low * (1.0 - 1e-9)) & (ticks <= high * (1.0 + 1e-9))]
        if len(ticks) > 1:
            break
    else:  # hardly a stretch of a decade: as a plain axis has them
        ticks = round_numbers(low, high)[0]
    axis.set_major_locator(_at(ticks))
    axis.set_major_formatter("{x:g}")


def _at(ticks: Array) -> Locator:
    from matplotlib.ticker import FixedLocator

    return FixedLocator(list(ticks))


def error_histogram(report: ReportContents) -> Chart | None:
    """How often the tool misses by how much on the held-out set, before and after, on a logarithmic axis."""
    norms = {stage: 1e3 * report.errors[stage].position_norm for stage in ("nominal", "final")}
    if not len(norms["final"]):
        return None
    figure, axes = small(4.6, 2.3)
    smallest = max(min(float(np.percentile(n, 1)) for n in norms.values()), 1e-5)
    largest = max(float(n.max()) for n in norms.values())
    bins = np.geomspace(0.8 * smallest, max(1.2 * largest, 2.0 * smallest), 40)
    said, highest = [], 1
    for stage, colour, hatch in (("nominal", "before", "////"), ("final", "after", "")):
        rms = float(np.sqrt(np.mean(norms[stage] ** 2)))
        said.append(f"{stage}: {rms:.3f} mm RMS")
        count, _ = np.histogram(np.clip(norms[stage], bins[0], None), bins)
        highest = max(highest, int(count.max()))
        tone, plain = LIGHT[colour], not hatch
        axes.add_patch(bars(bins, count, label=said[-1], fill=plain, hatch=hatch, facecolor=tone, edgecolor=tone))
    axes.set_xlim(bins[0] ** 1.05 / bins[-1] ** 0.05, bins[-1] ** 1.05 / bins[0] ** 0.05)
    axes.set_ylim(0.0, 1.05 * highest)
    axes.set_xscale("log")
    axes.minorticks_off()  # they take as long to draw as all the rest
    in_numbers(axes.xaxis, *axes.get_xlim())
    axes.locator_params("y", integer=True)
    label(axes, "position error of held-out samples, mm", "samples")
    axes.legend(frameon=False, fontsize=7.5, loc="upper center", bbox_to_anchor=(0.5, 1.08), ncols=2)
    alt = f"Histogram of held-out position errors. {'; '.join(said)}."
    words = (
        "Each bar counts held-out samples with an error of this size: hatched with the nominal model, "
        "solid with the final."
    )
    return chart(figure, "histogram", alt, words)


def spread_chart(report: ReportContents) -> Chart | None:
    """How well each combination of parameters is known by the data alone."""
    seen = report.identifiability
    if seen is None or not seen.deviations:
        return None
    figure, axes = small(4.6, 2.0)
    deviations = np.clip(np.array(seen.deviations), 1e-9, 1e3)
    count = np.arange(1, len(deviations) + 1)
    known = np.arange(len(deviations)) < seen.rank
    axes.semilogy(count[known], deviations[known], "o", ms=3.0, color=LIGHT["after"])
    axes.semilogy(count[~known], deviations[~known], "x", ms=5.0, color=LIGHT["bad"])
    axes.minorticks_off()
    in_decades(axes.yaxis)
    axes.axhline(1.0, color=LIGHT["warn"], lw=0.9, ls="--")
    label(axes, "combination of parameters, best known first", "deviation ÷ expected")
    alt = f"{seen.rank} of {seen.parameters} combinations of parameters are determined by the data."
    words = (
        "Remaining uncertainty of each combination, as a share of what was expected before measuring. "
        "Crosses, above the dashed line: not shown by these stations, held near nominal."
    )
    return chart(figure, "spread", alt, words)


def timeline(report: ReportContents, share: float = 1.0) -> Chart | None:
    """The stations in the order of their time, what each was used for, and those that were left out.

    share: of the marks that it usually has.
    """
    samples = report.samples
    if not len(report.residuals) or not len(samples):
        return None
    figure, axes = small(7.4, 2.3)
    wrong = report.wrong if len(report.wrong) == len(samples) else np.zeros(len(samples), bool)
    miss, time = 1e3 * np.maximum(report.residuals, 1e-9), (samples.stamps - samples.stamps.min()) / 60.0
    sizes = report.set_sizes()
    for name, marker, colour in _SETS:
        rows = getattr(report.sets, name)
        rows = rows[~wrong[rows]]
        rows = rows[spread_rows(len(rows), int(share * MOST_POINTS / 6.0))]
        said = f"{name.replace('_', '-')} ({sizes[name]})"
        if len(rows):
            axes.semilogy(time[rows], miss[rows], marker, ms=3.0, color=LIGHT[colour], mfc="none", label=said)
    out = report.rejected_rows()[:_MOST_REJECTED]
    if len(out):
        axes.semilogy(time[out], miss[out], "X", ms=6.0, color=LIGHT["bad"], label=f"rejected ({len(out)})")
    axes.minorticks_off()
    in_numbers(axes.yaxis, *axes.get_ylim())
    label(axes, "time since the first sample, min", "error of the final model, mm")
    axes.legend(frameon=False, fontsize=7.5, loc="upper center", bbox_to_anchor=(0.5, 1.1), ncols=4)
    over = f"{samples.stations} stations over {time.max():.1f} minutes"
    alt = f"Error of the final model at {over}; {counted(report.rejected_stations(), 'station')} rejected."
    words = "Circles fitted the model, squares chose the effects, triangles scored it; filled crosses were rejected."
    return chart(figure, "timeline", alt, words)
