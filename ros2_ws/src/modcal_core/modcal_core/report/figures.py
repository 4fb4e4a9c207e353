"""Figures of a page: charts of residuals and effects, and the scene of an arm in three dimensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.effects import AXIS, JOINTS, LENGTH, RADIAL, Effect, component_names, curve, motion
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.measurements.kinds import indirect_rows
from modcal_core.outcome import Outcome, counted
from modcal_core.report.blocks import Scene3D
from modcal_core.report.charts import (
    AFTER,
    BAD,
    BEFORE,
    GOOD,
    LARGE,
    OF_AXES,
    SOFT,
    Axis,
    Chart,
    Panel,
)
from modcal_core.report.tables import percent
from modcal_core.robots import ARMS, Mechanism, is_delta, tool_frames

MAX_POSTURES, MAX_POINTS = 60, 500  # that a page can show and a person look through


def arm_lines(chain: Mechanism, T_tip_tool: Array, q: Array, twists: Mapping[int, Array] | None = None) -> list[Array]:
    """The polylines of an arm over its joints at postures q (N, n), (N, k, 3) [m] each, in its base; the last ends at
    the tool. twists: of its places, as ``tool_frames`` takes them.
    """
    frames = tool_frames(chain, T_tip_tool, q, twists)
    T = chain.T_base_root
    p = np.moveaxis(frames.p, -1, 0) @ T[:3, :3].T + T[:3, 3]  # (N, places, 3)
    base = np.zeros((len(q), 1, 3))
    if not is_delta(chain):
        return [np.concatenate([base, p], axis=1)]
    tip = p[:, -2:-1] if chain.has_shaft else p[:, -1:]
    arms = []
    for i in range(1, 1 + ARMS):
        elbow = p[:, i] + frames.loops[i].lever.T @ T[:3, :3].T
        arms.append(np.concatenate([base, p[:, i : i + 1], elbow[:, None], tip], axis=1))
    return [*arms, np.concatenate([tip, p[:, -1:]], axis=1)]


def joints_in_words(chain: Mechanism, q: Array) -> str:
    """A posture (n,) in degrees, and millimetres of sliding joints."""
    turning = chain.revolute
    values = (f"{np.degrees(x):.1f}°" if turns else f"{1e3 * x:.1f} mm" for x, turns in zip(q, turning, strict=True))
    return ", ".join(f"{name} {value}" for name, value in zip(chain.names, values, strict=True))


@dataclass(frozen=True)
class ShownPostures:
    """Postures of an arm that a scene shows. what: Posture, Station or Image. q: (N, n). rows: those that are shown."""

    chain: Mechanism
    q: Array
    what: str = "Posture"
    T_tip_tool: Array | None = None

    @property
    def rows(self) -> np.ndarray:
        """Numbers of the postures that are shown."""
        return spread_rows(len(self.q), MAX_POSTURES)

    def said(self, row: int) -> str:
        """A posture in words."""
        return f"{self.what} {row + 1} of {len(self.q)}: {joints_in_words(self.chain, self.q[row])}."

    def scene(self, alt: str, more: Sequence[str] = (), **others: Any) -> Scene3D:
        """The scene of these postures. more: a sentence for each that is shown. others: fields of the scene."""
        paths = arm_lines(self.chain, np.eye(4) if self.T_tip_tool is None else self.T_tip_tool, self.q[self.rows])
        said = [self.said(int(row)) for row in self.rows]
        said = [f"{one} {also}" for one, also in zip(said, more, strict=True)] if more else said
        given: dict[str, Any] = {"points": paths[-1][:, -1], "shown": np.arange(len(said)), **others}
        arms = [[path[k] for path in paths] for k in range(len(said))]
        return Scene3D(arms=arms, said=said, base=self.chain.base, alt=alt, **given)

    def discs(self, of: str, shares: Array, more: Sequence[str]) -> Scene3D:
        """The same with a disc at each joint. of: what the shares (n,) are of. more: as of :meth:`scene`."""
        each = ", ".join(f"{name} {percent(share)}" for name, share in zip(self.chain.names, shares, strict=True))
        weights = [] if self.chain.closed else np.minimum(shares, 1.0).tolist()  # a Delta's line skips joints
        return self.scene(f"The arm; a disc at each joint shows the share of {of}: {each}", more, weights=weights)


MAX_ARROWS = 300
_MAX_STAGES = 7


def scene(report: Outcome) -> Scene3D | None:
    """The arm and what each held-out sample misses by; None if no model or no sample is at hand."""
    model, scored = report.model, report.scored
    if model is None or not len(scored):
        return None
    rows = spread_rows(len(scored), MAX_ARROWS)
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
        of_base = np.einsum("nji,nj->ni", R_frame_base, miss)
        stages.append((name, 1e3 * np.where(indirect[:, None], of_root, of_base)))
    twists = motion(model.effects, model.drivers(samples))[0] if model.effects else None
    places = arm_lines(model.chain, model.T_tip_tool, samples.q, twists)
    shown = spread_rows(len(samples), MAX_POSTURES)
    return Scene3D(
        points=places[-1][:, -1],
        arms=tuple(tuple(path[k] for path in places) for k in shown),
        shown=shown,
        said=(),
        base=model.chain.base,
        alt="The arm and an arrow for the error of every held-out sample",
        stages=tuple(stages),
        names=tuple(f"station {int(s)}" for s in samples.station),
    )


MAX_MARKS = 1200  # more make the page heavy and show no more
_SETS = (("train", "circle", SOFT), ("explain", "square", GOOD), ("held_out", "triangle", AFTER))
_MAX_REJECTED = 300
_WIDE = 532.0  # points; of the stations over time


def error_histogram(report: Outcome) -> list[Chart]:
    """How often the tool misses by how much on the held-out set, before and after, on a logarithmic axis."""
    norms = {stage: 1e3 * report.errors[stage].position_norm for stage in ("final", "nominal")}
    if not len(norms["final"]):
        return []
    smallest = max(min(float(np.percentile(n, 1)) for n in norms.values()), 1e-5)
    largest = max(float(n.max()) for n in norms.values())
    bins = np.geomspace(0.8 * smallest, max(1.2 * largest, 2.0 * smallest), 40)
    counts = {stage: np.histogram(np.clip(n, bins[0], None), bins)[0] for stage, n in norms.items()}
    said = [f"{stage}: {np.sqrt(np.mean(norms[stage] ** 2)):.3f} mm RMS" for stage in ("nominal", "final")]
    x = Axis.decades("position error of held-out samples, mm", float(bins[0]), float(bins[-1]))
    y = Axis("samples", 0.0, 1.05 * max(1, *(int(count.max()) for count in counts.values())), whole=True)
    panel = Panel(x, y, *LARGE, keys=((said[0], BEFORE, "square"), (said[1], AFTER, "bar")))
    for stage, colour, full in (("final", AFTER, 1.0), ("nominal", BEFORE, 0.0)):  # outlines over bars
        seen = np.flatnonzero(counts[stage])
        panel.bars((bins[seen], bins[seen + 1]), (np.zeros(len(seen)), counts[stage][seen]), colour, full)
    alt = f"Histogram of held-out position errors. {'; '.join(said)}."
    words = "Held-out samples with an error of this size: outlined with the nominal model, solid with the final."
    return [panel.chart("histogram", alt, words)]


def timeline(report: Outcome) -> list[Chart]:
    """The stations in the order of their time, what each was used for, and those that were left out."""
    samples = report.samples
    if not len(report.residuals) or not len(samples):
        return []
    wrong = report.wrong if len(report.wrong) == len(samples) else np.zeros(len(samples), bool)
    miss, time = 1e3 * np.maximum(report.residuals, 1e-9), (samples.stamps - samples.stamps.min()) / 60.0
    sizes = report.set_sizes()
    marks: list[tuple[np.ndarray, str, str, str]] = []
    for name, shape, colour in _SETS:
        rows = getattr(report.sets, name)
        rows = rows[~wrong[rows]]
        rows = rows[spread_rows(len(rows), MAX_MARKS // 6)]
        marks.append((rows, f"{name.replace('_', '-')} ({sizes[name]})", colour, shape))
    out = report.rejected_rows()[:_MAX_REJECTED]
    marks.append((out, f"rejected ({len(out)})", BAD, "cross"))
    marks = [mark for mark in marks if len(mark[0])]
    every = np.concatenate([rows for rows, *_ in marks])
    x = Axis.around("time since the first sample, min", time)
    y = Axis.decades("error of the final model, mm", float(miss[every].min()), float(miss[every].max()) * (1.0 + 1e-6))
    panel = Panel(x, y, _WIDE, LARGE[1], keys=tuple((said, colour, shape) for _, said, colour, shape in marks))
    for rows, _, colour, shape in marks:
        panel.marks(time[rows], miss[rows], colour, shape, 0.9)
    over = f"{samples.stations} stations over {time.max():.1f} minutes"
    alt = f"Error of the final model at {over}; {counted(report.rejected_stations(), 'station')} rejected."
    words = "Circles fitted the model, squares chose the effects, triangles scored it; crosses were rejected."
    return [panel.chart("timeline", alt, words)]


_MAX_TEMPERATURES = 4


def residual_charts(report: Outcome) -> list[Chart]:
    """What the final model leaves of the scored samples, against each joint, time and the recorded temperatures."""
    scored, model = report.scored, report.model
    if not len(scored):
        return []
    units = ["rad or m"] * len(scored.names)
    axes = [("time", "time, min", (scored.stamps - report.samples.stamps.min()) / 60.0)]
    if model is not None:
        units = ["rad" if turning else "m" for turning in model.chain.revolute]
        at = model.drivers(scored)
        heat = [name for name in at.signal_names() if name.startswith("temperature:")][:_MAX_TEMPERATURES]
        axes += [(name.replace(":", " of "), f"{name.replace(':', ' of ')}, °C", at.values(name)) for name in heat]
    joints = [(n, f"{n}, {unit}", q) for n, unit, q in zip(scored.names, units, scored.q.T, strict=True)]
    rows = spread_rows(len(scored), MAX_MARKS // 3)
    left = 1e3 * report.errors["final"].position[rows]
    rms = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    out = []
    for i, (name, words, values) in enumerate([*joints, *axes]):
        panel = residual_panel(words, values[rows], left)
        out.append(panel.chart(f"left-{i}", f"Residual against {name}: {rms:.3f} mm RMS.", f"against {name}"))
    return out


def residual_panel(words: str, x: Array, y: Array) -> Panel:
    """The three components of residuals (N, 3) [mm] at x (N,); a few far ones do not stretch the panel."""
    reach = 1.15 * max(float(np.percentile(np.abs(y), 99.5)) if len(y) else 1.0, 1e-6)
    panel = Panel(Axis.around(words, x if len(x) else np.zeros(1)), Axis("residual, mm", -reach, reach))
    for k, (colour, shape) in enumerate(OF_AXES):
        panel.marks(x, y[:, k], colour, shape)
    return panel


_POINTS, _MAX_CORNERS = 1600, 240  # of a curve: computed, and drawn
_MAX_SHAPES = 24  # charts; more are looked at by nobody
_MAX_WAVES, _DRAWN_WAVES = 20, 6  # more than the first make a grey block of a small chart
_MAX_TICKS = 250  # of samples, below the curve
_UNITS = {
    **dict.fromkeys(("position", "following"), "rad"),
    **dict.fromkeys(("load", "effort"), "N m"),
    **{"payload": "N m per kg", "direction": "−1 or 1", "temperature": "°C"},
}
_SHIFTS = ("x", "y", "z", LENGTH)


def effect_shapes(report: Outcome) -> tuple[Chart, ...]:
    """A chart for each direction of each effect that follows one number; none of what is a single number."""
    out: list[Chart] = []
    for finding in report.effects:
        drawn = tuple(e for e in finding.effects if _is_curve(e) and e.driver == finding.effects[0].driver)
        if drawn and report.model is not None:
            driver = report.model.drivers(report.samples).values(drawn[0].driver, drawn[0].lag)
            for component in range(len(component_names(drawn[0]))):
                if len(out) < _MAX_SHAPES:
                    out.append(_shape(report, drawn, driver, component, f"shape{len(out)}"))
    return tuple(out)


def _is_curve(effect: Effect) -> bool:
    kind = effect.driver.partition(":")[0]
    many = effect.direction in (JOINTS, RADIAL) or "," in effect.driver
    return not many and kind not in ("velocity", "reading", "constant", "moment", "weight", "tip_weight", "path")


def _shape(report: Outcome, effects: tuple[Effect, ...], driver: Array, component: int, name: str) -> Chart:
    effect, direction = effects[0], component_names(effects[0])[component]
    x, size, std = curve(effects, float(driver.min()), float(driver.max()), _POINTS, component)
    at, words = driver, _words(report, effect.driver)
    if effect.driver == "time":
        begin = float(report.samples.stamps.min())
        x, at, words = (x - begin) / 60.0, (driver - begin) / 60.0, "time, min"
    slides = direction == AXIS and not _turns(report, effect.place)
    unit = "mm" if direction in _SHIFTS or slides else "mrad"
    shown = _few_waves(size)
    rows = np.arange(len(x))[shown]
    rows = rows[spread_rows(len(rows), _MAX_CORNERS)]
    x, size, std = x[rows], size[rows], std[rows]
    at = at[(at >= x[0]) & (at <= x[-1])]
    low, high = (1e3 * (size + k * std) for k in (-2.0, 2.0))
    panel = Panel(Axis.around(words, x, 0.05), Axis.around(f"{direction}, {unit}", np.r_[low, high], 0.05))
    panel.band(x, low, high, BEFORE)
    panel.line(x, 1e3 * size, AFTER, 1.1)
    panel.rug(np.sort(at)[spread_rows(len(at), _MAX_TICKS)], SOFT)
    title = f"{effect.place}, {direction}: {effect.family.replace('_', ' ')}"
    if shown != slice(None):
        title += ", a part of its range"
    alt = (
        f"{title} over {words}: {1e3 * float(size.min()):.3g} to {1e3 * float(size.max()):.3g} {unit}, with a standard "
        f"deviation of up to {1e3 * float(std.max()):.2g} {unit}."
    )
    return panel.chart(name, alt, title)


def _few_waves(size: Array) -> slice:
    """The points (N,) of a curve that are drawn: of many waves a few in the middle, of which each can be seen."""
    over = size > size.mean()
    turns = np.flatnonzero(over[1:] != over[:-1])
    if len(turns) <= 2 * _MAX_WAVES:
        return slice(None)
    middle = len(turns) // 2
    return slice(int(turns[middle - _DRAWN_WAVES]), int(turns[middle + _DRAWN_WAVES]) + 2)


def _turns(report: Outcome, place: str) -> bool:
    chain = report.model.chain if report.model is not None else None
    return chain is None or place not in chain.names or bool(chain.revolute[chain.names.index(place)])


def _words(report: Outcome, driver: str) -> str:
    """A driver for people, with its unit."""
    kind, _, of = driver.partition(":")
    if kind not in _UNITS:
        return of if kind == "signal" else driver.replace(":", " of ")
    unit = _UNITS[kind] if _turns(report, of) else _UNITS[kind].replace("N m", "N").replace("rad", "m")
    return f"{'load' if kind in ('effort', 'payload') else kind} of {of}, {unit}"
