"""Reports of recordings with everything a page has a section for, made once for all tests here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from cells import record, ur10
from deltas import record_delta
from instruments import worlds

from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import SignalTrack
from modcal_core.outcome.contents import Outcome
from modcal_core.report.html import to_html
from modcal_core.report.report import to_json_data

COUNT = 120
WRONG = (7, 50, 91)


def page_of(report: Outcome, files: Sequence[str] = (), calibration: str = "") -> str:
    return to_html(report, to_json_data(report), files, calibration)


@cache
def warm_cell() -> Outcome:
    """Poses of an arm in MuJoCo with a gear error; its base creeps with a temperature; three readings are wrong."""
    made = record(5, COUNT)
    samples, rng = made.samples, np.random.default_rng(1)
    sent = samples.q.copy()
    sent[:, 2] += 4e-4 * np.sin(17.0 * samples.q[:, 2] + 0.3)
    T = made.world.tool_in_tracker(sent)
    elapsed = samples.stamps - samples.stamps[0]
    heat = 22.0 + 4.0 * np.sin(elapsed / 23.0)
    T[:, :3, 3] += np.outer(heat - 22.0, [6e-5, 0.0, 3e-5])
    T[:, :3, 3] += 3e-5 * rng.standard_normal((COUNT, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(5e-5 * rng.standard_normal((COUNT, 3)))
    T[list(WRONG), :3, 3] += 5e-3
    signals = (SignalTrack("temperature:cell", samples.stamps, heat[:, None], "/temperature"),)
    spoiled = replace(samples, reading=T[:, :3, 3], R=T[:, :3, :3], signals=signals)
    return replace(calibrate(spoiled, ur10(), np.random.default_rng(0)).report, title="warm <cell> & more")


@cache
def delta() -> Outcome:
    """Points of a Delta with a gear error."""
    made = record_delta(3, 80, gear=(1, 23.0, 6e-4))
    return replace(calibrate(made.samples, made.nominal, np.random.default_rng(0)).report, title="delta")


@cache
def points() -> Outcome:
    """Points alone, geometry alone: the plainest page."""
    made = record(4, 60, "point")
    return calibrate(made.samples, ur10(), np.random.default_rng(0), look_for_effects=False).report


@cache
def bearings() -> Outcome:
    """Directions from two theodolites, each of which sees across its line of sight only."""
    w, rng = worlds.world(2), np.random.default_rng(3)
    q = worlds.postures(ur10(), 60, rng)
    poses = np.array([w.tool_in_base(row) for row in q])
    stations = ([3.0, -1.0, 0.5, 0.1, 0.2, 2.5], [2.0, 2.5, 0.8, 0.1, -0.1, -2.0])
    parts = [
        worlds.samples_of(ur10(), q, poses, f"station_{k}", "bearing", worlds.theodolite(se3.exp(T)), 1e-5, rng)
        for k, T in enumerate(stations)
    ]
    return calibrate(worlds.together(parts), ur10(), np.random.default_rng(0), look_for_effects=False).report


REPORTS = {"warm": warm_cell, "delta": delta, "points": points, "bearings": bearings}
