"""Topology synthesis: the assembly with the fewest joints that does a task (Gao et al. 2014).

    for n = first … last:
        search over assemblies of n joints
        if one of them meets everything that is hard: stop

The fewest that can do is the number of constraints Σm of the most demanding target. Candidates are judged in batches of
a fixed size, in as many processes as wanted, so that a seed gives the same result with any number of them.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, NotReachable, refusing
from modcal_core.geometry import Array, so3
from modcal_core.modules.coding import Coding, plain_name
from modcal_core.modules.evaluation import (
    MET,
    Archive,
    Evaluator,
    Generation,
    Judge,
    SearchSettings,
    Use,
    Verdicts,
    evolve,
    uses_of,
)
from modcal_core.modules.library import JOINT, LINK, Assembly, Library, chain_of
from modcal_core.modules.requirements import REACH, REQUIREMENTS, Requirement
from modcal_core.modules.targets import Target
from modcal_core.robots import chain_forward, rotation_to_axis
from modcal_core.schema import NUMBER, POSITIVE, SIZE, TEXT, Schema, list_of, record, require, stated, whole

_BATCH = 32  # candidates; must not depend on the number of workers
Watch = Callable[[Generation], None]


@dataclass(frozen=True)
class SynthesisTask:
    """What an arm is wanted for.

    first, last: numbers of joints to be tried; modules: kinds of joints and links that may be used, all where it is
    empty; listed: how many results.
    """

    targets: tuple[Target, ...]
    uses: tuple[Use, ...]
    first: int
    last: int = 7
    settings: SearchSettings = field(default_factory=SearchSettings)
    listed: int = 10
    modules: tuple[str, ...] = ()
    name: str = "task"


@dataclass(frozen=True)
class Candidate:
    """A result. code: in bits; cost: weighted sum; terms: by requirement, before weighting.

    postures: (K, n) [rad, m], one for each target; error: the published measure there, (K, 6) [1, m]; miss: way [m] and
    angle [rad] to each target, (K, 2).
    """

    assembly: Assembly
    code: str
    cost: float
    terms: dict[str, float]
    postures: Array
    error: Array
    miss: Array


@dataclass(frozen=True)
class Tally:
    """Counts of the candidates with one number of joints: evaluated, feasible, and by first broken requirement."""

    joints: int
    generations: int
    judged: int
    met_all: int
    rejected: dict[str, int]
    descents: int


@dataclass(frozen=True)
class Synthesis:
    """The results, best first; of assemblies of the same kinds of modules in the same order only the best."""

    task: SynthesisTask
    ranking: tuple[Candidate, ...]
    tallies: tuple[Tally, ...]
    seed: int


def synthesize(
    task: SynthesisTask, library: Library, seed: int = 0, workers: int = 1, watch: Watch | None = None
) -> Synthesis:
    """The best assemblies of the library for a task, of as few joints as can be. watch: called after every generation.
    Raises NotReachable where none of up to ``task.last`` joints was found.
    """
    library = allowed(library, task.modules)
    coding = Coding(library)
    tallies: list[Tally] = []
    nearest = np.inf, 0
    with judges(library, task, seed, workers) as judge:
        for joints in range(task.first, task.last + 1):
            archive = evolve(coding, joints, judge, np.random.default_rng([seed, joints]), task.settings, watch)
            tallies.append(_tally(archive, task, joints))
            if tallies[-1].met_all:
                return Synthesis(task, _ranking(archive, task, coding), tuple(tallies), seed)
            lead = archive.verdicts.order()[0]
            if archive.verdicts.level[lead] == 2:
                nearest = min(nearest, (float(archive.verdicts.amount[lead]), joints))
    raise _none_found(task, tallies, *nearest)


def allowed(library: Library, modules: tuple[str, ...]) -> Library:
    """The library with no joints and links but these; as it is where none are named. Raises BadTable."""
    if not modules:
        return library
    named = {library.type(name).name for name in modules}
    types = {k: t for k, t in library.types.items() if k in named or t.role not in (JOINT, LINK)}
    for role in (JOINT, LINK):
        if not any(t.role == role for t in types.values()):
            kinds = ", ".join(t.name for t in library.of_role(role))
            raise BadTable("modules of the task", f"there is no {role} among them", f"add one of {kinds}")
    return replace(library, types=types)


@contextmanager
def judges(
    library: Library, task: SynthesisTask, seed: int, workers: int
) -> Iterator[Callable[[np.ndarray], Verdicts]]:
    """What judges genomes (N, n + 1), in batches, in this process or in several."""
    begun = library, task.targets, task.uses, seed

    def judge(each: Callable[..., Iterable[Verdicts]]) -> Judge:
        def judged(genomes: np.ndarray) -> Verdicts:
            batches = (genomes[i : i + _BATCH] for i in range(0, len(genomes), _BATCH))
            return Verdicts.joined(list(each(_judged, batches)))

        return judged

    if workers < 2:
        _begin(*begun)
        yield judge(map)
        return
    # a fresh interpreter each: what forks while threads run, such as those of a progress bar, may hang
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_begin, initargs=begun)
    try:
        yield judge(pool.map)
    finally:
        pool.shutdown(cancel_futures=True)


_evaluator: Evaluator | None = None  # of a process; tables are made once in each


def _begin(library: Library, targets: tuple[Target, ...], uses: tuple[Use, ...], seed: int) -> None:
    global _evaluator
    _evaluator = Evaluator(library, targets, uses, seed)


def _judged(genomes: np.ndarray) -> Verdicts:
    assert _evaluator is not None
    return _evaluator(genomes)


def _tally(archive: Archive, task: SynthesisTask, joints: int) -> Tally:
    broken = archive.verdicts.broken
    rejected = {use.name: int((broken == i).sum()) for i, use in enumerate(task.uses) if use.hard}
    met, descents = int((broken == MET).sum()), int(archive.verdicts.descents.sum())
    return Tally(joints, archive.generations, archive.judged, met, rejected, descents)


def _ranking(archive: Archive, task: SynthesisTask, coding: Coding) -> tuple[Candidate, ...]:
    out: list[Candidate] = []
    seen = set()
    for i in archive.verdicts.order():
        if not archive.verdicts.met[i] or len(out) == task.listed:
            break
        fields = coding.fields(archive.genomes[i, 1:])
        kinds = (*fields[0], *fields[2])
        if kinds not in seen:
            seen.add(kinds)
            out.append(_candidate(archive, int(i), task, coding, len(out) + 1))
    return tuple(out)


def _candidate(archive: Archive, i: int, task: SynthesisTask, coding: Coding, rank: int) -> Candidate:
    genome, at = archive.genomes[i], archive.verdicts
    assembly = coding.assembly(genome, f"{task.name}_{rank}")
    # not what the search says: the arm as every other part of the suite sees it
    T = chain_forward(chain_of(assembly, coding.library), at.q[i])
    misses = [target.miss(T[k]) for k, target in enumerate(task.targets)]
    terms = {u.name: float(x) for u, x in zip(task.uses, at.terms[i], strict=True) if np.isfinite(x)}
    error = np.stack([target.error(T[k]) for k, target in enumerate(task.targets)])
    return Candidate(assembly, coding.text(genome), float(at.cost[i]), terms, at.q[i], error, np.array(misses, float))


def _none_found(task: SynthesisTask, tallies: list[Tally], missing: float, joints: int) -> NotReachable:
    judged = sum(t.judged for t in tallies)
    counts = [(name, sum(t.rejected.get(name, 0) for t in tallies)) for name in tallies[-1].rejected]
    reasons = ", ".join(f"{name} {count}" for name, count in counts if count)
    said = f"none of {judged} assemblies of {task.first} to {task.last} joints meets all requirements ({reasons})"
    if np.isfinite(missing) and dict(counts)[REACH]:
        said += f"; the nearest, of {joints} joints, misses a target by {missing:.3g} (m and rad)"
    remedy = "ask for less, allow more joints or generations, or give other modules"
    return NotReachable(task.name, said, remedy, position=missing)


# --- The results of a synthesis as data and as a page that a person reads

FORMAT = 1


def to_data(result: Synthesis, library: Library) -> dict[str, Any]:
    """What ranking.json holds, all in SI units."""
    return {
        "modcal_ranking": FORMAT,
        "task": result.task.name,
        "library": library.name,
        "seed": result.seed,
        "joints": result.ranking[0].assembly.n,
        "requirements": [asdict(u) for u in result.task.uses],
        "searched": [asdict(t) for t in result.tallies],
        "ranking": [
            {
                "rank": rank,
                "code": candidate.code,
                "modules": described(candidate, library),
                "cost": candidate.cost,
                "terms": candidate.terms,
                "targets": [
                    {
                        "name": target.name,
                        "posture": candidate.postures[k].tolist(),
                        "position_error_m": float(candidate.miss[k, 0]),
                        "rotation_error_rad": float(candidate.miss[k, 1]),
                        "masked_error": candidate.error[k].tolist(),
                    }
                    for k, target in enumerate(result.task.targets)
                ],
            }
            for rank, candidate in enumerate(result.ranking, 1)
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
        lines.append(f"| {t.joints} | {t.judged} | {t.met_all} | {counts} |")
    return "\n".join(lines) + "\n"


def sentence(result: Synthesis) -> str:
    """What came of it, in one or two sentences."""
    judged, met = sum(t.judged for t in result.tallies), result.tallies[-1].met_all
    said = f"{judged} assemblies were judged, {met} meet every requirement."
    for tally in result.tallies[:-1]:
        name, count = max(tally.rejected.items(), key=lambda item: item[1])
        said += f" With {tally.joints} joints none was found ({name} broke {count} of {tally.judged})."
    return said


_FORMAT = 1
_SEE = "see docs/synthesis.md"
_PUBLISHED = ("structure", "reachability", "joint_range", "dexterity", "upright")
_ALWAYS = ("structure", "reachability")
_LAST, _MAX_JOINTS = 7, 10
_FARTHEST = 20.0  # m; farther targets were written in millimetres
_ROUNDING = 0.02  # how far a printed rotation may be from one

_POINT = list_of(NUMBER, 3, 3)
_ROTATIONS = {
    "rotation": list_of(_POINT, 3, 3),
    "rpy_rad": _POINT,
    "quaternion_xyzw": list_of(NUMBER, 4, 4),
    "z_axis": _POINT,
}
# options of requirements that are no plain sizes
_OPTIONS = {
    "spheres": list_of(record(("center_m", "radius_m"), center_m=_POINT, radius_m={**POSITIVE, "maximum": 20}), 1),
    "tolerance": {**POSITIVE, "maximum": 0.1},
}


def _of_requirement(known: Requirement) -> Schema:
    own = {key: _OPTIONS.get(key, SIZE) for key in known.options}
    own |= {"hard": {"type": "boolean"}} if known.hard and known.soft else {}
    own |= {"weight": SIZE} if known.soft else {}
    return record([key for key, default in known.options.items() if default is None], **own)


_SCHEMA = record(
    ("modcal_synthesis", "targets"),
    modcal_synthesis={"enum": [_FORMAT]},
    name=TEXT,
    targets=list_of(record(("position_m",), name=TEXT, position_m=_POINT, mask={}, **_ROTATIONS), 1),
    requirements=record((), **{name: _of_requirement(known) for name, known in REQUIREMENTS.items()}),
    joints=record((), first=whole(1, _MAX_JOINTS), last=whole(1, _MAX_JOINTS)),
    search=record((), population=whole(32, 100_000), generations=whole(1, 100_000), patience=whole(1, 100_000)),
    listed=whole(1, 1000),
    modules=list_of(TEXT),
)


@refusing
def task_from_data(data: Any, source: str) -> SynthesisTask:
    """The task that nested mappings and lists describe; ``source`` is named in refusals. Raises BadTable."""
    wanted = data.get("requirements") if isinstance(data, Mapping) else None
    if isinstance(wanted, Mapping):  # a name alone asks for a requirement with its defaults
        data = {**data, "requirements": {name: {} if value is None else value for name, value in wanted.items()}}
    top = stated(data)
    require(top, _SCHEMA, source, _SEE)
    targets = tuple(_target(item, f"{source}: target {i + 1}", i) for i, item in enumerate(top["targets"]))
    joints = top.get("joints", {})
    first = joints.get("first", max(t.constraints for t in targets))
    last = joints.get("last", max(_LAST, first))
    if last < first:
        raise BadTable(f"{source}: joints", f"run from {first} to {last}", "give first not above last")
    names = _ALWAYS if "requirements" in top else _PUBLISHED
    return SynthesisTask(
        targets=targets,
        uses=uses_of({**{name: {} for name in names}, **top.get("requirements", {})}),
        first=first,
        last=last,
        settings=SearchSettings(**top.get("search", {})),
        listed=top.get("listed", 10),
        modules=tuple(top.get("modules", ())),
        name=plain_name(top.get("name", "task"), source),
    )


def _target(data: Mapping[str, Any], what: str, i: int) -> Target:
    p = np.array(data["position_m"], dtype=float)
    if np.linalg.norm(p) > _FARTHEST:
        said = f"is {np.linalg.norm(p):.0f} m away, {_FARTHEST:g} m is the limit"
        raise BadTable(f"{what}: position_m", said, "give metres, not millimetres")
    mask = _mask(data.get("mask", "111111"), f"{what}: mask")
    given = [key for key in _ROTATIONS if key in data]
    if len(given) > 1 or (not given and mask[:3].any()):
        said = f"has {len(given)} rotations where its mask asks for one"
        raise BadTable(what, said, f"give one of {', '.join(_ROTATIONS)}")
    R = _rotation(given[0], np.array(data[given[0]], dtype=float), f"{what}: {given[0]}", mask) if given else np.eye(3)
    return Target.build(R, p, mask, data.get("name", f"target_{i + 1}"))


def _rotation(key: str, values: Array, what: str, mask: np.ndarray) -> Array:
    if key == "rpy_rad":
        return so3.from_rpy(values)
    length = float(np.linalg.norm(values))
    if key == "quaternion_xyzw":
        if abs(length - 1.0) > _ROUNDING:
            raise BadTable(what, f"has length {length:.3f}, not 1", "check its four numbers")
        return so3.from_quaternion(values)
    if key == "z_axis":
        if mask[2]:
            said = "leaves the turn about z open, the mask does not"
            raise BadTable(what, said, 'give mask: "110111", or a rotation')
        if length < 1e-6:
            raise BadTable(what, "has no length", "give a direction")
        return rotation_to_axis(values / length)
    off = float(np.abs(values @ values.T - np.eye(3)).max())
    if off > _ROUNDING or np.linalg.det(values) < 0.0:
        said = f"is not a rotation: R Rᵀ is off by {off:.2g}" if off > _ROUNDING else "is a reflection"
        raise BadTable(what, said, "give its three rows")
    return values


def _mask(stated_mask: Any, what: str) -> np.ndarray:
    digits = [str(d) for d in stated_mask] if isinstance(stated_mask, str | list | tuple) else []
    if len(digits) != 6 or not {"1"} <= set(digits) <= {"0", "1"}:
        remedy = 'write six digits in quotes, turns first: "110111"'
        raise BadTable(f"{what} {stated_mask!r}", "is not six of 0 and 1, at least one of them 1", remedy)
    return np.array([d == "1" for d in digits])
