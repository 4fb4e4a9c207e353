"""Do the tests bite? A fixed sample of faults, each put into a copy of the sources and shown to tests that reach it.

Which tests those are is found by one run of all tests over sources with marks in them, which takes as long as the suite
and is kept for the next time. Both runs may be interrupted, and go on where they were.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import queue
import shlex
import signal
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from copies import Copy, digests
from fragments import Mutant, NotApplicable, Place, find, functions, marked
from maps import Map, Test, lines_of
from probe import RECORD, SKIP, TESTS
from sample import SAMPLE

ROOT = Path(__file__).resolve().parents[2]
_FIRST, _MORE = 15.0, 4.0  # s of tests in the first round, and how many times as many in the next
_MIN_LIMIT, _PATIENCE = 60.0, 8.0  # s that any test may take, and how many times as long as it usually does
KILLED, SURVIVED, GONE, UNSEEN = "killed", "survived", "not applicable", "reached by no test"


class Bench:
    """The sample over one checkout and one folder of tests."""

    def __init__(self, options: argparse.Namespace, mutants: Sequence[Mutant]) -> None:
        self.options, self.mutants = options, mutants
        self.ended = False  # interrupted: what still comes in says nothing
        self.places: dict[str, Place] = {}
        self.gone: dict[str, str] = {}
        for mutant in SAMPLE:  # all are marked, whichever are asked for this time
            try:
                self.places[mutant.name] = find(ROOT, mutant)
            except NotApplicable as error:
                self.gone[mutant.name] = str(error)
        tests: Path | None = options.tests.resolve() if options.tests else None
        self.tests, self.files = tests, digests(tests or ROOT / "tests")
        said = _short(repr([(m.function, m.old) for m in SAMPLE]))
        sources = digests(ROOT / "ros2_ws/src") | digests(ROOT / "bags") | digests(ROOT / "examples")
        self.key = f"{_short(repr(sorted(sources.items())))}-{said}-{_short(repr(sorted(self.files.items())))}"
        self.kept = options.scratch / f"map-{self.key}"
        self.record, self.results = self.kept / "record.jsonl", self.kept / "results.jsonl"
        if not self.kept.exists():
            before = sorted(options.scratch.glob("map-*/files.json"), key=lambda path: path.stat().st_mtime)
            self.kept.mkdir(parents=True)
            if options.keep and before:
                self._take_over(before[-1].parent)
            (self.kept / "files.json").write_text(json.dumps(self.files))

    def _take_over(self, before: Path) -> None:
        """What another map says of test files that have not changed since, and of mutants that these have killed."""
        files = json.loads((before / "files.json").read_text())
        same = {f"tests/{name}" for name, own in self.files.items() if files.get(name) == own}
        print(f"{before.name}: {len(same)} of {len(self.files)} files of tests are as they were")

        def stands(line: dict[str, Any]) -> bool:
            test = line.get("done") or line.get("file") or line.get("test") or line.get("by") or ""
            return test.split("::")[0] in same

        for name in ("record.jsonl", "results.jsonl"):
            lines = [line for line in lines_of(before / name) if stands(line)]
            (self.kept / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
        (self.kept / "sample.json").write_text((before / "sample.json").read_text())

    def copy(self, name: str) -> Copy:
        """A copy of the checkout as it is now, for one worker."""
        copy = Copy(self.options.scratch / f"copy-{self.key}" / name, ROOT, self.tests)
        for place in self.places.values():  # one that was interrupted may have been left with a fault in it
            if (path := copy.root / place.path.relative_to(ROOT)).read_text(encoding="utf-8") != place.text:
                copy.write(path, place.text)
        return copy

    # which tests

    def map(self) -> Map:
        """The map, after as much of the marked run as is still to do."""
        finished = self.kept / "finished"
        if not finished.exists() and not self.options.so_far:
            print(f"marked run of the tests, into {self.kept}", flush=True)
            self._run_marked()
            if not self.options.paths:
                finished.touch()
        return Map.read(lines_of(self.record))

    def _run_marked(self) -> None:
        copy = self.copy("marked")
        by_file: dict[Path, dict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
        texts = {place.path: place.text for place in self.places.values()}
        for name, place in self.places.items():
            by_file[place.path][place.line].append(name)
        if not (self.kept / "sample.json").exists():
            (self.kept / "sample.json").write_text(json.dumps(sorted(self.places)))
        for path, marks in by_file.items():
            copy.write(copy.root / path.relative_to(ROOT), marked(texts[path], marks))
        try:
            parallel = ["-n", str(self.options.jobs), "--dist", "loadfile", "--no-loadscope-reorder"]
            for folder in self.options.paths or _folders(copy.root / "tests"):
                begun = time.monotonic()
                self._marked_part(copy, [*parallel, folder])
                lines = [line for line in lines_of(self.record) if line.get("done", "").startswith(folder)]
                failed = [line["done"] for line in lines if line["outcome"] == "failed"]
                print(f"  {folder}: {len(lines)} tests in {time.monotonic() - begun:.0f} s", flush=True)
                if failed:  # once more, one after the other: what fails by itself says nothing of a mutant
                    self._forget(failed)
                    self._marked_part(copy, ["-n0", folder])
        finally:
            for path in by_file:
                copy.write(copy.root / path.relative_to(ROOT), texts[path])

    def _marked_part(self, copy: Copy, arguments: list[str]) -> None:
        done = self.kept / "done.json"
        done.write_text(json.dumps([line["done"] for line in lines_of(self.record) if "done" in line]))
        copy.pytest(arguments, {RECORD: str(self.record), SKIP: str(done)}, 4 * 3600.0, self.options.prefix)

    def _forget(self, failed: list[str]) -> None:
        lines = [line for line in lines_of(self.record) if line.get("done") not in failed]
        self.record.write_text("".join(json.dumps(line) + "\n" for line in lines))

    # what they find

    def judge_all(self, tests: Map) -> dict[str, dict[str, Any]]:
        """Outcome of every mutant by name, what is known already included."""
        marked_ones = set(json.loads((self.kept / "sample.json").read_text()))
        known = {line["name"]: line for line in lines_of(self.results)}
        found: dict[str, dict[str, Any]] = {}
        left: list[Mutant] = []
        for mutant in self.mutants:
            line = known.get(mutant.name, {"new": None})
            whole = line.get("outcome") == KILLED or line.get("of") == len(
                tests.order(mutant)
            )  # else the map has grown
            if mutant.name in self.gone:
                found[mutant.name] = {"outcome": GONE, "by": self.gone[mutant.name]}
            elif mutant.name not in marked_ones:
                found[mutant.name] = {"outcome": GONE, "by": "not in the map that is kept"}
            elif line["new"] == mutant.new and whole and not self.options.again:
                found[mutant.name] = line
            else:
                left.append(mutant)
        if left:
            print(f"{len(left)} mutants, on {self.options.jobs} copies", flush=True)
            everyone = [self.copy(str(number)) for number in range(self.options.jobs)]
            copies: queue.SimpleQueue[Copy] = queue.SimpleQueue()
            for copy in everyone:
                copies.put(copy)
            lock = threading.Lock()

            def work(mutant: Mutant) -> None:
                copy, begun = copies.get(), time.monotonic()
                try:
                    line = self._judge(mutant, tests, copy)
                finally:
                    copies.put(copy)
                line |= {"name": mutant.name, "new": mutant.new, "took": round(time.monotonic() - begun, 1)}
                with lock, self.results.open("a") as stream:
                    if self.ended:
                        return
                    stream.write(json.dumps(line) + "\n")
                    found[mutant.name] = line
                    print(f"  {line['outcome']:8} {line['took']:5.0f} s  {mutant.name}  {line['by']}", flush=True)

            with ThreadPoolExecutor(self.options.jobs) as pool:
                try:
                    for done in [pool.submit(work, mutant) for mutant in left]:
                        done.result()
                except BaseException:
                    self.ended = True
                    pool.shutdown(wait=False, cancel_futures=True)
                    for copy in everyone:
                        copy.end()
                    raise
        return found

    def _judge(self, mutant: Mutant, tests: Map, copy: Copy) -> dict[str, Any]:
        order = tests.order(mutant)
        if not order:
            return {"outcome": UNSEEN, "by": "", "of": 0}
        place = self.places[mutant.name]
        path = copy.root / place.path.relative_to(ROOT)
        copy.write(path, place.mutated(mutant.new))
        try:
            return self._shown(order, copy)
        finally:
            copy.write(path, place.text)

    def _shown(self, order: list[Test], copy: Copy) -> dict[str, Any]:
        spent, size, ran = 0.0, _FIRST, 0
        waiting = list(order)
        while waiting and spent < self.options.most and not self.ended:
            part: list[Test] = []
            while waiting and (not part or sum(t.seconds for t in part) < size):
                part.append(waiting.pop(0))
            failed = self._first_failure(part, copy)
            if failed is not None and failed.waits and self._first_failure([failed], copy) is None:
                # it failed by chance: on with those behind it
                waiting = [*part[part.index(failed) + 1 :], *waiting]
                failed = None
            if failed is not None:
                return {"outcome": KILLED, "by": failed.name}
            ran += len(part)
            spent += sum(t.seconds for t in part)
            size *= _MORE
        return {"outcome": SURVIVED, "by": f"{ran} of {len(order)} tests", "of": len(order)}

    def _first_failure(self, part: list[Test], copy: Copy) -> Test | None:
        record, names = copy.root.parent / "record.jsonl", copy.root.parent / "tests.json"
        record.unlink(missing_ok=True)
        names.write_text(json.dumps([t.name for t in part]))
        each = max(_MIN_LIMIT, _PATIENCE * max(t.seconds for t in part))
        arguments = ["-n0", "-x", f"--timeout={each:.0f}", *dict.fromkeys(t.file for t in part)]
        seconds = _MIN_LIMIT + _PATIENCE * sum(t.seconds for t in part) + each
        code = copy.pytest(arguments, {RECORD: str(record), TESTS: str(names)}, seconds, self.options.prefix)
        done = {line["done"]: line["outcome"] for line in lines_of(record) if "done" in line}
        for test in part:
            if done.get(test.name) == "failed":
                return test
        if code == 0:
            return None
        # killed before it could say so: by time, by a crash, or because a file could not be imported
        return next((t for t in part if t.name not in done), part[0])


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _folders(tests: Path) -> list[str]:
    """Parts of the suite that are run one after the other, so that an interrupted run loses little."""
    inside = sorted(p for p in tests.iterdir() if not p.name.startswith(("_", ".")))
    return [f"tests/{p.name}" for p in inside if p.is_dir() or p.name.startswith("test_")]


def table(mutants: Sequence[Mutant], found: dict[str, dict[str, Any]]) -> str:
    """Outcomes by area, and by name those that no test minds."""
    lines = ["| area | mutants | killed | survived |", "| --- | --: | --: | --: |"]
    areas = list(dict.fromkeys(m.area for m in mutants))
    for area in [*areas, None]:
        own = [found[m.name]["outcome"] for m in mutants if m.name in found and area in (None, m.area)]
        own = [outcome for outcome in own if outcome != GONE]
        killed = own.count(KILLED)
        lines.append(f"| {area or '**all**'} | {len(own)} | {killed} | {len(own) - killed} |")
    for outcome in (SURVIVED, UNSEEN, GONE):
        named = [m.name for m in mutants if m.name in found and found[m.name]["outcome"] == outcome]
        if named:
            lines += ["", f"{outcome}:", *(f"* {name}" for name in named)]
    return "\n".join(lines)


def main() -> None:
    """Entry point."""
    parse = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parse.add_argument("paths", nargs="*", help="parts of the tests that the marked run is about; all by default")
    parse.add_argument("--only", action="append", default=[], help="mutants by name or area, with * and ?")
    parse.add_argument("--every", type=int, default=1, help="each N-th of them: 3 leaves 71 of all areas")
    parse.add_argument("--list", action="store_true", help="name the mutants, and those that do not apply any more")
    parse.add_argument("--tests", type=Path, help="another folder of tests, such as an older one")
    parse.add_argument("--jobs", type=int, default=2, help="copies that work side by side")
    parse.add_argument("--scratch", type=Path, default=Path(tempfile.gettempdir()) / "modcal_mutants")
    parse.add_argument(
        "--keep", action="store_true", help="take over from the last map what test files say that have not changed"
    )
    parse.add_argument("--so-far", action="store_true", help="no marked run: judge by what has been marked already")
    parse.add_argument("--again", action="store_true", help="also those whose outcome is known")
    parse.add_argument("--most", type=float, default=400.0, help="seconds of tests that one mutant is shown to")
    parse.add_argument("--prefix", type=shlex.split, default=[], help="words before each command, such as 'nice -n 10'")
    options = parse.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):  # also in the background: what was started is ended, files put back
        signal.signal(number, signal.default_int_handler)
    mutants = [
        m for m in SAMPLE[:: options.every] if not options.only or any(_meant(m, pattern) for pattern in options.only)
    ]
    if options.list:
        for mutant in mutants:
            try:
                place = find(ROOT, mutant)
                print(f"{mutant.area:12} {mutant.name}  ({place.path.name})")
            except NotApplicable as error:
                print(f"{mutant.area:12} NOT APPLICABLE {error}")
        return
    functions.cache_clear()
    bench = Bench(options, mutants)
    print(table(mutants, bench.judge_all(bench.map())))


def _meant(mutant: Mutant, pattern: str) -> bool:
    return pattern in mutant.name or fnmatch(mutant.name, pattern) or pattern == mutant.area


if __name__ == "__main__":
    sys.exit(main())
