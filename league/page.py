"""The page of the league: one static HTML file without scripts, made of the results alone; beside it the arms in 3-D.

python -m league.page league/results build/league [FOLDER]
"""

from __future__ import annotations

import html
import json
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from league import robot
from league.methods import METHODS, MISSING
from league.tasks import problem

HERE = Path(__file__).resolve().parent
Row = dict[str, Any]
OURS = "modcal"
WIDTH, LINE, LEFT, RIGHT = 720, 22, 170, 130  # px of a plot, its rows, and what stands beside the bars
SHOWN = "ur10_cubes"  # whose arm stands on the page itself
CAMERA, DOORS = "from a camera", "doors"
GROUPS = {"Arms": None, "Cameras": CAMERA, "Doors": DOORS}  # tables of tasks: all that is no track of the others'
INTRO = """<p>{} methods on {} tasks. Errors are distances at the tool in mm on rows that no method was given, and
<b>every</b> such row counts, also those that a method would call wrong; of cameras, where the camera is in the board's
frame; of doors, distances of the handle from where it was said to go. Intervals are of 95 %: blocks of rows that belong
together are drawn again. Simulated tasks (sim_) are scored on what is true. A green cell is the first of its task, or
its RMS lies within the first one's interval.</p>"""


def read(folder: Path) -> list[Row]:
    """All results of a folder and the published figures."""
    rows = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    return rows + json.loads((HERE / "published.json").read_text())


def ran(rows: list[Row], task: str) -> list[Row]:
    """Of a task, those with figures of their own, the best first."""
    own = (r for r in rows if r["task"] == task and r["status"] == "ran" and not r["published"])
    return sorted(own, key=lambda r: r["rms_mm"])


def beaten(rows: list[Row], task: str, method: str = OURS) -> tuple[Row, Row] | None:
    """The method's result and that of the first, where its RMS lies above the interval of the first."""
    order = ran(rows, task)
    own = next((r for r in order if r["method"] == method), None)
    return None if own is None or own["rms_mm"] <= order[0]["rms_ci95"][1] else (own, order[0])


def page(rows: list[Row], reasons: dict[str, str], robots: Iterable[str] = ()) -> str:
    """The whole page. reasons: by task, why modcal is not first there. robots: tasks whose arm has a page."""
    track = {r["task"]: r.get("track", "") for r in rows if r["status"] == "ran" and not r["published"]}
    tasks, robots = list(track), list(robots)
    met = dict.fromkeys(r["method"] for r in rows if not r["published"])
    methods = [m for m in METHODS if m in met] + [m for m in met if m not in METHODS]
    versions = {r["method"]: r.get("version", "") for r in rows if r["status"] == "ran"}
    lines = ((f"{_e(m)} {_e(versions.get(m, ''))}", _e(METHODS.get(m, {}).get("about", ""))) for m in methods)
    missing = ((_e(name), _e(why)) for name, why in MISSING.items())
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><meta name='viewport' content='width=device-width'>",
        f"<title>The league</title><style>{(HERE / 'page.css').read_text()}</style>",
        "<h1>Every method, the same recordings</h1>",
        INTRO.format(len(methods), len(tasks)),
        *(_group(rows, title, of, track, methods) for title, of in GROUPS.items()),
        f"<h2>An arm</h2><iframe src='{_file(SHOWN)}' title='The arm of {SHOWN} in 3-D'></iframe>" * (SHOWN in robots),
        f"<h2>Where modcal is not first</h2>{_losses(rows, tasks, reasons)}",
        f"<h2>What was claimed</h2>{_claims(rows, tasks, methods, reasons)}",
        f"<h2>Published figures</h2>{_published(rows)}",
        *(_task(rows, task, task in robots) for task in tasks),
        f"<h2>Methods</h2>{_table(('method', 'what it is'), lines)}<h2>Not here</h2>{_table(('name', 'why'), missing)}",
    ]
    return "\n".join(parts) + "\n"


def _e(text: object) -> str:
    return html.escape(str(text))


