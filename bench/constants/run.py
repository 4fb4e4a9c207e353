"""Does a number that decides matter? Each one 30 % lower and higher, over recordings of the two public benchmarks.

    python bench/constants/run.py                                        # all of constants.json, hours
    python bench/constants/run.py --only status.MAX_REJECTED,SIGNIFICANT --every 20 --jobs 1

Recordings are those of ``bench/undeclared`` (is the planted effect named, how well is the second recording predicted?)
and ``bench/verdict`` (is the verdict right?). A whole-number constant moves by at least one. The table says which
recordings have another outcome than with the number as it stands. What is done is kept in
``--json``, so that a sweep that was stopped goes on where it was. Numbers of ``verdict/`` change no name of an effect:
``--bench verdict --every 4`` gives them more recordings in the same time.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import importlib  # noqa: E402
import importlib.util  # noqa: E402
import json  # noqa: E402
import multiprocessing  # noqa: E402
import pkgutil  # noqa: E402
import sys  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from concurrent.futures import ProcessPoolExecutor, as_completed  # noqa: E402
from contextlib import contextmanager  # noqa: E402
from pathlib import Path  # noqa: E402
from types import ModuleType  # noqa: E402
from typing import Any  # noqa: E402

from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

HERE = Path(__file__).resolve().parent
FACTORS = (0.7, 1.3)
# scenario or kind and seed; the robots come in turn with the seed
UNDECLARED = (
    *(("compliance", 1), ("gear_harmonic", 2), ("approach_backlash", 3), ("thermal_sensor", 4), ("tool_bump", 5)),
    *(("tripod_settling", 6), ("wrist_coupling", 7), ("hose_drag", 8), ("gear_harmonic+compliance", 9)),
    *(("none", seed) for seed in range(21, 26)),
)
VERDICT = ("main", "later", "good")


def whole(value: float) -> bool:
    """Whether a constant counts something."""
    return isinstance(value, int) and not isinstance(value, bool)


def moved(value: float, factor: float) -> float:
    """A constant 30 % off; one that counts stays a whole number, and moves."""
    if not whole(value):
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
    holders = [
        loaded
        for key, loaded in list(sys.modules.items())
        if key.startswith("modcal_") and loaded is not None and getattr(loaded, name, None) is value
    ]
    for holder in holders:
        setattr(holder, name, moved(value, factor))
    try:
        yield
    finally:
        for holder in holders:
            setattr(holder, name, value)


def trial(constant: tuple[str, str] | None, factor: float, tasks: list[tuple[str, str, int]]) -> dict[str, str]:
    """Outcome by recording, with one constant moved; as it stands where ``constant`` is None."""
    for folder in ("undeclared", "verdict"):
        sys.path.insert(0, str(HERE.parent / folder))
    if constant is None:
        return dict(outcome(task) for task in tasks)
    with changed(*constant, factor):
        return dict(outcome(task) for task in tasks)


def outcome(task: tuple[str, str, int]) -> tuple[str, str]:
    """A recording's name, and what was said of it in a few words."""
    bench, kind, seed = task
    name = f"{kind} {seed}"
    if bench == "undeclared":
        run = runner("undeclared")
        result = run.one(kind, list(run.ROBOTS)[seed % 3], seed, run.STATIONS, None)
        if result["failed"] is not None:
            return name, "failed"
        said = "named" if result["attributed"] else "not named"
        false = f", {result['score']['false']} false" if result["score"]["false"] else ""
        worse = ", predicts above 1.2 x the floor" if result["error_over_floor"] > 1.2 else ""
        return name, said + false + worse
    run = runner("verdict")
    return name, str(run.one(run.Task(bench, kind, seed, "returns" if bench == "good" else ""))["outcome"])


def runner(bench: str) -> ModuleType:
    """The script of another bench; both are called run."""
    name = f"{bench}_run"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, HERE.parent / bench / "run.py")
        assert spec is not None, bench
        assert spec.loader is not None, bench
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


