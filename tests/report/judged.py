"""Verdicts of each status, and a report with every field of one, for tests of what is said of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cells import ur10
from report.reports import warm_cell

from modcal_core.diagnosis.loads import FoundPayload, Loads
from modcal_core.effects.drivers import NominalArm
from modcal_core.outcome.contents import Outcome, Trace, iso_date
from modcal_core.verdict.grounds import Grounds, NotApplied, Regime
from modcal_core.verdict.tolerance import Asked
from modcal_core.verdict.verdict import NotAsked, Reason, Repeatability, Row, Share, Verdict

WHY = (
    Reason("rejected", "48 of 160 stations were rejected."),
    Reason("predictable", "A regressor predicts 20 % of the squared error."),
    Reason("above_floor", "The error is above the floor."),
)
FLOOR = Verdict(
    "at_floor",
    floor_mm=0.055,
    floor_deg=0.004,
    repeatability_mm=Repeatability(0.05, "revisits"),
    repeatability_deg=Repeatability(0.004, "stated"),
)
OPEN = Verdict("open", WHY, floor_mm=0.04, floor_deg=0.003, predictable=Share(0.2, (0.1, 0.3), 0.07))
CANNOT = Verdict("cannot_tell", remedy="Visit six of these postures twice.")
ROWS = (Row("geometry", 7.5, (7.0, 8.0)), Row("effect:gear_harmonic elbow_joint", 0.25), Row("unaccounted", -0.05))


def everything() -> Outcome:
    """A report with every field of a verdict."""
    full = replace(
        OPEN,
        remedy="Record the effort.",
        not_asked=(NotAsked("whether it drifts", "more stations"),),
        account_mm2=ROWS,
        account_deg2=ROWS[:1],
        predictable_deg=Share(0.01, (0.0, 0.02), 0.0),
        repeatability_mm=FLOOR.repeatability_mm,
        repeatability_deg=FLOOR.repeatability_deg,
    )
    report = warm_cell()
    return replace(
        report,
        samples=replace(report.samples, sigma_position=np.full(len(report.samples), 1e-5)),
        judged=full,
        grounds=Grounds(
            converged=False,
            regimes=(Regime(0, 11, "tool"),),
            not_applied=(NotApplied("compliance at elbow_joint", "effort was not recorded", 0.004),),
            convention="pose inverted",
        ),
        loads=Loads(
            NominalArm(ur10()),
            NominalArm(ur10()),
            np.array([0.6, 0.0, -0.8]),
            0.01,
            0.64,
            (FoundPayload(1.7e9, 2.5, 0.1, np.array([0.0, 0.0, 0.06]), np.full(3, 0.004)),),
            centre=np.array([0.0, 0.02, 0.06]),
            centre_std=np.full(3, 0.003),
        ),
        dropped=(("readings outside the time of the joint states", 12),),
        trace=Trace(date=iso_date(1.7e9), bag_sha256="ab" * 32, robot="ur10", instrument="pose on /tracker/pose"),
    ).with_tolerance(Asked(0.2))
