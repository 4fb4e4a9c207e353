"""What a plan and a study of sensitivity say: data, tables, a trajectory, sentences, and pages."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from modcal_core.files import to_json, to_yaml
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.planning import NAMED, Plan, Study
from modcal_core.report.blocks import (
    Block,
    Figures,
    Fold,
    Page,
    Scene3D,
    Section,
    TableBlock,
    VerbResult,
    legend,
)
from modcal_core.report.charts import AFTER, GOOD, LARGE, Axis, Chart, Panel
from modcal_core.report.figures import MAX_POINTS, ShownPostures, arm_lines
from modcal_core.report.report import claim_data, picked
from modcal_core.report.tables import STATISTICS, csv_text, percent, stations_table
from modcal_core.robots import plain

_RISE = 1.5  # the peak of a cubic from rest to rest, over its mean speed


def to_plan_data(plan: Plan) -> dict[str, Any]:
    """The plan as nested dictionaries: stations in order, what is expected of them, and against what."""
    expected, ground = plan.expected, plan.pool.at
    return {
        "modcal_plan": 1,
        "joints": list(ground.model.chain.names),
        "reading": plan.request.reading,
        "parameters": list(plan.parameters),
        **claim_data(expected.claim),
        "left_rms_mm": {"planned": 1e3 * expected.left, "random": 1e3 * expected.at_random},
        "not_repeated_rms_mm": 1e3 * expected.repeat,
        "ratio_to_random": expected.ratios,
        "rank": expected.rank,
        "tried": [{"stations": n, "at_most_mm": c.mm["p95"].ci95[1]} for n, c in plan.tried.items()],
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
    needed = "" if request.accuracy is None else f"{1e3 * request.accuracy:.3g} mm ({STATISTICS[request.measure]})"
    asked = f" are needed for {needed}" if needed else ""
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
    out.append(said + ("." if plan.pool.at.site.tracker is None else f"; of these the tracker sees {percent(seen)}."))
    if plan.pool.at.site.floor is None:
        out.append("No floor is given: stations may lie below the base.")
    P = len(plan.parameters)
    if expected.rank < P:
        out.append(f"These stations show {expected.rank} of {P} parameters: the others stay nominal.")
    if plan.route.blocked:
        ways = ", ".join(f"{i + 1} to {i + 2}" for i in plan.route.blocked)
        out.append(f"No free path was found from station {ways}: use a motion planner or move the arm by hand there.")
    return out


def to_trajectory_data(plan: Plan, speed: float, dwell: float) -> dict[str, Any]:
    """The way through the stations as a trajectory_msgs/JointTrajectory: at rest at every posture, still at stations.

    speed: largest of any joint [rad/s, m/s]. dwell: [s] at each station. It ends before the first blocked way.
    """
    points: list[dict[str, Any]] = []
    chain = plan.pool.at.model.chain
    own = chain.own  # no controller takes a joint that follows
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
        "stations.csv": csv_text(plan.pool.at.model.chain.names, plan.q),
        "trajectory.yaml": to_yaml(to_trajectory_data(plan, speed, dwell)),
    }
    table = stations_table("Stations in their order", plan.pool.at.model.chain.names, plan.q)
    blocks = [_stations_shown(plan), Section("stations", "Stations", [table])]
    page = Page(f"{title}: stations to measure", sentences[0], blocks, lines=sentences[1:])
    return page.result(data, files, (), "Stations", "plan.yaml")


def _stations_shown(plan: Plan) -> Section:
    """The arm at the stations in their order, among the places that could be chosen."""
    pool, tracker = plan.pool, plan.pool.at.site.tracker
    shown = ShownPostures(plan.pool.at.model.chain, plan.q, "Station", plan.pool.at.model.T_tip_tool)
    some = pool.q[spread_rows(len(pool.q), MAX_POINTS)]
    way, could = (arm_lines(shown.chain, plan.pool.at.model.T_tip_tool, q)[-1][:, -1] for q in (plan.q, some))
    alt = f"The arm at {len(plan.q)} stations, in order, among the places that could be chosen."
    marks = () if tracker is None else (("tracker", tracker.position),)
    others: dict[str, Any] = {"points": way, "shown": shown.rows, "route": True, "cloud": could, "marks": marks}
    return Section("robot", "Robot", [shown.scene(alt, **others)])


COLUMNS = {
    "parameter": "",
    "share": "of the mean square error of the point, all parameters in error",
    "seen": "how much of this parameter's variance the stations remove; 100 % is determined",
    "gain mm": "by how much the RMS error falls once this parameter is known",
    "left mm": "the gain that these stations leave",
    "SFCDPE mm": "by how much an error of this parameter moves the point, weighted over the postures",
    "RSFCDPE": "the same, divided by that of the base factor",
}
_CELLS = (
    "{name} | {share:.1%} | {measured[seen]:.0%} | {rms_gain_mm:.4f} | {measured[rms_gain_left_mm]:.4f} | "
    "{sfcdpe_mm:.3f} | {rsfcdpe:.3f}"
)
_SAME = 1e-6  # share of an index within which it is the same at every posture
_SHOWN = 12  # parameters of the first table
_NAMED = 3  # of the strongest parameters, in a sentence


def sensitivity_data(study: Study) -> dict[str, Any]:
    """Numbers and texts that JSON can hold."""
    at, joint, constant = study.indices, study.joint, _constant(study)
    columns: dict[str, Array] = {
        "size": at.sizes,
        "sfcdpe_mm": 1e3 * at.multi,
        "rsfcdpe": at.relative_multi,
        "mean_mm": 1e3 * at.mean,
        "min_mm": 1e3 * at.single.min(axis=0),
        "max_mm": 1e3 * at.single.max(axis=0),
        "same_everywhere": constant,
        "share": joint.before.share,
        "rms_gain_mm": 1e3 * joint.before.rms_gain,
    }
    left = 1e3 * joint.after.rms_gain
    measured = {"seen": joint.seen, "rms_gain_left_mm": left, "matters_and_is_not_seen": joint.unseen}
    return {
        "modcal_sensitivity": 1,
        "joints": list(study.closed.chain.names),
        "postures": len(study.q),
        "base_factor": at.names[at.base],
        "rms_mm": {"as_built": 1e3 * joint.before.rms, "after_measuring": 1e3 * joint.after.rms},
        "measured": {
            "stations": len(study.measured.q),
            "kind": study.measured.kind,
            "std_mm": 1e3 * study.measured.std_m,
            "std_mrad": 1e3 * study.measured.std_rad,
        },
        "parameters": [
            {
                **picked(factor, "name", "unit"),
                **_row_of(k, columns),
                "measured": _row_of(k, measured),
            }
            for k, factor in enumerate(study.closed.factors)
        ],
        "sentences": sensitivity_sentences(study),
    }


def _row_of(k: int, columns: Mapping[str, Array]) -> dict[str, Any]:
    return {name: values[k].item() for name, values in columns.items()}


def _constant(study: Study) -> np.ndarray:
    """True where the single-point index is the same at every posture, (P,)."""
    single = study.indices.single
    return np.asarray(np.ptp(single, axis=0) <= _SAME * np.maximum(single.max(axis=0), 1e-300))


def sensitivity_sentences(study: Study) -> list[str]:
    """What a person should know first."""
    joint, names, measured = study.joint, study.closed.names, study.measured
    lengths = np.array([f.is_length for f in study.closed.factors])
    constant = _constant(study)
    order = np.argsort(-joint.before.share)
    strongest = ", ".join(f"{names[k]} ({percent(joint.before.share[k], 1)})" for k in order[:_NAMED])
    said = (
        f"{_assumed(study, lengths)} the point misses by {1e3 * joint.before.rms:.3f} mm RMS; "
        f"the largest shares of its square: {strongest}."
    )
    out = [said, _about_lengths(study, lengths, constant)] if lengths.any() else [said]
    if (~lengths).any():
        steady = [names[k] for k in np.flatnonzero(~lengths & constant)]
        varying, angles = int((~lengths & ~constant).sum()), int((~lengths).sum())
        said = f"{varying} of {angles} angles have a different influence from pose to pose"
        out.append(said + (f"; {', '.join(steady)} move the point by the same at every one." if steady else "."))
    out.append(
        f"{len(measured.q)} stations ({measured.kind}s, {1e3 * measured.std_m:.3g} mm) would leave "
        f"{1e3 * joint.after.rms:.3f} mm."
    )
    for k in np.flatnonzero(joint.unseen):
        out.append(
            f"{names[k]} matters ({percent(joint.before.share[k], 1)} of the mean square error): "
            "these stations do not observe it."
        )
    return out


def _assumed(study: Study, lengths: np.ndarray) -> str:
    """Which errors the parameters have, the beginning of a sentence."""
    sizes = study.indices.sizes
    parts = []
    for mask, unit in ((~lengths, "mrad"), (lengths, "mm")):
        if mask.any():
            low, high = 1e3 * sizes[mask].min(), 1e3 * sizes[mask].max()
            size = f"{low:.3g}" if high - low < 1e-6 * high else f"{low:.3g} to {high:.3g}"
            parts.append(f"{size} {unit} in every {'length' if unit == 'mm' else 'angle'}")
    return f"With errors of {' and '.join(parts)}"


def _about_lengths(study: Study, lengths: np.ndarray, constant: np.ndarray) -> str:
    count = int(lengths.sum())
    single = study.indices.single[:, lengths] / np.maximum(study.indices.sizes[lengths], 1e-300)
    if constant[lengths].all() and np.ptp(single) <= _SAME * single.max():
        return f"All {count} translation parameters move the point by their own error, at every pose."
    return f"{int((lengths & constant).sum())} of {count} translation parameters have the same influence at every pose."


def sensitivity_report(study: Study, title: str) -> VerbResult:
    """The study as a verb leaves it: the answer, the strongest parameters, the robot, and pictures."""
    data = sensitivity_data(study)
    sentences, rows = data["sentences"], sorted(data["parameters"], key=lambda row: -row["share"])
    single = np.c_[study.q, 1e3 * study.indices.single]
    files = {
        "sensitivity.json": to_json(data),
        "single_point.csv": csv_text([*study.closed.chain.names, *study.indices.names], single, ".9g"),
    }
    header, below = " | ".join(COLUMNS), legend(COLUMNS)
    strongest = TableBlock.of("The strongest parameters", header, _CELLS, rows[:_SHOWN], below=below)
    every = TableBlock.of("All parameters", header, _CELLS, rows)
    blocks: list[Block] = [
        Section("strongest", "Parameters that matter most", [strongest, Figures([_gain(study)])]),
        Section("robot", "Robot", [_robot(study)]),
        Fold("Expert: all parameters", [every], "expert"),
    ]
    page = Page(f"{title}: sensitivity", sentences[0], blocks, lines=sentences[1:])
    return page.result(data, files, [strongest])


def _robot(study: Study) -> Scene3D:
    """The arm in the postures of the study, every joint as large as the share of its parameters."""
    chain, share, joints = study.closed.chain, study.joint.before.share, study.closed.names
    of_joint = [share[[name.partition("/")[0] == joint for name in joints]].sum() for joint in chain.names]
    shown = ShownPostures(chain, study.q)
    more = ["Discs: share of the squared error that each joint's parameters have."] * len(shown.rows)
    return shown.discs("the error that its parameters have", np.array(of_joint), more)


def _gain(study: Study) -> Chart:
    """The remaining RMS error when the strongest parameters are known, one after the other."""
    share = np.sort(study.joint.before.share)[::-1]
    left = 1e3 * study.joint.before.rms * np.sqrt(np.maximum(1.0 - np.r_[0.0, np.cumsum(share)], 0.0))
    known, rest = np.arange(float(len(left))), np.full(2, 1e3 * study.joint.after.rms)
    large = int((share >= NAMED).sum())
    x = Axis.around(f"parameters known, the strongest first (a share above {percent(NAMED)}: {large})", known)
    y = Axis("RMS error, mm", 0.0, 1.05 * max(float(left.max()), rest[0]))
    panel = Panel(x, y, LARGE[0], 180.0, keys=(("left by the measured stations", GOOD, "line"),))
    panel.line(known, left, AFTER, 1.2)
    panel.marks(known, left, AFTER, "dot", 2.7)
    panel.line(np.array([x.low, x.high]), rest, GOOD, 1.0)
    words = "Remaining RMS error when the strongest parameters are known, one after the other."
    return panel.chart("gain", words, words)
