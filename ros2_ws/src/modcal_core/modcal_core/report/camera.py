"""The report of a calibration by camera: the data of ``report.json``, lines for a person, and the files.

Held-out pixels stand in it and are never called accuracy; what stands for accuracy is the interval in millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from modcal_core.calibration import Calibration, NoiseModel
from modcal_core.camera import (
    ALL_BUT_IMAGES,
    APPLY,
    CANNOT_TELL,
    COMMON,
    DISTORTIONS,
    READOUT,
    SCALE,
    SHAPE,
    SHAPE_NAMES,
    BundleMarker,
    CameraCause,
    CameraSolution,
    Lens,
    MarkerBundle,
    ToolError,
    uncertainty_about,
)
from modcal_core.effects import ReportEntry, family_named
from modcal_core.files import to_json, to_yaml
from modcal_core.geometry import Array
from modcal_core.outcome import STAGES, Trace, at_tool, parameters
from modcal_core.report.as_json import FORMAT, finite, in_mm, picked, sizes_to_json, tolerance_data, unexplained
from modcal_core.report.blocks import SummaryLine, VerbResult
from modcal_core.report.camera_page import camera_charts, camera_sentences, to_html
from modcal_core.report.report import model_files
from modcal_core.robot import Robot
from modcal_core.verdict import Tolerance


def moved_data(solution: CameraSolution) -> dict[str, Any] | None:
    """What was moved among the images, None if nothing was."""
    moved = solution.evidence.moved
    if moved is None:
        return None
    return {
        "what": moved.what,
        "before_image": solution.fit.table.names[int(moved.since)],
        **in_mm(moved, shift_mm="shift_m"),
        "turn_deg": float(np.degrees(moved.turn_rad)),
        "focal_percent": 100.0 * moved.focal,
    }


def lens_data(lens: Lens, std: Array) -> dict[str, Any]:
    """The values that a lens has. std: of its values, and of others behind them."""
    known = zip(lens.names, lens.values, std, lens.used, strict=False)
    return {name: {"value": float(value), "std": float(s)} for name, value, s, used in known if used}


def further_data(solution: CameraSolution) -> list[dict[str, Any]]:
    """The further cameras."""
    fit = solution.fit
    every = zip(fit.cameras.every, fit.states, fit.std, fit.rms_px, strict=True)
    return [
        {
            "name": one.given.name,
            "mounting": "tip" if one.mounting.camera_on_tip else "world",
            "target": one.given.target.label,
            "images": {"given": len(one.given.views), "used": one.table.views, "left_out": one.left_out},
            "rms_px": rms_px,
            "lens": lens_data(state.lens, std[len(state.values) + 1 :]),
            "clock_s": state.offset_s,
            "readout_s": state.readout_s,
        }
        for one, state, std, rms_px in list(every)[1:]
    ]


_NAMED = 3  # markers that are named in a sentence, those that are farthest off
_TIMES = 3.0  # the stated tolerance, beyond which a marker is named: one of a thousand is off by so much
_SURE = 3.0  # standard deviations of where it is


@dataclass(frozen=True)
class _MarkerPlace:
    """marker: whose. offset_m: from the drawing, in the body's frame, (3,). std_m: of it, RMS of the three. turn_rad:
    from the drawing, 0 where corners were not read.
    """

    marker: BundleMarker
    offset_m: np.ndarray
    std_m: float
    turn_rad: float

    @property
    def off_m(self) -> float:
        """How far it is from its place."""
        return float(np.linalg.norm(self.offset_m))


def body_data(solution: CameraSolution) -> dict[str, Any] | None:
    """The body as ``report.json`` has it, None of a sheet."""
    target, fit = solution.camera.given.target, solution.fit
    if not isinstance(target, MarkerBundle):
        return None
    std = fit.std[0][fit.poses.count + 1 :][SCALE]
    sizes = {"size": (fit.state.shape[0], std[0])}
    if target.turning:
        sizes["print_size"] = (fit.state.shape[1], std[1])
    return {
        **{name: {"value": float(value), "std": float(s)} for name, (value, s) in sizes.items()},
        "tolerance_mm": 1e3 * target.place_m,
        "offsets_in_tolerances": fit.sizes.places,
        "markers": [
            {
                "id": one.marker.id,
                "offset_mm": (1e3 * one.offset_m).tolist(),
                "std_mm": 1e3 * one.std_m,
                "turn_deg": float(np.degrees(one.turn_rad)) if target.turning else None,
            }
            for one in _places(solution, target)
        ],
    }


def body_notes(solution: CameraSolution) -> tuple[str, ...]:
    """Where the markers of a body are, in sentences; nothing of a sheet."""
    target = solution.camera.given.target
    if not isinstance(target, MarkerBundle):
        return ()
    places = _places(solution, target)
    rms = float(np.sqrt(np.mean([one.off_m**2 for one in places]) / 3.0))
    out = [f"Markers are {1e3 * rms:.2f} mm from their places on the drawing, RMS along an axis."]
    far = [one for one in places if one.off_m > _TIMES * target.place_m and one.off_m > _SURE * one.std_m]
    far = sorted(far, key=lambda one: -one.off_m)[:_NAMED]
    if far:
        named = ", ".join(f"{m.marker.label} by {1e3 * m.off_m:.1f} ± {1e3 * m.std_m:.1f} mm" for m in far)
        out.append(f"Off the drawing by more than {_TIMES:.0f} times what is stated: {named}.")
    return tuple(out)


def _places(solution: CameraSolution, target: MarkerBundle) -> list[_MarkerPlace]:
    """Where the markers are, in the order of the target."""
    fit = solution.fit
    values = fit.state.shape[SHAPE:].reshape(len(target.markers), -1)
    std = fit.std[0][fit.poses.count + 1 + COMMON :].reshape(values.shape)
    grown = fit.state.shape[0] * (target.middles - target.middles.mean(axis=0))
    return [
        _MarkerPlace(one, v[:3] + g, float(np.sqrt((s[:3] ** 2).mean())), float(np.linalg.norm(v[3:])))
        for one, v, g, s in zip(target.markers, values, grown, std, strict=True)
    ]


_TOLD_BY = {
    "lens": " Images of the board tilted, near, and in every corner of the image tell it.",
    "print scale": " A calliper on its rulers tells it.",
    "size of the body": " A calliper across it tells it.",
}
_OF_BODY = {"print scale": "size of the body", "lens": "lenses", "places of markers": "where the markers are"}
_MOSTLY = 0.5  # of the squared error at the tool
_WORTH = 0.1  # share of the squared error at the tool that knowing something exactly would take away, to be named


def camera_calibration(solution: CameraSolution) -> Calibration:
    """The calibration as other verbs read it: the arm watched from the frame ``camera`` or ``target``."""
    fit = solution.fit
    seen = np.stack([fit.poses.q.min(axis=0), fit.poses.q.max(axis=0)])
    std = fit.std[0]
    table = tuple(
        (p.name, float(v), float(s), p.unit)
        for p, v, s in zip(fit.poses.parameters, fit.state.values, std, strict=False)
    )
    noise = NoiseModel(max(fit.sizes.shift, 1e-6), max(fit.sizes.joint, 1e-6))
    return Calibration(
        *(solution.nominal_model, solution.model, solution.geometric_model, seen, table),
        postures=fit.poses.q,
        noise=noise,
        uncertainty=uncertainty_about(solution.model, fit),
        converged=fit.converged,
        clock=False,
    )


def camera_report(
    solution: CameraSolution,
    robot: Robot,
    images: int,
    left_out: Mapping[str, str],
    met: Tolerance | None = None,
    page: bool = True,
) -> VerbResult:
    """What a calibration by camera leaves behind. images: how many there were. left_out: those no corners came from.

    met: a tolerance. page: whether report.html is among the files.
    """
    data = camera_data(solution, robot, images, left_out, met)
    files = {
        "report.json": to_json(data),
        **model_files(camera_calibration(solution), robot.chain, robot.description),
        "camera.yaml": to_yaml(camera_info(solution.fit.state.lens)),
    }
    for i, state in enumerate(solution.fit.states[1:], start=2):
        files[f"camera_{i}.yaml"] = to_yaml(camera_info(state.lens, f"camera_{i}"))
    if page:
        html = to_html(data, solution.model, solution.fit.poses.q, files, camera_charts(solution.fit))
        files = {"report.html": html, **files}
    camera = data["camera"]
    said = [*camera_sentences(data), f"{camera['decision'].upper()}: {' '.join(camera['because'])}"]
    said += [] if met is None else [f"{met.result}: {met.because}"]
    return VerbResult(data, [*map(SummaryLine, said)], files)


def camera_info(lens: Lens, name: str = "camera") -> dict[str, Any]:
    """A lens in the form of ROS's camera_info files. name: of the camera."""
    fx, fy, cx, cy = (float(x) for x in lens.values[:4])
    rational = bool(lens.below.any())
    d = [*lens.values[4 : 4 + DISTORTIONS[lens.model]], *(lens.below if rational else ())]
    projection = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return {
        "image_width": lens.size[0],
        "image_height": lens.size[1],
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": [float(x) for x in lens.K.ravel()]},
        "distortion_model": "rational_polynomial" if rational else lens.model,
        "distortion_coefficients": {"rows": 1, "cols": len(d), "data": [float(x) for x in d]},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": [float(x) for x in np.eye(3).ravel()]},
        "projection_matrix": {"rows": 3, "cols": 4, "data": projection},
    }


