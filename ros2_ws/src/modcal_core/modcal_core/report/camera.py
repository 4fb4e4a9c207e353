"""The report of a calibration by camera: the data of ``report.json``, lines for a person, and the files.

Held-out pixels stand in it and are never called accuracy; what stands for accuracy is the interval in millimetres.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
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
from modcal_core.report.blocks import VerbResult
from modcal_core.report.camera_page import camera_charts, camera_page
from modcal_core.report.report import model_files
from modcal_core.robot import Robot
from modcal_core.verdict import Tolerance


def _estimates(names: Iterable[str], values: Array, std: Array) -> dict[str, Any]:
    """Values with their standard deviations, by name; values and deviations may go on behind them."""
    return {n: {"value": float(v), "std": float(s)} for n, v, s in zip(names, values, std, strict=False)}


def lens_data(lens: Lens, std: Array) -> dict[str, Any]:
    """The values that a lens has. std: of its values, and of others behind them."""
    values = _estimates(lens.names, lens.values, std)
    return {name: values[name] for name, used in zip(lens.names, lens.used, strict=False) if used}


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


def body_data(solution: CameraSolution) -> dict[str, Any] | None:
    """The body as ``report.json`` has it, with where its markers are from their places on the drawing; None of a
    sheet.
    """
    target, fit = solution.camera.given.target, solution.fit
    if not isinstance(target, MarkerBundle):
        return None
    P, sizes = fit.poses.count + 1, ("size", "print_size") if target.turning else ("size",)
    moved = fit.state.shape[SHAPE:].reshape(len(target.markers), -1)
    std = fit.std[0][P + COMMON :].reshape(moved.shape)
    offset = moved[:, :3] + fit.state.shape[0] * (target.middles - target.middles.mean(axis=0))
    return {
        **_estimates(sizes, fit.state.shape, fit.std[0][P:][SCALE]),
        "tolerance_mm": 1e3 * target.place_m,
        "offsets_in_tolerances": fit.sizes.places,
        "markers": [
            {
                "id": marker.id,
                "offset_mm": (1e3 * offset[k]).tolist(),
                "std_mm": 1e3 * float(np.sqrt((std[k, :3] ** 2).mean())),
                "turn_deg": float(np.degrees(np.linalg.norm(moved[k, 3:]))) if target.turning else None,
            }
            for k, marker in enumerate(target.markers)
        ],
    }


def _body_notes(body: Mapping[str, Any], target: MarkerBundle) -> tuple[str, ...]:
    """Where the markers of a body are, in sentences."""
    rows = zip(target.markers, body["markers"], strict=True)
    places = [(float(np.linalg.norm(m["offset_mm"])), m["std_mm"], marker.label) for marker, m in rows]
    rms = float(np.sqrt(np.mean([off**2 for off, *_ in places]) / 3.0))
    out = [f"Markers are {rms:.2f} mm from their places on the drawing, RMS along an axis."]
    far = sorted((p for p in places if p[0] > _TIMES * body["tolerance_mm"] and p[0] > _SURE * p[1]), reverse=True)
    if far:
        named = ", ".join(f"{label} by {off:.1f} ± {std:.1f} mm" for off, std, label in far[:_NAMED])
        out.append(f"Off the drawing by more than {_TIMES:.0f} times what is stated: {named}.")
    return tuple(out)


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
    known = zip(fit.poses.parameters, fit.state.values, std, strict=False)
    table = tuple((p.name, float(v), float(s), p.unit) for p, v, s in known)
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
) -> VerbResult:
    """What a calibration by camera leaves behind. images: how many there were. left_out: those no corners came from.

    met: a tolerance.
    """
    data = camera_data(solution, robot, images, left_out, met)
    files = {
        "report.json": to_json(data),
        **model_files(camera_calibration(solution), robot.chain, robot.description),
        "camera.yaml": to_yaml(camera_info(solution.fit.state.lens)),
    }
    for i, state in enumerate(solution.fit.states[1:], start=2):
        files[f"camera_{i}.yaml"] = to_yaml(camera_info(state.lens, f"camera_{i}"))
    return camera_page(data, solution.model, solution.fit.poses.q, files, camera_charts(solution.fit))


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
    body, moved = body_data(solution), solution.evidence.moved
    effects, left = effect_entries(solution), solution.evidence.left
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
        "effects": effects,
        "unexplained": left and unexplained(1e3 * _throw(solution) * fit.sizes.joint, left) | {"p_value": left.p_value},
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
            "images": {"given": images, "used": fit.table.views, "left_out": dict(left_out) | solution.camera.left_out},
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
            "sheet": {} if body else _estimates(SHAPE_NAMES, values[P + 1 + SCALE.start :], std[P + 1 + SCALE.start :]),
            "body": body,
            "clock_s": {"value": fit.state.offset_s, "std": float(std[P])} if std[P] > 0.0 else None,
            "readout_s": {"value": fit.state.readout_s, "std": float(std[R])} if std[R] > 0.0 else None,
            "moved": moved
            and {
                "what": moved.what,
                "before_image": fit.table.names[int(moved.since)],
                **in_mm(moved, shift_mm="shift_m"),
                "turn_deg": float(np.degrees(moved.turn_rad)),
                "focal_percent": 100.0 * moved.focal,
            },
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
        "notes": [*(effect["sentence"] for effect in effects), *notes(solution, body)],
        "verdict": f"{decision.word.capitalize()}. {' '.join(decision.because)}",
    }


def notes(solution: CameraSolution, body: Mapping[str, Any] | None) -> tuple[str, ...]:
    """What else a person should know beside the effects, in sentences."""
    target, evidence, shares = solution.camera.given.target, solution.evidence, dict(solution.claim.shares)
    out = [] if body is None or not isinstance(target, MarkerBundle) else [*_body_notes(body, target)]
    out += (*evidence.open_points, *solution.notes)
    if evidence.left is not None:
        said = evidence.left.effect.label
        out.append(f"Something is left that correlates with {said}, and no effect was found that predicts it.")
    out += evidence.weak
    every, without = shares.pop(ALL_BUT_IMAGES, (0.0, 0.0))
    if without > _MOSTLY * every:
        out.append(
            "Too few pixels or images are most of what is left: were all else known exactly, the error at the tool "
            f"would still be {1e3 * without**0.5:.2f} mm RMS and not {1e3 * every**0.5:.2f} mm. More images, a larger "
            "target, a nearer camera or more pixels tell more."
        )
    for name, (whole, known) in sorted(shares.items(), key=lambda share: share[1][1]):
        if whole - known > _WORTH * whole:
            what = _OF_BODY.get(name, name) if body else name
            out.append(
                f"{what.capitalize()}: were it known exactly, the error at the tool would be "
                f"{1e3 * known**0.5:.2f} mm RMS and not {1e3 * whole**0.5:.2f} mm.{_TOLD_BY.get(what, '')}"
            )
    return tuple(out)


def effect_entries(solution: CameraSolution) -> list[dict[str, Any]]:
    """The effects as ``report.json`` has them. RMS before and after are what images have of their own, at the tool."""
    poses, throw = solution.fit.poses, _throw(solution)
    scatter, samples = throw * solution.fit.sizes.joint, poses.drivers().samples
    found: list[tuple[str, ReportEntry, float, str, tuple[float, float, float]]] = []
    for i, cause in enumerate(solution.evidence.causes):
        e = cause.effect
        sizes = parameters((e,), poses.model.chain)
        entry = ReportEntry(e.place, e.direction, e.public_driver, sizes, cause.same_as)
        rms = throw * cause.before, throw * cause.after, at_tool(solution.model, [i], samples)
        found.append((e.family, entry, cause.p_value, f"{family_named(e.family).sentence(entry)}.", rms))
    for one in solution.evidence.findings:
        rms = float(np.hypot(scatter, one.at_tool_m)), scatter, one.at_tool_m
        found.append((one.family, one.entry, one.p_value, one.sentence, rms))
    return [
        {
            "family": family,
            **picked(entry, "place", "direction", "driver", "same_as"),
            "parameters": sizes_to_json(entry.sizes),
            "p_value": p_value,
            **{f"rms_mm_{name}": 1e3 * x for name, x in zip(("before", "after", "at_tool"), rms, strict=True)},
            "sentence": sentence,
        }
        for family, entry, p_value, sentence, rms in found
    ]


def _throw(solution: CameraSolution) -> float:
    """RMS distance at the flange per radian (or metre) that each joint is off by itself [m]."""
    poses, values = solution.fit.poses, solution.fit.state.values
    T = poses.tool_at(values)
    moved = solution.fit.at_flange(T, poses.own_motions(values, T)[:, :, :-3])
    return float(np.sqrt((moved**2).sum() / len(T)))


def _errors(error: ToolError) -> dict[str, Any]:
    names = ("rms", "low95", "high95")
    return {
        "calibrated": dict(zip(names, (1e3 * x for x in error.interval), strict=True)),
        "nominal": dict(zip(names, (1e3 * x for x in error.nominal_interval), strict=True)),
    }
