"""The certificate as a page that prints on one sheet of A4."""

from __future__ import annotations

from modcal_core.report.certificates import Certificate, Scale
from modcal_core.report.page import Chart, framed, render

_WIDTH, _LEFT, _RIGHT = 370.0, 8.0, 362.0  # points; a phone shows all of it
_LABEL = 36.0  # points, half of what the tolerance's label takes
_HEIGHT, _BAR, _AXIS = 54.0, 22.0, 36.0


def certificate_html(one: Certificate) -> str:
    """The certificate as HTML text."""
    return render(
        "certificate.html.j2",
        title=one.title,
        verdict=one.because,
        heading=one.heading,
        tone=one.tone,
        one=one,
        scale=drawn(one.scale, one.tone),
    )


def drawn(scale: Scale, tone: str) -> Chart:
    """The error, its interval and the tolerance on one axis."""

    def at(mm: float) -> float:
        return _LEFT + min(mm / scale.end, 1.0) * (_RIGHT - _LEFT)

    ink = "stroke:var(--ink)"
    parts = [f'<path d="M{_LEFT} {_AXIS}H{_RIGHT}" style="{ink};stroke-width:0.8"/>']
    for mm in ticks(scale.end):
        parts.append(f'<path d="M{at(mm):.1f} {_AXIS}v4" style="{ink};stroke-width:0.8"/>')
        parts.append(_text(f"{mm:g}", at(mm), _AXIS + 14.0, "middle" if mm else "start"))
    parts.append(_text("mm", _RIGHT, _AXIS + 14.0, "end"))
    if scale.value is not None:
        low = scale.value if scale.low is None else scale.low
        high = scale.value if scale.high is None else scale.high
        wide = max(at(high) - at(low), 1.5)
        parts.append(
            f'<rect x="{at(low):.1f}" y="{_BAR - 5}" width="{wide:.1f}" height="10" style="fill:var(--{tone})"/>'
            f'<path d="M{at(scale.value):.1f} {_BAR - 8}v16" style="{ink};stroke-width:1.6"/>'
        )
    parts.append(
        f'<path d="M{at(scale.asked):.1f} 13V{_AXIS}" style="stroke:var(--bad);stroke-width:1.4;stroke-dasharray:4 2"/>'
    )
    asked = at(scale.asked)
    anchor = "start" if asked < _LEFT + _LABEL else "end" if asked > _RIGHT - _LABEL else "middle"
    parts.append(_text(f"tolerance {scale.asked:g}", asked, 9.0, anchor))
    said = f"tolerance {scale.asked:g} mm"
    if scale.value is not None:
        said += f", error {scale.value:.3f} mm"
    if scale.low is not None and scale.high is not None:
        said += f" with a 95 % interval of {scale.low:.3f} to {scale.high:.3f} mm"
    words = "Bar: 95 % interval of the error that is judged; stroke in it: the error; dashed: the tolerance."
    if scale.before is not None:
        words += f" Before calibration the error was {scale.before:.3f} mm."
    return Chart("scale", framed("".join(parts) + "</svg>", _WIDTH, _HEIGHT, f"Scale in millimetres: {said}."), words)


def ticks(end: float) -> list[float]:
    """Round numbers [mm] from 0 to end, about five."""
    from modcal_core.report.panel import round_numbers

    return [abs(round(float(value), 9)) for value in round_numbers(0.0, 0.92 * end)[0]]


def _text(said: str, x: float, y: float, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" style="font-size:8.5px;text-anchor:{anchor}">{said}</text>'