def camera_data(
    solution: CameraSolution, robot: Robot, images: int, left_out: Mapping[str, str], met: Tolerance | None = None
) -> dict[str, Any]:
    """The data of ``report.json``: the keys of every report, and ``camera``. left_out: images no corners came from."""
    fit, decision, rests = solution.fit, solution.claim.decision, solution.claim.rests_on
    P = fit.poses.count
    R = P + 1 + READOUT
    std = fit.std[0]
    values = fit.state.vector
    problems = () if decision.word in (APPLY, CANNOT_TELL) else decision.because
    trace = Trace(robot=robot.name, instrument=f"camera, {solution.camera.given.target.label}")
    out = dict(left_out) | solution.camera.left_out
    return {
        "modcal_report": FORMAT,
        "recording": {
            "stations": fit.table.views,
            "rejected": images - fit.table.views,
            "measurement": "corners",
            "joints": list(robot.names),
            "duration_s": None,
        },
        "split": None,
        "error_mm": dict.fromkeys(STAGES),
        "error_deg": dict.fromkeys(STAGES),
        "noise_floor_mm": None,
        "effects": effect_entries(solution),
        "unexplained": _left(solution),
        "identifiability": None,
        "status": "open" if problems or solution.evidence.open_points else "cannot_tell",
        "open_because": [*problems, *solution.evidence.open_points],
        "remedy": decision.because[0] if decision.word == CANNOT_TELL else None,
        "converged": fit.converged,
        "regimes": [],
        "convention": None,
        "tolerance": tolerance_data(met),
        "trace": asdict(trace),
        "camera": {
            **picked(decision, "because", "chance_worse", decision="word"),
            "metric": list(solution.claim.metric),
            "rests_on_size": rests
            and {
                "images_percent": 100.0 * rests.images_std,
                "mm_per_percent": 10.0 * rests.per_unit_m,
                "if_wrong_high95_mm": 1e3 * rests.if_wrong_m,
            },
            "mounting": "tip" if fit.poses.camera_on_tip else "world",
            "rival_mounting": float(solution.camera.mounting.rival),
            "target": solution.camera.given.target.label,
            "images": {"given": images, "used": fit.table.views, "left_out": out},
            "corners": {"used": int(fit.table.weight.sum()), "left_out_share": solution.fit.table.left_out},
            "tool_error_mm": {
                "in_view": _errors(solution.claim.in_view),
                "anywhere": _errors(solution.claim.anywhere),
                "arm_alone": _errors(solution.claim.alone),
            },
            "held_out_px": dict(zip(("nominal", "calibrated"), map(finite, solution.claim.held_out_px), strict=True)),
            "rms_px": fit.rms_px[0],
            "sizes": asdict(fit.sizes),
            "lens": lens_data(fit.state.lens, std[P + 1 :]),
            "sheet": {
                name: {"value": float(values[i]), "std": float(std[i])}
                for i, name in enumerate(SHAPE_NAMES, start=P + 1 + SCALE.start)
                if not fit.table.places
            },
            "body": body_data(solution),
            "clock_s": {"value": fit.state.offset_s, "std": float(std[P])} if std[P] > 0.0 else None,
            "readout_s": {"value": fit.state.readout_s, "std": float(std[R])} if std[R] > 0.0 else None,
            "moved": moved_data(solution),
            "account_mm2": [
                {"what": name, "value": 1e6 * (whole - known)}
                for name, (whole, known) in solution.claim.shares.items()
                if name != ALL_BUT_IMAGES
            ],
            "weak": list(solution.evidence.weak),
            "further": further_data(solution),
        },
        "parameters": [
            {**picked(p, "name", "unit"), "value": float(v), "std": float(s)}
            for p, v, s in zip(fit.poses.parameters, values, std, strict=False)
        ],
        "notes": list(notes(solution)),
        "verdict": f"{decision.word.capitalize()}. {' '.join(decision.because)}",
    }


