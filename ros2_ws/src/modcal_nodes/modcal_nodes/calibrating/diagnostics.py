"""The calibrator's health: what it hears, which model stands, and how it keeps up."""

from __future__ import annotations

import json
import time
from collections import deque
from dataclasses import dataclass, field
from typing import cast, get_args

import numpy as np

from modcal_core.online import SUSPECTED, SampleStream, Supervisor
from modcal_core.recalibrate import ModelComparison
from modcal_core.report import REMEDY
from modcal_core.verdict import Status as VerdictStatus
from modcal_nodes.ros import ERROR, OK, WARN, Status

_MAX_SAID = 2  # reasons in a message; the report has all of them


@dataclass(frozen=True)
class Standing:
    """The verdict of a model. because: the reasons of an open one, the remedy where it cannot be told, else nothing.

    line: both in one sentence or two. claim_mm: upper end of the tool's 95th percentile, None if nothing is claimed.
    apply: whether the model is surely better than the nominal arm.
    """

    status: VerdictStatus
    because: tuple[str, ...]
    line: str
    claim_mm: float | None = None
    apply: bool | None = None


def standing_of(report: str | None) -> Standing | None:
    """What may be said of a model by the text of its ``report.json``; None without one, or without a verdict in it."""
    try:
        data = json.loads(report or "")
        status, reasons, remedy = data["status"], tuple(map(str, data["open_because"])), data["remedy"]
        claimed, apply = data.get("claim_mm"), data.get("apply")
        p95 = None if claimed is None else float(claimed["p95"]["ci95"][1])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    strange = not isinstance(remedy, str | None) or not isinstance(apply, bool | None)
    if strange or status not in get_args(VerdictStatus):
        return None
    because = reasons or tuple(filter(None, [remedy]))
    said = " ".join(because[:_MAX_SAID])
    lines = {"at_floor": "At the floor.", "open": f"Open: {said}", "cannot_tell": f"Cannot tell: {said or REMEDY}"}
    return Standing(cast(VerdictStatus, status), because, lines[status], p95, apply)


_ADVISED = 40  # stations before a first solve that nobody has set: some twice as many numbers as an arm has
_TIMED = 20_000  # updates whose times are remembered
_EVERY = 11  # updates of which one is timed: of a kilohertz, asking the kernel twice for each cost a tenth of them


@dataclass
class Times:
    """Seconds of a processor that updates took, and by which readings were old when they had been taken in."""

    took: deque[float] = field(default_factory=lambda: deque(maxlen=_TIMED))
    late: deque[float] = field(default_factory=lambda: deque(maxlen=_TIMED))
    _count: int = 0

    def begin(self) -> float | None:
        """The time of the processor that an update begins with; None for those that are not timed."""
        self._count += 1
        return time.thread_time() if self._count % _EVERY == 0 else None

    def end(self, began: float | None) -> None:
        """Note that it has ended."""
        if began is not None:
            self.took.append(time.thread_time() - began)

    def values(self) -> dict[str, object]:
        """The figures for a status."""
        out: dict[str, object] = {}
        if self.took:
            out["compute of an update, median [ms]"] = f"{1e3 * np.median(self.took):.3f}"
            out["compute of an update, p99 [ms]"] = f"{1e3 * np.percentile(self.took, 99):.3f}"
        if self.late:
            out["from stamp to update, median [ms]"] = f"{1e3 * np.median(self.late):.2f}"
            out["from stamp to update, p99 [ms]"] = f"{1e3 * np.percentile(self.late, 99):.2f}"
        return out


def model_status(
    supervisor: Supervisor,
    verdict: str,
    standing: Standing | None,
    trouble: str,
    solving: bool,
    candidate: ModelComparison | None,
) -> Status:
    """Which model is trusted, whether it still holds, and what may be said of it: OK only at the floor.

    verdict: what the last solve, or what went wrong with it, said. standing: of the trusted model, None where there is
    none or nothing is known of it.
    """
    facts: dict[str, object] = {"state": supervisor.state, "solving": solving, "last result": verdict}
    if standing is not None:
        facts["status"] = standing.status
        facts["because"] = " ".join(standing.because)
        facts["claim p95 [mm]"] = "none" if standing.claim_mm is None else f"{standing.claim_mm:.4f}"
        facts["apply"] = {True: "yes", False: "no", None: "not judged"}[standing.apply]
    if supervisor.live is not None:
        facts["largest sign of change"] = f"{supervisor.live.detector.largest:.1f}"
        facts["samples rejected"] = supervisor.live.estimator.rejected
    if candidate is not None:
        facts["candidate, error before [mm]"] = f"{1e3 * candidate.before:.4f}"
        facts["candidate, error after [mm]"] = f"{1e3 * candidate.after:.4f}"
    if trouble:
        return Status("model", ERROR, trouble, facts)
    if supervisor.state == SUSPECTED and supervisor.hypothesis is not None:
        text = f"{supervisor.hypothesis.sentence}; the last trusted model is still published"
        return Status("model", WARN, text, facts)
    if standing is None:
        return Status("model", WARN, verdict, facts)
    known = standing.line.partition(":")[0].rstrip(".") in verdict
    text = verdict if known else f"{verdict.rstrip('. ')}. {standing.line}"
    return Status("model", OK if standing.status == "at_floor" else WARN, text, facts)


def collected(supervisor: Supervisor) -> str:
    """How far collecting is."""
    policy = supervisor.policy
    if supervisor.live is not None:
        if supervisor.hypothesis is not None and supervisor.hypothesis.mistake:
            return (
                f"{supervisor.live.since} stations whose readings are written wrongly: correct that, then call ~/reset"
            )
        if supervisor.hypothesis is not None and policy.after_change:
            return (
                f"{supervisor.live.since} of {policy.after_change} stations since the change, then it is solved again"
            )
        return f"{supervisor.stations} stations"
    wanted, then = (policy.first_solve, "it is solved") if policy.first_solve else (_ADVISED, "call ~/solve")
    if supervisor.stations >= wanted:
        now = "it is being solved" if policy.first_solve else then
        return f"{supervisor.stations} stations are collected, {wanted} are needed: {now}"
    return f"{supervisor.stations} of {wanted} stations, then {then}"


def sample_status(supervisor: Supervisor, refused: int, stream: SampleStream | None, times: Times) -> Status:
    """How many stations there are, what was left out, and how long updates take."""
    facts: dict[str, object] = {"messages refused": refused}
    if stream is not None:
        facts["clock set back"] = stream.counts.jumps
        facts["messages out of order"] = stream.counts.late
        facts["readings without joint states"] = stream.counts.unpaired
        facts["bursts of readings, spread"] = stream.counts.bursts
    if supervisor.live is not None:
        facts["readings in unknown frames"] = supervisor.live.strange
    message = collected(supervisor) + (f", {refused} messages refused" if refused else "")
    return Status("samples", WARN if refused else OK, message, {**facts, **times.values()})
