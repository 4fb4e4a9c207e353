"""The report of a calibration by camera: the data of ``report.json``, sentences, the page, and the files.

Held-out pixels stand in it and are never called accuracy; what stands for accuracy is the interval in millimetres.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
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
    CameraFit,
    CameraSolution,
    Lens,
    MarkerBundle,
    uncertainty_about,
    view_distances,
)
from modcal_core.files import to_json, to_yaml
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.outcome import STAGES, Finding, Trace, at_tool, counted, parameters
from modcal_core.report.blocks import (
    Block,
    Figures,
    Fold,
    Page,
    Section,
    SummaryLine,
    TableBlock,
    VerbResult,
    parameter_tables,
    quantity_tables,
    size_tables,
    tone_of,
)
from modcal_core.report.charts import AFTER, Axis, Chart, Panel
from modcal_core.report.figures import ShownPostures
from modcal_core.report.report import (
    FORMAT,
    effect_data,
    finite,
    in_mm,
    model_files,
    picked,
    tolerance_data,
    unexplained,
)
from modcal_core.report.tables import effects_table, tolerance_lines
from modcal_core.robot import Robot
from modcal_core.verdict import Tolerance


def _estimates(names: Iterable[str], values: Array, std: Array) -> dict[str, Any]:
    """Values with their standard deviations, by name; values and deviations may go on behind them."""
    return {n: {"value": float(v), "std": float(s)} for n, v, s in zip(names, values, std, strict=False)}


def _camera(solution: CameraSolution, i: int) -> dict[str, Any]:
    """What is said of each camera alike. i: which of them."""
    one, state, fit = solution.fit.cameras.every[i], solution.fit.states[i], solution.fit
    values = _estimates(state.lens.names, state.lens.values, fit.std[i][len(state.values) + 1 :])
    return {
        "mounting": "tip" if one.mounting.camera_on_tip else "world",
        "target": one.given.target.label,
        "images": {"given": len(one.given.views), "used": one.table.views, "left_out": one.left_out},
        "rms_px": fit.rms_px[i],
        "lens": {name: values[name] for name, used in zip(state.lens.names, state.lens.used, strict=False) if used},
    }


_NAMED = 3  # markers that are named in a sentence, those that are farthest off
_TIMES = 3.0  # the stated tolerance, beyond which a marker is named: one of a thousand is off by so much
_SURE = 3.0  # standard deviations of where it is


def _body(solution: CameraSolution) -> dict[str, Any] | None:
    """The body as ``report.json`` has it, with its markers' offsets from the drawing; None of a sheet."""
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
    """What a calibration by camera leaves. images: how many there were. left_out: those no corners came from."""
    data = camera_data(solution, robot, images, left_out, met)
    files = {
        "report.json": to_json(data),
        **model_files(camera_calibration(solution), robot.chain, robot.description),
        "camera.yaml": to_yaml(camera_info(solution.fit.state.lens)),
    }
    for i, state in enumerate(solution.fit.states[1:], start=2):
        files[f"camera_{i}.yaml"] = to_yaml(camera_info(state.lens, f"camera_{i}"))
    tables = [replace(table, heading=True) for table in _tables(data)]
    camera, shown = data["camera"], ShownPostures(solution.model.serial, solution.fit.poses.q, "Image")
    blocks: list[Block] = [
        Section("found", "What was found", tables),
        Section("robot", "Robot", [shown.scene(f"The arm in the postures of {counted(len(shown.q), 'image')}.")]),
        Section("images", "Images", [Figures(_charts(solution.fit))]),
        Fold("Expert: all parameters", _parameters(data), "expert"),
    ]
    title, decision, answer = f"{robot.name or 'arm'}: calibration by camera", camera["decision"], camera["because"]
    lines: list[str | SummaryLine] = [*tolerance_lines(met), *_sentences(data)]
    said = f"{decision.upper()}: {' '.join(answer)}"
    page = Page(title, " ".join(answer), blocks, decision, tone_of(decision), lines=lines, said=said)
    return page.result(data, files, tables[:1])


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
    fit, camera, claim, evidence = solution.fit, solution.camera, solution.claim, solution.evidence
    decision, rests, moved, left = claim.decision, claim.rests_on, evidence.moved, evidence.left
    P, std, values = fit.poses.count, fit.std[0], fit.state.vector
    R, first = P + 1 + READOUT, P + 1 + SCALE.start
    problems = () if decision.word in (APPLY, CANNOT_TELL) else decision.because
    body, effects = _body(solution), _effects(solution)
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
        "status": "open" if problems or evidence.open_points else "cannot_tell",
        "open_because": [*problems, *evidence.open_points],
        "remedy": decision.because[0] if decision.word == CANNOT_TELL else None,
        "converged": fit.converged,
        "regimes": [],
        "convention": None,
        "tolerance": tolerance_data(met),
        "trace": asdict(Trace(robot=robot.name, instrument=f"camera, {camera.given.target.label}")),
        "camera": {
            **picked(decision, "because", "chance_worse", decision="word"),
            "metric": list(claim.metric),
            "rests_on_size": rests
            and {
                "images_percent": 100.0 * rests.images_std,
                "mm_per_percent": 10.0 * rests.per_unit_m,
                "if_wrong_high95_mm": 1e3 * rests.if_wrong_m,
            },
            **_camera(solution, 0),
            "rival_mounting": float(camera.mounting.rival),
            "images": {"given": images, "used": fit.table.views, "left_out": dict(left_out) | camera.left_out},
            "corners": {"used": int(fit.table.weight.sum()), "left_out_share": fit.table.left_out},
            "tool_error_mm": {
                name: {"calibrated": _size(error.interval), "nominal": _size(error.nominal_interval)}
                for name, error in (
                    ("in_view", claim.in_view),
                    ("anywhere", claim.anywhere),
                    ("arm_alone", claim.alone),
                )
            },
            "held_out_px": dict(zip(("nominal", "calibrated"), map(finite, claim.held_out_px), strict=True)),
            "sizes": asdict(fit.sizes),
            "sheet": {} if body else _estimates(SHAPE_NAMES, values[first:], std[first:]),
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
                for name, (whole, known) in claim.shares.items()
                if name != ALL_BUT_IMAGES
            ],
            "weak": list(evidence.weak),
            "further": [
                {
                    "name": one.given.name,
                    **_camera(solution, i),
                    "clock_s": fit.states[i].offset_s,
                    "readout_s": fit.states[i].readout_s,
                }
                for i, one in enumerate(fit.cameras.every[1:], 1)
            ],
        },
        "parameters": [
            {**picked(p, "name", "unit"), "value": float(v), "std": float(s)}
            for p, v, s in zip(fit.poses.parameters, values, std, strict=False)
        ],
        "notes": [*(effect["sentence"] for effect in effects), *_notes(solution, body)],
        "verdict": f"{decision.word.capitalize()}. {' '.join(decision.because)}",
    }