def _mm(value: float) -> str:
    return f"{value:.3f}" if value < 10 else f"{value:.1f}"


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of cells that are HTML already; one that begins with a class in braces gets it."""

    def line(tag: str, row: Iterable[str]) -> str:
        cells = (cell.split("}", 1) if cell.startswith("{") else ("", cell) for cell in row)
        return "<tr>" + "".join(f"<{tag} class='{c[1:]}'>{text}</{tag}>" for c, text in cells) + "</tr>"

    return f"<div class='wide'><table>{line('th', heads)}{''.join(line('td', row) for row in rows)}</table></div>"


def _file(task: str) -> str:
    return f"arm_{task.replace('#', '_')}.html"


def _link(task: str) -> str:
    return f"<a href='#{_e(task)}'>{_e(task)}</a>"


def _group(rows: list[Row], title: str, of: str | None, track: dict[str, str], methods: list[str]) -> str:
    """The table of one group of tasks and of the methods that do any of them; nothing where there are none."""
    rest = {name for name in GROUPS.values() if name}
    tasks = [task for task, own in track.items() if (own == of if of else own not in rest)]
    ran_any = {r["method"] for r in rows if r["task"] in tasks and r["status"] == "ran"}
    return f"<h2>{title}</h2>{_matrix(rows, tasks, [m for m in methods if m in ran_any])}" if tasks else ""


def _published(rows: list[Row]) -> str:
    """Peers' own figures, and the same by the same definition where their data is at hand."""
    lines = []
    for r in (r for r in rows if r["published"]):
        mean, here = r.get("mean_mm"), r.get("here_mm")
        got = f"{_mm(here)} ({100.0 * (here / mean - 1.0):+.1f} %)" if mean and here else ""
        lines.append((_e(r["task"]), _e(r["method"]), _mm(mean) if mean else "", got, "{text}" + _e(r["source"])))
    return _table(("data", "method", "published mean", "here", "{text}what it is"), lines)


def _matrix(rows: list[Row], tasks: list[str], methods: list[str]) -> str:
    by = {(r["task"], r["method"]): r for r in rows if not r["published"]}

    def cell(task: str, method: str) -> str:
        r = by.get((task, method), {"status": "–"})
        if r["status"] != "ran":
            return "{soft}" + {"not applicable": "–"}.get(r["status"], r["status"])
        first = r["rms_mm"] <= ran(rows, task)[0]["rms_ci95"][1]
        return ("{best}" if first else "") + _mm(r["rms_mm"])

    return _table(("RMS, mm", *map(_e, methods)), ((_link(t), *(cell(t, m) for m in methods)) for t in tasks))


def _why(reasons: dict[str, str], task: str) -> str:
    return reasons.get(task.split("#")[0], "not known")


def _losses(rows: list[Row], tasks: list[str], reasons: dict[str, str]) -> str:
    lost = [(task, *pair) for task in tasks if (pair := beaten(rows, task))]
    if not lost:
        return "<p>In every task modcal is the first, or within the interval of the first.</p>"
    lost.sort(key=lambda item: -item[1]["rms_mm"] / item[2]["rms_mm"])
    lines = []
    for task, own, first in lost:
        ratio = f"{own['rms_mm'] / first['rms_mm']:.2f}"
        why = "{text}" + _e(_why(reasons, task))
        lines.append((_link(task), _mm(own["rms_mm"]), _mm(first["rms_mm"]), _e(first["method"]), ratio, why))
    return _table(("task", "modcal", "first", "", "ratio", "{text}why, as far as known"), lines)


def _claims(rows: list[Row], tasks: list[str], methods: list[str], reasons: dict[str, str]) -> str:
    lines, silent = [], []
    for method in methods:
        own = [r for task in tasks for r in ran(rows, task) if r["method"] == method]
        told = sorted(r["coverage"] for r in own if r["coverage"] is not None)
        if not told:
            silent.append(method)
            continue
        wrong, opened = (sum(bool(r[key]) for r in own) for key in ("calm_and_wrong", "open"))
        causes = [r["false_causes"] for r in own if r.get("false_causes") is not None]
        cells = [
            _e(method),
            str(len(told)),
            f"{100 * told[len(told) // 2]:.0f} %",
            ("{bad}" if wrong else "") + str(wrong),
        ]
        lines.append((*cells, str(opened), str(sum(causes)) if causes else ""))
    heads = ("method", "tasks with a claim", "median coverage", "calm and wrong", "says open", "false causes")
    calm = [task for task in tasks for r in ran(rows, task) if r["method"] == OURS and r["calm_and_wrong"]]
    ours = "".join(f"<p>{OURS} in {_link(task)}: {_e(_why(reasons, task))}</p>" for task in calm)
    return _table(heads, lines) + ours + f"<p class='soft'>No claim at all: {_e(', '.join(silent))}.</p>"


