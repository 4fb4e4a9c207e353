"""What may be said of the model that is trusted: its verdict, and why it is that one."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import cast, get_args

from modcal_core.report import REMEDY, Report, short_status
from modcal_core.verdict import Status

_MAX_SAID = 2  # reasons in a message; the report has all of them


@dataclass(frozen=True)
class Standing:
    """The verdict of a model. because: the reasons of an open one, the remedy where it cannot be told, else nothing.

    line: both in one sentence or two.
    """

    status: Status
    because: tuple[str, ...]
    line: str

    @property
    def at_floor(self) -> bool:
        """Whether the error is as small as arm and instrument can be."""
        return self.status == "at_floor"


def standing_of(report: Report) -> Standing:
    """What may be said of a model by its report."""
    judged = report.judged
    because = () if judged is None else judged.open_because or tuple(filter(None, [judged.remedy]))
    return Standing(report.status, because, short_status(judged))


def standing_of_json(text: str | None) -> Standing | None:
    """The same by the text of ``report.json``; None where there is none, or it is of a version that had no verdict."""
    try:
        data = json.loads(text or "")
        status, reasons, remedy = data["status"], tuple(map(str, data["open_because"])), data["remedy"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    if not isinstance(remedy, str | None):
        return None
    if status not in get_args(Status):
        return None
    because = reasons or tuple(filter(None, [remedy]))
    said = " ".join(because[:_MAX_SAID])
    lines = {"at_floor": "At the floor.", "open": f"Open: {said}", "cannot_tell": f"Cannot tell: {said or REMEDY}"}
    return Standing(cast(Status, status), because, lines[status])
