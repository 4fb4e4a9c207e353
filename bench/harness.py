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
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from pathlib import Path
from typing import Any

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
os.environ.update(dict.fromkeys(THREADS, "1"))

BENCH = Path(__file__).resolve().parent
ROOT = BENCH.parent
ROBOTS = ROOT / "examples" / "robots"
DATA = ROOT.parent / "shared" / "data"
WIDTH = 170  # of tables that go to a file
# Where benches find one another's truth, and what the tests share; a bench's own folder comes first.
sys.path.extend(str(ROOT / folder) for folder in ("tests", "bench", "bench/undeclared", "bench/verdict"))
_BEGUN: set[Path] = set()  # files of results that this run has written to
Task = dict[str, Any]
Result = dict[str, Any]
One = Callable[[Task], Result]


def data(*parts: str) -> Path:
    """A path among the real recordings. Ends the program where they are not beside this checkout."""
    path = DATA.joinpath(*parts)
    if not path.exists():
        sys.exit(f"no real recordings: ../shared/data{''.join('/' + p for p in parts)} is not beside this checkout")
    return path


def parser(
    doc: str | None,
    *,
    seeds: int | None = 1,
    first: int | None = 0,
    names: Iterable[str] = (),
    jobs: int = 2,
    **own: Any,
) -> argparse.ArgumentParser:
    """The common options and a bench's own; ``parsed`` reads them.

    names: what ``--only`` chooses from; without any there is no option. seeds: of each; 0: no option; None: the bench
    says what it is where it is not given. own: defaults by name; False is a switch, a list takes several values, a
    tuple is a choice of which the first is the default, and a type is an option without a default.
    """
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = list(names)
    if known:
        made.add_argument("--only", nargs="+", default=[], help="names, or parts of them: " + ", ".join(known[:60]))
    if seeds != 0:
        made.add_argument("--seeds", type=int, default=seeds, help=f"of each; default: {seeds or 'by name'}")
        made.add_argument(
            "--first", type=int, default=first, help=f"the first; default: {'by name' if first is None else first}"
        )
    made.add_argument("--jobs", type=int, default=jobs, help=f"processes; 1: this one; default: {jobs}")
    made.add_argument("--json", type=Path, default=None, metavar="FILE", help="a line of JSON for each task")
    made.add_argument("--resume", action="store_true", help="take from that file what it holds already")
    for name, usual in own.items():
        about: dict[str, Any] = {"type": type(usual), "default": usual, "help": f"default: {usual}".replace("%", "%%")}
        if usual is False:
            about = {"action": "store_true"}
        elif isinstance(usual, type):
            about = {"type": usual}
        elif isinstance(usual, list):
            about |= {"nargs": "+", "type": type(usual[0])}
        elif isinstance(usual, tuple):
            about = {"choices": usual, "default": usual[0]}
        made.add_argument(f"--{name.replace('_', '-')}", **about)
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
    return parsed(parser(doc, **about))


def told(given: argparse.Namespace, *names: str) -> Task:
    """Some of the options, as a part of a task."""
    return {name: getattr(given, name) for name in names}


def chosen(known: Iterable[str], only: Iterable[str]) -> list[str]:
    """The known names that are asked for: a whole name, or every one that holds a part. Commas separate as well. Raises
    LookupError for what is no part of one.
    """
    known, parts = list(known), [part for text in only for part in text.split(",") if part]
    for part in parts:
        if not any(part in name for name in known):
            raise LookupError(f"nothing is called {part}; there are {', '.join(known)}")
    whole = set(parts) & set(known)
    return [n for n in known if not parts or n in whole or any(p in n for p in parts if p not in whole)]


def tasks(given: argparse.Namespace, counts: dict[str, int] | None = None, **axes: Iterable[Any]) -> list[Task]:
    """A task for each combination of the axes and of the seeds, which change fastest. counts: of seeds by values of the
    first axis, where the options say no number.
    """
    axes = {name: list(values) for name, values in axes.items()}
    out = [dict(zip(axes, values, strict=True)) for values in product(*axes.values())]
    if not hasattr(given, "seeds"):
        return out
    numbers = [counts[next(iter(t.values()))] if counts and given.seeds is None else given.seeds for t in out]
    return [{**t, "seed": given.first + k} for t, number in zip(out, numbers, strict=True) for k in range(number)]


