"""What a track tells of an articulated object: as data, and as one page that needs nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.articulation import Choice, JointFit, JointModel, Track, describe, sound
from modcal_core.files import to_json
from modcal_core.geometry import Array, so3
from modcal_core.measurements import spread_rows
from modcal_core.report.blocks import (
    Figures,
    Page,
    Quantity,
    Scene3D,
    Section,
    TableBlock,
    Tone,
    VerbResult,
    quantity_tables,
)
from modcal_core.report.charts import Chart
from modcal_core.report.figures import MAX_MARKS, residual_panel
from modcal_core.report.tables import STATISTICS

_MAX_SEEN, _MAX_PLACES = 400, 61  # that a page can show and a person look through
_BEYOND = 0.15  # of the path's size, by which the axis goes on beyond what turns about it
URDF = "object.urdf"
_HAND = 0.06  # m; the strokes of the handle's orientation are half a hand long


def object_scene(fit: JointFit, track: tuple[Array, Array], joint: dict[str, Any], scale: float, frame: str) -> Scene3D:
    """The path of a joint, the object on it, and where its handle was seen, in the frame of the track.

    track: configurations (n,) of samples that are no outliers, and their places (n, 3) [m]. joint: its ``axis`` and
    ``point`` as stated in JSON, where it has them. scale: from the unit of configurations to what people read, ° or mm.
    frame: name of the track's frame, may be empty. The first stroke of the object goes from the axis to the handle.
    """
    (a, seen), model = track, fit.model
    over = np.linspace(a.min(), a.max(), _MAX_PLACES)
    T = model.pose(over)
    path = T[:, :3, 3]
    lines, strokes = [], []
    if joint.get("axis") is not None and model.centre() is not None:
        direction, point = np.asarray(joint["axis"]), np.asarray(joint["point"])
        along = (path - point) @ direction
        feet = point + along[:, None] * direction
        size = float(np.linalg.norm(np.ptp(np.concatenate([path, feet]), axis=0)))
        ends = np.array([along.min() - _BEYOND * size, along.max() + _BEYOND * size])
        lines = [("axis", point + ends[:, None] * direction)]
        strokes.append(np.stack([feet, path], axis=1))
    if model.oriented:
        strokes += [np.stack([path, path + 0.5 * _HAND * T[:, :3, i]], axis=1) for i in range(3)]
    strokes = strokes or [np.stack([path, path], axis=1)]
    unit = {"rad": "°", "m": " mm"}.get(model.unit, "")
    said = tuple(
        f"Joint at {scale * x:.1f}{unit}, of {scale * over[0]:.1f} to {scale * over[-1]:.1f}{unit} seen: "
        f"handle at x {p[0]:.3f}, y {p[1]:.3f}, z {p[2]:.3f} m."
        for x, p in zip(over, path, strict=True)
    )
    alt = f"The measured places of the handle, the path of a {model.kind} joint"
    return Scene3D(
        points=path,
        arms=[[stroke[k] for stroke in strokes] for k in range(len(path))],
        shown=np.arange(len(path)),
        said=said,
        base=frame or "the track's frame",
        alt=alt + (", its axis, and the handle on it" if lines else ", and the handle on it"),
        route=True,
        cloud=seen[spread_rows(len(seen), _MAX_SEEN)],
        lines=lines,
        local=True,
        slider="Position",
        legend="Grey dots were measured, the blue line is the path of the joint, the dashed line its axis.",
    )


_HEADINGS: dict[bool, tuple[str, Tone]] = {True: ("Verdict", "good"), False: ("Verdict: something is open", "warn")}
_UNITS = {"rad": ("°", float(np.degrees(1.0))), "m": ("mm", 1e3), "1": ("", 1.0)}  # how people read them
_MAX_LEFT = 0.05  # m; what is farther is no residual of a joint, and would flatten the chart


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


def articulation_report(found: Articulation) -> VerbResult:
    """What a verb leaves of an articulated object: data, page, and a URDF where it has a joint that moves so."""
    data, choice = articulation_data(found), found.choice
    files, fit, model = {"articulation.json": to_json(data)}, choice.fit, choice.fit.model
    frame = f"frame {found.frame}" if found.frame else "a frame without a name"
    rejected = f"{data['rejected'] or 'none'} of them rejected as gross outliers"
    said = [f"{data['samples']} {data['measurement']}s in {frame}, {rejected}."]
    if not choice.follows:
        said.append(
            "By positions alone: the measured rotations do not follow it (the handle turned in the grasp, or they are "
            "wrong)."
        )
    if choice.misfit.fails:
        said.append(f"No {URDF}: a URDF has no joint that moves so; articulation.json has the best one and its phases.")
    elif isinstance(model, JointModel):
        reach = data["configuration"]
        limits = None if not model.moves else (reach["lower"], max(reach["upper"], reach["lower"] + 1e-6))
        files[URDF] = describe(model, found.frame or "world", "object_handle", limits)
    else:
        said.append(f"No {URDF}: a URDF has no joint like a {choice.kind}; articulation.json says how it moves.")
    good = sound(fit, found.track)
    track = fit.configurations[good], found.track.positions[good]
    drawn = object_scene(fit, track, data["joint"], _UNITS[model.unit][1], found.frame)
    kinds = tuple((kind, f"{100 * p:.1f} %") for kind, p in data["probabilities"].items())
    kind = data["kind"] if data["kind"] == data["best"] else f"{data['kind']}; the best is {data['best']}"
    blocks = [
        Section("kind", "Joint type", [TableBlock("Probabilities", ("kind", "probability"), kinds)]),
        Section("joint", f"The joint: {kind}", quantity_tables(_quantities(data))),
        Section("object", "The object in three dimensions", [drawn]),
        Section("path", "Residual along the path", [Figures([_residual(found, data)])]),
    ]
    heading, tone = _HEADINGS[bool(data["enough"])]
    page = Page(f"{found.source}: articulation", data["verdict"], blocks, heading, tone, lines=said)
    return page.result(data, files)


def _quantities(data: dict[str, Any]) -> list[Quantity]:
    """Place of the joint, motion and residual, as people read them."""
    joint, std, seen = data["joint"], data["joint"]["std"], data["configuration"]
    out: list[Quantity] = []
    for name, key, unit in (
        ("point on the axis", "point", "m"),
        ("origin of the object", "object", "m"),
        ("direction of the axis", "axis", "1"),
    ):
        known = (*std.get(key, ()), None, None, None)  # of an object's pose its place
        out += [(f"{name}, {axis}", x, s, unit) for axis, x, s in zip("xyz", joint.get(key) or (), known, strict=False)]
    if joint["point"] is not None:
        out.append(("distance of the handle from the axis", joint["radius"], None, "m"))
    if joint["pitch"] is not None:
        turn = 2.0 * np.pi
        out.append(("rise in a turn", turn * joint["pitch"], turn * std["pitch"][0] if "pitch" in std else None, "m"))
    if joint["axis"] is not None and "axis" in std:
        out.append(("the axis is known to (one standard deviation)", float(np.linalg.norm(std["axis"])), None, "rad"))
    for name, known in joint.get("parameters", {}).items():
        out.append((name.replace("_", " "), known["value"], known["std"], known["unit"]))
    out.append(("motion that was seen", seen["upper"] - seen["lower"], None, seen["unit"]))
    for key in ("rms", "p95"):
        out.append((f"residual, {STATISTICS[key]}", 1e-3 * data["residual_mm"][key], None, "m"))
    if data["residual_deg"] is not None:
        out.append(("residual of the rotation, RMS", np.radians(data["residual_deg"]["rms"]), None, "rad"))
    turn = float(np.degrees(1.0))
    return [(n, turn * v, std and turn * std, "°") if unit == "rad" else (n, v, std, unit) for n, v, std, unit in out]


def _residual(found: Articulation, data: dict[str, Any]) -> Chart:
    """What is left along the path."""
    left, _ = _left(found)
    shown = np.linalg.norm(left, axis=1) < _MAX_LEFT
    far = int((~shown).sum())
    unit, scale = _UNITS[data["configuration"]["unit"]]
    rows = np.flatnonzero(shown)
    rows = rows[spread_rows(len(rows), MAX_MARKS // 3)]
    at = scale * found.choice.fit.configurations[rows]
    panel = residual_panel(f"motion of the joint, {unit}" if unit else "motion of the joint", at, 1e3 * left[rows])
    words = "What the joint leaves along its motion: x as circles, y as triangles, z as squares."
    words += f" {far} samples farther than {1e3 * _MAX_LEFT:.0f} mm are not shown." if far else ""
    alt = f"Residual along the path: {data['residual_mm']['rms']:.2f} mm RMS."
    return panel.chart("residual", alt, words)