def notes(solution: CameraSolution) -> tuple[str, ...]:
    """What else a person should know, in sentences."""
    out = [f"{_sentence(cause.effect.family, entry)}." for cause, entry in _named(solution)]
    out += [found.sentence for found in solution.evidence.findings]
    out += (*body_notes(solution), *solution.evidence.open_points, *solution.notes)
    if solution.evidence.left is not None:
        said = solution.evidence.left.effect.label
        out.append(f"Something is left that correlates with {said}, and no effect was found that predicts it.")
    out += solution.evidence.weak
    target = "body" if solution.fit.table.places else "sheet"
    every, without = solution.claim.shares.get(ALL_BUT_IMAGES, (0.0, 0.0))
    if without > _MOSTLY * every:
        out.append(
            f"Too few pixels or images are most of what is left: were lens, {target} and clock known exactly, the "
            f"error at the tool would still be {1e3 * without**0.5:.2f} mm RMS and not {1e3 * every**0.5:.2f} mm. More "
            "images, a larger target, a nearer camera or more pixels tell more."
        )
    body = solution.fit.table.places > 0
    for name, (whole, known) in sorted(solution.claim.shares.items(), key=lambda s: s[1][1]):
        if name == ALL_BUT_IMAGES:
            continue
        if whole - known > _WORTH * whole:
            what = _OF_BODY.get(name, name) if body else name
            out.append(
                f"{what.capitalize()}: were it known exactly, the error at the tool would be "
                f"{1e3 * known**0.5:.2f} mm RMS and not {1e3 * whole**0.5:.2f} mm.{_TOLD_BY.get(what, '')}"
            )
    return tuple(out)


