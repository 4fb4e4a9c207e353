"""What a track tells of an articulated object: as data, and as one page that needs nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.articulation.choice import Choice, gross
from modcal_core.articulation.fit import JointFit
from modcal_core.articulation.track import Track
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.thinning import spread_rows
from modcal_core.report.effect_tables import number
from modcal_core.report.figures import MOST_POINTS, label, small
from modcal_core.report.object_scene import ObjectScene, object_scene
from modcal_core.report.page import Chart, PageTable, as_script_data, chart, render
from modcal_core.report.palette import LIGHT, OF_AXES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_UNITS = {"rad": ("°", float(np.degrees(1.0))), "m": ("mm", 1e3), "1": ("", 1.0)}  # how people read them
_MOST_LEFT = 0.05  # m; what is farther is no residual of a joint, and would flatten the chart


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


def to_json_data(found: Articulation) -> dict[str, Any]:
    """What was found, as numbers and texts that JSON can hold."""
    choice, track = found.choice, found.track
    fit, model = choice.fit, choice.fit.model
    used = track if model.oriented else track.points()
    good = np.logical_not(gross(fit, used))
    good = good if good.any() else np.ones(len(track), dtype=bool)
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
        "configuration": {
            "unit": model.unit,
            "lower": float(a.min()),
            "upper": float(a.max()),
        },
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


def to_html(found: Articulation) -> str:
    """The page as HTML text."""
    data = to_json_data(found)
    drawn = _scene(found, data)
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


def _scene(found: Articulation, data: dict[str, Any]) -> ObjectScene:
    """The object in three dimensions, over what was seen of its motion."""
    fit = found.choice.fit
    good = _trusted(fit)
    scale = _UNITS[fit.model.unit][1]
    seen = found.track.positions[good]
    return object_scene(fit.model, fit.configurations[good], seen, data["joint"], scale, found.frame)


def _trusted(fit: JointFit) -> np.ndarray:
    """The samples to draw: no outliers, unless hardly any are left."""
    good = fit.weights > 0.2
    return good if good.sum() > 2 else np.ones(len(good), dtype=bool)


def _tables(data: dict[str, Any]) -> list[PageTable]:
    """Where the joint lies and what is left over: lengths, angles and pure numbers apart."""
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
    fit = found.choice.fit
    figure, axes = small(3.4, 2.9)
    _draw_path(axes, found)
    path = chart(
        figure,
        "path",
        f"The measured path and that of a {data['best']} joint, in the plane of the path.",
        "The measured path as dots, that of the joint as a line, in the plane of the path; a cross is its axis.",
    )
    left, _ = _left(found)
    unit, scale = _UNITS[data["configuration"]["unit"]]
    shown = np.linalg.norm(left, axis=1) < _MOST_LEFT
    figure, axes = small(3.4, 2.9)
    for k, (colour, marker) in enumerate(zip(OF_AXES, "o^s", strict=True)):
        x, y = scale * fit.configurations[shown], 1e3 * left[shown, k]
        rows = spread_rows(len(x), MOST_POINTS // 3)
        axes.plot(x[rows], y[rows], marker, ms=2.8, mfc="none", mew=0.7, color=LIGHT[colour], label="xyz"[k])
    if shown.any():  # a few gross outliers do not stretch it
        reach = 1.15e3 * max(float(np.percentile(np.abs(left[shown]), 99.5)), 1e-6)
        axes.set_ylim(-reach, reach)
    label(axes, f"motion of the joint, {unit}" if unit else "motion of the joint", "residual, mm")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 0.97), frameon=False, fontsize=7.5, ncols=3)
    far = int((~shown).sum())
    residual = chart(
        figure,
        "residual",
        f"Residual along the path: {data['residual_mm']['rms']:.2f} mm RMS.",
        "What the joint leaves along its motion: x, y and z in the frame of the track."
        + (f" {far} samples farther than {1e3 * _MOST_LEFT:.0f} mm are not shown." if far else ""),
    )
    return [path, residual]


def _draw_path(axes: Axes, found: Articulation) -> None:
    fit, p = found.choice.fit, found.track.positions
    good = _trusted(fit)
    middle = p[good].mean(axis=0)
    plane = np.linalg.svd(p[good] - middle, full_matrices=False)[2][:2].T
    flat = (p - middle) @ plane
    seen = flat[good][spread_rows(int(good.sum()), MOST_POINTS)]
    axes.plot(*(1e3 * seen).T, ".", ms=3.0, color=LIGHT["before"], label="seen")
    a = fit.configurations[good]
    path = (fit.model.position(np.linspace(a.min(), a.max(), 200)) - middle) @ plane
    axes.plot(*(1e3 * path).T, color=LIGHT["after"], lw=1.2, label=fit.model.kind)
    if (point := fit.model.centre()) is not None:
        centre = (point - middle) @ plane
        axes.plot(1e3 * centre[0], 1e3 * centre[1], "+", ms=8.0, color=LIGHT["after"])
    still = float(np.ptp(flat, axis=0).max()) < 1e-6
    if still:  # a picture needs some width
        axes.set(xlim=(-1.0, 1.0), ylim=(-1.0, 1.0))
    axes.set_aspect("equal", adjustable="box" if still else "datalim")
    label(axes, "along the path, mm", "across it, mm")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 0.97), frameon=False, fontsize=7.5, ncols=2)
