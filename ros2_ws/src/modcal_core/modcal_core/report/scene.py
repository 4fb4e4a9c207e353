"""The robot in three dimensions with what each held-out sample misses by: data for the page, and a still picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.calibration import Model
from modcal_core.effects import motion
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import indirect_rows
from modcal_core.report.contents import ReportContents
from modcal_core.report.page import AFTER, BEFORE, INK, LIGHT, SOFT, Chart
from modcal_core.report.plots import chart, columns, limits_to_scale, line_size, plot
from modcal_core.robots import ARMS, Delta, tool_frames

if TYPE_CHECKING:
    from lets_plot.plot.core import PlotSpec

MAX_ARROWS = 300
_MAX_POSTURES = 60
_MAX_STILL = 120  # arrows of the still picture, which cannot be turned or zoomed
_MAX_STAGES = 7
_WIDE, _HIGH = 386, 384  # px, either half of the still picture
_RATIO = 1.0  # width to height of what is between its axes, about


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
    rows = spread_rows(len(scored), int(share * MAX_ARROWS))
    samples = scored.select(rows)
    indirect = indirect_rows(samples)
    named = [("nominal model", report.errors["nominal"]), *((s.added, s.errors) for s in report.steps)]
    named = [*named[: _MAX_STAGES - 1], *named[-1:]] if len(named) > _MAX_STAGES else named
    # misses as the base sees them; those of readings that are no positions come from the first joint
    R_frame_base = model.T_frame_base[samples.frame][:, :3, :3]
    stages = []
    for name, errors in named:
        miss = errors.position[rows]
        of_root = miss @ model.chain.T_base_root[:3, :3].T
        stages.append((name, np.where(indirect[:, None], of_root, np.einsum("nji,nj->ni", R_frame_base, miss))))
    places = _arms(model, samples)
    shown = spread_rows(len(samples), max(int(share * _MAX_POSTURES), 8))
    paths = tuple(tuple(path[k] for path in places) for k in shown)
    names = tuple(f"station {int(s)}" for s in samples.station)
    return ReportScene(places[-1][:, -1], tuple(stages), paths, shown, names, bool(indirect.any()), model.chain.base)


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
    import lets_plot as lp

    rows = spread_rows(len(drawn.points), _MAX_STILL)
    points = drawn.points[rows]
    before, after = 1e3 * drawn.stages[0][1][rows], 1e3 * drawn.stages[-1][1][rows]
    reach = float(np.ptp(points, axis=0).max()) or 1.0
    usual = float(np.percentile(np.linalg.norm(before, axis=1), 95)) or 1.0
    scale = float(f"{0.15e3 * reach / usual:.1g}")
    arm = drawn.paths[len(drawn.paths) // 2]
    views = [
        _view(points, ((before, BEFORE, 1.2), (after, AFTER, 2.1)), scale, arm, axes, seen)
        for axes, seen in (((0, 1), "from above"), ((0, 2), "from the side"))
    ]
    alt = f"The arm and the errors of {len(points)} held-out samples, from above and from the side."
    words = (
        f"Errors are drawn {scale:g} times as long as they are: thin grey lines with the nominal model, "
        "thick blue ones with the final."
    )
    return chart(lp.gggrid(views, hspace=16) + lp.ggsize(2 * _WIDE + 16, _HIGH), "still", alt, words)


def _view(
    points: Array,
    misses: tuple[tuple[Array, str, float], ...],
    scale: float,
    arm: tuple[Array, ...],
    axes: tuple[int, int],
    seen: str,
) -> PlotSpec:
    """The arm, the points (N, 3) [m] and their misses, each (N, 3) [mm], a colour and a width, along two axes."""
    import lets_plot as lp

    i, j = axes
    x, y = (f"{'xyz'[i]}, m ({seen})", f"{'xyz'[j]}, m")
    view = plot(_WIDE, _HIGH, x, y)
    place = lp.aes("x", "y")
    for path in arm:
        at = columns({"x": path[:, i], "y": path[:, j]})
        view += lp.geom_path(place, data=at, color=LIGHT[INK], size=line_size(3.0))
        view += lp.geom_point(place, data=at, color=LIGHT[INK], size=line_size(5.2))
    tips = [points + 1e-3 * scale * miss for miss, *_ in misses]
    for to, (_, colour, width) in zip(tips, misses, strict=True):
        ends = {"x": points[:, i], "y": points[:, j], "to_x": to[:, i], "to_y": to[:, j]}
        view += lp.geom_segment(
            lp.aes("x", "y", xend="to_x", yend="to_y"), data=columns(ends), color=LIGHT[colour], size=line_size(width)
        )
    at = columns({"x": points[:, i], "y": points[:, j]})
    view += lp.geom_point(place, data=at, color=LIGHT[SOFT], size=line_size(2.6))
    every = np.concatenate([points, *tips, *arm])
    (left, right), (low, high) = limits_to_scale(every[:, i], every[:, j], _RATIO)
    room = 0.25 * (right - left) / scale * 1e3
    decade = 10.0 ** np.floor(np.log10(room))
    mm = float(max(m * decade for m in (1.0, 2.0, 5.0) if m * decade <= room))
    at_x, at_y, tall = left + 0.04 * (right - left), low + 0.04 * (high - low), 0.01 * (high - low)
    bar = {"color": LIGHT[INK], "size": line_size(2.0)}
    end = at_x + 1e-3 * scale * mm
    view += lp.geom_segment(x=at_x, xend=end, y=at_y, yend=at_y, **bar)
    for side in (at_x, end):
        view += lp.geom_segment(x=side, xend=side, y=at_y - tall, yend=at_y + tall, **bar)
    view += lp.geom_text(
        x=at_x, y=at_y + 0.025 * (high - low), label=f"{mm:g} mm of error", size=5.0, hjust=0, vjust=0, color=LIGHT[INK]
    )
    view += lp.scale_x_continuous(expand=[0, 0]) + lp.scale_y_continuous(expand=[0, 0])
    return view + lp.coord_fixed(xlim=[left, right], ylim=[low, high])
