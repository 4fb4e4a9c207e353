"""What a study of sensitivity says: as data, as a table in text, in a few sentences, and as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.measurements import spread_rows
from modcal_core.planning import NAMED, Study
from modcal_core.report.page import (
    AFTER,
    GOOD,
    INK,
    LIGHT,
    MAX_POSTURES,
    WARN,
    PageTable,
    RobotScene,
    arm_paths,
    joints_in_words,
    plain_page,
)
from modcal_core.report.plots import SMALL, chart, columns, line_size, plot, svg
from modcal_core.report.sentence import percent

if TYPE_CHECKING:
    from lets_plot.plot.core import FeatureSpec, PlotSpec

_FILES = [
    ("sensitivity.json", "all numbers, for programs"),
    ("sensitivity.md", "every parameter in a table"),
    ("single_point.csv", "single-point indices, one row a posture"),
]
_SAME = 1e-6  # share of an index within which it is the same at every posture
_LISTED = 10  # parameters of a table on the page
_PLAIN = ("gain",)  # pictures for everybody; the indices are for experts
_ROW = 21  # px of a picture, a parameter
_NAMED = 3  # of the strongest parameters, in a sentence


def sensitivity_data(study: Study) -> dict[str, Any]:
    """Numbers and texts that JSON can hold."""
    at, joint = study.indices, study.joint
    rows = []
    for k, factor in enumerate(study.closed.factors):
        row: dict[str, Any] = {
            "name": factor.name,
            "unit": factor.unit,
            "size": float(at.sizes[k]),
            "sfcdpe_mm": 1e3 * float(at.multi[k]),
            "rsfcdpe": float(at.relative_multi[k]),
            "mean_mm": 1e3 * float(at.mean[k]),
            "min_mm": 1e3 * float(at.single[:, k].min()),
            "max_mm": 1e3 * float(at.single[:, k].max()),
            "same_everywhere": bool(_constant(study)[k]),
            "share": float(joint.before.share[k]),
            "rms_gain_mm": 1e3 * float(joint.before.rms_gain[k]),
        }
        for output, indices in study.variance.items():
            row[f"sobol_{output}"] = {
                "first": float(indices.first[k]),
                "std_first": float(indices.std_first[k]),
                "total": float(indices.total[k]),
                "std_total": float(indices.std_total[k]),
            }
        row["measured"] = {
            "seen": float(joint.seen[k]),
            "rms_gain_left_mm": 1e3 * float(joint.after.rms_gain[k]),
            "matters_and_is_not_seen": bool(joint.unseen[k]),
        }
        rows.append(row)
    return {
        "modcal_sensitivity": 1,
        "joints": list(study.closed.chain.names),
        "design": {"name": study.of.design, "postures": len(study.of.q)},
        "base_factor": at.names[at.base],
        "rms_mm": {"as_built": 1e3 * joint.before.rms, "after_measuring": 1e3 * joint.after.rms},
        "measured": {
            "stations": len(study.of.measured.q),
            "kind": study.of.measured.kind,
            "std_mm": 1e3 * study.of.measured.std_m,
            "std_mrad": 1e3 * study.of.measured.std_rad,
        },
        "parameters": rows,
        "sentences": sensitivity_sentences(study),
    }


def _constant(study: Study) -> np.ndarray:
    """True where the single-point index is the same at every posture, (P,)."""
    single = study.indices.single
    return np.asarray(np.ptp(single, axis=0) <= _SAME * np.maximum(single.max(axis=0), 1e-300))


def sensitivity_sentences(study: Study) -> list[str]:
    """What a person should know first."""
    joint, names, measured = study.joint, study.closed.names, study.of.measured
    lengths = np.array([f.is_length for f in study.closed.factors])
    constant = _constant(study)
    order = np.argsort(-joint.before.share)
    strongest = ", ".join(f"{names[k]} ({percent(joint.before.share[k], 1)})" for k in order[:_NAMED])
    said = (
        f"{_assumed(study, lengths)} the point misses by {1e3 * joint.before.rms:.3f} mm RMS; "
        f"the largest shares of its square: {strongest}."
    )
    out = [said, _about_lengths(study, lengths, constant)]
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
    if count and constant[lengths].all() and np.ptp(single) <= _SAME * single.max():
        return f"All {count} translation parameters move the point by their own error, at every pose."
    return f"{int((lengths & constant).sum())} of {count} translation parameters have the same influence at every pose."


def to_text(study: Study) -> str:
    """A Markdown table of every parameter, the strongest share first, under the sentences."""
    joint, at = study.joint, study.indices
    head = (
        f"| parameter | SFCDPE mm | RSFCDPE | mean mm | min … max mm | share | S | S_T | S_T distance | gain mm "
        f"| seen by {len(study.of.measured.q)} stations | gain left mm |"
    )
    lines = ["# Sensitivity", "", *(f"* {s}" for s in sensitivity_sentences(study)), "", head, "|---" * 12 + "|"]
    vector, distance = study.variance["vector"], study.variance["distance"]
    for k in np.argsort(-joint.before.share, kind="stable"):
        name = at.names[k]
        low, high = 1e3 * at.single[:, k].min(), 1e3 * at.single[:, k].max()
        lines.append(
            f"| {name} | {1e3 * at.multi[k]:.3f} | {at.relative_multi[k]:.3f} | {1e3 * at.mean[k]:.3f} "
            f"| {low:.3f} … {high:.3f} | {joint.before.share[k]:.2%} | {vector.first[k]:.3f} | {vector.total[k]:.3f} "
            f"| {distance.total[k]:.3f} | {1e3 * joint.before.rms_gain[k]:.4f} | {joint.seen[k]:.0%} "
            f"| {1e3 * joint.after.rms_gain[k]:.4f} |"
        )
    lines += ["", f"Base factor {at.names[at.base]}; {study.of.design}, {len(study.of.q)} postures."]
    return "\n".join(lines) + "\n"


def single_csv(study: Study) -> str:
    """Single-point indices [mm] as CSV: joints, then parameters; one row a posture."""
    head = ",".join([*study.closed.chain.names, *study.indices.names])
    rows = np.c_[study.of.q, 1e3 * study.indices.single]
    return head + "\n" + "".join(",".join(f"{v:.9g}" for v in row) + "\n" for row in rows)


def pictures(study: Study) -> dict[str, str]:
    """Names and texts of the SVG files."""
    return {f"{name}.svg": svg(drawn, name) for name, (drawn, _) in _plots(study).items()}


def sensitivity_html(study: Study, title: str) -> str:
    """The study as a page: the answer, sentences, the strongest parameters, the robot, and pictures."""
    first, *others = sensitivity_sentences(study)
    charts = [chart(drawn, name, words, words) for name, (drawn, words) in _plots(study).items()]
    plain = [one for one in charts if one.name in _PLAIN]
    expert = [one for one in charts if one.name not in _PLAIN]
    return plain_page(
        f"{title}: sensitivity", first, others, plain, _FILES, _tables(study), _robot(study), expert=expert
    )


def _tables(study: Study) -> tuple[PageTable, ...]:
    """Strongest parameters, lengths and angles separate, with what each adds to the error."""
    joint, out = study.joint, []
    order = [int(k) for k in np.argsort(-joint.before.share, kind="stable")]
    for title, lengths, unit in (("Angles", False, "mrad"), ("Lengths", True, "mm")):
        rows = [
            (
                study.closed.names[k],
                percent(joint.before.share[k], 1),
                percent(joint.seen[k]),
                f"{1e3 * study.indices.sizes[k]:.3g}",
            )
            for k in order
            if study.closed.factors[k].is_length == lengths
        ]
        header = ("parameter", "share of the squared error", "observed by the stations", f"assumed error, {unit}")
        below = "" if len(rows) <= _LISTED else f"{len(rows) - _LISTED} weaker ones are in sensitivity.md."
        if rows:
            out.append(PageTable(f"{title} that matter most", header, tuple(rows[:_LISTED]), below=below))
    return tuple(out)


def _robot(study: Study) -> RobotScene:
    """The arm in the postures of the study, every joint as large as the share of its parameters."""
    chain, share = study.closed.chain, study.joint.before.share
    rows = spread_rows(len(study.of.q), MAX_POSTURES)
    paths = arm_paths(chain, study.of.q[rows])
    of_joint = [
        sum(share[k] for k, name in enumerate(study.closed.names) if name.partition("/")[0] == joint)
        for joint in chain.names
    ]
    said = [
        f"Posture {row + 1} of {len(study.of.q)}: {joints_in_words(chain, study.of.q[row])}. Discs: share of the "
        "squared error that each joint's parameters have."
        for row in rows
    ]
    alt = "The arm; a disc at each joint shows the share of the error that its parameters have: " + ", ".join(
        f"{name} {percent(value)}" for name, value in zip(chain.names, of_joint, strict=True)
    )
    points = paths[:, -1]
    weights = () if chain.closed else tuple(map(float, of_joint))  # its line does not go from joint to joint
    return RobotScene(tuple(paths), tuple(said), points, np.arange(len(rows)), chain.base, alt, weights=weights)


def _plots(study: Study) -> dict[str, tuple[PlotSpec, str]]:
    return {
        "gain": (_gain(study), "Remaining RMS error when the strongest parameters are known, one after the other."),
        "indices": (
            _indices(study),
            "Left: the multi-point index RSFCDPE, the influence of a parameter over all postures as a multiple of the "
            "base factor's, with a line from its smallest to its largest at one posture. Right: the total Sobol index "
            "S_T, a parameter's share of the variance of the error with all that it does together with others, with "
            "two standard errors.",
        ),
        "by_pose": (
            _by_pose(study),
            "Relative single-point indices RSFDPE: the influence of a parameter (down) at one posture (across), as a "
            "multiple of the base factor's.",
        ),
    }


def _by_pose(study: Study) -> PlotSpec:
    """Relative single-point indices as a map, parameters down and postures across."""
    import lets_plot as lp

    relative = study.indices.relative_single.T
    wide, high = 160 + min(23 * len(study.of.q), 960), 120 + _ROW * len(relative)
    down, across = (n.ravel() for n in np.indices(relative.shape))
    x = f"posture of the design {study.of.design}"
    drawn = plot(wide, high, x, "", "right", across=across, down=down, relative=relative.ravel())
    drawn += lp.geom_raster(lp.aes("across", "down", fill="relative"))
    bar = lp.guide_colorbar(barheight=0.5 * high)
    drawn += lp.scale_fill_viridis(name=f"RSFDPE,\n{study.indices.names[study.indices.base]} is 1", guide=bar)
    drawn += lp.theme(legend_title=lp.element_text(size=SMALL)) + lp.coord_cartesian()
    return drawn + lp.scale_x_continuous(expand=[0, 0]) + _parameters(study.indices.names)


def _indices(study: Study) -> PlotSpec:
    """Multi-point indices beside the Sobol indices, one bar a parameter, with twice the standard error."""
    import lets_plot as lp

    row, high = np.arange(len(study.indices.names)), 120 + _ROW * len(study.indices.names)
    low, top = study.indices.relative_single.min(axis=0), study.indices.relative_single.max(axis=0)
    left = plot(440, high, "RSFCDPE", "", row=row, low=low, top=top)
    bars = {"above": row - 0.35, "below": row + 0.35, "all": study.indices.relative_multi}
    left += lp.geom_rect(
        lp.aes(ymin="above", ymax="below", xmax="all"), data=columns(bars), xmin=0.0, fill=LIGHT[AFTER], size=0
    )
    left += lp.geom_segment(lp.aes("low", "row", xend="top", yend="row"), color=LIGHT[INK], size=line_size(1.2))
    right = plot(440, high, "S_T of the error", "", "top")
    for output, shift in (("vector", -0.2), ("distance", 0.2)):
        indices = study.variance[output]
        bars = {
            "row": row + shift,
            "above": row + shift - 0.19,
            "below": row + shift + 0.19,
            "total": indices.total,
            "low": indices.total - 2.0 * indices.std_total,
            "top": indices.total + 2.0 * indices.std_total,
            "output": np.repeat(output, len(row)),
        }
        data = columns(bars)
        what = lp.aes(ymin="above", ymax="below", xmax="total", fill="output")
        right += lp.geom_rect(what, data=data, xmin=0.0, size=0)
        ends = lp.aes("low", "row", xend="top", yend="row")
        right += lp.geom_segment(ends, data=data, color=LIGHT[INK], size=line_size(0.9))
    right += lp.scale_fill_manual({"vector": LIGHT[AFTER], "distance": LIGHT[WARN]})
    names = study.indices.names
    sides = ((left, names), (right, [""] * len(names)))
    views = [view + lp.scale_x_continuous(expand=[0, 0, 0.05, 0]) + _parameters(said) for view, said in sides]
    return lp.gggrid(views, widths=[500, 340], hspace=16, align=True) + lp.ggsize(856, high)


def _parameters(names: Sequence[str]) -> FeatureSpec:
    """An axis of parameters with these names, down."""
    import lets_plot as lp

    ends, rows = [-0.5, len(names) - 0.5], list(range(len(names)))
    return lp.scale_y_reverse(limits=ends, expand=[0, 0], breaks=rows, labels=list(names))


def _gain(study: Study) -> PlotSpec:
    """The Remaining RMS error when the strongest parameters are known, one after the other."""
    import lets_plot as lp

    share = np.sort(study.joint.before.share)[::-1]
    left = 1e3 * study.joint.before.rms * np.sqrt(np.maximum(1.0 - np.r_[0.0, np.cumsum(share)], 0.0))
    large = int((share >= NAMED).sum())
    x = f"parameters known, the strongest first (a share above {percent(NAMED)}: {large})"
    drawn = plot(490, 266, x, "RMS error, mm", "top", known=np.arange(len(left)), left=left)
    drawn += lp.geom_line(lp.aes("known", "left"), color=LIGHT[AFTER], size=line_size(1.8))
    drawn += lp.geom_point(lp.aes("known", "left"), color=LIGHT[AFTER], size=line_size(4.0))
    rest = {"left": [1e3 * study.joint.after.rms], "said": ["left by the measured stations"]}
    drawn += lp.geom_hline(lp.aes(yintercept="left", color="said"), data=rest, size=line_size(1.5))
    drawn += lp.scale_color_manual([LIGHT[GOOD]])
    return drawn + lp.scale_y_continuous(limits=[0.0, None], expand=[0, 0, 0.05, 0])