def effect_entries(solution: CameraSolution) -> list[dict[str, Any]]:
    """The effects as ``report.json`` has them. RMS before and after are what images have of their own, at the tool."""
    model, throw = solution.model, _throw(solution)
    out = []
    for i, (cause, entry) in enumerate(_named(solution)):
        moved = at_tool(model, [i], solution.fit.poses.drivers().samples)
        rms = (throw * cause.before, throw * cause.after, moved)
        out.append(_entry(cause.effect.family, entry, cause.p_value, rms, _sentence(cause.effect.family, entry)))
    scatter = throw * solution.fit.sizes.joint
    for found in solution.evidence.findings:
        rms = (float(np.hypot(scatter, found.at_tool_m)), scatter, found.at_tool_m)
        out.append(_entry(found.family, found.entry, found.p_value, rms, found.sentence))
    return out


def _entry(
    family: str, entry: ReportEntry, p_value: float, rms_m: tuple[float, float, float], sentence: str
) -> dict[str, Any]:
    """An effect. rms_m: before, after, and of the effect by itself, at the tool [m]."""
    return {
        "family": family,
        "place": entry.place,
        "direction": entry.direction,
        "driver": entry.driver,
        "parameters": sizes_to_json(entry.sizes),
        "p_value": p_value,
        **{f"rms_mm_{name}": 1e3 * x for name, x in zip(("before", "after", "at_tool"), rms_m, strict=True)},
        "same_as": list(entry.same_as),
        "sentence": sentence,
    }


def _named(solution: CameraSolution) -> list[tuple[CameraCause, ReportEntry]]:
    chain = solution.fit.poses.model.chain
    out = []
    for cause in solution.evidence.causes:
        e = cause.effect
        sizes = parameters((e,), chain)
        out.append((cause, ReportEntry(e.place, e.direction, e.public_driver, sizes, cause.same_as)))
    return out


def _sentence(family: str, entry: ReportEntry) -> str:
    return family_named(family).sentence(entry)


def _throw(solution: CameraSolution) -> float:
    """RMS distance at the flange per radian (or metre) that each joint is off by itself [m]."""
    poses, values = solution.fit.poses, solution.fit.state.values
    T = poses.tool_at(values)
    moved = solution.fit.at_flange(T, poses.own_motions(values, T)[:, :, :-3])
    return float(np.sqrt((moved**2).sum() / len(T)))


def _left(solution: CameraSolution) -> dict[str, Any] | None:
    choice = solution.evidence.left
    if choice is None:
        return None
    return unexplained(1e3 * _throw(solution) * solution.fit.sizes.joint, choice) | {"p_value": choice.p_value}


def _errors(error: ToolError) -> dict[str, Any]:
    names = ("rms", "low95", "high95")
    return {
        "calibrated": dict(zip(names, (1e3 * x for x in error.interval), strict=True)),
        "nominal": dict(zip(names, (1e3 * x for x in error.nominal_interval), strict=True)),
    }
