"""The report as one page that needs nothing else: no files beside it, no network."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.diagnosis import EvidenceMap
from modcal_core.effects import remembered
from modcal_core.report.as_json import to_json_data
from modcal_core.report.contents import STAGES, ReportContents
from modcal_core.report.figures import comparisons, effect_shapes, error_histogram, spread_chart, timeline
from modcal_core.report.page import Sizes, as_script_data, parameter_tables, render, size_tables
from modcal_core.report.scene import scene, still
from modcal_core.report.sentence import STATUS_WORDS, sentence
from modcal_core.report.terminal import accounts
from modcal_core.verdict import Status

TONES: dict[Status, str] = {"at_floor": "good", "open": "bad", "cannot_tell": "warn"}
MAX_BYTES = 950_000  # of a page: below 1 MB, with what a mail puts around it
_SHARES = (1.0, 0.5, 0.25, 0.1, 0.04)  # of the usual marks that charts have, tried in turn
_MAX_COLUMNS = 28  # drivers of a map
STATISTICS = {"mean": "mean", "rms": "RMS", "p95": "95th percentile", "max": "largest"}
_MAX_LISTED = 30  # stations that were left out


@dataclass(frozen=True)
class File:
    """One file beside the report. holds: what it is for. commands: how to use it, run in the report's folder."""

    name: str
    holds: str
    commands: tuple[str, ...] = ()


FILES = (
    File(
        "calibration.yaml",
        "Everything needed for prediction: nominal and calibrated arm, effects, base frames, tool, covariance.",
        (
            "modcal evaluate calibration.yaml OTHER_BAG --out check",
            'ros2 launch modcal_nodes correct.launch.py calibration:="$PWD"',
        ),
    ),
    File(
        "calibrated.urdf",
        "The robot description with corrected origins, every other byte as it was: geometry, no effects.",
        ("ros2 run robot_state_publisher robot_state_publisher calibrated.urdf",),
    ),
    File("kinematics.yaml", "The same numbers in the manufacturer's format, or by joint name.", ()),
    File(
        "calibrated_delta.yaml",
        "The Delta's constants and the identified tool.",
        ("modcal calibrate OTHER_BAG --delta calibrated_delta.yaml --out again",),
    ),
    File("report.json", "All numbers of this page, for programs.", ("python3 -m json.tool report.json",)),
)


@remembered()
def to_html(report: ReportContents, files: Iterable[str] = (), calibration: str = "") -> str:
    """The report as HTML text, below 1 MB. files: names of what is written beside it. calibration: of an evaluation,
    the name of what was evaluated.

    Where recordings, effects or joints are many, charts are thinned until the page is small enough, and it says so.
    """
    beside = tuple(files)
    for share in _SHARES:
        page = _page(report, beside, calibration, share)
        if len(page.encode()) < MAX_BYTES:
            break
    return page


def _page(report: ReportContents, files: tuple[str, ...], calibration: str, share: float) -> str:
    """The page with this share of the marks and curves that charts usually have."""
    data = to_json_data(report)
    drawn = scene(report, share)
    kind = "evaluation" if report.searched is None else "calibration"
    title = f"{report.title}: {kind} report"
    if report.searched is None and calibration:
        title = f"{calibration}, evaluated on {report.title}"
    return render(
        "report.html.j2",
        title=title,
        verdict=sentence(report),
        tone=TONES[report.status],
        heading=f"Verdict: {STATUS_WORDS[report.status]}",
        accounts=[(one, one.drawn()) for one in accounts(report.judged)],
        counts_rejected=report.counts_rejected,
        data=data,
        claim=report.claim and report.claim.sentence,
        statistics=STATISTICS.items(),
        tiles=_tiles(report, data),
        stages=[stage for stage in STAGES if data["error_mm"][stage]],
        histogram=error_histogram(report),
        offsets=_offsets(report),
        tables=parameter_tables(report.parameters),
        sizes=size_tables(_named_sizes(data)),
        scene=None if drawn is None else as_script_data(drawn.to_data()),
        scene_stages=[] if drawn is None else [name for name, _ in drawn.stages],
        postures=0 if drawn is None else len(drawn.paths),
        partly=drawn is not None and drawn.partly,
        still=None if drawn is None else still(drawn),
        comparisons=comparisons(report, share),
        shapes=effect_shapes(report, share),
        maps=_maps(report.evidence),
        spread=spread_chart(report),
        timeline=timeline(report, share),
        rejected=_rejected(report),
        files=[file for file in FILES if file.name in files],
        rivals=any(f["same_as"] for f in data["effects"]),
        thinned=0 if share == 1.0 else round(100 * share),
    )


def _named_sizes(data: dict[str, Any]) -> list[tuple[str, Sizes]]:
    """Name and sizes of each effect; of those with one name the later ones are numbered."""
    names = [f"{e['family'].replace('_', ' ')} at {e['place']}, {e['direction']}" for e in data["effects"]]
    count = [names[:k].count(name) + 1 for k, name in enumerate(names)]
    return [
        (name if k == 1 else f"{name} ({k})", e["parameters"])
        for name, k, e in zip(names, count, data["effects"], strict=True)
    ]


