"""What modcal says of a case, and whether that is right."""

from __future__ import annotations

import json
import re
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import harness
import numpy as np
from case import Case

LEFT = 1.5  # times the floor that count as something left
CALM = re.compile(
    r"nothing[^.]{0,60}stands out|which is (?:the )?noise|is noise|noise of the measurement|at (?:its|the) floor", re.I
)
CALM_AND_WRONG, NAMED, FOUND, UNNAMED = "calm and wrong", "open, named", "modelled, named", "open, not named"
SILENT, HARMLESS, FAILED = "cannot tell, not named", "harmless here", "failed"
RIGHT, ONE_OF, NONE, WRONG = "right", "one of", "none", "wrong"
HEDGED = re.compile(r"^or |; or |, or of |one of these", re.I)  # parts of the grounds that name several
AT_FLOOR, BESIDE, CANNOT_TELL, OPEN = "at the floor", "at the floor, unknown", "cannot tell", "open"


@dataclass(frozen=True)
class Outcome:
    """What was said of one case. status: of the report, or ``refused``. left: final error over the floor.

    known: of a good one, whether its floor can be known. false: causes that were named and are none. hints: the same of
    the reasons to be open. word: right, one of, none, wrong, or calm and wrong.
    """

    outcome: str
    status: str
    text: str = ""
    left: float = float("nan")
    seconds: float = 0.0
    known: bool | None = None
    effects: tuple[str, ...] = ()
    false: tuple[str, ...] = ()
    hints: tuple[str, ...] = ()
    word: str = ""


def judge(case: Case, folder: Path, known: bool | None = None) -> Outcome:
    """Records a case in a folder, runs its steps, and compares what is said with what is true."""
    case.write(folder)
    begin = time.perf_counter()
    code, said, report = 0, "", None
    for k, step in enumerate(case.steps):
        code, said, found = modcal(folder, step, f"{{out{k}}}")
        if code not in (0, 3):
            break
        report = found or report
    beside = _aside(case, folder) if code in (0, 3) else None
    made = Outcome(FAILED, f"exit {code}", said[-600:])
    if code == 2:
        made = _refused(case, (said.strip().splitlines() or [""])[-1])
    elif code in (0, 3):
        stated = report is not None and report.get("status") is not None
        made = _reported(case, report, known, beside) if stated and report else Outcome(FAILED, "no status")
    return replace(made, seconds=time.perf_counter() - begin, known=known, word=_word(case, made))


def _word(case: Case, made: Outcome) -> str:
    """How right the word is: a cause outright, among others, none, or a false one."""
    if made.outcome == CALM_AND_WRONG:
        return CALM_AND_WRONG
    if made.false or (made.outcome == OPEN and not case.fault):
        return WRONG
    if not case.fault:
        return RIGHT
    if not _names(case, made.text) or made.outcome == FAILED:
        return NONE
    outright = " | ".join(part for part in made.text.split(" | ") if not HEDGED.search(part))
    return RIGHT if _names(case, outright) else ONE_OF


def _aside(case: Case, folder: Path) -> dict[str, Any] | None:
    """The report that tells what is truly left; None where the case has none, or the calibration cannot be used."""
    report = None
    for step in case.aside:
        code, _, report = modcal(folder, step)
        if code not in (0, 3):
            return None
    return report


def modcal(folder: Path, step: tuple[str, ...], out: str = "") -> tuple[int, str, dict[str, Any] | None]:
    """Exit code, what was said on both channels, and the report; ``{name}`` is a path in the folder."""
    if "--out" in step:
        out = step[step.index("--out") + 1]
    else:
        step = (*step, "--out", out)
    code, said = harness.modcal(*(str(folder / a[1:-1]) if a.startswith("{") else a for a in step))
    report = folder / out[1:-1] / "report.json"
    return code, said, harness.report_of(report.parent) if report.is_file() else None


def _refused(case: Case, said: str) -> Outcome:
    outcome = OPEN if not case.fault else NAMED if _names(case, said) else UNNAMED
    return Outcome(outcome, "refused", said, false=falsely(case, [said]))