def _notes(solution: CameraSolution, body: Mapping[str, Any] | None) -> tuple[str, ...]:
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


def _effects(solution: CameraSolution) -> list[dict[str, Any]]:
    """The effects as ``report.json`` has them. RMS before and after are what images have of their own, at the tool."""
    poses, throw = solution.fit.poses, _throw(solution)
    scatter, samples = throw * solution.fit.sizes.joint, poses.drivers().samples
    found = []
    for i, cause in enumerate(solution.evidence.causes):
        e, rms = cause.effect, (throw * cause.before, throw * cause.after)
        sizes, moved = parameters((e,), poses.model.chain), at_tool(solution.model, [i], samples)
        where = (e.family, e.place, e.direction, e.public_driver)
        finding = Finding(*where, sizes, cause.p_value, *rms, cause.same_as, tool=moved)
        found.append((finding, f"{finding.what}."))
    for one in solution.evidence.findings:
        at, rms = one.entry, (float(np.hypot(scatter, one.at_tool_m)), scatter)
        where = (one.family, at.place, at.direction, at.driver)
        finding = Finding(*where, dict(at.sizes), one.p_value, *rms, at.same_as, tool=one.at_tool_m)
        found.append((finding, one.sentence))
    return [{**effect_data(finding), "sentence": sentence} for finding, sentence in found]


def _throw(solution: CameraSolution) -> float:
    """RMS distance at the flange per radian (or metre) that each joint is off by itself [m]."""
    poses, values = solution.fit.poses, solution.fit.state.values
    T = poses.tool_at(values)
    moved = solution.fit.at_flange(T, poses.own_motions(values, T)[:, :, :-3])
    return float(np.sqrt((moved**2).sum() / len(T)))


def _size(interval: tuple[float, float, float]) -> dict[str, float]:
    return dict(zip(("rms", "low95", "high95"), (1e3 * x for x in interval), strict=True))


_PLACES = {
    "in_view": "where the target is in view",
    "arm_alone": "there, the arm by itself",
    "anywhere": "anywhere within the joint limits",
}


