"""The certificate as a PDF: one sheet of A4, the same words as the page."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from modcal_core.report.certificate import Certificate, Scale
from modcal_core.report.certificate_page import ticks
from modcal_core.report.palette import LIGHT

if TYPE_CHECKING:
    from fpdf import FPDF

_LEFT, _WIDTH, _BOTTOM = 16.0, 178.0, 284.0  # mm, of the text on A4
_SIZES = (9.6, 9.0, 8.4, 7.8, 7.2, 6.6, 6.0)  # pt; the first at which everything stands on one sheet is taken
_Line = tuple[str, tuple[float, ...], int]  # of a table: name, values, digits behind the point
_NAME = 42.0  # mm, of the names of facts


def to_pdf(one: Certificate) -> bytes:
    """The certificate as the bytes of a PDF file, the same for the same certificate."""
    for size in _SIZES:
        made, end = _written(one, size)
        try:
            if end <= _BOTTOM or size == _SIZES[-1]:
                return bytes(made.output())
        finally:
            for font in made.fonts.values():
                font.close()  # both are files, which FPDF leaves open
    raise AssertionError("the smallest size is always taken")


def _written(one: Certificate, size: float) -> tuple[FPDF, float]:
    """The sheet in letters of this size [pt], and where its text ends [mm]."""
    pdf = _empty(one.title)
    line = 0.49 * size  # mm; the letters' size and a third
    _ink(pdf, "ink")
    pdf.set_font("text", "B", 15)
    pdf.cell(_WIDTH, 8, one.title, new_x="LMARGIN", new_y="NEXT")
    _result(pdf, one, size, line)
    _scale(pdf, one.scale, one.tone)
    _facts(pdf, one, size, line)
    if one.errors:
        _errors(pdf, one, size, line)
    if one.iso:
        _paragraphs(pdf, "ISO 9283", one.iso, size, line)
    _paragraphs(pdf, "What this certificate does not say", one.silent_on, size, line, "•")
    if one.hashes:
        _title(pdf, "SHA-256", size)
        for name, digest in one.hashes:
            pdf.set_font("text", "", size - 1.4)
            pdf.cell(_NAME, line, name)
            pdf.cell(_WIDTH - _NAME, line, digest, new_x="LMARGIN", new_y="NEXT")
    _signatures(pdf, one, size)
    return pdf, float(pdf.get_y())


def _empty(title: str) -> FPDF:
    import matplotlib
    from fpdf import FPDF

    pdf = FPDF(format="A4")
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"  # letters beyond Latin-1: …, ≤, Greek, Cyrillic
    pdf.add_font("text", "", fonts / "DejaVuSans.ttf")
    pdf.add_font("text", "B", fonts / "DejaVuSans-Bold.ttf")
    pdf.set_creation_date(datetime(2000, 1, 1, tzinfo=UTC))  # the same certificate gives the same bytes
    pdf.set_title(title)
    pdf.set_lang("en")
    pdf.c_margin = 0.0
    pdf.set_margins(_LEFT, 13.0, _LEFT)
    pdf.set_auto_page_break(False)
    pdf.add_page()
    return pdf


def _ink(pdf: FPDF, name: str, fill: bool = False) -> None:
    red, green, blue = (int(LIGHT[name][k : k + 2], 16) for k in (1, 3, 5))
    pdf.set_text_color(red, green, blue)
    pdf.set_draw_color(red, green, blue)
    if fill:
        pdf.set_fill_color(red, green, blue)


def _title(pdf: FPDF, text: str, size: float) -> None:
    pdf.ln(1.2)
    pdf.set_font("text", "B", size + 1.0)
    pdf.cell(_WIDTH, 0.55 * size, text, new_x="LMARGIN", new_y="NEXT")


def _result(pdf: FPDF, one: Certificate, size: float, line: float) -> None:
    """The band with the result, and why there are reservations."""
    top = pdf.get_y() + 1.0
    pdf.set_xy(_LEFT + 4.0, top + 1.0)
    _ink(pdf, one.tone)
    pdf.set_font("text", "B", 18)
    pdf.cell(_WIDTH - 4.0, 8.5, one.heading, new_x="LMARGIN", new_y="NEXT")
    _ink(pdf, "ink")
    pdf.set_font("text", "", size + 0.6)
    for mark, said in (("", one.because), *(("•", reason) for reason in one.reservations)):
        _sentence(pdf, said, line + 0.3, 4.0, mark)
    _ink(pdf, one.tone, fill=True)
    pdf.rect(_LEFT, top, 1.6, pdf.get_y() - top + 1.0, style="F")
    _ink(pdf, "ink")
    pdf.ln(3.0)


def _scale(pdf: FPDF, scale: Scale, tone: str) -> None:
    """The error, its interval and the tolerance on one axis."""
    top, left, wide = pdf.get_y(), _LEFT + 2.0, _WIDTH - 6.0

    def at(mm: float) -> float:
        return left + min(mm / scale.end, 1.0) * wide

    pdf.set_font("text", "", 6.5)
    pdf.set_line_width(0.25)
    pdf.line(left, top + 11.0, left + wide, top + 11.0)
    for mm in ticks(scale.end):
        pdf.line(at(mm), top + 11.0, at(mm), top + 12.2)
        pdf.set_xy(at(mm) - 8.0, top + 12.4)
        pdf.cell(16.0, 3.0, f"{mm:g}", align="C")
    pdf.set_xy(left + wide - 10.0, top + 12.4)
    pdf.cell(10.0, 3.0, "mm", align="R")
    if scale.value is not None:
        low = scale.value if scale.low is None else scale.low
        high = scale.value if scale.high is None else scale.high
        _ink(pdf, tone, fill=True)
        pdf.rect(at(low), top + 5.2, max(at(high) - at(low), 0.5), 3.4, style="F")
        _ink(pdf, "ink")
        pdf.set_line_width(0.6)
        pdf.line(at(scale.value), top + 4.2, at(scale.value), top + 9.6)
    _ink(pdf, "bad")
    pdf.set_line_width(0.5)
    pdf.set_dash_pattern(dash=1.4, gap=0.8)
    pdf.line(at(scale.asked), top + 3.4, at(scale.asked), top + 11.0)
    pdf.set_dash_pattern()
    pdf.set_line_width(0.2)
    _ink(pdf, "ink")
    pdf.set_xy(at(scale.asked) - 20.0, top)
    pdf.cell(40.0, 3.0, f"tolerance {scale.asked:g}", align="C")
    pdf.set_xy(_LEFT, top + 16.0)
    _ink(pdf, "soft")
    words = "Bar: 95 % interval of the error that is judged; stroke in it: the error; dashed: the tolerance."
    if scale.before is not None:
        words += f" Before calibration the error was {scale.before:.3f} mm."
    pdf.cell(_WIDTH, 3.2, words, new_x="LMARGIN", new_y="NEXT")
    _ink(pdf, "ink")
    pdf.ln(1.5)


def _facts(pdf: FPDF, one: Certificate, size: float, line: float) -> None:
    for name, value in one.facts:
        pdf.set_font("text", "", size)
        _ink(pdf, "soft")
        pdf.cell(_NAME, line, name)
        _ink(pdf, "ink")
        if value:
            pdf.multi_cell(_WIDTH - _NAME, line, value, align="L", new_x="LMARGIN", new_y="NEXT")
        else:
            y = pdf.get_y() + line - 0.6
            pdf.set_dash_pattern(dash=0.4, gap=0.6)
            pdf.line(_LEFT + _NAME + 1.0, y, _LEFT + _NAME + 70.0, y)
            pdf.set_dash_pattern()
            pdf.ln(line)


def _errors(pdf: FPDF, one: Certificate, size: float, line: float) -> None:
    """Before and after, lengths and angles in tables of their own."""
    _title(pdf, "Error on scored stations", size)
    positions: list[_Line] = [(row.name, row.mm, 3) for row in one.errors]
    turned: list[_Line] = [(row.name, row.deg, 4) for row in one.errors if row.deg is not None]
    tables: list[tuple[tuple[str, ...], list[_Line]]] = [
        (("position, mm", "mean", "RMS", "95 %", "largest"), positions)
    ]
    if turned:
        tables.append((("orientation, °", "mean", "RMS", "95 %", "largest"), turned))
    for header, rows in tables:
        pdf.set_font("text", "", size)
        _ink(pdf, "soft")
        for k, name in enumerate(header):
            pdf.cell(62.0 if not k else 24.0, line, name, align="R" if k else "L")
        pdf.ln(line)
        _ink(pdf, "ink")
        for name, values, digits in rows:
            pdf.cell(62.0, line, name)
            for value in values:
                pdf.cell(24.0, line, f"{value:.{digits}f}", align="R")
            pdf.ln(line)
        pdf.ln(0.6)
    pdf.cell(_WIDTH, line, f"Floor of arm and instrument: {one.floor}.", new_x="LMARGIN", new_y="NEXT")


def _paragraphs(pdf: FPDF, title: str, said: tuple[str, ...], size: float, line: float, mark: str = "") -> None:
    _title(pdf, title, size)
    pdf.set_font("text", "", size)
    for sentence in said:
        _sentence(pdf, sentence, line, 0.0, mark)


def _sentence(pdf: FPDF, said: str, line: float, indent: float, mark: str) -> None:
    """A sentence, behind a mark and in line with it where there is one. indent: [mm]."""
    pdf.set_x(_LEFT + indent)
    if mark:
        pdf.cell(4.0, line, mark)
        indent += 4.0
    pdf.multi_cell(_WIDTH - indent, line, said, align="L", new_x="LMARGIN", new_y="NEXT")


def _signatures(pdf: FPDF, one: Certificate, size: float) -> None:
    y, wide = pdf.get_y() + 11.0, 0.5 * _WIDTH - 6.0
    for k, (role, name) in enumerate(one.signatures):
        x = _LEFT + k * (wide + 12.0)
        pdf.set_font("text", "", size)
        pdf.set_xy(x, y - 4.6)
        pdf.cell(wide, 4.0, name)
        pdf.line(x, y, x + wide, y)
        _ink(pdf, "soft")
        pdf.set_xy(x, y + 0.6)
        pdf.cell(wide, 4.0, f"{role}: name, date, signature")
        _ink(pdf, "ink")
    pdf.set_xy(_LEFT, y + 5.0)
