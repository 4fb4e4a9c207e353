"""The page of a calibration or an evaluation: its sections, made of the data of ``report.json`` and of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.measurements.kinds import indirect_rows
from modcal_core.outcome import Outcome
from modcal_core.report.blocks import (
    Block,
    Figures,
    File,
    Fold,
    HeatTable,
    KeyFigures,
    Listing,
    Page,
    Section,
    SummaryLine,
    TableBlock,
    files_section,
    parameter_tables,
    size_tables,
    tone_of,
)
from modcal_core.report.figures import effect_shapes, error_histogram, residual_charts, scene, timeline
from modcal_core.report.tables import (
    SOURCES,
    STATISTICS,
    STATUS_WORDS,
    account_tables,
    distances_table,
    effects_table,
    error_tables,
    rejected_words,
    sentence,
    span,
    tolerance_lines,
)

_MAX_COLUMNS = 28  # drivers of a map
_MAX_LISTED = 30  # stations that were left out
_DECIDE = File(
    "Which of several explanations is it?",
    "Stations that tell them apart:",
    ("modcal plan --decide . --out deciding",),
    is_file=False,
)


def to_html(report: Outcome, data: Mapping[str, Any], files: Iterable[str] = (), calibration: str = "") -> str:
    """The report as HTML text, below 1 MB: of long recordings a part is drawn, and all is counted.

    data: of ``report.json``. files: names of what is written beside it. calibration: of an evaluation, the name of what
    was evaluated.
    """
    kind = "evaluation" if report.searched is None else "calibration"
    title = f"{report.title}: {kind} report"
    if report.searched is None and calibration:
        title = f"{calibration}, evaluated on {report.title}"
    return Page(
        title,
        sentence(report),
        _Sections(report, data, tuple(files)).all(),
        heading=f"Verdict: {STATUS_WORDS[report.status]}",
        tone=tone_of(report.status),
    ).html()


@dataclass(frozen=True)
class _Sections:
    """Sections of a report; each is None, or has no block, where there is nothing to say. data: of ``report.json``."""

    report: Outcome
    data: Mapping[str, Any]
    files: tuple[str, ...]

    def all(self) -> list[Block | None]:
        """All in their order, those for experts folded together."""
        rivals = [_DECIDE] if self.files and any(e["same_as"] for e in self.data["effects"]) else []
        expert = (
            self.account(), self.steps(), self.evidence(), self.distances(), self.identifiability(), self.parameters()
        )  # fmt: skip
        title = "Expert: account of the error, steps, evidence, identifiability, all parameters"
        trace = self.data["trace"]
        digest = trace["bag_sha256"] and f"recording sha256 {trace['bag_sha256']}"
        made_of = (f"modcal {trace['version']}", trace["date"], trace["robot"], trace["instrument"], digest)
        return [
            *self.answer(),
            self.claim(),
            self.offsets(),
            self.error(),
            self.robot(),
            self.residual(),
            self.effects(),
            self.stations(),
            files_section(self.files, *rivals),
            self.grounds(),
            Section("notes", "Notes", [Listing(self.data["notes"])], "Notes"),
            Fold(title, expert, "expert"),
            SummaryLine(" · ".join(filter(None, made_of)), "legend"),
        ]

    def answer(self) -> list[Block]:
        """What stands above the sections."""
        reasons = Listing(self.data["open_because"], tone_of(self.report.status), "Open because")
        met = tolerance_lines(self.report.tolerance)
        return [reasons, *met, KeyFigures(self._tiles()), Listing(self.data["story"])]

    def _tiles(self) -> list[tuple[str, str]]:
        """The few numbers that are wanted first."""
        data = self.data
        out = [
            (f"{what}, {stage} model, RMS", form.format(size["rms"]))
            for what, of, form in (("position", "error_mm", "{:.3f} mm"), ("orientation", "error_deg", "{:.3g}°"))
            for stage in ("nominal", "final")
            if (size := data[of][stage])
        ]
        floor, recording = data["noise_floor_mm"], data["recording"]
        out.append(("floor of arm and instrument", "not known" if floor is None else f"{floor:.3f} mm"))
        if claim := data["claim_mm"]:
            out.append(("tool, 95 % of the errors, at most", f"{claim['p95']['ci95'][1]:.3f} mm"))
            out += [] if data["apply"] else [("apply the calibration", "no")]
        return [*out, ("stations, rejected of them", f"{recording['stations']}, {recording['rejected'] or 'none'}")]

    def claim(self) -> Section | None:
        """What may be said of the tool."""
        mm, deg = self.data["claim_mm"], self.data["claim_deg"]
        if not mm or self.report.claim is None:
            return None
        rows = [
            {"what": what, "unit": unit, **part}
            for what, part, unit in (("position", mm, " mm"), ("orientation", deg, "°"))
            if part
        ]
        header = " | ".join([f"over the {mm['over']}", *STATISTICS.values()])
        cells = " | ".join(["{what}", *(f"{{{name}[ci95]:.3f}}{{unit}}" for name in STATISTICS)])
        table = TableBlock.of("The claim", header, cells, rows)
        out: list[Block] = [SummaryLine(self.report.claim.sentence), table]
        if mm["open"]:
            shown, held = f"{mm['shown_mm']:.3f} mm", f"{mm['unshown_mm']:.3f} mm"
            names = ("95 %, shown by the readings", f"95 %, held by what arms are like: {mm['open']}")
            out.append(KeyFigures(tuple(zip(names, (shown, held), strict=True))))
        said = "Each end is passed with a chance of 5 %."
        out.append(SummaryLine(said + ("" if deg else " Readings without orientation claim none."), "legend"))
        return Section("claim", "Claim: the tool's error", out, "Claim")

    def offsets(self) -> Section | None:
        """What to add to the reported joint positions."""
        found = self.report.offsets
        if found is None:
            return None
        said = (
            "Added to the reported positions, these bring the nominal arm nearest to the calibrated one: "
            f"{found.nominal_mm:.3f} mm RMS apart without them, {found.left_mm:.3f} mm with them alone, base and tool "
            "being free. The interval holds what the fit leaves open, and what other postures of this kind would make "
            "nearest. A joint that is not listed has an offset that is no other motion than one of base or tool."
        )
        out: list[Block] = [SummaryLine(said, "legend")]
        units = {True: ("Joint offsets", "°", np.degrees(1.0)), False: ("Offsets of sliding joints", "mm", 1e3)}
        for turning, (title, unit, factor) in units.items():
            rows = [
                (o.joint, f"{factor * o.value:+.4f}", span(o.ci95 and factor * np.array(o.ci95), 4) or "not known")
                for o in found.found
                if o.turning == turning
            ]
            header = ("joint", f"offset, {unit}", f"95 % interval, {unit}")
            out.append(TableBlock(title, header, tuple(rows), strong=1))
        return Section("offsets", "Joint offsets", out, "Joint offsets")

    def error(self) -> Section:
        """The error before and after, and what each station was used for."""
        recording, split = self.data["recording"], self.data["split"]
        where, used, of = "with the calibration frozen", "", "scored station"
        if split["train"]:
            where = "that neither the fit nor the selection has seen"
            used = f"; {split['train']} to fit, {split['explain']} to choose effects, {split['held_out']} to score"
            of = f"held-out {split['unit']}"
        said = f"On {split['held_out']} stations {where}."
        kind = recording["measurement"].replace("_", " ")
        dropped = ", ".join(f"{count} {reason}" for reason, count in recording["dropped"].items())
        more = [f"{recording['stations']} stations ({kind}){used}.", rejected_words(self.report)]
        more += [f"Not used: {dropped}."] if dropped else []
        out: list[Block] = [SummaryLine(said, "legend"), *error_tables(self.report)]
        out.append(SummaryLine(" ".join(filter(None, more)), "legend"))
        out.append(Figures(error_histogram(self.report)))
        return Section("error", f"Error on {of}s", out, "Error")

    def robot(self) -> Section | None:
        """The arm in three dimensions, and on paper."""
        drawn = scene(self.report)
        if drawn is None:
            return None
        partly = "Some of these instruments measure along one line only: their arrows show that component of the error."
        out: list[Block] = [SummaryLine(partly, "legend")] if indirect_rows(self.report.scored).any() else []
        return Section("robot", "Robot and errors", [*out, drawn], "Robot")

    def residual(self) -> Section | None:
        """What the final model leaves."""
        charts, size = residual_charts(self.report), self.report.size_mm("final")
        if not charts or size is None:
            return None
        said = (
            "The residual of the final model: x as circles, y as triangles, z as squares. A pattern here is an effect "
            "that the model lacks."
        )
        title = f"Residual: {size.rms:.3f} mm RMS"
        return Section("residuals", title, [SummaryLine(said, "legend"), Figures(charts)], "Residual")

    def effects(self) -> Section | None:
        """What was added to the geometry."""
        effects = self.data["effects"]
        if not effects:
            return None
        out: list[Block] = [effects_table(effects)]
        words = "Each ± one standard deviation; a table for each unit."
        out += [SummaryLine(words, "legend", "Their sizes."), *size_tables(effects)]
        tied = [e for e in effects if e["same_as"]]
        rivals = [f"{e['family'].replace('_', ' ')} at {e['place']}: {'; '.join(e['same_as'])}." for e in tied]
        out += [SummaryLine("", lead="Cannot be distinguished from others:"), Listing(rivals)] if rivals else []
        if shapes := effect_shapes(self.report):
            words = "The line is the estimate, the band its two standard deviations; ticks below show the samples."
            out += [SummaryLine(words, "legend", "Their shapes."), Figures(shapes)]
        return Section("effects", "Unmodelled effects", out, "Effects")

    def stations(self) -> Section:
        """The stations in time, and those that were left out, the farthest first."""
        report, rejected = self.report, self.data["rejected"]
        out: list[Block] = [Figures(timeline(report))]
        if not rejected:
            return Section("stations", "Stations", [*out, SummaryLine("No station was rejected.")], "Stations")
        usual = 1e3 * float(np.median(report.residuals[~report.wrong])) if (~report.wrong).any() else 0.0
        start, shown = float(report.samples.stamps.min()), rejected[:_MAX_LISTED]
        rows = [{**row, "time": row["stamp"] - start, "times": row["miss_mm"] / max(usual, 1e-9)} for row in shown]
        columns = (
            "station | time, s | error, mm | times the usual",
            "{station} | {time:.1f} | {miss_mm:.3f} | {times:.0f}",
        )
        said = f"Rejected, because their residuals are too large for the spread of the model; usual are {usual:.3f} mm."
        more = len(rejected) - len(rows)
        below = f"And {more} more; all are in report.json." if more else ""
        table = TableBlock.of("Rejected stations", *columns, rows, below=below)
        return Section("stations", "Stations", [*out, SummaryLine(said, "legend"), table], "Stations")

    def grounds(self) -> Section:
        """What else the verdict stands on."""
        data = self.data
        lines = [f"Corrected convention: {data['convention']}."] if data["convention"] else []
        for r in data["regimes"]:
            what = "a base and a tool" if r["what"] == "both" else f"a {r['what']}"
            lines.append(f"Stations {r['from_station']} … {r['to_station']} have {what} of their own.")
        for n in data["not_applied"]:
            cost = f"That costs {n['cost_mm2']:.3g} mm² on held-out stations."
            lines.append(f"{n['effect']} was not applied: {n['why']}. {cost}")
        return Section("grounds", "Further grounds of the verdict", [Listing(lines)])

    def account(self) -> Section | None:
        """The account of the squared error."""
        found, data = account_tables(self.report.judged), self.data
        if not found:
            return None
        said = (
            f"The rows add up to the squared error of the nominal model on the held-out {data['split']['unit']}s. "
            "What is predictable but not modelled was measured with a regressor without physics, on data it was not "
            "trained on."
        )
        parts = []
        if position := data["predictable"]:
            read = f"A regressor without physics predicts {_predicted(position)} of the squared position error left"
            if turned := data["predictable_deg"]:
                read += f", and {_predicted(turned)} of the orientation error"
            parts.append(f"{read}.")
        for size, unit in ((data["repeatability_mm"], " mm"), (data["repeatability_deg"], "°")):
            if size and size["value"] is not None:
                parts.append(f"Repeatability {size['value']:.3g}{unit}{SOURCES[size['source']]}.")
        blocks: list[Block] = [SummaryLine(said, "legend"), *found, SummaryLine(" ".join(parts))]
        return Section("account", "Account of the squared error", blocks)

    def steps(self) -> Section:
        """What each step took away."""
        header = "added | RMS of what is left, mm"
        table = TableBlock.of("Steps", header, "{added:driver} | {rms_mm:.3f}", self.data["steps"])
        return Section("steps", "What each step leaves", [table] if self.data["error_mm"]["nominal"] else [])

    def evidence(self) -> Section | None:
        """Maps of the first and the last scan, with the same columns: the drivers that explain most in either."""
        evidence = self.report.evidence
        if not evidence:
            return None
        said = (
            "Each cell shows its best candidate: the percentage of the squared residual that it explains alone, free "
            "shapes included. Empty: no candidate."
        )
        out: list[Block] = [SummaryLine(said, "legend")]
        best: dict[str, float] = {}
        for seen in evidence:
            for driver, share in zip(seen.drivers, np.nanmax(seen.share, axis=0).tolist(), strict=True):
                best[driver] = max(share, best.get(driver, 0.0))
        kept = set(sorted(best, key=lambda d: -best[d])[:_MAX_COLUMNS])
        titles = ("Before any effect was added", "After the last one") if len(evidence) > 1 else ("The scan",)
        for title, seen in zip(titles, evidence, strict=True):
            columns = [j for j, driver in enumerate(seen.drivers) if driver in kept]
            said = "".join(
                f"Most is explained at {place} ({direction}) by {driver.replace(':', ' of ')}: {100 * share:.0f} %. "
                for place, direction, driver, share in seen.strongest(1)
            )
            said += f"Noise alone gives as good a maximum with p = {seen.p_value:.1g}."
            if len(seen.drivers) > len(columns):
                said += f" {len(seen.drivers) - len(columns)} weaker drivers are not shown."
            rows = [(f"{place}, {way}", seen.share[i, columns].tolist()) for i, (place, way) in enumerate(seen.rows)]
            names = [seen.drivers[j].replace(":", " of ") for j in columns]
            out += [SummaryLine(said, lead=f"{title}."), HeatTable(title, "place, direction", names, rows)]
        return Section("evidence", "Evidence: place, direction, driver", out)

    def distances(self) -> Section:
        """Known distances, as stated and as found; what distances alone make of a Delta."""
        header = "between | stated, mm | misfit of the fit, mm | by the readings alone, mm"
        cells = "{name} | {stated_mm:.3f} ± {stated_std_mm:.3f} | {misfit_mm:+.3f}"
        cells += " | {found_mm:.3f} ± {found_std_mm:.3f}{but}"
        stated = [{**d, "but": ", contradicted" if d["contradicted"] else ""} for d in self.data["known_distances"]]
        known: list[Block] = [TableBlock.of("Known distances", header, cells, stated)]
        return Section("distances", "Distances", [*known, *distances_table(self.report.by_distances)])

    def identifiability(self) -> Section | None:
        """What the stations determine."""
        seen = self.data["identifiability"]
        if not seen:
            return None
        said = f"{seen['parameters']} parameters, rank {seen['rank']}"
        said += f", condition {seen['condition']:.0f}." if seen["condition"] else "."
        if seen["rank"] == seen["parameters"] and not seen["weak"]:
            said += " These stations determine every combination of them."
        end = "% of what was expected beforehand"
        weak = [f"{w['direction']}: known to {100 * w['std_over_prior']:.0f} {end}" for w in seen["weak"]]
        lists = {"Not determined by these stations, kept nominal:": seen["unobservable"], "Weakly determined:": weak}
        out: list[Block] = [SummaryLine(said)]
        for title, lines in lists.items():
            out += [SummaryLine("", lead=title), Listing(lines)] if lines else []
        if left := seen["left_out"]:
            title = f"{len(left)} directions that no recording of this kind can distinguish from others"
            out.append(Fold(title, [SummaryLine(", ".join(left))]))
        return Section("told", "Identifiability", out)

    def parameters(self) -> Section:
        """All parameters."""
        tables = parameter_tables(self.report.parameters)
        said = "Deviations from the nominal robot, with their standard deviations; one unit a table."
        return Section("parameters", "All parameters", [SummaryLine(said, "legend"), *tables] if tables else [])


def _predicted(share: Mapping[str, Any]) -> str:
    low, high = (100 * end for end in share["ci95"])
    return f"{100 * share['share']:.0f} % ({low:.0f} … {high:.0f} %)"
