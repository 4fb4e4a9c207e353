"""What every bench shares: one thread, options, a pool of tasks, tables, the ``modcal`` command, real data, intervals.

Import it before NumPy. A bench is a list of tasks (dicts of plain values), a function ``one(task)`` that returns what
came of one of them, and a table:

    given = harness.options(__doc__, seeds=20, names=KINDS)
    results = harness.each(one, harness.tasks(given, kind=given.names), given)
    harness.counts("kinds", results, "kind", "outcome")

A flat file ``bench/NAME.py`` writes ``import harness``; ``bench/NAME/run.py`` first puts this folder on ``sys.path``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import os
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from pathlib import Path
from typing import Any

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
os.environ.update(dict.fromkeys(THREADS, "1"))

BENCH = Path(__file__).resolve().parent
ROOT = BENCH.parent
DATA = ROOT.parent / "shared" / "data"
WIDTH = 170  # of tables that go to a file
# Where benches find one another's truth, and what the tests share; a bench's own folder comes first.
sys.path.extend(str(ROOT / folder) for folder in ("tests", "bench", "bench/undeclared", "bench/verdict"))
_BEGUN: set[Path] = set()  # files of results that this run has written to
Task = dict[str, Any]
Result = dict[str, Any]


def data(*parts: str) -> Path:
    """A path among the real recordings. Ends the program where they are not beside this checkout."""
    path = DATA.joinpath(*parts)
    if not path.exists():
        sys.exit(f"no real recordings: ../shared/data{''.join('/' + p for p in parts)} is not beside this checkout")
    return path


def parser(
    doc: str | None, *, seeds: int | None = 1, first: int | None = 0, names: Iterable[str] = (), jobs: int = 2
) -> argparse.ArgumentParser:
    """The common options; a bench adds its own and parses with ``parsed``.

    names: what ``--only`` chooses from; without any there is no option. seeds: of each; 0: no option; None: the
    bench says what it is where it is not given.
    """
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = list(names)
    if known:
        made.add_argument("--only", nargs="+", default=[], help="names, or parts of them: " + ", ".join(known))
    if seeds != 0:
        made.add_argument("--seeds", type=int, default=seeds, help=f"of each; default: {seeds or 'by name'}")
        made.add_argument(
            "--first", type=int, default=first, help=f"the first; default: {'by name' if first is None else first}"
        )
    made.add_argument("--jobs", type=int, default=jobs, help=f"processes; 1: this one; default: {jobs}")
    made.add_argument("--json", type=Path, default=None, metavar="FILE", help="a line of JSON for each task")
    made.add_argument("--resume", action="store_true", help="take from that file what it holds already")
    made.set_defaults(known=known)
    return made


def parsed(made: argparse.ArgumentParser, arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The options, with ``names``: those that ``--only`` chose, in their order."""
    given = made.parse_args(arguments)
    try:
        given.names = chosen(given.known, getattr(given, "only", []))
    except LookupError as error:
        made.error(str(error))
    return given


def options(doc: str | None, **about: Any) -> argparse.Namespace:
    """The common options, parsed: for a bench that adds none."""
    return parsed(parser(doc, **about))


def chosen(known: Iterable[str], only: Iterable[str]) -> list[str]:
    """The known names that are asked for: a whole name, or every one that holds a part. Commas separate as well.

    Raises LookupError for what is no part of a known name.
    """
    known, parts = list(known), [part for text in only for part in text.split(",") if part]
    for part in parts:
        if not any(part in name for name in known):
            raise LookupError(f"nothing is called {part}; there are {', '.join(known)}")
    whole = set(parts) & set(known)
    return [n for n in known if not parts or n in whole or any(p in n for p in parts if p not in whole)]


def tasks(given: argparse.Namespace, **axes: Iterable[Any]) -> list[Task]:
    """A task for each combination of the axes and of the seeds, which change fastest."""
    axes = {name: list(values) for name, values in axes.items()}
    if hasattr(given, "seeds"):
        axes["seed"] = range(given.first, given.first + given.seeds)
    return [dict(zip(axes, values, strict=True)) for values in product(*axes.values())]


def each(
    one: Callable[[Task], Result],
    tasks: Sequence[Task],
    given: argparse.Namespace,
    line: Callable[[Result], str] | None = None,
    fresh: bool = False,
) -> list[Result]:
    """The tasks with what ``one`` makes of each added, in their order.

    ``one`` stands at the top of its module. What it raises is kept as ``failed``; a task that went well has None there.
    Every result goes to standard error as a ``line`` and to ``--json`` at once. fresh: a process for each task.
    """
    done = dict(_before(tasks, given))
    waiting = [i for i in range(len(tasks)) if i not in done]
    with contextlib.ExitStack() as stack:
        log = None
        if given.json is not None:
            mode = "a" if given.resume or given.json in _BEGUN else "w"
            log = stack.enter_context(given.json.open(mode, encoding="utf-8"))
            _BEGUN.add(given.json)
        for i, result in _made(one, tasks, waiting, given.jobs, fresh):
            done[i] = result
            said = f"FAILED {result['failed'].splitlines()[-1]}" if result["failed"] else line(result) if line else ""
            what = " ".join(str(v) for v in tasks[i].values() if isinstance(v, str | int | float))
            print(f"[{len(done)}/{len(tasks)}] {what}: {said}", file=sys.stderr, flush=True)
            if log is not None:
                log.write(json.dumps(result, default=_plain) + "\n")
                log.flush()
    return [done[i] for i in range(len(tasks))]


