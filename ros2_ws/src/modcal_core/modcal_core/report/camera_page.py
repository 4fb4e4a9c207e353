"""The page of a calibration by camera: the advice, errors in millimetres with intervals, and what the images lack."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from modcal_core.camera.clean import distances_of_views
from modcal_core.camera.solve import CameraSolution
from modcal_core.camera.tool_error import ToolError
from modcal_core.report.camera import camera_report, notes
from modcal_core.report.page import Chart, PageTable, plain_page
from modcal_core.report.palette import AFTER
from modcal_core.report.panel import Panel
from modcal_core.robot import Robot

_FILES = [
    ("report.json", "all numbers, for programs"),
    ("calibrated.urdf", "the corrected arm, geometry alone"),
    ("calibration.yaml", "everything that is needed to predict, effects included"),
    ("kinematics.yaml", "the corrected arm as a table"),
    ("camera.yaml", "the lens, in the form of camera_info"),
]
_DIGITS = {"fx": 1, "fy": 1, "cx": 1, "cy": 1}
_DRAWN = 4000  # corners in a picture; more only make the page heavy


def to_html(solution: CameraSolution, robot: Robot, images: int, left_out: Mapping[str, str]) -> str:
    """The page. images, left_out: as in the report."""
    data = camera_report(solution, robot, images, left_out)
    fit = solution.fit
    lines = [
        f"{solution.target.label}; {solution.mounting.label}; {fit.table.views} of {images} images, "
        f"{int(fit.table.weight.sum())} corners.",
        "What has a length that somebody measured: " + (", ".join(solution.metric) or "nothing") + ".",
        *notes(solution),
        f"Held-out images: {solution.held_out_px[0]:.2f} px with the nominal arm, {solution.held_out_px[1]:.2f} px "
        "with the calibrated one. Pixels are no accuracy: an arm can get worse while they get fewer.",
    ]
    return plain_page(
        f"{robot.name}: calibration by camera", data["verdict"], lines, _charts(solution), _FILES,
        _tables(solution, data),
    )  # fmt: skip


def _tables(solution: CameraSolution, data: dict) -> list[PageTable]:  # type: ignore[type-arg]
    camera = data["camera"]
    out = [
        PageTable(
            "Error at the tool, mm RMS, 95 % interval",
            ("postures", "nominal arm", "calibrated arm"),
            (
                ("where the target is in view", *_errors(solution.in_view)),
                ("anywhere within the joint limits", *_errors(solution.anywhere)),
            ),
        )
    ]
    if data["effects"]:
        rows = tuple((e["sentence"], f"{e['rms_mm_at_tool']:.3f}", f"{e['p_value']:.1g}") for e in data["effects"])
        out.append(PageTable("Effects beyond geometry", ("effect", "at the tool, mm RMS", "chance of noise"), rows))
    shares = tuple((one["what"], f"{one['value']:.3f}") for one in camera["account_mm2"])
    if shares:
        below = "By how much the mean square error at the tool would fall, were this known exactly."
        out.append(PageTable("What knowing more would be worth, mm²", ("known", "mm²"), shares, below=below))
    lens = tuple(
        (name, f"{one['value']:.{_DIGITS.get(name, 4)}f}", f"{one['std']:.2g}") for name, one in camera["lens"].items()
    )
    out.append(PageTable("Lens", ("parameter", "value", "standard deviation"), lens))
    sheet = tuple((name, f"{one['value']:.5f}", f"{one['std']:.2g}") for name, one in camera["sheet"].items())
    below = "Size over what is stated, less one; bow in metres at the sheet's corner."
    out.append(PageTable("Sheet", ("parameter", "value", "standard deviation"), sheet, below=below))
    gone = tuple(camera["images"]["left_out"].items())
    if gone:
        out.append(PageTable("Images left out", ("image", "why"), gone, words=2))
    return out


def _errors(error: ToolError) -> tuple[str, str]:
    parts = (error.nominal_interval, error.interval)
    nominal, calibrated = (f"{1e3 * m:.2f} ({1e3 * low:.2f} to {1e3 * high:.2f})" for m, low, high in parts)
    return nominal, calibrated


def _charts(solution: CameraSolution) -> list[Chart]:
    fit = solution.fit
    used = np.flatnonzero(fit.table.weight > 0.0)
    rows = used[np.unique(np.linspace(0, len(used) - 1, min(len(used), _DRAWN)).astype(int))]
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
            "apart", "image", "distance from the arm, σ", "How far each image is from where the arm has its target.",
            "how far each image's target is from where the arm has it; one is usual",
        ),
    ]  # fmt: skip