def _sentences(data: Mapping[str, Any]) -> list[str]:
    """What was seen and what was found, for the page and a terminal."""
    camera = data["camera"]
    where = "on the tip, the target stands still" if camera["mounting"] == "tip" else "beside the arm, the target moves"
    px = {name: "not known" if x is None else f"{x:.2f} px" for name, x in camera["held_out_px"].items()}
    out = [f"The camera is {where}. {_seen(camera)}, {camera['corners']['used']} corners."]
    out += [f"Also {one['name']}, on the {one['mounting']}: {_seen(one)}." for one in camera["further"]]
    out.append(
        f"Held-out images: {px['nominal']} with the nominal arm, {px['calibrated']} with the calibrated one. "
        "Pixels are no accuracy: an arm can get worse while its pixels get better."
    )
    if moved := camera["moved"]:
        said = "The {what} was moved before {before_image}, by {shift_mm:.2f} mm and {turn_deg:.2f}°."
        out.append(said.format(**moved))
    out += [f"Left out: {name}: {why}." for name, why in camera["images"]["left_out"].items()]
    return [*out, *data["notes"]]


def _seen(camera: Mapping[str, Any]) -> str:
    images = camera["images"]
    used = f"{images['used']} of {counted(images['given'], 'image')}"
    return f"{camera['target']}, {used}, {camera['rms_px']:.2f} px RMS"


_OF_EFFECTS = {
    "error": "RMS at the tool of what images have of their own, without the effect and with it",
    "p": "the chance that noise would look as good",
}
_PIXELS = ("fx", "fy", "cx", "cy")
_OF_LENS = {"In px": "Lens, px", "Numbers without a unit": "Distortion of the lens"}


def _tables(data: Mapping[str, Any]) -> list[TableBlock]:
    """The error at the tool first, then effects, the lens, and the body; a table has one unit."""
    camera, effects = data["camera"], data["effects"]
    errors = [
        {"arm": arm, "place": words, **camera["tool_error_mm"][place][arm]}
        for place, words in _PLACES.items()
        for arm in ("nominal", "calibrated")
    ]
    at_tool = ("arm | RMS, mm | 95 % interval, mm", "{arm} arm, {place} | {rms:.2f} | {low95:.2f} … {high95:.2f}")
    falls = "By how much the mean square error at the tool would fall, were this known exactly."
    off = [{**m, "off": np.linalg.norm(m["offset_mm"])} for m in (camera["body"] or {"markers": ()})["markers"]]
    of_marker = "marker | from its place on the drawing, mm | ± one standard deviation, mm"
    worth = "What knowing more would be worth, mm²"
    lens = [(k, v["value"], v["std"], "px" if k in _PIXELS else "1") for k, v in camera["lens"].items()]
    return [
        TableBlock.of("Error at the tool, mm", *at_tool, errors),
        effects_table(effects, _OF_EFFECTS),
        *size_tables(effects),
        TableBlock.of(worth, "known | mm²", "{what} | {value:.3f}", camera["account_mm2"], below=falls),
        TableBlock.of("Markers on the body, mm", of_marker, "{id} | {off:.2f} | {std_mm:.2f}", off),
        *(replace(t, title=_OF_LENS.get(t.title, t.title)) for t in quantity_tables(lens, "constant")),
    ]


def _parameters(data: Mapping[str, Any]) -> list[Fold]:
    """All of the arm, the tool and the target, a table for each unit."""
    out = parameter_tables((p["name"], p["value"], p["std"], p["unit"]) for p in data["parameters"])
    if sheet := data["camera"]["sheet"]:
        rows = [(name, s["value"], s["std"], "1") for name, s in sheet.items()]
        out.append(Fold("The sheet, in SI units", quantity_tables(rows, "constant")))
    return out


_DRAWN = 4000  # corners in a picture; more only make the page heavy


def _charts(fit: CameraFit) -> list[Chart]:
    """Coverage of the image by corners, and the distance of each image's target from where the arm has it."""
    used = np.flatnonzero(fit.table.weight > 0.0)
    rows = used[spread_rows(len(used), _DRAWN)]
    w, h = fit.state.lens.size
    covered = Panel(Axis("u, px", 0.0, float(w)), Axis("−v, px", -float(h), 0.0))
    covered.marks(fit.table.pixels[rows, 0], -fit.table.pixels[rows, 1], AFTER)
    off = np.sqrt(view_distances(fit)[0] / 6.0)
    apart = Panel(Axis("image", 0.0, len(off) + 1.0), Axis("distance, σ", 0.0, 1.1 * max(float(off.max()), 2.0)))
    apart.marks(np.arange(1.0, len(off) + 1.0), off, AFTER)
    corners = "where corners were in the images: the lens is known where they are"
    far = "how far each image's target is from where the arm has it; one is usual"
    return [
        covered.chart("covered", "Where corners were in the images.", corners),
        apart.chart("apart", "How far each image is from where the arm has its target.", far),
    ]
