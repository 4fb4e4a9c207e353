"""What a track tells of an articulated object: as data, and as one page that needs nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.articulation import Choice, JointFit, PlacedJoint, Track, sound
from modcal_core.geometry import Array, so3
from modcal_core.measurements import spread_rows
from modcal_core.report.figures import MAX_POINTS
from modcal_core.report.page import AFTER, BEFORE, LIGHT, OF_AXES, Chart, PageTable, as_script_data, number, render
from modcal_core.report.plots import CIRCLE, SQUARE, TRIANGLE, chart, columns, limits_to_scale, line_size, plot

if TYPE_CHECKING:
    from lets_plot.plot.core import PlotSpec


_MAX_SEEN, _MAX_PLACES = 400, 61  # that a page can show and a person look through
_BEYOND = 0.15  # of the path's size, by which the axis goes on beyond what turns about it
_HAND = 0.06  # m; the strokes of the handle's orientation are half a hand long


@dataclass(frozen=True)
class ObjectScene:
    """All in the frame of the track [m]. seen: measured places of the handle (N, 3). path: of the joint (k, 3).

    handles: orientation and position of the handle on the path (k, 4, 4); oriented: whether the orientation was
    measured. axis: its two ends (2, 3), and feet: the points on it beside the handle (k, 3), both None without an axis
    nearby. said: a sentence for each place on the path. frame: its name. alt: for those who do not see it.
    """

    seen: Array
    path: Array
    handles: Array
    oriented: bool
    axis: Array | None
    feet: Array | None
    said: tuple[str, ...]
    frame: str
    alt: str

    def to_data(self) -> dict[str, Any]:
        """What the page's script draws."""
        lines = [] if self.axis is None else [{"path": np.round(self.axis, 4).tolist(), "name": "axis"}]
        return {
            "points": np.round(self.path, 4).tolist(),
            "stages": [],
            "arms": [[np.round(line, 4).tolist() for line in self._object(k)] for k in range(len(self.path))],
            "shown": list(range(len(self.path))),
            "said": list(self.said),
            "route": True,
            "cloud": np.round(self.seen, 4).tolist(),
            "lines": lines,
            "base": self.frame,
            "local": True,
        }

    def _object(self, k: int) -> list[Array]:
        """Strokes (2, 3) of the object at a place: from the axis to the handle, and the handle's own directions."""
        at = self.handles[k, :3, 3]
        strokes = [] if self.feet is None else [np.stack([self.feet[k], at])]
        if self.oriented:
            strokes += [np.stack([at, at + 0.5 * _HAND * self.handles[k, :3, i]]) for i in range(3)]
        return strokes or [np.stack([at, at])]


def object_scene(
    model: PlacedJoint, a: Array, seen: Array, joint: dict[str, Any], scale: float, frame: str
) -> ObjectScene:
    """The scene of a joint over configurations a (n,), those of samples that are no outliers.

    seen: measured places (n, 3) [m]. joint: its ``axis`` and ``point`` as stated in JSON, where it has them. scale:
    from the unit of configurations to what people read, ° or mm. frame: of the track, may be empty.
    """
    over = np.linspace(a.min(), a.max(), _MAX_PLACES)
    T = model.pose(over)
    path = T[:, :3, 3]
    axis = feet = None
    if joint.get("axis") is not None and model.centre() is not None:
        direction, point = np.asarray(joint["axis"]), np.asarray(joint["point"])
        along = (path - point) @ direction
        feet = point + along[:, None] * direction
        size = float(np.linalg.norm(np.ptp(np.concatenate([path, feet]), axis=0)))
        ends = np.array([along.min() - _BEYOND * size, along.max() + _BEYOND * size])
        axis = point + ends[:, None] * direction
    unit = {"rad": "°", "m": " mm"}.get(model.unit, "")
    said = tuple(
        f"Joint at {scale * x:.1f}{unit}, of {scale * over[0]:.1f} to {scale * over[-1]:.1f}{unit} seen: "
        f"handle at x {p[0]:.3f}, y {p[1]:.3f}, z {p[2]:.3f} m."
        for x, p in zip(over, path, strict=True)
    )
    alt = f"The measured places of the handle, the path of a {model.kind} joint"
    alt += ", its axis, and the handle on it" if axis is not None else ", and the handle on it"
    few = seen[spread_rows(len(seen), _MAX_SEEN)]
    return ObjectScene(few, path, T, bool(model.oriented), axis, feet, said, frame or "the track's frame", alt)


