"""Pictures of a report, as SVG text. Matplotlib is imported only when one is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from modcal_core.calibration.effects import AXIS
from modcal_core.report.findings import Finding, curve
from modcal_core.report.report import Report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_POINTS = 1200  # more make the page heavy and show no more
_CURVE_POINTS = 2000
_COLOURS = {"nominal": "#b0b7c3", "final": "#1f6feb"}


def error_histogram(report: Report) -> str:
    """How often the tool misses by how much on the held-out set, before and after."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    axes = figure.subplots()
    norms = {stage: 1e3 * report.errors[stage].position_norm for stage in _COLOURS}
    bins = np.linspace(0.0, max(float(np.percentile(n, 99.5)) for n in norms.values()) or 1.0, 50)
    for stage, colour in _COLOURS.items():
        label = f"{stage}: {np.sqrt(np.mean(norms[stage] ** 2)):.3f} mm RMS"
        axes.hist(norms[stage], bins.tolist(), color=colour, alpha=0.8, label=label)
    axes.set_xlabel("position error of held-out samples, mm")
    axes.set_ylabel("samples")
    axes.legend(loc="upper right", frameon=False)
    return svg(figure)


def error_by_joint(report: Report) -> str:
    """What is left, against each joint's position: a pattern here is an effect that the model lacks."""
    from matplotlib.figure import Figure

    shown = np.linspace(0, len(report.scored) - 1, min(len(report.scored), _MOST_POINTS)).astype(int)
    samples, left = report.scored.select(shown), report.errors["final"].position[shown]
    n = len(samples.names)
    columns = min(n, 4)
    rows = -(-n // columns)
    figure = Figure(figsize=(2.6 * columns, 1.9 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, sharey=True)).ravel()
    for j, name in enumerate(samples.names):
        for k, colour in enumerate(("#d1495b", "#3a7d44", "#1f6feb")):
            axes[j].plot(samples.q[:, j], 1e3 * left[:, k], ".", ms=1.5, color=colour, label="xyz"[k])
        axes[j].set_title(name, fontsize=9)
        axes[j].tick_params(labelsize=7)
    for spare in axes[n:]:
        spare.set_visible(False)
    axes[0].legend(loc="upper right", frameon=False, fontsize=7, markerscale=4, ncols=3)
    figure.supylabel("left over, mm", fontsize=9)
    figure.supxlabel("joint position, rad or m", fontsize=9)
    return svg(figure)


def effect_shapes(report: Report) -> str | None:
    """Each effect that follows one joint's position, over the range that was seen, with two standard deviations."""
    from matplotlib.figure import Figure

    shown = [f for f in report.effects if f.direction == AXIS and _follows_one_joint(f)]
    if not shown:
        return None
    figure = Figure(figsize=(8.0, 1.9 * len(shown)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(shown), 1))
    for ax, finding in zip(axes, shown, strict=True):
        q = report.samples.q[:, report.samples.names.index(finding.driver.partition(":")[2])]
        x, size, std = curve(finding.effects, float(q.min()), float(q.max()), _CURVE_POINTS)
        ax.fill_between(x, 1e3 * (size - 2.0 * std), 1e3 * (size + 2.0 * std), color=_COLOURS["nominal"], lw=0)
        ax.plot(x, 1e3 * size, color=_COLOURS["final"], lw=0.9)
        ax.set_title(f"{finding.place}: {finding.family.replace('_', ' ')}", fontsize=9)
        ax.set_ylabel("mrad", fontsize=8)
        ax.tick_params(labelsize=7)
    axes[-1].set_xlabel("joint position, rad", fontsize=9)
    return svg(figure)


def _follows_one_joint(finding: Finding) -> bool:
    return (
        bool(finding.effects)
        and all(e.driver == finding.driver for e in finding.effects)
        and (finding.driver.startswith("position:"))
    )


def svg(figure: Figure) -> str:
    """The figure as SVG text, the same bytes for the same figure."""
    import matplotlib

    # fixed ids and no date: the same report gives the same bytes
    with matplotlib.rc_context({"svg.hashsalt": "modcal", "svg.fonttype": "none"}):
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
