"""The robot in three dimensions with what each held-out sample misses by: data for the page, and a still picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.calibration.score import Errors
from modcal_core.effects.effect import motion
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.rows import indirect_rows
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows
from modcal_core.report.contents import ReportContents
from modcal_core.report.figures import label
from modcal_core.report.page import Chart, chart
from modcal_core.report.palette import LIGHT
from modcal_core.robots.delta import ARMS, Delta
from modcal_core.robots.mechanism import tool_frames

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_ARROWS = 300
_MOST_POSTURES = 60
_MOST_STILL = 120  # arrows of the still picture, which cannot be turned or zoomed
_MOST_STAGES = 7


@dataclass(frozen=True)
class ReportScene:
    """All in the arm's base [m]. points: where the tool is, (N, 3). stages: name and misses (N, 3). paths: of the arm
    at the points ``shown``, polylines (k, 3). names: of the points. partly: some readings see along one line only.
    base: name of the base link.
    """

    points: Array
    stages: tuple[tuple[str, Array], ...]
    paths: tuple[tuple[Array, ...], ...]
    shown: np.ndarray
    names: tuple[str, ...]
    partly: bool
    base: str = ""

    def to_data(self) -> dict[str, Any]:
        """What the page's script draws: metres, and millimetres of the misses."""
        return {
            "points": np.round(self.points, 4).tolist(),
            "stages": [{"name": name, "arrows": np.round(1e3 * miss, 4).tolist()} for name, miss in self.stages],
            "arms": [[np.round(path, 3).tolist() for path in arm] for arm in self.paths],
            "shown": self.shown.tolist(),
            "names": list(self.names),
            "base": self.base,
        }


def scene(report: ReportContents, share: float = 1.0) -> ReportScene | None:
    """The scene of a report's held-out samples; None where no model or no sample is at hand.

    share: of the arrows that are usually drawn.
    """
    model, scored = report.model, report.scored
    if model is None or not len(scored):
        return None
    rows = spread_rows(len(scored), int(share * MOST_ARROWS))
    samples = scored.select(rows)
    indirect = indirect_rows(samples)
    named = [("nominal model", report.errors["nominal"]), *((s.added, s.errors) for s in report.steps)]
    named = [*named[: _MOST_STAGES - 1], *named[-1:]] if len(named) > _MOST_STAGES else named
    stages = tuple((name, _in_base(model, samples, e, rows, indirect)) for name, e in named)
    places = _arms(model, samples)
    shown = spread_rows(len(samples), max(int(share * _MOST_POSTURES), 8))
    paths = tuple(tuple(path[k] for path in places) for k in shown)
    names = tuple(f"station {int(s)}" for s in samples.station)
    return ReportScene(places[-1][:, -1], stages, paths, shown, names, bool(indirect.any()), model.chain.base)


def _in_base(model: Model, samples: Samples, errors: Errors, rows: np.ndarray, indirect: np.ndarray) -> Array:
    """Misses (N, 3) as the base sees them; those of readings that are no positions come from the first joint."""
    R_frame_base = model.T_frame_base[samples.frame][:, :3, :3]
    miss = errors.position[rows]
    of_root = miss @ model.chain.T_base_root[:3, :3].T
    return np.where(indirect[:, None], of_root, np.einsum("nji,nj->ni", R_frame_base, miss))


def _arms(model: Model, samples: Samples) -> list[Array]:
    """The polylines of the robot, (N, k, 3) each, in its base; the last ends at the tool."""
    twists = motion(model.effects, model.drivers(samples))[0] if model.effects else {}
    f = tool_frames(model.chain, model.T_tip_tool, samples.q, twists)
    T = model.chain.T_base_root
    p = np.moveaxis(f.p, -1, 0) @ T[:3, :3].T + T[:3, 3]  # (N, places, 3)
    base = np.zeros((len(samples), 1, 3))
    if not isinstance(model.chain, Delta):
        return [np.concatenate([base, p], axis=1)]
    tip = p[:, -2:-1] if model.chain.has_shaft else p[:, -1:]
    elbows = [p[:, i] + (f.loops[i].lever.T @ T[:3, :3].T) for i in range(1, 1 + ARMS)]
    arms = [np.concatenate([base, p[:, i : i + 1], elbows[i - 1][:, None], tip], axis=1) for i in range(1, 1 + ARMS)]
    return [*arms, np.concatenate([tip, p[:, -1:]], axis=1)]


def still(drawn: ReportScene) -> Chart:
    """The same from the side and from above, for paper and where no script runs."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.4, 3.6))
    places = ((0.085, 0.13, 0.41, 0.845), (0.58, 0.13, 0.41, 0.845))  # a layout that is found takes as long as drawing
    rows = spread_rows(len(drawn.points), _MOST_STILL)
    points = drawn.points[rows]
    before, after = 1e3 * drawn.stages[0][1][rows], 1e3 * drawn.stages[-1][1][rows]
    reach = float(np.ptp(points, axis=0).max()) or 1.0
    usual = float(np.percentile(np.linalg.norm(before, axis=1), 95)) or 1.0
    scale = float(f"{0.15e3 * reach / usual:.1g}")
    arm = drawn.paths[len(drawn.paths) // 2]
    for place, (i, j), seen in zip(places, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        axes = figure.add_axes(place)
        for path in arm:
            axes.plot(path[:, i], path[:, j], "-o", color=LIGHT["ink"], lw=2.0, ms=3.5)
        for miss, colour, wide in ((before, "before", 0.8), (after, "after", 1.4)):
            to = points + 1e-3 * scale * miss
            ends = np.stack([points, to, np.full_like(to, np.nan)], axis=1).reshape(-1, 3)
            axes.plot(ends[:, i], ends[:, j], color=LIGHT[colour], lw=wide)
        axes.plot(points[:, i], points[:, j], ".", ms=2.0, color=LIGHT["soft"])
        axes.set_aspect("equal", adjustable="datalim")
        axes.tick_params(labelsize=7.5)
        label(axes, f"{'xyz'[i]}, m ({seen})", f"{'xyz'[j]}, m")
        _scale_bar(axes, scale)
    alt = f"The arm and the errors of {len(points)} held-out samples, from above and from the side."
    words = (
        f"Errors are drawn {scale:g} times as long as they are: thin grey lines with the nominal model, "
        "thick blue ones with the final."
    )
    return chart(figure, "still", alt, words)


def _scale_bar(axes: Axes, scale: float) -> None:
    """A stroke as long as a round error is drawn, in the lower left corner."""
    axes.autoscale_view()
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    room = 0.25 * (right - left) / scale * 1e3  # mm of error
    mm = 10.0 ** np.floor(np.log10(room))
    mm *= max(m for m in (1.0, 2.0, 5.0) if m * mm <= room)
    x, y = left + 0.04 * (right - left), low + 0.05 * (high - low)
    axes.plot([x, x + 1e-3 * scale * mm], [y, y], "|-", color=LIGHT["ink"], lw=1.6, ms=5.0)
    axes.text(x, y + 0.02 * (high - low), f"{mm:g} mm of error", fontsize=7)