def _offsets(report: ReportContents) -> dict[str, Any] | None:
    """Joint offsets by unit: names, values, and their intervals as far as they are known."""
    found = report.offsets
    if found is None:
        return None
    tables = []
    for turning, unit, factor, title in (
        (True, "°", np.degrees(1.0), "Joint offsets"),
        (False, "mm", 1e3, "Offsets of sliding joints"),
    ):
        rows = [
            (o.joint, factor * o.value, None if o.ci95 is None else [factor * end for end in o.ci95])
            for o in found.found
            if o.turning == turning
        ]
        if rows:
            tables.append({"title": title, "unit": unit, "rows": rows})
    return {"tables": tables, "nominal_mm": found.nominal_mm, "left_mm": found.left_mm}


def _tiles(report: ReportContents, data: dict[str, Any]) -> list[tuple[str, str]]:
    """The few numbers that are wanted first."""
    out = []
    before, after = data["error_mm"]["nominal"], data["error_mm"]["final"]
    if before and after:
        out += [("position, nominal model, RMS", f"{before['rms']:.3f} mm")]
        out += [("position, final model, RMS", f"{after['rms']:.3f} mm")]
        rejection = data["rejected_rms_mm"]
        if rejection and None not in rejection.values() and rejection["with"] != rejection["without"]:
            other = "without" if report.counts_rejected else "with"
            out.append((f"{other} rejected stations, RMS", f"{rejection[other]:.3f} mm"))
    if data["error_deg"]["nominal"] and data["error_deg"]["final"]:
        out.append(("orientation, nominal model, RMS", f"{data['error_deg']['nominal']['rms']:.3g}°"))
        out.append(("orientation, final model, RMS", f"{data['error_deg']['final']['rms']:.3g}°"))
    floor, recording = data["noise_floor_mm"], data["recording"]
    out.append(("floor of arm and instrument", "not known" if floor is None else f"{floor:.3f} mm"))
    if claim := data["claim_mm"]:
        out.append(("tool, 95 % of the errors, at most", f"{claim['p95']['ci95'][1]:.3f} mm"))
        if not data["apply"]:
            out.append(("apply the calibration", "no"))
    if met := data["tolerance"]:
        out.append((f"tolerance {met['asked_mm']:g} mm, {STATISTICS[met['statistic']]}", met["result"]))
    out.append(("stations, rejected of them", f"{recording['stations']}, {recording['rejected'] or 'none'}"))
    return out


def _maps(evidence: tuple[EvidenceMap, ...]) -> list[dict[str, Any]]:
    """Tables of the first and the last scan, with the same columns: the drivers that explain most in either."""
    if not evidence:
        return []
    best: dict[str, float] = {}
    for seen in evidence:
        for driver, share in zip(seen.drivers, np.nanmax(seen.share, axis=0).tolist(), strict=True):
            best[driver] = max(share, best.get(driver, 0.0))
    kept = set(sorted(best, key=lambda d: -best[d])[:_MAX_COLUMNS])
    titles = ("Before any effect was added", "After the last one") if len(evidence) > 1 else ("The scan",)
    out = []
    for title, seen in zip(titles, evidence, strict=True):
        columns = [j for j, driver in enumerate(seen.drivers) if driver in kept]
        rows = [
            {"place": place, "direction": direction, "cells": [_cell(seen.share[i, j]) for j in columns]}
            for i, (place, direction) in enumerate(seen.rows)
        ]
        out.append(
            {
                "title": title,
                "drivers": [seen.drivers[j].replace(":", " of ") for j in columns],
                "rows": rows,
                "p_value": seen.p_value,
                "best": next(iter(seen.strongest(1)), None),
                "dropped": len(seen.drivers) - len(columns),
            }
        )
    return out


def _cell(share: float) -> tuple[str, str] | None:
    """How full a cell is, and what it says; None where nothing was looked for."""
    return None if np.isnan(share) else (f"{min(max(share, 0.0), 1.0):.2f}", f"{100.0 * share:.0f}")


def _rejected(report: ReportContents) -> dict[str, Any] | None:
    """The stations that were left out, the farthest first, and against what that is far."""
    rows = report.rejected_rows()
    if not len(rows):
        return None
    usual = 1e3 * float(np.median(report.residuals[~report.wrong])) if (~report.wrong).any() else 0.0
    start = float(report.samples.stamps.min())
    listed = []
    for row in rows[:_MAX_LISTED]:
        miss, stamp = 1e3 * float(report.residuals[row]), float(report.samples.stamps[row])
        listed.append((int(report.samples.station[row]), stamp - start, miss, miss / max(usual, 1e-9)))
    return {"usual": usual, "listed": listed, "more": len(rows) - len(listed)}
