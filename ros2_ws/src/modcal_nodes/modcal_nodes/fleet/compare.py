"""The recordings of each robot held against its first calibration, and the drift that shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.store import Calibration
from modcal_core.errors import ModcalError
from modcal_core.evaluation import evaluate
from modcal_core.online.drift import WEEK, Change, Drift, change_since, drift
from modcal_nodes.fleet.task import DONE
from modcal_nodes.fleet.work import SAMPLES, iso, read_samples
from modcal_nodes.io.inputs import read_calibration

Row = dict[str, Any]


@dataclass(frozen=True)
class Compared:
    """rows: of the recordings, with what the comparison adds. drifts: a row for each parameter of each robot."""

    rows: list[Row]
    drifts: list[Row]


def compare(rows: Sequence[Row], out: Path, refit_base: bool = False, refit_tool: bool = False) -> Compared:
    """The rows with the error of each recording under the robot's first calibration, and every robot's drift.

    Recordings of one robot have its name and the same nominal kinematics. refit_base, refit_tool: find them again in
    every recording.
    """
    added: dict[str, Row] = {row["name"]: dict.fromkeys(_ADDED) for row in rows}
    drifts: list[Row] = []
    robots: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row["state"] == DONE:
            robots.setdefault((row["robot"], row["kinematics"]), []).append(row)
    for (robot, kinematics), of_robot in sorted(robots.items()):
        if len(of_robot) < 2:
            continue
        first, *later = sorted(of_robot, key=lambda row: (row["started"], row["name"]))
        reference = read_calibration(out / first["name"])
        changes = []
        for row in later:
            change, said = _held_against(reference, out / row["name"], refit_base, refit_tool)
            added[row["name"]] |= said
            changes += [] if change is None else [change]
        try:
            found = drift(reference, changes)
        except ModcalError as error:
            sentence = f"no drift can be determined: {error}"
        else:
            sentence = in_words(found)
            drifts += _drift_rows(found, robot, kinematics)
        for row in of_robot:
            added[row["name"]]["drift"] = sentence
    return Compared([{**row, **added[row["name"]]} for row in rows], drifts)


_ADDED = ("frozen_rms_mm", "frozen_p95_mm", "compared", "drift")


def _held_against(reference: Calibration, folder: Path, base: bool, tool: bool) -> tuple[Change | None, Row]:
    """How a later recording's arm has changed, and how far the first calibration misses there."""
    try:
        samples = read_samples(folder / SAMPLES)
        change = change_since(reference, samples, base, tool)
        again = [name for name, found in (("base", change.base), ("tool", change.tool)) if found]
        # held out and scored as modcal evaluate does
        report = evaluate(reference, samples, np.random.default_rng(0), change.base, change.tool, Cell())
    except (ModcalError, OSError, ValueError, KeyError) as error:
        return None, {"compared": f"no: {error}"}
    size = report.size_mm("final")
    said = f"{' and '.join(again)} found again" if again else "as it stood"
    return change, {
        "frozen_rms_mm": None if size is None else size.rms,
        "frozen_p95_mm": None if size is None else size.p95,
        "compared": said,
    }


def in_words(found: Drift) -> str:
    """The summary for maintenance."""
    since, until = (iso(t)[:10] for t in (found.since, found.until))
    named = found.named
    if named is None:
        return f"still since {since}, {found.recordings} recordings"
    weeks = (found.until - found.since) / WEEK
    parts = []
    rates, stds = WEEK * found.size, WEEK * found.size_std
    for direction, unit, rate, std in zip(named.directions, named.units, rates, stds, strict=True):
        unit = f"m{unit}"
        parts.append(
            f"{direction} {1e3 * rate:+.3g} ± {1e3 * std:.1g} {unit} a week ({1e3 * rate * weeks:+.3g} {unit})"
        )
    also = f"; it may as well be {', '.join(found.same_as)}" if found.same_as else ""
    return f"drifting since {since}, to {until}: {named.place} {', '.join(parts)}{also}"


def _drift_rows(found: Drift, robot: str, kinematics: str) -> list[Row]:
    """What was named first, then every parameter of the reference."""
    span = found.until - found.since
    about = {
        "robot": robot,
        "kinematics": kinematics,
        "since": iso(found.since),
        "until": iso(found.until),
        "recordings": found.recordings,
    }
    rows = []
    if (named := found.named) is not None:
        for direction, unit, r, s in zip(named.directions, named.units, found.size, found.size_std, strict=True):
            rows.append(_drift_row(about, f"{named.place}/{direction}", True, r, s, span, unit))
    for parameter, r, s in zip(found.parameters, found.rate, found.std, strict=True):
        rows.append(_drift_row(about, parameter.name, False, r, s, span, parameter.unit))
    return [{**row, "p_value": found.p_value} for row in rows]


def _drift_row(
    about: Mapping[str, Any], name: str, named: bool, rate: float, std: float, span: float, unit: str
) -> Row:
    return {
        **about,
        "parameter": name,
        "named": named,
        "unit": unit,
        "change": float(rate * span),
        "change_std": float(std * span),
        "per_week": float(rate * WEEK),
        "per_week_std": float(std * WEEK),
    }
