"""What a track tells of an articulated object: as data, and as one page that needs nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.articulation.choice import Choice, gross
from modcal_core.articulation.joints import KINDS
from modcal_core.articulation.track import Track
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.report.figures import svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{{ data.source }}</title>
<style>
  body { font: 16px/1.5 system-ui, sans-serif; color: #1c2330; }
  body { max-width: 60rem; margin: 2.5rem auto; padding: 0 1.2rem; }
  h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2.2rem; }
  .verdict { font-size: 1.15rem; padding: .4rem 1rem; background: #f5f8fd; }
  .verdict { border-left: 4px solid {{ "#3a7d44" if data.enough else "#d9a441" }}; }
  table { border-collapse: collapse; } td { padding: .3rem .9rem .3rem 0; border-bottom: 1px solid #dde3ec; }
  td.n { text-align: right; font-variant-numeric: tabular-nums; }
  .soft { color: #667085; } svg { max-width: 100%; height: auto; }
</style>
</head>
<body>
<h1>{{ data.source }}</h1>
<p class="verdict">{{ data.verdict }}</p>
<p class="soft">{{ data.samples }} {{ data.measurement }}s in frame {{ data.frame or "without a name" }},
{{ data.rejected }} of them gross outliers.
{% if not data.rotations_followed %}The rotations that were seen are not the handle's: the grasp turned.{% endif %}</p>
<h2>What it may be</h2>
<table>
{% for kind, p in data.probabilities.items() %}
<tr><td>{{ kind }}</td><td class="n">{{ "%.1f %%"|format(100 * p) }}</td></tr>
{% endfor %}
</table>
<h2>The joint</h2>
<table>
{% for name, text in joint %}<tr><td>{{ name }}</td><td>{{ text }}</td></tr>
{% endfor %}
</table>
<h2>Path and what is left</h2>
{{ figure|safe }}
</body>
</html>
"""


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
    std = {name: [float(v) for v in np.sqrt(np.diag(C))] for name, C in fit.covariance.items() if name != "centre"}
    a = fit.configurations[good]
    return {
        "modcal_articulation": 1,
        "source": found.source,
        "frame": found.frame,
        "measurement": "pose" if track.oriented else "point",
        "samples": len(track),
        "rejected": int((~good).sum()),
        "kind": model.kind,
        "enough": bool(choice.enough),
        "probabilities": {kind: float(choice.probabilities[kind]) for kind in KINDS},
        "verdict": choice.why[:1].upper() + choice.why[1:] + ".",
        "rotations_followed": bool(choice.follows),
        "joint": {
            "axis": model.axis.tolist() if model.kind != "rigid" else None,
            "point": model.point.tolist() if model.turns else None,
            "radius": model.radius if model.turns else None,
            "pitch": model.pitch if model.kind == "screw" else None,
            "start": se3.to_pose(model.start).tolist(),
            "std": std,
        },
        "configuration": {
            "unit": "rad" if model.turns else "m",
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
    }


def to_html(found: Articulation) -> str:
    """The page as HTML text."""
    from jinja2 import Environment

    data = to_json_data(found)
    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(_PAGE)
    return page.render(data=data, joint=_rows(data), figure=_figure(found))


def _rows(data: dict[str, Any]) -> list[tuple[str, str]]:
    joint, std = data["joint"], data["joint"]["std"]

    def spread(name: str, scale: float, unit: str) -> str:
        size = float(np.linalg.norm(std[name])) if name in std else np.nan
        return f" ± {scale * size:.2g} {unit}" if np.isfinite(size) else ""

    def numbers(values: list[float]) -> str:
        return " ".join(f"{v:.4f}" for v in values)

    rows = [("kind", data["kind"])]
    if joint["axis"] is not None:
        rows.append(("axis", numbers(joint["axis"]) + spread("axis", 180.0 / np.pi, "deg")))
    if joint["point"] is not None:
        rows.append(("on the axis, m", numbers(joint["point"]) + spread("point", 1e3, "mm")))
        rows.append(("distance of the handle", f"{1e3 * joint['radius']:.1f} mm"))
    if joint["pitch"] is not None:
        rows.append(("rise", f"{2e3 * np.pi * joint['pitch']:.2f} mm a turn{spread('pitch', 2e3 * np.pi, 'mm')}"))
    span = data["configuration"]["upper"] - data["configuration"]["lower"]
    rows.append(
        ("seen", f"{np.degrees(span):.1f} deg" if data["configuration"]["unit"] == "rad" else f"{1e2 * span:.1f} cm")
    )
    rows.append(("left over", f"{data['residual_mm']['rms']:.2f} mm RMS, {data['residual_mm']['p95']:.2f} mm at 95 %"))
    if data["residual_deg"] is not None:
        rows.append(("", f"{data['residual_deg']['rms']:.2f} deg RMS"))
    return rows


def _figure(found: Articulation) -> str:
    """The path in its own plane, and what is left along it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    side, along = figure.subplots(1, 2)
    _draw_path(side, found)
    fit = found.choice.fit
    left, _ = _left(found)
    scale, unit = (180.0 / np.pi, "deg") if fit.model.turns else (1e2, "cm")
    shown = np.linalg.norm(left, axis=1) < 0.05
    for k, colour in enumerate(("#d1495b", "#3a7d44", "#1f6feb")):
        along.plot(scale * fit.configurations[shown], 1e3 * left[shown, k], ".", ms=2.0, color=colour, label="xyz"[k])
    along.set_xlabel(f"configuration, {unit}")
    along.set_ylabel("left over, mm")
    along.legend(frameon=False, fontsize=8, ncols=3)
    return svg(figure)


def _draw_path(axes: Axes, found: Articulation) -> None:
    fit, p = found.choice.fit, found.track.positions
    good = fit.weights > 0.2
    good = good if good.sum() > 2 else np.ones(len(p), dtype=bool)
    middle = p[good].mean(axis=0)
    plane = np.linalg.svd(p[good] - middle, full_matrices=False)[2][:2].T
    flat = (p - middle) @ plane
    axes.plot(*(1e2 * flat[good]).T, ".", ms=2.0, color="#b0b7c3", label="seen")
    a = fit.configurations[good]
    path = (fit.model.position(np.linspace(a.min(), a.max(), 200)) - middle) @ plane
    axes.plot(*(1e2 * path).T, color="#1f6feb", lw=1.2, label=fit.model.kind)
    if fit.model.turns and fit.model.radius < 2.0:
        centre = (fit.model.point - middle) @ plane
        axes.plot(1e2 * centre[0], 1e2 * centre[1], "+", ms=8.0, color="#1f6feb")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("cm")
    axes.legend(frameon=False, fontsize=8)
