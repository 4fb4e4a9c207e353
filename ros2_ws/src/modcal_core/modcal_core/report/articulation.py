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
from modcal_core.report.figures import label
from modcal_core.report.page import Chart, chart, render
from modcal_core.report.palette import LIGHT, OF_AXES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = {"rad": (180.0 / np.pi, "deg"), "m": (1e2, "cm"), "1": (1.0, "")}  # how people read configurations


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
    return render(
        "articulation.html.j2",
        title=found.source,
        verdict=data["verdict"],
        tone="good" if data["enough"] else "warn",
        heading="Verdict" if data["enough"] else "Verdict: something is open",
        data=data,
        joint=_rows(data),
        picture=_picture(found, data),
    )


def _rows(data: dict[str, Any]) -> list[tuple[str, str]]:
    joint, std = data["joint"], data["joint"]["std"]

    def spread(name: str, scale: float, unit: str) -> str:
        size = float(np.linalg.norm(std[name])) if name in std else np.nan
        return f" ± {scale * size:.2g} {unit}" if np.isfinite(size) else ""

    def numbers(values: list[float]) -> str:
        return " ".join(f"{v:.4f}" for v in values)

    rows = [("kind", data["kind"] if data["kind"] == data["best"] else f"{data['kind']}; the best is {data['best']}")]
    if joint["axis"] is not None:
        rows.append(("axis", numbers(joint["axis"]) + spread("axis", 180.0 / np.pi, "deg")))
    if joint["point"] is not None:
        rows.append(("on the axis, m", numbers(joint["point"]) + spread("point", 1e3, "mm")))
        rows.append(("distance of the handle", f"{1e3 * joint['radius']:.1f} mm"))
    if joint["pitch"] is not None:
        rows.append(("rise", f"{2e3 * np.pi * joint['pitch']:.2f} mm a turn{spread('pitch', 2e3 * np.pi, 'mm')}"))
    for name, known in joint.get("parameters", {}).items():
        unit = "" if known["unit"] == "1" else f" {known['unit']}"
        rows.append((name, f"{known['value']:.4g} ± {known['std']:.2g}{unit}"))
    if "object" in joint:
        rows.append(("the object's origin, m", numbers(joint["object"][:3])))
    span = data["configuration"]["upper"] - data["configuration"]["lower"]
    scale, unit = _SHOWN[data["configuration"]["unit"]]
    rows.append(("seen", f"{scale * span:.1f} {unit}".rstrip()))
    rows.append(("left over", f"{data['residual_mm']['rms']:.2f} mm RMS, {data['residual_mm']['p95']:.2f} mm at 95 %"))
    if data["residual_deg"] is not None:
        rows.append(("residual, rotation", f"{data['residual_deg']['rms']:.2f} deg RMS"))
    return rows


def _picture(found: Articulation, data: dict[str, Any]) -> Chart:
    """The path in its own plane, and what is left along it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.0), layout="constrained")
    side, along = figure.subplots(1, 2)
    _draw_path(side, found)
    fit = found.choice.fit
    left, _ = _left(found)
    scale, unit = _SHOWN[data["configuration"]["unit"]]
    shown = np.linalg.norm(left, axis=1) < 0.05
    for k, (colour, marker) in enumerate(zip(OF_AXES, "o^s", strict=True)):
        x, y = scale * fit.configurations[shown], 1e3 * left[shown, k]
        along.plot(x, y, marker, ms=2.2, mfc="none", mew=0.6, color=LIGHT[colour], label="xyz"[k])
    label(along, f"configuration, {unit}" if unit else "configuration", "residual, mm")
    along.legend(loc="upper right", frameon=False, fontsize=8, ncols=3)
    alt = f"The path of a {data['best']} joint and its residual: {data['residual_mm']['rms']:.2f} mm RMS."
    words = "Left: the measured path, in the plane of the path, and the joint's own path. Right: the residual along it."
    return chart(figure, "path", alt, words)


def _draw_path(axes: Axes, found: Articulation) -> None:
    fit, p = found.choice.fit, found.track.positions
    good = fit.weights > 0.2
    good = good if good.sum() > 2 else np.ones(len(p), dtype=bool)
    middle = p[good].mean(axis=0)
    plane = np.linalg.svd(p[good] - middle, full_matrices=False)[2][:2].T
    flat = (p - middle) @ plane
    axes.plot(*(1e2 * flat[good]).T, ".", ms=2.0, color=LIGHT["before"], label="seen")
    a = fit.configurations[good]
    path = (fit.model.position(np.linspace(a.min(), a.max(), 200)) - middle) @ plane
    axes.plot(*(1e2 * path).T, color=LIGHT["after"], lw=1.2, label=fit.model.kind)
    if (point := fit.model.centre()) is not None:
        centre = (point - middle) @ plane
        axes.plot(1e2 * centre[0], 1e2 * centre[1], "+", ms=8.0, color=LIGHT["after"])
    axes.set_aspect("equal", adjustable="datalim")
    label(axes, "cm", "cm")
    axes.legend(loc="upper right", frameon=False, fontsize=8)
