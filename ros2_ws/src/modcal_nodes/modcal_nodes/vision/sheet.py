"""The sheet to print: the target as vectors, to scale, with a ruler along each side, as PDF."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import cv2
import numpy as np
from fpdf import FPDF

from modcal_core.camera import ARUCO_GRID, CHARUCO, CHESSBOARD, TAG, PrintedTarget
from modcal_core.errors import BadTable
from modcal_nodes.vision.detection import charuco_board, dictionary

PAPERS = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4), "A2": (420.0, 594.0)}  # mm
_MARGIN = 6.0  # mm that printers leave blank
_RULER = 12.0  # mm beside the pattern, for a ruler and its figures
_TICK = 3.0  # mm
_LINE = 0.15  # mm


@dataclass(frozen=True)
class PrintedSheet:
    """pdf: its bytes. rulers_m: lengths of the rulers along x and y, as the sheet has them [m]."""

    pdf: bytes
    rulers_m: tuple[float, float]


def draw_sheet(target: PrintedTarget, paper: str) -> PrintedSheet:
    """The target on this paper, the right way round for it. Raises BadTable where it does not fit."""
    width, height = (1e3 * side for side in target.size)
    across, down = PAPERS[paper]
    need = width + _RULER + 2 * _MARGIN, height + _RULER + 2 * _MARGIN
    landscape = need[0] > across or (need[0] > need[1] and need[0] <= down and need[1] <= across)
    if landscape:
        across, down = down, across
    if need[0] > across or need[1] > down:
        said = f"needs {need[0]:.0f} × {need[1]:.0f} mm with its rulers, {paper} has {across:.0f} × {down:.0f} mm"
        raise BadTable(target.label, said, "use smaller squares, fewer of them, or larger paper")
    page = FPDF(orientation="landscape" if landscape else "portrait", unit="mm", format=PAPERS[paper])
    page.set_creation_date(datetime(2000, 1, 1, tzinfo=UTC))  # the same target gives the same bytes
    page.set_auto_page_break(False)
    page.add_page()
    left, top = 0.5 * (across - width - _RULER), 0.5 * (down - height - _RULER)
    page.set_fill_color(0, 0, 0)
    for x, y, w, h in rectangles(target):
        page.rect(left + x, top + y, w, h, style="F")
    lengths = tuple(10.0 * max(int(side // 10.0), 1) for side in (width, height))
    page.set_line_width(_LINE)
    page.set_font("helvetica", size=7)
    _ruler(page, left, top + height + 4.0, lengths[0], along_x=True)
    _ruler(page, left + width + 4.0, top, lengths[1], along_x=False)
    page.text(left, top + height + _RULER + 1.5, f"{target.label} {target.dictionary}. Print at 100 %; measure rulers.")
    return PrintedSheet(bytes(page.output()), (1e-3 * lengths[0], 1e-3 * lengths[1]))


def _ruler(page: FPDF, x: float, y: float, length: float, along_x: bool) -> None:
    """A line from (x, y) with a tick every centimetre, long ones at its ends, which is what is measured."""

    def tick(at: float, size: float) -> None:
        if along_x:
            page.line(x + at, y, x + at, y + size)
        else:
            page.line(x, y + at, x + size, y + at)

    page.line(x, y, x + (length if along_x else 0.0), y + (0.0 if along_x else length))
    for at in np.arange(0.0, length + 1e-9, 10.0):
        tick(float(at), _TICK if at in (0.0, length) else 0.5 * _TICK)
    said = f"{length:.0f} mm"
    page.text(x + 0.5 * length if along_x else x + 2.0, y + _TICK + 2.5 if along_x else y + 0.5 * length, said)


def rectangles(target: PrintedTarget) -> list[tuple[float, float, float, float]]:
    """Black rectangles (x, y, width, height) [mm] from the pattern's upper left corner."""
    side, inner = 1e3 * target.square, 1e3 * target.marker
    out: list[tuple[float, float, float, float]] = []
    if target.kind in (CHARUCO, CHESSBOARD):
        for row in range(target.rows):
            out += [(c * side, row * side, side, side) for c in range(target.columns) if (row + c) % 2 == 0]
        if target.kind == CHARUCO:
            board = charuco_board(target)
            ids, points = np.asarray(board.getIds()).ravel(), np.asarray(board.getObjPoints())
            for number, corners in zip(ids, points, strict=True):
                x, y = 1e3 * corners[0, :2]
                out += _marker(target.dictionary, int(number), float(x), float(y), inner)
        return out
    if target.kind in (ARUCO_GRID, TAG):
        for k in range(target.columns * target.rows):
            row, column = divmod(k, target.columns)
            out += _marker(target.dictionary, target.first_id + k, column * (side + inner), row * (side + inner), side)
        return out
    raise BadTable(target.label, "is Kalibr's form", "print it with Kalibr, and give its file to calibrate")


def _marker(name: str, number: int, x: float, y: float, side: float) -> list[tuple[float, float, float, float]]:
    """The black cells of a marker, each row's neighbours as one."""
    words = dictionary(name)
    cells = words.markerSize + 2
    if not 0 <= number < len(words.bytesList):
        raise BadTable(f"dictionary {name}", f"has no marker {number}", "use a larger one")
    black = np.asarray(cv2.aruco.generateImageMarker(words, number, cells)) == 0
    step = side / cells
    out = []
    for r, row in enumerate(black):
        edges = np.flatnonzero(np.diff(np.r_[False, row, False].astype(int)))
        out += [(x + a * step, y + r * step, (b - a) * step, step) for a, b in edges.reshape(-1, 2)]
    return out
