"""The page of a calibration by camera: the advice, the error at the tool in millimetres, what was found, the robot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.calibration import Model
from modcal_core.camera import CameraFit, distances_of_views
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.report.page import (
    AFTER,
    MAX_POSTURES,
    Chart,
    PageTable,
    RobotScene,
    arm_paths,
    joints_in_words,
    number,
    plain_page,
    size_tables,
)
from modcal_core.report.panel import Panel
from modcal_core.report.sentence import counted

Parameter = tuple[str, float, float, str]  # name, value, standard deviation, unit
_PARTS = (("m", "mm", 1e3, "Lengths"), ("rad", "mrad", 1e3, "Angles"), ("1", "‰", 1e3, "Ratios"))


@dataclass(frozen=True)
class ParameterTable:
    """Rows of one unit: name, value and standard deviation in it."""

    title: str
    unit: str
    rows: tuple[tuple[str, float, float], ...]


def parameter_tables(parameters: tuple[Parameter, ...]) -> tuple[ParameterTable, ...]:
    """All of them, a table for each unit."""
    parts = [(si, unit, factor, title) for si, unit, factor, title in _PARTS]
    known = {si for si, *_ in _PARTS}
    parts += [(unit, unit, 1.0, "Others") for unit in sorted({p[3] for p in parameters} - known)]
    tables = [
        ParameterTable(title, unit, tuple((name, factor * v, factor * s) for name, v, s, u in parameters if u == si))
        for si, unit, factor, title in parts
    ]
    return tuple(table for table in tables if table.rows)


TONES = {"apply": "good", "do not apply": "bad", "cannot tell": "warn"}
_HOLDS = {
    "report.json": "all numbers of this page, for programs",
    "calibration.yaml": "everything needed for prediction: nominal and calibrated arm, covariance",
    "calibrated.urdf": "the robot description with corrected origins, as a proposal",
    "kinematics.yaml": "the same numbers in the manufacturer's format, or by joint name",
    "camera.yaml": "the lens, in the form of camera_info",
}
_PLACES = (("in_view", "where the target is in view"), ("anywhere", "anywhere within the joint limits"))


def to_html(
    data: Mapping[str, Any], model: Model, q: Array, files: Iterable[str] = (), charts: Sequence[Chart] = ()
) -> str:
    """The page. data: of ``report.json``. model: the calibrated one. q: the postures of the images (N, n) [rad, m].

    charts: of :func:`modcal_core.report.camera_page.camera_charts`.
    """
    camera = data["camera"]
    files_held = [(name, _HOLDS[name]) for name in files if name in _HOLDS]
    return plain_page(
        f"{data['trace']['robot'] or 'arm'}: calibration by camera",
        " ".join(camera["because"]),
        _sentences(data),
        list(charts),
        files_held,
        _tables(data),
        _robot(model, q),
        heading=camera["decision"],
        tone=TONES.get(camera["decision"], "warn"),
        expert_tables=_parameters(data),
    )


def _sentences(data: Mapping[str, Any]) -> list[str]:
    camera, images = data["camera"], data["camera"]["images"]
    where = "on the tip, the target stands still" if camera["mounting"] == "tip" else "beside the arm, the target moves"
    px = {name: "not known" if x is None else f"{x:.2f} px" for name, x in camera["held_out_px"].items()}
    out = [
        f"The camera is {where}. {camera['target']}, {images['used']} of {counted(images['given'], 'image')}, "
        f"{camera['corners']['used']} corners, {camera['rms_px']:.2f} px RMS.",
        f"Held-out images: {px['nominal']} with the nominal arm, {px['calibrated']} with the calibrated one. "
        "Pixels are no accuracy: an arm can get worse while its pixels get better.",
    ]
    if moved := camera["moved"]:
        out.append(
            f"The {moved['what']} was moved before {moved['before_image']}, by {moved['shift_mm']:.2f} mm and "
            f"{moved['turn_deg']:.2f}°."
        )
    out += [f"Left out: {name}: {why}." for name, why in images["left_out"].items()]
    return [*out, *data["notes"]]


def _tables(data: Mapping[str, Any]) -> list[PageTable]:
    """The error at the tool first, then effects, the lens, and the sheet; a table has one unit."""
    camera = data["camera"]
    rows = []
    for place, words in _PLACES:
        for arm in ("nominal", "calibrated"):
            size = camera["tool_error_mm"][place][arm]
            rows.append((f"{arm} arm, {words}", f"{size['rms']:.2f}", f"{size['low95']:.2f} … {size['high95']:.2f}"))
    tables = [PageTable("Error at the tool, mm", ("arm", "RMS, mm", "95 % interval, mm"), tuple(rows))]
    effects = [(f"{e['family'].replace('_', ' ')} at {e['place']}, {e['direction']}", e) for e in data["effects"]]
    if effects:
        tables.append(
            PageTable(
                "Unmodelled effects",
                ("effect", "driver", "moves the tool by, mm", "p"),
                tuple(
                    (name, e["driver"].replace(":", " of "), f"{e['rms_mm_at_tool']:.3f}", f"{e['p_value']:.1g}")
                    for name, e in effects
                ),
                words=2,
                below="p is the chance that noise would look as good.",
            )
        )
        tables += size_tables((name, e["parameters"]) for name, e in effects)
    worth = tuple((one["what"], f"{one['value']:.3f}") for one in camera.get("account_mm2", ()))
    if worth:
        below = "By how much the mean square error at the tool would fall, were this known exactly."
        tables.append(PageTable("What knowing more would be worth, mm²", ("known", "mm²"), worth, below=below))
    if body := camera.get("body"):
        off = tuple(
            (f"{m['id']}", f"{np.linalg.norm(m['offset_mm']):.2f}", f"{m['std_mm']:.2f}") for m in body["markers"]
        )
        header = ("marker", "from its place on the drawing, mm", "± one standard deviation, mm")
        tables.append(PageTable("Markers on the body, mm", header, off))
    lens: dict[bool, list[tuple[str, str, str]]] = {True: [], False: []}
    for name, known in camera["lens"].items():
        lens[name in ("fx", "fy", "cx", "cy")].append((name, number(known["value"], 5), number(known["std"], 2)))
    for pixels, title, end in ((True, "Lens, px", ", px"), (False, "Distortion of the lens", "")):
        if lens[pixels]:
            header = ("constant", f"value{end}", f"± one standard deviation{end}")
            tables.append(PageTable(title, header, tuple(lens[pixels])))
    return tables


def _parameters(data: Mapping[str, Any]) -> list[PageTable]:
    """All of the arm, the tool and the target, a table for each unit."""
    rows = tuple((p["name"], p["value"], p["std"], p["unit"]) for p in data["parameters"])
    out = []
    for table in parameter_tables(rows):
        end = "" if table.unit == "1" else f", {table.unit}"
        cells = tuple((name, f"{value:.4f}", f"{std:.4f}") for name, value, std in table.rows)
        header = ("parameter", f"value{end}", f"± one standard deviation{end}")
        out.append(PageTable(f"{table.title} of all parameters{end}", header, cells))
    sheet = data["camera"]["sheet"]
    if sheet:
        cells = tuple((name, number(s["value"]), number(s["std"], 2)) for name, s in sheet.items())
        out.append(PageTable("The sheet, in SI units", ("constant", "value", "± one standard deviation"), cells))
    return out


def _robot(model: Model, q: Array) -> RobotScene | None:
    """The arm in the postures of the images."""
    if not len(q):
        return None
    chain = model.serial
    rows = spread_rows(len(q), MAX_POSTURES)
    paths = arm_paths(chain, q[rows])
    said = [f"Image {row + 1} of {len(q)}: {joints_in_words(chain, q[row])}." for row in rows]
    alt = f"The arm in the postures of {counted(len(q), 'image')}."
    return RobotScene(tuple(paths), tuple(said), paths[:, -1], np.arange(len(rows)), chain.base, alt)


_DRAWN = 4000  # corners in a picture; more only make the page heavy


def camera_charts(fit: CameraFit) -> list[Chart]:
    """Coverage of the image by corners, and the distance of each image's target from where the arm has it."""
    used = np.flatnonzero(fit.table.weight > 0.0)
    rows = used[spread_rows(len(used), _DRAWN)]
    w, h = fit.state.lens.size
    covered = Panel((0.0, float(w)), (-float(h), 0.0))
    covered.hollow(fit.table.pixels[rows, 0], -fit.table.pixels[rows, 1], AFTER, "circle")
    off = np.sqrt(distances_of_views(fit) / 6.0)
    number = np.arange(1, len(off) + 1, dtype=float)
    apart = Panel((0.0, float(len(off) + 1)), (0.0, 1.1 * max(float(off.max()), 2.0)))
    apart.hollow(number, off, AFTER, "circle")
    return [
        covered.chart(
            "covered", "u, px", "−v, px", "Where corners were in the images.",
            "where corners were in the images: the lens is known where they are",
        ),
        apart.chart(
            "apart", "image", "distance, σ", "How far each image is from where the arm has its target.",
            "how far each image's target is from where the arm has it; one is usual",
        ),
    ]  # fmt: skip
