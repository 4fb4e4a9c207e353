"""The report: its contents with what a person reads on one screen, and the files of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from html import escape
from pathlib import Path
from typing import Any, Self

import numpy as np

from modcal_core.calibration import Calibration, to_data
from modcal_core.files import to_json, to_yaml, write_folder
from modcal_core.geometry import Array, so3
from modcal_core.outcome import Outcome
from modcal_core.report.as_json import to_json_data
from modcal_core.report.blocks import Summary, SummaryLine, legend, text, tone_of
from modcal_core.report.tables import (
    MAX_REASONS,
    account_tables,
    distances_table,
    effects_table,
    error_tables,
    sentence,
    tolerance_lines,
)
from modcal_core.robots import Chain, Delta, Mechanism, delta_to_data, is_serial_arm

# What stands in the tables, below them
_STAGES = {
    "nominal": "the robot description, base and tool fitted",
    "geometric": "lengths, angles and joint zeros corrected",
    "final": "the effects below as well",
}


def summary(report: Outcome) -> tuple[Summary, ...]:
    """Before and after, what the data could not tell, the effects, the account, and the verdict."""
    return tuple(_blocks(report))


def _blocks(report: Outcome) -> Iterator[Summary]:
    stages = {stage: said for stage, said in _STAGES.items() if report.size_mm(stage) or report.size_deg(stage)}
    yield from (replace(table, below=legend(stages)) for table in error_tables(report))
    if (seen := report.identifiability) is not None:
        said = f"{seen.parameters} parameters, rank {seen.rank} (directions that the stations determine), "
        yield SummaryLine(said + f"condition {seen.condition:.0f} (largest over smallest singular value)")
        for name in seen.unobservable:
            yield SummaryLine(f"not determined by these stations: {name}", "doubt")
    if report.effects:
        yield effects_table(to_json_data(report)["effects"])
        yield from map(SummaryLine, report.story)
    yield from (SummaryLine(note, "doubt") for note in report.notes)
    yield from distances_table(report.by_distances)
    yield from account_tables(report.judged, fold=True)
    yield SummaryLine(sentence(report), tone_of(report.status))
    yield from (SummaryLine(f"Open: {reason}", "reason") for reason in report.open_because[MAX_REASONS:])
    if report.claim is not None:
        yield SummaryLine(report.claim.sentence, "plain" if report.claim.apply else "doubt")
    yield from tolerance_lines(report.tolerance)


def calibration_files(
    calibration: Calibration,
    report: Outcome,
    nominal: Mechanism | None = None,
    urdf: str | None = None,
    factory: Mapping[str, Any] | None = None,
    page: bool = True,
) -> dict[str, str]:
    """Names and texts of everything that a calibration leaves behind; without report.html if not page.

    nominal, urdf: the arm as its description has it. factory: as of :func:`model_files`.
    """
    return report_files(report, page, others=model_files(calibration, nominal, urdf, factory))


def model_files(
    calibration: Calibration, nominal: Mechanism | None, urdf: str | None, factory: Mapping[str, Any] | None = None
) -> dict[str, str]:
    """The same without a report. Of a Delta, into whose file the tool that was found is written, and of an arm without
    a description there is no URDF.

    factory: the kinematics that the manufacturer's tool took from this arm, whose form and hash are kept. The robot
    description and the kinematics hold the geometry that is best alone: their readers know no effects.
    """
    files = {"calibration.yaml": to_yaml(to_data(calibration))}
    calibrated = calibration.geometric.chain
    if isinstance(calibrated, Delta):
        T = calibration.geometric.T_tip_tool
        tool = np.r_[T[:3, 3], so3.log(T[:3, :3])]
        with_tool = calibrated.with_vector(np.r_[calibrated.constants.ravel(), tool])
        return {**files, "calibrated_delta.yaml": to_yaml(delta_to_data(with_tool))}
    if urdf is None or nominal is None or not is_serial_arm(nominal):
        return files
    from modcal_core.robots import calibrated_urdf, joint_origins  # a parser of URDFs comes with these

    corrected = calibrated_urdf(urdf, nominal, calibrated)
    kinematics = kinematics_text(calibrated, joint_origins(corrected), factory)
    return {**files, "calibrated.urdf": corrected, "kinematics.yaml": kinematics}


def kinematics_text(chain: Chain, origins: Mapping[str, Array], factory: Mapping[str, Any] | None = None) -> str:
    """The text of a kinematics.yaml, with a line that says so where it lacks the maker's hash. origins: by joint."""
    from modcal_core.robots import NO_HASH, kinematics_yaml_data, lacks_hash

    data = kinematics_yaml_data(chain, origins, factory)
    return (NO_HASH if lacks_hash(data) else "") + to_yaml(data)


def report_files(
    report: Outcome, page: bool = True, calibration: str = "", others: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Names and texts of a report, whose page names the other files as well, and of those.

    calibration: of an evaluation, the name of what was evaluated.
    """
    files, others = {"report.json": to_json(to_json_data(report))}, others or {}
    if page:
        # drawing it takes longer than many a fit, and so does the import of what draws it
        from modcal_core.report.html import to_html

        files["report.html"] = to_html(report, ["report.json", *others], calibration)
    return {**files, **others}


@dataclass(frozen=True)
class Report(Outcome):
    """An outcome with what a person and a program read of it."""

    @classmethod
    def of(cls, outcome: Outcome) -> Self:
        """The report of an outcome."""
        return cls(**{one.name: getattr(outcome, one.name) for one in fields(outcome)})

    @property
    def verdict(self) -> str:
        """What a person reads first: what was scored, how large the error is, and what may be said of the rest."""
        return sentence(self)

    def __str__(self) -> str:
        """What the command shows on the terminal."""
        return text(summary(self))

    def _repr_html_(self) -> str:
        """The page for notebooks, in a frame of its own: its styles and scripts meet no others."""
        from modcal_core.report.html import to_html

        return f'<iframe srcdoc="{escape(to_html(self))}" style="width: 100%; height: 60em; border: 0"></iframe>'

    def to_data(self) -> dict[str, Any]:
        """The data of ``report.json``: dictionaries, lists, texts, numbers and None."""
        return to_json_data(self)

    def save(self, folder: str | Path, page: bool = True) -> Path:
        """Write report.json, and report.html if page, into a folder; returns the folder."""
        write_folder(Path(folder), report_files(self, page))
        return Path(folder)
