"""Does a number that decides matter? Each one 30 % lower and higher, over recordings of the two public benchmarks.

    make bench NAME=constants ARGS="--only status.MAX_REJECTED SIGNIFICANT --every 20"

Recordings are those of ``bench/undeclared`` (is the planted effect named, how well is the second recording predicted?)
and ``bench/verdict`` (is the verdict right?). A number that counts moves by at least one. One that is a default,
or that another constant was computed from, stays as it was there. The table says which recordings have another outcome
than with the number as it stands. Numbers of ``verdict/`` change no name of an effect: ``--bench verdict --every 4``
gives them more recordings in the same time. ``--json FILE --resume`` goes on where a sweep was stopped.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import importlib
import importlib.util
import json
import pkgutil
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import ModuleType
from typing import Any

HERE = Path(__file__).resolve().parent
FACTORS = (0.7, 1.3)
# scenario or kind and seed; the robots come in turn with the seed
UNDECLARED = (
    *(("compliance", 1), ("gear_harmonic", 2), ("approach_backlash", 3), ("thermal_sensor", 4), ("tool_bump", 5)),
    *(("tripod_settling", 6), ("wrist_coupling", 7), ("hose_drag", 8), ("gear_harmonic+compliance", 9)),
    *(("none", seed) for seed in range(21, 26)),
)
VERDICT = ("main", "later", "good")
AS_IT_STANDS = "as it stands"


def moved(value: float, factor: float) -> float:
    """A constant 30 % off; one that counts stays a whole number, and moves."""
    if not isinstance(value, int):
        return value * factor
    return min(round(value * factor), value - 1) if factor < 1.0 else max(round(value * factor), value + 1)


def value_of(module: str, name: str) -> float:
    """The constant as it stands. Raises LookupError for a name that is not there."""
    value = getattr(importlib.import_module(module), name, None)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise LookupError(f"{module} has no number {name}")
    return value


@contextmanager
def changed(module: str, name: str, factor: float) -> Iterator[None]:
    """The constant moved wherever it has been imported to. Raises LookupError for a name that is not there."""
    import modcal_core

    for found in pkgutil.walk_packages(modcal_core.__path__, "modcal_core."):
        importlib.import_module(found.name)
    value = value_of(module, name)
    loaded = [m for key, m in list(sys.modules.items()) if key.startswith("modcal_") and m is not None]
    holders = [m for m in loaded if getattr(m, name, None) is value]
    for holder in holders:
        setattr(holder, name, moved(value, factor))
    try:
        yield
    finally:
        for holder in holders:
            setattr(holder, name, value)


def runner(bench: str) -> ModuleType:
    """The script of another bench; both are called run."""
    name = f"{bench}_run"
    if name not in sys.modules:
        spec: Any = importlib.util.spec_from_file_location(name, harness.BENCH / bench / "run.py")
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


def one(task: harness.Task) -> harness.Result:
    """Outcome by recording, with one constant moved, or as it stands."""
    constant, still = task["constant"], task["constant"] == AS_IT_STANDS
    with nullcontext() if still else changed(*constant.split(":"), task["factor"]):
        return {"outcomes": [outcome(*r) for r in task["recordings"]]}


def outcome(bench: str, kind: str, seed: int) -> str:
    """What was said of a recording in a few words."""
    if bench != "undeclared":
        task = {"group": bench, "kind": kind, "seed": seed, "way": "returns" if bench == "good" else ""}
        return str(runner("verdict").one(task)["outcome"])
    run = runner("undeclared")
    robot = list(run.ROBOTS)[seed % 3]
    try:
        found = run.one({"scenario": kind, "robot": robot, "seed": seed, "stations": run.STATIONS, "keep": None})
    except RuntimeError:
        return "failed"
    false = f", {found['score']['false']} false" if found["score"]["false"] else ""
    worse = ", predicts above 1.2 x the floor" if found["error_over_floor"] > 1.2 else ""
    return ("named" if found["attributed"] else "not named") + false + worse


def recordings(every: int, benches: list[str]) -> list[tuple[str, str, int]]:
    """The panel: some of bench/undeclared, and every so manyth kind of bench/verdict; of the benches that are named."""
    out = [("undeclared", kind, seed) for kind, seed in UNDECLARED if "undeclared" in benches]
    kinds = runner("verdict").KINDS if "verdict" in benches else dict.fromkeys(VERDICT, ())
    return out + [(group, kind, 40 + k) for group in VERDICT for k, kind in enumerate(kinds[group])][::every]


def harms(recording: str, said: str) -> bool:
    """Whether an outcome is of the kind that may not happen: calm and wrong, or an effect of a clean arm."""
    return said == "calm and wrong" or (recording.startswith("none ") and "false" in said)


def main() -> int:
    """Exit code: 0 where no move of a number made a verdict calm and wrong, or a clean arm one with an effect."""
    listed = json.loads((HERE / "constants.json").read_text(encoding="utf-8"))
    constants = {f"{module.removeprefix('modcal_core.')}.{name}": (module, name) for module, name in listed}
    parser = harness.parser(__doc__, seeds=0, names=constants)
    parser.add_argument("--bench", nargs="+", default=["undeclared", "verdict"], help="whose recordings")
    parser.add_argument("--every", type=int, default=8, help="of bench/verdict's kinds, one in so many")
    given = harness.parsed(parser)
    for name in given.names:
        value_of(*constants[name])  # said now, not after an hour
    panel = recordings(given.every, given.bench)
    trials = [(AS_IT_STANDS, 1.0), *((":".join(constants[name]), f) for name in given.names for f in FACTORS)]
    tasks = [{"constant": constant, "factor": factor, "recordings": panel} for constant, factor in trials]
    first, *results = harness.each(one, tasks, given, fresh=True)
    rows, harmed = [], 0
    for r in [r for r in results if not r["failed"] and not first["failed"]]:
        pairs = zip(panel, first["outcomes"], r["outcomes"], strict=True)
        others = [(f"{kind} {seed}", was, said) for (_, kind, seed), was, said in pairs if said != was]
        harmed += any(harms(recording, said) for recording, _, said in others)
        words = "; ".join(f"{recording}: {was} → {said}" for recording, was, said in others)
        rows.append([r["constant"].replace(":", "."), r["factor"], words or "none"])
    title = f"Numbers that decide, 30 % lower and higher, over {len(panel)} recordings"
    harness.table(title, ("constant", "factor", "other outcomes"), rows)
    return int(bool(harness.failures([first, *results]))) or harness.met(("no move does harm", not harmed))


if __name__ == "__main__":
    sys.exit(main())