_UNITS = {"rad": ("°", float(np.degrees(1.0))), "m": ("mm", 1e3), "1": ("", 1.0)}  # how people read them
_MAX_LEFT = 0.05  # m; what is farther is no residual of a joint, and would flatten the chart
_SIZE = (362, 310)  # px
_RATIO = 1.35  # width to height of what is between the axes, about


@dataclass(frozen=True)
class Articulation:
    """A choice, what it was made from, and by what names. source: of the file. frame: of the track, may be empty."""

    source: str
    frame: str
    track: Track
    choice: Choice


def _left(found: Articulation) -> tuple[Array, Array | None]:
    """What is left across the path: positions (n, 3) [m], and rotations (n, 3) [rad] or None."""
    fit, track = found.choice.fit, found.track
    T = fit.model.pose(fit.configurations)
    position = track.positions - T[:, :3, 3]
    if track.rotations is None or not fit.model.oriented:
        return position, None
    return position, so3.log(np.swapaxes(T[:, :3, :3], 1, 2) @ track.rotations)


def articulation_data(found: Articulation) -> dict[str, Any]:
    """What was found, as numbers and texts that JSON can hold."""
    choice, track = found.choice, found.track
    fit, model = choice.fit, choice.fit.model
    good = sound(fit, track)
    position, rotation = _left(found)
    lengths = np.linalg.norm(position[good], axis=1)
    a = fit.configurations[good]
    return {
        "modcal_articulation": 1,
        "source": found.source,
        "frame": found.frame,
        "measurement": "pose" if track.oriented else "point",
        "samples": len(track),
        "rejected": int((~good).sum()),
        "kind": choice.kind,
        "best": model.kind,
        "enough": bool(choice.enough),
        "probabilities": {kind: float(p) for kind, p in choice.probabilities.items()},
        "verdict": choice.why[:1].upper() + choice.why[1:] + ".",
        "rotations_followed": bool(choice.follows),
        "joint": _joint_data(fit),
        "configuration": {"unit": model.unit, "lower": float(a.min()), "upper": float(a.max())},
        "residual_mm": {
            "rms": 1e3 * float(np.sqrt(np.mean(lengths**2))),
            "p95": 1e3 * float(np.quantile(lengths, 0.95)),
        },
        "residual_deg": None
        if rotation is None
        else {"rms": float(np.degrees(np.sqrt(np.mean((rotation[good] ** 2).sum(axis=1)))))},
        "fails_between_m": None if choice.misfit.between is None else list(choice.misfit.between),
        "phases": [
            {
                "from_m": phase.begin,
                "to_m": phase.end,
                "kind": phase.choice.kind,
                "enough": bool(phase.choice.enough),
                "joint": _joint_data(phase.choice.fit),
            }
            for phase in choice.phases
        ],
    }


def _joint_data(fit: JointFit) -> dict[str, Any]:
    """Where a joint lies and what its shape is, and how well that is known."""
    data: dict[str, Any] = {**fit.model.data(fit.configurations, fit.std)}
    own = data.get("parameters", {})  # state their own
    std = {name: np.sqrt(np.diag(C)).tolist() for name, C in fit.covariance.items() if name not in (*own, "centre")}
    more: dict[str, Any] = {name: data.pop(name) for name in ("object", "parameters") if name in data}
    return {**data, "std": std, **more}


