"""What a plan says: stations as data, as a table, as a trajectory, in a few sentences, and as a page."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from modcal_core.files import to_yaml
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.planning import Plan
from modcal_core.report.as_json import claim_data
from modcal_core.report.blocks import Block, Listing, Section, SummaryLine, VerbResult
from modcal_core.report.page import Page, files_section
from modcal_core.report.scene import MAX_POINTS, ShownPostures, arm_lines
from modcal_core.report.tables import csv_text, stations_table
from modcal_core.report.words import STATISTICS, percent
from modcal_core.robots import is_serial_arm, plain

_RISE = 1.5  # the peak of a cubic from rest to rest, over its mean speed


def to_plan_data(plan: Plan) -> dict[str, Any]:
    """The plan as nested dictionaries: stations in order, what is expected of them, and against what."""
    expected, ground = plan.expected, plan.ground
    return {
        "modcal_plan": 1,
        "joints": list(ground.model.chain.names),
        "reading": plan.request.reading,
        "criterion": plan.request.criterion,
        "parameters": list(plan.parameters),
        **claim_data(expected.claim),
        "left_rms_mm": {"planned": 1e3 * expected.left, "random": 1e3 * expected.at_random},
        "not_repeated_rms_mm": 1e3 * expected.repeat,
        "ratio_to_random": expected.ratios,
        "observability": vars(expected.indices),
        "tried": [{"stations": n, "at_most_mm": c.mm["p95"].ci95[1]} for n, c in plan.curve],
        "postures": {
            "candidates": len(plan.pool.q),
            "share_free": plan.pool.shares[0],
            "share_of_these_seen": plan.pool.shares[1],
        },
        "blocked_ways": [int(i) + 1 for i in plan.route.blocked],
        "returns": [[first + 1, second + 1] for first, second in plan.route.returns],
        "stations": [{"position": plain(q)} for q in plan.q],
    }


def plan_sentences(plan: Plan) -> list[str]:
    """What a person should know."""
    request, expected, k, claim = plan.request, plan.expected, plan.distinct, plan.expected.claim
    more = "" if request.besides is None else f" besides the {len(request.besides)} that are measured"
    asked = (
        ""
        if request.accuracy is None
        else f" are needed for {1e3 * request.accuracy:.3g} mm ({STATISTICS[request.measure]})"
    )
    out = [
        f"{k} stations{more}{asked}. To be claimed of a usual arm: 95 % of the errors over the workspace are below "
        f"{claim.mm['p95'].ci95[1]:.3f} mm, RMS at most {claim.mm['rms'].ci95[1]:.3f} mm. The fit leaves "
        f"{1e3 * expected.left:.3f} mm RMS by the site's noise, and the joints do not repeat "
        f"{1e3 * expected.repeat:.3f} mm."
    ]
    if pairs := plan.route.returns:
        out.append(
            f"{len(pairs)} of them are visited twice, from different sides: {len(plan.q)} stops in all. These returns "
            "tell what the arm does not repeat."
        )
    else:
        out.append("No station is visited twice: the noise floor will be unknown.")
    out.append(
        f"{k} stations drawn at random from the same postures would leave {1e3 * expected.at_random:.3f} mm where "
        f"these leave {1e3 * expected.left:.3f} mm: the ratio is {expected.ratios['model_rms']:.2f}."
    )
    free, seen = plan.pool.shares
    said = f"{percent(free)} of the postures within the limits touch nothing"
    out.append(said + ("." if plan.ground.site.tracker is None else f"; of these the tracker sees {percent(seen)}."))
    if plan.ground.site.floor is None:
        out.append("No floor is given: stations may lie below the base.")
    P = len(plan.parameters)
    if expected.indices.rank < P:
        out.append(
            f"These stations show {expected.indices.rank} of {P} parameters: the others keep their nominal values."
        )
    if plan.route.blocked:
        ways = ", ".join(f"{i + 1} to {i + 2}" for i in plan.route.blocked)
        out.append(f"No free path was found from station {ways}: use a motion planner or move the arm by hand there.")
    return out


def to_trajectory_data(plan: Plan, speed: float, dwell: float) -> dict[str, Any]:
    """The way through the stations as a trajectory_msgs/JointTrajectory: at rest at every posture, still at stations.

    speed: largest of any joint [rad/s, m/s]. dwell: [s] at each station. It ends before the first blocked way.
    """
    points: list[dict[str, Any]] = []
    chain = plan.ground.model.chain
    own = chain.own if is_serial_arm(chain) else np.ones(chain.n, bool)  # no controller takes a joint that follows
    now = 0.0

    def stand(q: Array) -> None:
        seconds, nanoseconds = divmod(round(now * 1e9), 10**9)
        at = {"sec": seconds, "nanosec": nanoseconds}
        points.append({"positions": plain(q[own]), "velocities": [0.0] * int(own.sum()), "time_from_start": at})

    stand(plan.q[0])
    now += dwell
    stand(plan.q[0])
    for i, stops in enumerate(plan.route.stops(plan.q)):
        if i in plan.route.blocked:
            break
        for before, here in pairwise(stops):
            now += _RISE * float(np.abs(here - before).max()) / speed
            stand(here)
        now += dwell
        stand(stops[-1])
    return {"joint_names": [name for name, moves in zip(chain.names, own, strict=True) if moves], "points": points}


def plan_report(plan: Plan, title: str, speed: float, dwell: float) -> VerbResult:
    """The plan as a verb leaves it. speed, dwell: of :func:`to_trajectory_data`."""
    sentences, data = plan_sentences(plan), to_plan_data(plan)
    files = {
        "plan.yaml": to_yaml(data),
        "stations.csv": csv_text(plan.ground.model.chain.names, plan.q),
        "trajectory.yaml": to_yaml(to_trajectory_data(plan, speed, dwell)),
    }
    table = stations_table("Stations in their order", plan.ground.model.chain.names, plan.q)
    listed = Section("stations", "Stations", [table])
    blocks: list[Block | None] = [Listing(sentences[1:]), _robot(plan), listed, files_section(files)]
    page = Page(f"{title}: stations to measure", sentences[0], blocks).html()
    return VerbResult(data, [*map(SummaryLine, sentences)], {**files, "report.html": page}, "Stations", "plan.yaml")


def _robot(plan: Plan) -> Section:
    """The arm at the stations in their order, among the places that could be chosen."""
    pool, tracker = plan.pool, plan.ground.site.tracker
    shown = ShownPostures(plan.ground.model.chain, plan.q, "Station", plan.ground.model.T_tip_tool)
    some = pool.q[spread_rows(len(pool.q), MAX_POINTS)]
    way, could = (arm_lines(shown.chain, plan.ground.model.T_tip_tool, q)[-1][:, -1] for q in (plan.q, some))
    alt = f"The arm at {len(plan.q)} stations, in order, among the places that could be chosen."
    marks = () if tracker is None else (("tracker", tracker.position),)
    others: dict[str, Any] = {"points": way, "shown": shown.rows, "route": True, "cloud": could, "marks": marks}
    return Section("robot", "Robot", [shown.scene(alt, **others)])
