"""The picture at the top of the README: an arm that moves between held-out stations, with what it misses by.

.venv/bin/python scripts/moving_picture.py      # writes docs/before_after.svg; after `make build`

Calibrates the recording in bags/ and draws stations that neither the fit nor the choice of effects has seen. A ring is
where the tracker saw the tool, a dot where the model puts it, SCALE times as far off as it is. The picture is one SVG
file without scripts: it moves by SMIL, follows the reader's colour scheme, and stands still with every station shown
where the reader wants nothing to move: SMIL does not ask, so that a still arm stands beside the moving one.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from modcal_core.report.charts import DARK, LIGHT  # noqa: E402
from modcal_core.report.figures import scene  # noqa: E402
from modcal_core.report.report import Report  # noqa: E402
from modcal_core.robots.mechanism import tool_frames  # noqa: E402
from modcal_nodes.io.inputs import calibrate_bag  # noqa: E402
from modcal_nodes.io.options import Options  # noqa: E402

Array = NDArray[np.float64]
SCALE = 100  # how much longer errors are drawn
STATIONS = 9
ABOVE = -0.02  # m; postures that reach below the floor are not shown
MOVE, STAY = 0.9, 1.1  # s
BETWEEN = 5  # pictures of a move
WIDTH, HEIGHT, PANEL = 860, 420, 430
METRE = 200.0  # px
SEEN_FROM = np.radians([-50.0, 18.0])  # azimuth and elevation


@dataclass(frozen=True)
class Shots:
    """What is drawn, in metres in the base.

    arms: postures as polylines (F, k, 3). when: their times (F,), shares of the whole. Of each station: when the arm is
    there (S, 2), where the tool was seen (S, 3), its errors before and after (S, 3).
    """

    arms: Array
    when: Array
    stays: Array
    seen: Array
    before: Array
    after: Array
    rms_mm: tuple[float, float]


def shots(report: Report) -> Shots:
    """The held-out stations of a report, a few of them, in an order in which the joints move little."""
    drawn, model = scene(report), report.model
    assert drawn is not None
    assert model is not None
    q = report.scored.q
    above = [i for i, path in enumerate(_paths(report, q)) if path[:, 2].min() > ABOVE]
    order = _route(q, above)[:STATIONS]
    round_trip = [*order, order[0]]
    stays: list[tuple[float, float]] = []
    steps, when, now = [q[order[0]]], [0.0], 0.0
    whole = STATIONS * (MOVE + STAY)
    for here, there in pairwise(round_trip):
        stays.append((now / whole, (now + STAY) / whole))
        now += STAY
        steps.append(q[here])
        when.append(now / whole)
        for s in np.linspace(0.0, 1.0, BETWEEN + 1)[1:]:
            eased = s * s * (3.0 - 2.0 * s)
            steps.append((1.0 - eased) * q[here] + eased * q[there])
            when.append((now + s * MOVE) / whole)
        now += MOVE
    arms = _paths(report, np.array(steps))
    sizes = [report.size_mm(stage) for stage in ("nominal", "final")]
    assert sizes[0] is not None
    assert sizes[1] is not None
    return Shots(
        arms, np.array(when), np.array(stays), drawn.points[order],
        drawn.stages[0][1][order], drawn.stages[-1][1][order], (sizes[0].rms, sizes[1].rms),
    )  # fmt: skip


def _paths(report: Report, q: Array) -> Array:
    """The arm in postures (F, n) as polylines from its base to the tool, (F, k, 3)."""
    model = report.model
    assert model is not None
    frames = tool_frames(model.chain, model.T_tip_tool, q)
    T = model.chain.T_base_root
    p = np.moveaxis(frames.p, -1, 0) @ T[:3, :3].T + T[:3, 3]
    return np.concatenate([np.zeros((len(p), 1, 3)), p], axis=1)


def _route(q: Array, rows: list[int]) -> list[int]:
    """These rows of q, each next to the one before: the nearest that was not there yet."""
    route, left = rows[:1], set(rows[1:])
    while left:
        nearest = min(left, key=lambda i: float(np.abs(q[i] - q[route[-1]]).max()))
        route.append(nearest)
        left.remove(nearest)
    return route


def flat(p: Array) -> Array:
    """Points (…, 3) [m] on the panel (…, 2) [px]."""
    azimuth, elevation = SEEN_FROM
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    ahead = np.array([-np.cos(azimuth) * np.cos(elevation), -np.sin(azimuth) * np.cos(elevation), -np.sin(elevation)])
    up = np.cross(right, ahead)
    out: Array = np.stack([PANEL / 2 + METRE * (p @ right), 358.0 - METRE * (p @ up)], axis=-1)
    return out


def points(polyline: Array) -> str:
    """Points (k, 2) as SVG writes them."""
    return " ".join(f"{x:.0f},{y:.0f}" for x, y in polyline)


def panel(shot: Shots, errors: Array, kind: str, title: str, rms_mm: float) -> str:
    """One half: the arm, and at each station the ring, the dot, and the line between them."""
    whole = STATIONS * (MOVE + STAY)
    keys = ";".join(f"{t:.4f}" for t in shot.when)
    arms = flat(shot.arms)
    arm = (
        f'<polyline class="arm" points="{points(arms[0])}"><animate attributeName="points" dur="{whole:g}s" '
        f'repeatCount="indefinite" keyTimes="{keys}" values="{";".join(points(a) for a in arms)}"/></polyline>'
    )
    still = f'<polyline class="arm" points="{points(arms[0])}"/>'
    marks, moving, numbers = [], [], []
    for seen, error, (begin, end) in zip(shot.seen, errors, shot.stays, strict=True):
        (x, y), (u, v) = flat(seen), flat(seen - SCALE * error)
        mark = f'<path class="miss" d="M{x:.1f},{y:.1f}L{u:.1f},{v:.1f}"/>'
        mark += f'<circle class="ring" cx="{x:.1f}" cy="{y:.1f}" r="5"/>'
        mark += f'<circle class="dot" cx="{u:.1f}" cy="{v:.1f}" r="3"/>'
        faded = f'<animate attributeName="opacity" dur="{whole:g}s" repeatCount="indefinite" calcMode="discrete" '
        marks.append(mark)
        moving.append(f'<g>{mark}{faded}keyTimes="0;{max(begin, 1e-4):.4f};1" values="0;1;1"/></g>')
        number = f'<text x="{PANEL / 2:.0f}" y="88" opacity="0">here {1e3 * np.linalg.norm(error):.3f} mm'
        numbers.append(f'{number}{faded}keyTimes="0;{max(begin, 1e-4):.4f};{end:.4f};1" values="0;1;0;0"/></text>')
    foot = flat(np.zeros(3))
    floor = flat(np.array([[0.6, 0.6, 0], [-0.6, 0.6, 0], [-0.6, -0.6, 0], [0.6, -0.6, 0]], dtype=float))
    return (
        f'<g class="{kind}"><polygon class="floor" points="{points(floor)}"/>'
        f'<text class="title" x="{PANEL / 2:.0f}" y="34">{title}</text>'
        f'<text class="rms" x="{PANEL / 2:.0f}" y="64">{rms_mm:.2g} mm RMS</text>'
        f'<circle class="foot" cx="{foot[0]:.0f}" cy="{foot[1]:.0f}" r="11"/>'
        f'<g class="still">{still}{"".join(marks)}</g>'
        f'<g class="moving">{arm}{"".join(moving)}{"".join(numbers)}</g></g>'
    )


def svg(shot: Shots) -> str:
    """The whole picture."""
    before = panel(shot, shot.before, "before", "with the nominal model", shot.rms_mm[0])
    after = panel(shot, shot.after, "after", "calibrated by modcal", shot.rms_mm[1])
    return f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT + 24}" width="{WIDTH}" height="{HEIGHT + 24}" role="img" aria-labelledby="what">
<title id="what">A simulated UR10 moves between {STATIONS} stations that no fit has seen. The nominal model misses the tool by {shot.rms_mm[0]:.2g} mm RMS, the calibrated one by {shot.rms_mm[1]:.2g} mm.</title>
<style>
svg {{ {_variables(LIGHT)} font-family: system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }}
@media (prefers-color-scheme: dark) {{ svg {{ {_variables(DARK)} }} }}
.card {{ fill: var(--paper); stroke: var(--line); }}
text {{ fill: var(--soft); font-size: 15px; text-anchor: middle; }}
.title {{ fill: var(--ink); font-size: 18px; }}
.rms {{ font-size: 24px; font-weight: 700; fill: var(--kind); }}
.floor {{ fill: var(--panel); stroke: var(--line); }}
.foot {{ fill: var(--soft); }}
marker circle {{ fill: var(--paper); stroke: var(--soft); stroke-width: 0.3; }}
.arm {{ marker-mid: url(#joint); fill: none; stroke: var(--soft); stroke-width: 8; stroke-linecap: round; stroke-linejoin: round; }}
.ring {{ fill: none; stroke: var(--ink); stroke-width: 1.6; }}
.miss {{ stroke: var(--kind); stroke-width: 2.4; }}
.dot {{ fill: var(--kind); }}
.still {{ display: none; }}
@media (prefers-reduced-motion: reduce) {{ .still {{ display: inline; }} .moving {{ display: none; }} }}
@media print {{ .still {{ display: inline; }} .moving {{ display: none; }} }}
.before {{ --kind: var(--bad); }}
.after {{ --kind: var(--good); }}
</style>
<marker id="joint" viewBox="-1 -1 2 2" markerWidth="1.3" markerHeight="1.3"><circle r="0.8"/></marker>
<rect class="card" x="0.5" y="0.5" width="{WIDTH - 1}" height="{HEIGHT + 23}" rx="10"/>
{before}
<g transform="translate({PANEL} 0)">{after}</g>
<text x="{WIDTH / 2:.0f}" y="{HEIGHT + 12}">ring: where the tracker sees the tool · dot: where the model puts it, errors drawn {SCALE} times as long</text>
</svg>
"""  # noqa: E501


def _variables(colours: dict[str, str]) -> str:
    return " ".join(f"--{name}: {value};" for name, value in colours.items() if name not in ("after", "before", "warn"))


def main() -> None:
    """Calibrate and draw."""
    report = calibrate_bag(ROOT / "bags" / "ur10_cell", Options()).result.report
    (ROOT / "docs" / "before_after.svg").write_text(svg(shots(report)), encoding="utf-8")


if __name__ == "__main__":
    main()