def _reported(case: Case, report: dict[str, Any], known: bool | None, beside: dict[str, Any] | None = None) -> Outcome:
    status, text = report["status"], grounds(report)
    left = _left(case, beside or report)
    effects = tuple(f"{e['family']}@{e['place']}" for e in report.get("effects") or [])
    false, hints = (falsely(case, said) for said in (causes(report), report.get("open_because") or []))
    made = Outcome("", status, text, left, effects=effects, false=false, hints=hints)
    if not case.fault:
        floor = AT_FLOOR if known else BESIDE
        return replace(made, outcome={"open": OPEN, "at_floor": floor}.get(status, CANNOT_TELL))
    named, much = _names(case, text), not left <= LEFT
    # where nothing was planted and what can be reached is reached, there is nothing to name: what else is found in a
    # recording (an error of a joint that is left) may well make it open
    if case.shown == "if missed" and not much and status != "at_floor":
        return replace(made, outcome=HARMLESS)
    if beside and passed_wrongly(report, beside):
        return replace(made, outcome=CALM_AND_WRONG, status="PASS")
    if status == "open":
        return replace(made, outcome=NAMED if named else UNNAMED)
    if case.shown == "if left" and not much:
        return replace(made, outcome=HARMLESS)
    calm = status == "at_floor" or bool(CALM.search(str(report.get("verdict", ""))))
    if calm and (much or not named):
        return replace(made, outcome=CALM_AND_WRONG)
    return replace(made, outcome=FOUND if named and not much else SILENT if case.shown else HARMLESS)


def passed_wrongly(report: dict[str, Any], beside: dict[str, Any]) -> bool:
    """Whether a tolerance was met that the calibration misses on another recording of the same arm."""
    tolerance = report.get("tolerance") or {}
    return tolerance.get("result") == "PASS" and beside["error_mm"]["final"]["p95"] > tolerance["asked_mm"]


def _names(case: Case, text: str) -> bool:
    """Whether the grounds name what is wrong."""
    return not case.must_name or _holds(text, case.must_name)


def _holds(text: str, patterns: tuple[str, ...]) -> bool:
    """Whether a pattern is found; options and lists of what might be checked name nothing."""
    text = re.sub(r"check that [^|]*|--[a-z-]+", "", text)
    return any(re.search(pattern, text, re.I) for pattern in patterns)


def falsely(case: Case, named: list[str]) -> tuple[str, ...]:
    """The causes among those that were named that hold a false word, and neither a true one nor what was planted."""
    true = (*case.must_name, *case.planted)
    return tuple(cause for cause in named if _holds(cause, case.must_not) and not _holds(cause, true))


def causes(report: dict[str, Any]) -> list[str]:
    """What a report blames: effects but those of readings that are left out, regimes, and the convention."""
    effects = [e for e in report.get("effects") or [] if e.get("family") != "outliers"]
    blamed = [" ".join(str(e.get(key)) for key in ("family", "place", "driver")) for e in effects]
    blamed += [str(regime.get("what")) for regime in report.get("regimes") or []]
    return blamed + ([str(report["convention"])] if report.get("convention") else [])


def _left(case: Case, report: dict[str, Any]) -> float:
    """What is left, with what was rejected, over the floor that is true."""
    final = (report.get("error_mm") or {}).get("final") or {}
    sizes = [s for s in ((report.get("rejected_rms_mm") or {}).get("with"), final.get("rms")) if s is not None]
    return max(sizes) / case.best_mm if sizes and case.best_mm else float("nan")


def grounds(report: dict[str, Any]) -> str:
    """Everything that a report names: why it is open, effects, regimes, what was not applied, the convention, and
    what it would need to tell more.
    """
    parts = [*(report.get("open_because") or [])]
    for effect in report.get("effects") or []:
        if effect.get("family") == "outliers":
            continue  # that readings are wrong is said of every reading that is left out
        parts += [str(effect.get(key)) for key in ("family", "place", "driver")]
        parts += ["or " + str(other) for other in effect.get("same_as") or []]
    parts += [str(regime.get("what")) for regime in report.get("regimes") or []]
    parts += [f"{n.get('effect')} {n.get('why')}" for n in report.get("not_applied") or []]
    parts += ["or " + str(n.get("needs")) for n in report.get("not_asked") or []]
    parts += [json.dumps(report[key]) for key in ("unexplained", "convention") if report.get(key)]
    return " | ".join(parts)


def variant(case: Case, way: str) -> Case:
    """A good case with its floor known by ``returns``, ``stated`` in numbers, or ``unknown``."""
    if way == "returns":
        return case
    made = replace(case, sessions={name: s.only(~s.again) for name, s in case.sessions.items()})
    if way == "unknown":
        return made
    arm_mm, arm_deg, eye_mm, eye_deg = made.judged.stated
    # of the mean of a dwell
    root = np.sqrt(int((0.5 * 4.0 - 0.5) * made.judged.stream)) if made.judged.stream else 1.0
    options = ("--repeatability-mm", f"{arm_mm:.6f}", "--instrument-mm", f"{eye_mm / root:.6f}")
    if made.judged.kind == "pose":
        options += ("--repeatability-deg", f"{arm_deg:.6f}", "--instrument-deg", f"{eye_deg / root:.6f}")
    return replace(made, steps=(*made.steps[:-1], (*made.steps[-1], *options)))
