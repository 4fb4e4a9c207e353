"""Pages that need nothing else: one file, its style and scripts inside, nothing fetched; and pictures for them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Any

from modcal_core.report.palette import DARK, LIGHT, TINT

if TYPE_CHECKING:
    from jinja2 import Environment

    from modcal_core.report.robot_scene import RobotScene

_PX = 1.48  # on the page, per point of a small chart: three then fill a row
_NARROWEST = 300.0  # px; a wider chart is shrunk no further than 0.65 of its size, and can be moved sideways instead


@dataclass(frozen=True)
class Chart:
    """A picture of a page. drawn: SVG in the page's colours. caption: under it. name: unique on the page."""

    name: str
    drawn: str
    caption: str


@dataclass(frozen=True)
class PageTable:
    """A table of a page. words: how many columns, from the left, hold words. below: a sentence under it."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int = 1
    below: str = ""


def render(template: str, **values: Any) -> str:
    """The page that a template of this package makes of these values."""
    return str(_environment().get_template(template).render(light=LIGHT, dark=DARK, tint=TINT, **values))


@cache
def _environment() -> Environment:
    """The templates."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("modcal_core.report", "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )


def plain_page(
    title: str,
    verdict: str,
    lines: list[str],
    charts: list[Chart],
    files: list[tuple[str, str]],
    tables: Sequence[PageTable] = (),
    robot: RobotScene | None = None,
    expert: Sequence[Chart] = (),
    expert_tables: Sequence[PageTable] = (),
    heading: str = "Result",
    tone: str = "plain",
) -> str:
    """A page of an answer, sentences, tables and pictures. verdict: the answer. files: names and what each holds.

    robot: the arm in three dimensions, where there is one to show. expert, expert_tables: what is folded
    away. heading, tone: a word over the answer, and its colour (plain, good, warn, bad).
    """
    return render(
        "plain.html.j2",
        title=title,
        verdict=verdict,
        tone=tone,
        heading=heading,
        lines=lines,
        charts=charts,
        expert=expert,
        expert_tables=expert_tables,
        files=files,
        tables=tables,
        scene=None if robot is None else as_script_data(robot.to_data()),
        scene_alt="" if robot is None else robot.alt,
        postures=0 if robot is None else len(robot.arms),
    )


def as_script_data(data: Any) -> str:
    """JSON that can stand inside a script element."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def framed(body: str, width: float, height: float, alt: str, px: float = _PX) -> str:
    """An SVG element of this width and height. body: what stands in it, and its end. px: of the page in a unit of it.

    alt: what it shows, for those who do not see it.
    """
    natural = px * width
    least = min(natural, max(_NARROWEST, 0.65 * natural))
    return (
        f'<svg class="chart" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(alt, quote=True)}" '
        f'style="max-width:{natural:.0f}px;min-width:{least:.0f}px">{body}'
    )
