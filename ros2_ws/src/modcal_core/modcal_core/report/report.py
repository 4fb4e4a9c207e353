"""The report: its contents with what a person reads, and the files of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modcal_core.files import write_folder
from modcal_core.report.contents import ReportContents
from modcal_core.report.sentence import sentence
from modcal_core.report.summary import summary, text


@dataclass(frozen=True)
class Report(ReportContents):
    """Everything a calibration or an evaluation has to say."""

    @property
    def verdict(self) -> str:
        """What a person reads first: what was scored, how large the error is, and what may be said of the rest."""
        return sentence(self)

    def __str__(self) -> str:
        """What the command shows on the terminal."""
        return text(summary(self))

    def to_data(self) -> dict[str, Any]:
        """The data of ``report.json``: dictionaries, lists, texts, numbers and None."""
        from modcal_core.report.as_json import to_json_data

        return to_json_data(self)

    def save(self, folder: str | Path, page: bool = True) -> Path:
        """Write report.json, and report.html if page, into a folder; returns the folder."""
        from modcal_core.report.files import report_files  # a parser of URDFs comes with it

        write_folder(Path(folder), report_files(self, page))
        return Path(folder)