def _task(rows: list[Row], task: str, drawn: bool) -> str:
    order = ran(rows, task)
    against = "what is true" if order[0]["truth"] else "readings"
    about = (
        f"{_e(order[0].get('about', ''))} ({_e(order[0]['track'])}); {order[0]['scored']} rows scored, on {against}."
    )
    about += f" <a href='{_file(task)}'>The arm in 3-D</a>." * drawn
    lines = []
    for r in order:
        name = ("{ours}" if r["method"] == OURS else "") + _e(r["method"])
        claim = "" if r["claim_p95_mm"] is None else _mm(r["claim_p95_mm"]) + (" (open)" if r["open"] else "")
        cells = [name, _mm(r["rms_mm"]), " – ".join(map(_mm, r["rms_ci95"])), _mm(r["p95_mm"]), _mm(r["max_mm"])]
        cells += ["" if r.get("rms_deg") is None else f"{r['rms_deg']:.3f}°", claim]
        cells += ["" if r["coverage"] is None else f"{100 * r['coverage']:.0f} %"]
        cells += ["{bad}yes" if r["calm_and_wrong"] else "", f"{r['cpu_s']:.1f}", f"{r['memory_mb']:.0f}"]
        lines.append((*cells, "{text}" + _e(r["remark"][:200])))
    heads = (
        "method",
        "RMS",
        "95 %",
        "p95",
        "max",
        "turn, RMS",
        "claimed p95",
        "coverage",
        "calm and wrong",
        "processor s",
        "MB",
        "",
    )
    out = [f"<h2 id='{_e(task)}'>{_e(task)}</h2><p>{about}</p>", _plot(order), _table(heads, lines)]
    for r in (r for r in rows if r["task"] == task and r not in order):
        mean = f", mean {_mm(r['mean_mm'])} mm" if "mean_mm" in r else ""
        said = f"published{mean}: {r['source']}" if r["published"] else f"{r['status']}: {r['remark']}"
        out.append(f"<p class='soft'>{_e(r['method'])}, {_e(said)}</p>")
    return "".join(out)


def _plot(order: list[Row]) -> str:
    """Bars on a logarithmic axis with their intervals."""
    ends = [max(v, 1e-4) for r in order for v in (*r["rms_ci95"], r["rms_mm"])]
    low, high = math.log10(min(ends)) - 0.15, math.log10(max(ends)) + 0.05

    def x(value: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (math.log10(max(value, 1e-4)) - low) / (high - low)

    height = LINE * len(order) + 26
    out = [f"<div class='wide'><svg viewBox='0 0 {WIDTH} {height}' role='img' aria-label='RMS by method, logarithmic'>"]
    steps = (1, 2, 5) if high - low < 1.5 else (1,)
    ticks = (m * 10.0**d for d in range(math.floor(low), math.ceil(high) + 1) for m in steps)
    for tick in (t for t in ticks if low <= math.log10(t) <= high):
        out.append(f"<line x1='{x(tick):.1f}' x2='{x(tick):.1f}' y1='0' y2='{height - 20}' stroke='var(--line)'/>")
        out.append(f"<text x='{x(tick):.1f}' y='{height - 6}' text-anchor='middle'>{tick:g}</text>")
    for k, r in enumerate(order):
        y, colour = LINE * k + 4, "var(--ours)" if r["method"] == OURS else "var(--other)"
        (a, b), end = (x(v) for v in r["rms_ci95"]), x(r["rms_mm"])
        out.append(f"<text x='{LEFT - 8}' y='{y + 12}' text-anchor='end'>{_e(r['method'])}</text>")
        out.append(f"<rect x='{LEFT}' y='{y}' width='{max(end - LEFT, 1):.1f}' height='14' fill='{colour}'/>")
        out.append(f"<line x1='{a:.1f}' x2='{b:.1f}' y1='{y + 7}' y2='{y + 7}' stroke='var(--ink)' stroke-width='2'/>")
        out.append(f"<text x='{max(b, end) + 6:.1f}' y='{y + 12}'>{_mm(r['rms_mm'])} mm</text>")
    return "".join(out) + "</svg></div>"


def write(results: Path, out: Path, data: Path | None = None) -> Path:
    """Write index.html and the arms' pages into a folder and return the path of the first. data: as tasks need it."""
    out.mkdir(parents=True, exist_ok=True)
    rows, robots = read(results), []
    for task in dict.fromkeys(r["task"] for r in rows if r.get("shown_mm")):
        try:
            (out / _file(task)).write_text(robot.drawn(problem(task, data), ran(rows, task)), encoding="utf-8")
        except FileNotFoundError:
            continue  # the recording is not at hand
        robots.append(task)
    file, reasons = out / "index.html", json.loads((HERE / "reasons.json").read_text())
    file.write_text(page(rows, reasons, robots), encoding="utf-8")
    return file


if __name__ == "__main__":
    print(write(*map(Path, sys.argv[1:])))