def _made(
    one: Callable[[Task], Result], tasks: Sequence[Task], waiting: list[int], jobs: int, fresh: bool
) -> Iterator[tuple[int, Result]]:
    if jobs <= 1 and not fresh:
        yield from ((i, _kept(one, tasks[i])) for i in waiting)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, max_tasks_per_child=1 if fresh else None) as pool:
        going = {pool.submit(_kept, one, tasks[i]): i for i in waiting}
        for future in as_completed(going):
            yield going[future], future.result()


def _kept(one: Callable[[Task], Result], task: Task) -> Result:
    began, clock = time.process_time(), time.perf_counter()
    try:
        result = {"failed": None, **one(task)}
    except Exception:
        result = {"failed": traceback.format_exc(limit=-3)}
    spent = {"cpu_s": round(time.process_time() - began, 3), "s": round(time.perf_counter() - clock, 3)}
    return {**task, **spent, **result}


def _before(tasks: Sequence[Task], given: argparse.Namespace) -> Iterator[tuple[int, Result]]:
    """Results of an earlier run, by the number of their task."""
    if given.json is None or not given.resume or not given.json.is_file():
        return
    read = [json.loads(text) for text in given.json.read_text(encoding="utf-8").splitlines()]
    for i, task in enumerate(tasks):
        told = json.loads(json.dumps(task, default=_plain))
        found = [r for r in read if all(k in r and r[k] == v for k, v in told.items())]
        if found:
            yield i, {**found[-1], **task}


def _plain(value: Any) -> Any:
    """Arrays as lists, NumPy's numbers as Python's, anything else as its text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def modcal(*arguments: object) -> tuple[int, str]:
    """The command, run in this process: its exit code, and what it said on both channels."""
    from modcal_nodes.cli.main import run

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = run([str(a) for a in arguments])
    return code, said.getvalue()


def succeeded(*arguments: object, codes: tuple[int, ...] = (0,)) -> str:
    """The same where it has to end with one of these codes: what it said. Raises RuntimeError if it does not."""
    code, said = modcal(*arguments)
    if code not in codes:
        raise RuntimeError(f"modcal {arguments[0]}: exit {code}: {said.strip()[-800:]}")
    return said


def report_of(folder: Path) -> dict[str, Any]:
    """The ``report.json`` in the folder of a result."""
    return dict(json.loads((folder / "report.json").read_text(encoding="utf-8")))


@contextlib.contextmanager
def scratch(keep: Path | None = None) -> Iterator[Path]:
    """A folder that is there for this long; or ``keep``, which stays."""
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="bench_") as folder:
        yield Path(folder)


def rms(values: Any) -> float:
    """Root of the mean square of all values; of vectors (…, 3) give their lengths."""
    import numpy as np

    return float(np.sqrt(np.mean(np.square(values))))


def interval(hits: int, count: int, sure: float = 0.95) -> tuple[float, float]:
    """The interval of a share (Clopper & Pearson 1934)."""
    from scipy.stats import beta

    low = 0.0 if hits == 0 else float(beta.ppf(0.5 - 0.5 * sure, hits, count - hits + 1))
    high = 1.0 if hits == count else float(beta.ppf(0.5 + 0.5 * sure, hits + 1, count - hits))
    return low, high


def share(hits: Iterable[bool]) -> str:
    """How many of how many."""
    told = list(hits)
    return f"{sum(told)} of {len(told)}"


def say(*text: str) -> None:
    """Lines for the reader, not wrapped."""
    for part in text:
        print(part, flush=True)


def table(title: str, heads: Sequence[str], rows: Iterable[Sequence[object] | None]) -> None:
    """Print a table; the first column is left-aligned. None: a line between sections."""
    from rich.console import Console
    from rich.table import Table

    made = Table(title=title, title_justify="left")
    for k, head in enumerate(heads):
        made.add_column(head, justify="right" if k else "left")
    for row in rows:
        if row is None:
            made.add_section()
        else:
            made.add_row(*(_cell(v) for v in row))
    Console(width=None if sys.stdout.isatty() else WIDTH, markup=False).print(made)


def _cell(value: object) -> str:
    if value is None or value != value:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def counts(
    title: str, results: Sequence[Result], by: str, of: str, outcomes: Sequence[str] = (), sums: bool = True
) -> None:
    """Print how often each outcome came of each group: a row a value of ``by``, a column a value of ``of``."""
    columns = list(outcomes) or list(dict.fromkeys(str(r.get(of)) for r in results))
    groups = list(dict.fromkeys(r[by] for r in results))
    rows: list[Sequence[object] | None] = []
    for group in [*groups, *([None] if sums and len(groups) > 1 else [])]:
        here = [r for r in results if group is None or r[by] == group]
        counted = Counter(str(r.get(of)) for r in here)
        if group is None:
            rows.append(None)
        rows.append([("all" if group is None else group), len(here), *(counted[c] or "" for c in columns)])
    table(title, [by, "runs", *columns], rows)


def failures(results: Sequence[Result]) -> int:
    """Print what failed, whole; how many there are."""
    failed = [r for r in results if r["failed"] is not None]
    for r in failed:
        what = ", ".join(f"{k} {v}" for k, v in list(r.items())[:6] if isinstance(v, str | int) and k != "failed")
        say(f"failed: {what}: {r['failed']}")
    return len(failed)


def met(*targets: tuple[str, bool]) -> int:
    """Exit code: 0 where every target is met; those that are not are printed."""
    missed = [what for what, good in targets if not good]
    for what in missed:
        say(f"not met: {what}")
    return int(bool(missed))
