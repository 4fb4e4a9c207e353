"""The results of a synthesis as data and as a page that a person reads."""

from __future__ import annotations

from typing import Any

from modcal_core.modules.library import Library
from modcal_core.modules.synthesis import Candidate, Synthesis, Tally

FORMAT = 1


def to_data(result: Synthesis, library: Library) -> dict[str, Any]:
    """What ranking.json holds, all in SI units."""
    return {
        "modcal_ranking": FORMAT,
        "task": result.task.name,
        "library": library.name,
        "seed": result.seed,
        "joints": result.ranking[0].assembly.n,
        "requirements": [
            {"name": u.name, "hard": u.hard, "weight": u.weight, "options": dict(u.options)} for u in result.task.uses
        ],
        "searched": [
            {
                "joints": t.joints,
                "generations": t.generations,
                "judged": t.judged,
                "met_all": t.met,
                "rejected": t.rejected,
                "descents": t.descents,
            }
            for t in result.tallies
        ],
        "ranking": [_candidate(c, i + 1, result, library) for i, c in enumerate(result.ranking)],
    }


def _candidate(candidate: Candidate, rank: int, result: Synthesis, library: Library) -> dict[str, Any]:
    return {
        "rank": rank,
        "code": candidate.code,
        "modules": described(candidate, library),
        "cost": candidate.cost,
        "terms": candidate.terms,
        "targets": [
            {
                "name": target.name,
                "posture": [float(x) for x in candidate.postures[k]],
                "position_error_m": float(candidate.miss[k, 0]),
                "rotation_error_rad": float(candidate.miss[k, 1]),
                "masked_error": [float(x) for x in candidate.error[k]],
            }
            for k, target in enumerate(result.task.targets)
        ],
    }


def described(candidate: Candidate, library: Library) -> list[str]:
    """The modules, base to gripper, each with its length in mm and its turn in degrees against the one before."""
    out = []
    for i, module in enumerate(candidate.assembly.modules):
        kind = library.types[module.kind]
        length = f" {1e3 * kind.length(module.size):.10g} mm" if kind.step else ""
        out.append(f"{module.kind}{length}" + (f", {90 * module.turn}°" if i else ""))
    return out


def to_markdown(result: Synthesis, library: Library) -> str:
    """The ranking with reasons, as text; lengths in mm, angles in degrees."""
    best = result.ranking[0]
    terms = [u.name for u in result.task.uses if u.name in best.terms]
    lines = [f"# {result.task.name}: {best.assembly.n} joints", "", sentence(result), ""]
    lines += ["| rank | cost | " + " | ".join(terms) + " | worst miss | modules |", "|" + "---|" * (len(terms) + 4)]
    for i, c in enumerate(result.ranking):
        values = " | ".join(f"{c.terms[name]:.4g}" for name in terms)
        way, angle = c.miss.max(axis=0)
        modules = " · ".join(m for m in described(c, library))
        lines.append(f"| {i + 1} | {c.cost:.4g} | {values} | {1e3 * way:.1e} mm, {angle:.1e} rad | {modules} |")
    lines += ["", "Terms are before weighting. Of arms of the same kinds in the same order, the best is listed."]
    lines += ["", "## The best", "", *(f"- `{m}`" for m in described(best, library)), "", f"Code `{best.code}`", ""]
    lines += ["## Why others were rejected", "", "By the first requirement that was broken.", ""]
    names = list(result.tallies[-1].rejected)
    lines += ["| joints | judged | met all | " + " | ".join(names) + " |", "|" + "---|" * (len(names) + 3)]
    for t in result.tallies:
        counts = " | ".join(str(t.rejected[name]) for name in names)
        lines.append(f"| {t.joints} | {t.judged} | {t.met} | {counts} |")
    return "\n".join(lines) + "\n"


def sentence(result: Synthesis) -> str:
    """What came of it, in one or two sentences."""
    judged, met = sum(t.judged for t in result.tallies), result.tallies[-1].met
    said = f"{judged} assemblies were judged, {met} meet every requirement."
    return said + "".join(f" With {t.joints} joints none was found{_mostly(t)}." for t in result.tallies[:-1])


def _mostly(tally: Tally) -> str:
    name, count = max(tally.rejected.items(), key=lambda item: item[1])
    return f" ({name} broke {count} of {tally.judged})"