def articulation_html(found: Articulation) -> str:
    """The page as HTML text."""
    data = articulation_data(found)
    fit = found.choice.fit
    good, scale = _trusted(fit), _UNITS[fit.model.unit][1]
    seen = found.track.positions[good]
    drawn = object_scene(fit.model, fit.configurations[good], seen, data["joint"], scale, found.frame)
    return render(
        "articulation.html.j2",
        title=f"{found.source}: articulation",
        verdict=data["verdict"],
        tone="good" if data["enough"] else "warn",
        heading="Verdict" if data["enough"] else "Verdict: something is open",
        data=data,
        kind=data["kind"] if data["kind"] == data["best"] else f"{data['kind']}; the best is {data['best']}",
        tables=_tables(data),
        charts=_charts(found, data),
        scene=as_script_data(drawn.to_data()),
        scene_alt=drawn.alt,
        places=len(drawn.path),
    )


def _trusted(fit: JointFit) -> np.ndarray:
    """The samples to draw: no outliers, unless hardly any are left."""
    good = fit.weights > 0.2
    return good if good.sum() > 2 else np.ones(len(good), dtype=bool)


def _tables(data: dict[str, Any]) -> list[PageTable]:
    """Place of the joint and residual, as tables of lengths, angles and numbers."""
    joint, std = data["joint"], data["joint"]["std"]
    rows: dict[str, list[tuple[str, str, str]]] = {"mm": [], "°": [], "": []}

    def add(name: str, value: float, unit: str, factor: float = 1.0, deviation: float | None = None) -> None:
        known = deviation is not None and np.isfinite(deviation)
        rows[unit].append((name, number(factor * value), number(factor * deviation, 2) if known else ""))  # type: ignore[operator]

    if joint["point"] is not None:
        for k, name in enumerate("xyz"):
            add(f"point on the axis, {name}", joint["point"][k], "mm", 1e3, _component(std, "point", k))
        add("distance of the handle from the axis", joint["radius"], "mm", 1e3)
    if joint["pitch"] is not None:
        add("rise in a turn", joint["pitch"], "mm", 2e3 * np.pi, _component(std, "pitch", 0))
    if "object" in joint:
        for k, name in enumerate("xyz"):
            add(f"origin of the object, {name}", joint["object"][k], "mm", 1e3)
    if joint["axis"] is not None:
        for k, name in enumerate("xyz"):
            add(f"direction of the axis, {name}", joint["axis"][k], "", 1.0, _component(std, "axis", k))
        if (size := float(np.linalg.norm(std.get("axis", np.nan)))) and np.isfinite(size):
            add("the axis is known to (one standard deviation)", size, "°", np.degrees(1.0))
    for name, known in joint.get("parameters", {}).items():
        unit, factor = _UNITS.get(known["unit"], (known["unit"], 1.0))
        rows.setdefault(unit, [])
        add(name.replace("_", " "), known["value"], unit, factor, known["std"])
    seen = data["configuration"]
    unit, factor = _UNITS[seen["unit"]]
    add("motion that was seen", seen["upper"] - seen["lower"], unit, factor)
    add("residual, RMS", data["residual_mm"]["rms"], "mm")
    add("residual, 95th percentile", data["residual_mm"]["p95"], "mm")
    if data["residual_deg"] is not None:
        add("residual of the rotation, RMS", data["residual_deg"]["rms"], "°")
    titles = {"mm": "Lengths", "°": "Angles", "": "Numbers without a unit"}
    out = []
    for unit, found in rows.items():
        end = f", {unit}" if unit else ""
        deviations = any(row[2] for row in found)
        header = ("quantity", f"value{end}", f"± one standard deviation{end}")[: 3 if deviations else 2]
        if found:
            out.append(PageTable(titles.get(unit, f"In {unit}"), header, tuple(row[: len(header)] for row in found)))
    return out


def _component(std: dict[str, Any], name: str, k: int) -> float | None:
    """The standard deviation of one component of what the fit states; None where it states none."""
    return float(std[name][k]) if name in std and k < len(std[name]) else None


