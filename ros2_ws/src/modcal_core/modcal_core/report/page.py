"""Pages that need nothing else: one file, its style and scripts inside, nothing fetched; and pictures for them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.robots import ARMS, Mechanism, is_delta, tool_frames

if TYPE_CHECKING:
    from jinja2 import Environment


INK, SOFT, LINE, PAPER, PANEL = "ink", "soft", "line", "paper", "panel"
AFTER, BEFORE, GOOD, WARN, BAD = "after", "before", "good", "warn", "bad"

# Text stands on paper and on panels in ink, soft, after, good, warn and bad: those keep a contrast of 4.5 there.
COLOURS: dict[str, tuple[str, str]] = {
    INK: ("#1c2430", "#e6eaf0"),
    SOFT: ("#566172", "#a9b3c1"),
    LINE: ("#d5dbe4", "#3a4350"),
    PAPER: ("#ffffff", "#12161c"),
    PANEL: ("#f3f6fa", "#1c222b"),
    AFTER: ("#1a5fd0", "#7db1ff"),
    BEFORE: ("#8791a0", "#7f8a99"),
    GOOD: ("#2c6a38", "#7fcb8d"),
    WARN: ("#85560a", "#e3b560"),
    BAD: ("#b3263c", "#ff8f99"),
}
LIGHT = {name: light for name, (light, _) in COLOURS.items()}
DARK = {name: dark for name, (_, dark) in COLOURS.items()}
OF_AXES = (BAD, GOOD, AFTER)  # x, y, z
TINT = 50  # per cent of `after` in the fullest cell of a map; ink can be read on it

MAX_POSTURES, MAX_POINTS = 60, 500  # that a page can show and a person look through


@dataclass(frozen=True)
class RobotScene:
    """All in the arm's base [m]. arms: polylines (k, 3), one a posture. said: a sentence for each posture. points: of
    the target (N, 3), at the postures ``shown`` (indices). route: whether they are connected in order. cloud: others
    (M, 3). marks: named places. weights: for each joint how large it is drawn, 0 … 1; empty: alike. base: its link.
    alt: for those who do not see it.
    """

    arms: tuple[Array, ...]
    said: tuple[str, ...]
    points: Array
    shown: np.ndarray
    base: str
    alt: str
    route: bool = False
    cloud: Array | None = None
    marks: tuple[tuple[str, Array], ...] = ()
    weights: tuple[float, ...] = ()

    def to_data(self) -> dict[str, Any]:
        """What the page's script draws."""
        cloud = np.empty((0, 3)) if self.cloud is None else self.cloud
        return {
            "points": np.round(self.points, 4).tolist(),
            "stages": [],
            "arms": [[np.round(path, 3).tolist()] for path in self.arms],
            "shown": self.shown.tolist(),
            "said": list(self.said),
            "route": self.route,
            "cloud": np.round(cloud, 3).tolist(),
            "marks": [{"name": name, "at": np.round(at, 3).tolist()} for name, at in self.marks],
            "weights": [round(weight, 4) for weight in self.weights],
            "base": self.base,
        }


def arm_paths(chain: Mechanism, q: Array, T_tip_tool: Array | None = None) -> Array:
    """Polylines from base over every joint to the tool at postures q (N, n), (N, n + 2, 3) [m], in the base."""
    frames = tool_frames(chain, np.eye(4) if T_tip_tool is None else T_tip_tool, q, {})
    p = np.moveaxis(frames.p, -1, 0)  # (N, places, 3)
    if is_delta(chain):  # one line over all three arms
        shoulders = [p[:, i] for i in range(1, 1 + ARMS)]
        elbows = [s + frames.loops[i].lever.T for i, s in enumerate(shoulders, 1)]
        tip = p[:, -2] if chain.has_shaft else p[:, -1]
        (a, b, c), (e, f, g) = shoulders, elbows
        return np.stack([p[:, 0], a, e, tip, f, b, c, g, tip, p[:, -1]], axis=1)
    T = chain.T_base_root
    return np.concatenate([np.zeros((len(q), 1, 3)), p @ T[:3, :3].T + T[:3, 3]], axis=1)


def joints_in_words(chain: Mechanism, q: Array) -> str:
    """A posture (n,) in degrees, and millimetres of sliding joints."""
    turning = chain.revolute
    values = (f"{np.degrees(x):.1f}°" if turns else f"{1e3 * x:.1f} mm" for x, turns in zip(q, turning, strict=True))
    return ", ".join(f"{name} {value}" for name, value in zip(chain.names, values, strict=True))


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


_FIRST = ("mrad", "mm")  # then the others by name, numbers without a unit last
_GROUPED = (1e4, 1e7)  # numbers between are written in full, their thousands apart
_STAMP = 1e8  # s; larger ones are moments, of which every second counts

Sizes = Mapping[str, Mapping[str, Any]]  # name of a quantity: value, std and unit, as in report.json


def scaled(unit: str) -> tuple[str, float]:
    """The unit that a person reads for one of SI, and what values are multiplied by."""
    for si, shown in (("rad", "mrad"), ("m", "mm")):
        if unit == si or unit.startswith(f"{si}/"):
            return shown + unit.removeprefix(si), 1e3
    return unit, 1.0


def number(value: float, digits: int = 4) -> str:
    """A number with a few digits; large ones in full."""
    if 1.0 <= abs(value) < _GROUPED[0]:
        rounded = float(f"{value:.{digits}g}")
        behind = max(digits - 1 - int(np.floor(np.log10(abs(rounded)))), 0)
        return f"{rounded:.{behind}f}".replace("-", "−")
    if _GROUPED[0] <= abs(value) < _GROUPED[1]:
        return f"{float(f'{value:.{digits}g}'):,.0f}".replace(",", "\u202f").replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def with_deviation(quantity: Mapping[str, Any]) -> str:
    """Value and standard deviation in the unit that ``scaled`` gives, without it."""
    factor = scaled(quantity["unit"])[1]
    std = quantity["std"]
    if quantity["unit"] == "s" and abs(quantity["value"]) > _STAMP:
        return f"{quantity['value']:.1f}" + (f" ± {number(std, 1)}" if std else "")
    return number(factor * quantity["value"]) + (f" ± {number(factor * std, 1)}" if std else "")


def size_tables(rows: Iterable[tuple[str, Sizes]]) -> list[PageTable]:
    """A table for each unit of what effects are made of. rows: the name of an effect, and its sizes."""
    found: dict[str, list[tuple[str, ...]]] = {}
    for name, sizes in rows:
        for quantity, size in sizes.items():
            cells = (name, quantity.replace("_", " "), with_deviation(size))
            found.setdefault(scaled(str(size["unit"]))[0], []).append(cells)
    ranked = sorted(found, key=lambda unit: (_FIRST.index(unit) if unit in _FIRST else len(_FIRST), unit == "1", unit))
    return [
        PageTable(
            "Sizes without a unit" if unit == "1" else f"Sizes in {unit}",
            ("effect", "quantity", "value" if unit == "1" else f"value, {unit}"),
            tuple(found[unit]),
            words=2,
        )
        for unit in ranked
    ]


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