def each(
    one: One | dict[str, One],
    tasks: Sequence[Task],
    given: argparse.Namespace,
    line: Callable[[Result], str] | None = None,
    fresh: bool = False,
) -> list[Result]:
    """The tasks with what ``one`` makes of each added, in their order.

    ``one`` stands at the top of its module; several of them go by the first value of a task. What it raises is kept as
    ``failed``; a task that went well has None there. Every result goes to standard error as a ``line`` and to
    ``--json`` at once. fresh: a process for each task.
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
    one: One | dict[str, One], tasks: Sequence[Task], waiting: list[int], jobs: int, fresh: bool
) -> Iterator[tuple[int, Result]]:
    ones = {i: one[next(iter(tasks[i].values()))] if isinstance(one, dict) else one for i in waiting}
    if jobs <= 1 and not fresh:
        yield from ((i, _kept(ones[i], tasks[i])) for i in waiting)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, max_tasks_per_child=1 if fresh else None) as pool:
        going = {pool.submit(_kept, ones[i], tasks[i]): i for i in waiting}
        for future in as_completed(going):
            yield going[future], future.result()


def _kept(one: One, task: Task) -> Result:
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
    from scipy.stats import binomtest

    found = binomtest(hits, count).proportion_ci(sure)
    return float(found.low), float(found.high)


def share(hits: Iterable[bool]) -> str:
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
    if isinstance(value, list | tuple):
        return ", ".join(map(_cell, value))
    if value is None or value != value:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def counts(
    title: str, results: Sequence[Result], by: str, of: str, outcomes: Sequence[str] = (), sums: bool = True
) -> None:
    """Print how often each outcome came of each group: a row a value of ``by``, a column a value of ``of``."""
    columns = {
        outcome: lambda found, outcome=outcome: sum(str(r.get(of)) == outcome for r in found) or ""
        for outcome in outcomes or dict.fromkeys(str(r.get(of)) for r in results)
    }
    summary(title, [{**r, "failed": None} for r in results], by, columns, sums)


def grouped(results: Iterable[Result], *by: str) -> dict[Any, list[Result]]:
    """Results that did not fail, by the value of a key, or of several together, in the order in which they come."""
    out: dict[Any, list[Result]] = {}
    for r in results:
        if r.get("failed") is None:
            out.setdefault(r[by[0]] if len(by) == 1 else tuple(r[key] for key in by), []).append(r)
    return out


def over(key: str | Callable[[Result], Any], make: Callable[[list[Any]], Any]) -> Callable[[list[Result]], Any]:
    """A column of ``summary``: what ``make`` makes of a value of every result that has one."""

    def column(results: list[Result]) -> Any:
        values = [r.get(key) if isinstance(key, str) else key(r) for r in results]
        known = [v for v in values if v is not None]
        return make(known) if known else None

    return column


def median(values: list[float]) -> float:
    import numpy as np

    return float(np.median(values))


def summary(
    title: str,
    results: Iterable[Result],
    by: str | Sequence[str],
    columns: dict[str, Callable[[list[Result]], Any]],
    sums: bool = False,
) -> None:
    """Print a row for each value of ``by``: how many results did not fail, and what each column makes of them."""
    keys = [by] if isinstance(by, str) else list(by)
    groups = {k if isinstance(k, tuple) else (k,): found for k, found in grouped(results, *keys).items()}
    made = [[*name, len(found), *(column(found) for column in columns.values())] for name, found in groups.items()]
    if sums and len(groups) > 1:
        found = [r for some in groups.values() for r in some]
        every = ["all", *([""] * (len(keys) - 1)), len(found), *(column(found) for column in columns.values())]
        made += [None, every]
    if made:
        table(title, [*keys, "runs", *columns], made)


def rows(title: str, results: Iterable[Result], keys: Sequence[str]) -> None:
    """Print a row for each result that did not fail: its values of these keys."""
    found = [[r.get(key) for key in keys] for r in results if r.get("failed") is None]
    if found:
        table(title, keys, found)


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


def judged(rows: Sequence[tuple[str, object, str, bool]]) -> int:
    """Print what was measured beside its limit; exit code 0 where every row is good."""
    table("", ("", "measured", "limit"), [row[:3] for row in rows])
    return met(*((row[0], row[3]) for row in rows))


def ended(results: Sequence[Result], *targets: tuple[str, bool]) -> int:
    """Exit code: 0 where nothing failed and every target is met; what is not is printed."""
    return int(bool(failures(results))) | met(*targets)