def recordings(every: int, benches: str = "undeclared,verdict") -> list[tuple[str, str, int]]:
    """The panel: some of bench/undeclared, and every so manyth kind of bench/verdict; of the benches that are named."""
    sys.path.insert(0, str(HERE.parent / "verdict"))

    kinds = runner("verdict").KINDS
    verdict = [(group, kind, 40 + k) for group in VERDICT for k, kind in enumerate(kinds[group])]
    both = [*(("undeclared", kind, seed) for kind, seed in UNDECLARED), *verdict[::every]]
    return [task for task in both if ("undeclared" if task[0] == "undeclared" else "verdict") in benches.split(",")]


def main() -> int:
    """Exit code: 0 where no move of a number made a verdict calm and wrong, or a clean arm one with an effect."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", default="", help="comma-separated names, as NAME or file.NAME; default: all of constants.json"
    )
    parser.add_argument("--bench", default="undeclared,verdict", help="whose recordings")
    parser.add_argument("--every", type=int, default=8, help="of bench/verdict's kinds, one in so many")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", type=Path, default=HERE / "sweep.json", metavar="FILE", help="where results go")
    given = parser.parse_args()
    listed = [tuple(c) for c in json.loads((HERE / "constants.json").read_text(encoding="utf-8"))]
    wanted = [name for name in given.only.split(",") if name]
    constants = [c for c in listed if not wanted or any(f".{c[0]}.{c[1]}".endswith(f".{name}") for name in wanted)]
    for module, name in constants:
        value_of(module, name)  # said now, not after an hour
    tasks = recordings(given.every, given.bench)
    trials: list[tuple[tuple[str, str] | None, float]] = [(None, 1.0), *((c, f) for c in constants for f in FACTORS)]
    done: dict[str, Any] = {}
    if given.json.is_file():
        done = json.loads(given.json.read_text(encoding="utf-8"))
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, mp_context=spawn, max_tasks_per_child=1) as pool:
        waiting = {pool.submit(trial, c, f, tasks): key for c, f in trials if (key := key_of(c, f)) not in done}
        for k, future in enumerate(as_completed(waiting), 1):
            done[waiting[future]] = future.result()
            print(f"[{k}/{len(waiting)}] {waiting[future]}", file=sys.stderr, flush=True)
            given.json.write_text(json.dumps(done, indent=1), encoding="utf-8")
    rows = [
        (f"{module.removeprefix('modcal_core.')}.{name}", factor, others(done, (module, name), factor))
        for module, name in constants
        for factor in FACTORS
    ]
    table = Table(title=f"Numbers that decide, 30 % lower and higher, over {len(tasks)} recordings")
    for header in ("constant", "factor", "other outcomes"):
        table.add_column(header)
    for name, factor, other in rows:
        words = "; ".join(f"{recording}: {was} → {said}" for recording, was, said in other)
        table.add_row(name, f"{factor:g}", words or "none")
    Console(width=None if sys.stdout.isatty() else 160).print(table)
    return 1 if any(harms(recording, said) for *_, other in rows for recording, _, said in other) else 0


def others(done: dict[str, Any], constant: tuple[str, str], factor: float) -> list[tuple[str, str, str]]:
    """Recordings of which something else was said: name, what is said with the number as it stands, and now."""
    base = done[key_of(None, 1.0)]
    return [(name, base[name], said) for name, said in done[key_of(constant, factor)].items() if said != base[name]]


def harms(recording: str, said: str) -> bool:
    """Whether an outcome is of the kind that may not happen: calm and wrong, or an effect of a clean arm."""
    return said == "calm and wrong" or (recording.startswith("none ") and "false" in said)


def key_of(constant: tuple[str, str] | None, factor: float) -> str:
    """The name of a trial in the results."""
    return "as it stands" if constant is None else f"{constant[0]}.{constant[1]} x {factor:g}"


if __name__ == "__main__":
    sys.exit(main())