def _charts(found: Articulation, data: dict[str, Any]) -> list[Chart]:
    """The path in its own plane, and what is left along it."""
    path = chart(
        _path(found),
        "path",
        f"The measured path and that of a {data['best']} joint, in the plane of the path.",
        "The measured path as dots, that of the joint as a line, in the plane of the path; a cross is its axis.",
    )
    left, _ = _left(found)
    shown = np.linalg.norm(left, axis=1) < _MAX_LEFT
    far = int((~shown).sum())
    residual = chart(
        _along(found, left, shown, data["configuration"]["unit"]),
        "residual",
        f"Residual along the path: {data['residual_mm']['rms']:.2f} mm RMS.",
        "What the joint leaves along its motion: x, y and z in the frame of the track."
        + (f" {far} samples farther than {1e3 * _MAX_LEFT:.0f} mm are not shown." if far else ""),
    )
    return [path, residual]


def _path(found: Articulation) -> PlotSpec:
    """The measured path and that of the joint, in the plane of the path."""
    import lets_plot as lp

    fit, p = found.choice.fit, found.track.positions
    good = _trusted(fit)
    middle = p[good].mean(axis=0)
    plane = np.linalg.svd(p[good] - middle, full_matrices=False)[2][:2].T
    seen = 1e3 * ((p - middle) @ plane)[good][spread_rows(int(good.sum()), MAX_POINTS)]
    a = fit.configurations[good]
    path = 1e3 * (fit.model.position(np.linspace(a.min(), a.max(), 200)) - middle) @ plane
    drawn = plot(*_SIZE, "along the path, mm", "across it, mm", "top")
    place, every = lp.aes("x", "y", color="said"), [seen, path]
    for layer, points, said, size in ((lp.geom_point, seen, "seen", 2.6), (lp.geom_path, path, fit.model.kind, 1.8)):
        at = {"x": points[:, 0], "y": points[:, 1], "said": np.repeat(said, len(points))}
        drawn += layer(place, data=columns(at), size=line_size(size))
    if (point := fit.model.centre()) is not None:
        centre = 1e3 * (point - middle) @ plane
        drawn += lp.geom_point(x=centre[0], y=centre[1], shape=3, color=LIGHT[AFTER], size=line_size(8.0))
        every.append(centre[None])
    order = ["seen", fit.model.kind]
    key = lp.guide_legend(override_aes={"size": [1.6, 0.8], "linetype": ["blank", "solid"]})
    drawn += lp.scale_color_manual([LIGHT[BEFORE], LIGHT[AFTER]], breaks=order, limits=order, guide=key)
    if float(np.ptp(seen, axis=0).max()) < 1e-3:  # a picture needs some width
        every.append(np.array([[-1.0, -1.0], [1.0, 1.0]]))
    around = np.concatenate(every)
    x, y = limits_to_scale(around[:, 0], around[:, 1], _RATIO)
    drawn += lp.scale_x_continuous(expand=[0, 0]) + lp.scale_y_continuous(expand=[0, 0])
    return drawn + lp.coord_fixed(xlim=x, ylim=y)


def _along(found: Articulation, left: Array, shown: np.ndarray, of: str) -> PlotSpec:
    """What the joint leaves (N, 3) [m] of the samples that are shown, along its motion in this unit."""
    import lets_plot as lp

    unit, scale = _UNITS[of]
    rows = np.flatnonzero(shown)
    rows = rows[spread_rows(len(rows), MAX_POINTS // 3)]
    name = f"motion of the joint, {unit}" if unit else "motion of the joint"
    at = np.repeat(scale * found.choice.fit.configurations[rows], 3)
    of_axis = np.tile(list("xyz"), len(rows))
    drawn = plot(*_SIZE, name, "residual, mm", "top", at=at, left=1e3 * left[rows].ravel(), axis=of_axis)
    what = lp.aes("at", "left", color="axis", shape="axis")
    drawn += lp.geom_point(what, size=line_size(3.2), stroke=line_size(1.1))
    order = list("xyz")
    drawn += lp.scale_color_manual([LIGHT[colour] for colour in OF_AXES], breaks=order, limits=order)
    drawn += lp.scale_shape_manual([CIRCLE, TRIANGLE, SQUARE], breaks=order, limits=order)
    if shown.any():  # a few gross outliers do not stretch it
        reach = 1.15e3 * max(float(np.percentile(np.abs(left[shown]), 99.5)), 1e-6)
        drawn += lp.coord_cartesian(ylim=[-reach, reach])
    return drawn
