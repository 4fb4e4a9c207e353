"""Do the tests bite? A fixed sample of faults, each put into a copy of the sources and shown to tests that reach it.

    make mutants                                # the whole sample
    make mutants ARGS="--only so3.log"          # mutants by name or area; --list names them
    make mutants ARGS="--keep"                  # after a change of tests: only what has changed is run again

Which tests reach a mutant is found by one run of all tests over sources with marks in them, each file in a process of
its own, so that what is cached in one is computed in the next. It takes half as long again as the suite and is kept for
the next time. Both runs may be interrupted, and go on where they were.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import queue
import signal
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from copies import Copy, digests
from fragments import Mutant, NotApplicable, Place, find, marked, sample
from probe import FILE, RECORD, TESTS

ROOT = Path(__file__).resolve().parents[2]
_FIRST, _MORE = 15.0, 4.0  # s of tests in the first round, and how many times as many in the next
_MIN_LIMIT, _PATIENCE = 60.0, 8.0  # s that any test may take, and how many times as long as it usually does
KILLED, SURVIVED, GONE, UNSEEN = "killed", "survived", "not applicable", "reached by no test"
Line = dict[str, Any]


def read(path: Path) -> list[Line]:
    """What a record says, line by line; nothing where there is none."""
    out = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            out.append(json.loads(line))
        except json.JSONDecodeError:  # the last one, where a run was interrupted
            continue
    return out


@dataclass
class Test:
    """A test of the marked run. waits: whether it starts nodes, which a busy machine may keep waiting."""

    name: str
    file: str
    seconds: float
    waits: bool


class Map:
    """Tests that pass without any fault, by name, and which of them come by each mutant; from a record.

    What a fixture or a cached helper does is noted of the first test that asks for it; all others of its file are shown
    the mutant as well, after those that were seen to reach it.
    """

    def __init__(self, lines: list[Line]) -> None:
        passed = [line for line in lines if line.get("outcome") == "passed"]
        self.tests = {line["done"]: Test(line["done"], line["file"], line["seconds"], line["waits"]) for line in passed}
        self.reach: dict[str, set[str]] = defaultdict(set)
        self.files: dict[str, set[str]] = defaultdict(set)
        for line in lines:
            if "mutant" in line:
                self.reach[line["mutant"]].add(line["test"])
                self.files[line["mutant"]].add(line["file"])

    def order(self, mutant: Mutant) -> list[Test]:
        """The tests for a mutant: cheap files first, and last what else stands in the files that it reaches."""
        some = [test for test in self.tests.values() if test.file in self.files[mutant.name]]
        reach, cost = self.reach[mutant.name], defaultdict[str, float](float)
        for test in some:
            cost[test.file] += test.seconds * (test.name in reach)
        return sorted(some, key=lambda t: (t.name not in reach, cost[t.file], t.file, t.seconds))


class Bench:
    """The sample over one checkout and one folder of tests."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.ended = False  # interrupted: what still comes in says nothing
        self.everyone: list[Copy] = []
        self.places: dict[str, Place] = {}
        self.gone: dict[str, str] = {}
        for mutant in sample():  # all are marked, whichever are asked for this time
            try:
                self.places[mutant.name] = find(ROOT, mutant)
            except NotApplicable as error:
                self.gone[mutant.name] = str(error)
        self.tests = options.tests.resolve() if options.tests else None
        self.files = digests(self.tests or ROOT / "tests")
        sources = [sorted(digests(ROOT / name).items()) for name in ("ros2_ws/src", "bags", "examples")]
        words = [(m.function, m.old) for m in sample()]
        self.key = "-".join(_short(repr(what)) for what in (sources, words, sorted(self.files.items())))
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
        for name, key in (("record.jsonl", "file"), ("results.jsonl", "by")):
            lines = [line for line in read(before / name) if line[key].split("::")[0] in same]
            (self.kept / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
        (self.kept / "sample.json").write_text((before / "sample.json").read_text())

    def copies(self) -> queue.SimpleQueue[Copy]:
        """Copies of the checkout as it is now, one for each worker."""
        out: queue.SimpleQueue[Copy] = queue.SimpleQueue()
        for number in range(self.options.jobs):
            copy = Copy(self.options.scratch / f"copy-{self.key}" / str(number), ROOT, self.tests)
            self._put_back(copy)  # one that was interrupted may have been left with a fault in it
            self.everyone.append(copy)
            out.put(copy)
        return out

    def _put_back(self, copy: Copy) -> None:
        for place in self.places.values():
            if (path := copy.root / place.path.relative_to(ROOT)).read_text(encoding="utf-8") != place.text:
                copy.write(path, place.text)

    def _side_by_side(self, work: Callable[[Any], None], left: Sequence[Any]) -> None:
        with ThreadPoolExecutor(self.options.jobs) as pool:
            try:
                for done in [pool.submit(work, each) for each in left]:
                    done.result()
            except BaseException:
                self.ended = True
                pool.shutdown(wait=False, cancel_futures=True)
                for copy in self.everyone:
                    copy.end()
                raise

    def map(self) -> Map:
        """The map, after as much of the marked run as is still to do."""
        ran = {line["file"] for line in read(self.record) if "ran" in line}
        names = [f"tests/{name}" for name in self.files if Path(name).name.startswith("test_") and name.endswith(".py")]
        left = [name for name in names if name not in ran]
        if left:
            print(f"marked run of {len(left)} files of tests, into {self.kept}", flush=True)
            self._run_marked(left)
        return Map(read(self.record))

    def _run_marked(self, left: list[str]) -> None:
        copies = self.copies()
        by_file: dict[Path, dict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
        texts = {place.path: place.text for place in self.places.values()}
        for name, place in self.places.items():
            by_file[place.path][place.line].append(name)
        if not (self.kept / "sample.json").exists():
            (self.kept / "sample.json").write_text(json.dumps(sorted(self.places)))
        for copy in self.everyone:
            for path, marks in by_file.items():
                copy.write(copy.root / path.relative_to(ROOT), marked(texts[path], marks))

        def work(file: str) -> None:
            copy, begun = copies.get(), time.monotonic()
            try:
                settings = {RECORD: str(self.record), FILE: file}
                copy.pytest(["-n0", file], settings, 3600.0)
                lines = [line for line in read(self.record) if line["file"] == file and "done" in line]
                failed = [line["done"] for line in lines if line["outcome"] == "failed"]
                if failed and not self.ended:  # once more: what fails by itself says nothing of a mutant
                    names = copy.root.parent / "tests.json"
                    names.write_text(json.dumps(failed))
                    copy.pytest(["-n0", file], {**settings, TESTS: str(names)}, 3600.0)
            finally:
                copies.put(copy)
            if not self.ended:
                with self.record.open("a") as stream:
                    stream.write(json.dumps({"ran": True, "file": file}) + "\n")
                print(f"  {file}: {len(lines)} tests in {time.monotonic() - begun:.0f} s", flush=True)

        try:
            self._side_by_side(work, left)
        finally:
            for copy in self.everyone:
                self._put_back(copy)

    def judge_all(self, mutants: Sequence[Mutant], tests: Map) -> dict[str, Line]:
        """Outcome of every mutant by name, what is known already included."""
        marked_ones = set(json.loads((self.kept / "sample.json").read_text()))
        known = {line["name"]: line for line in read(self.results)}
        found: dict[str, Line] = {}
        left: list[Mutant] = []
        for mutant in mutants:
            line = known.get(mutant.name, {"new": None})
            if mutant.name in self.gone or mutant.name not in marked_ones:
                found[mutant.name] = {"outcome": GONE, "by": self.gone.get(mutant.name, "not in the map that is kept")}
            elif line["new"] == mutant.new and (  # else the map has grown
                line.get("outcome") == KILLED or line.get("of") == len(tests.order(mutant))
            ):
                found[mutant.name] = line
            else:
                left.append(mutant)
        if not left:
            return found
        print(f"{len(left)} mutants, on {self.options.jobs} copies", flush=True)
        copies = self.copies()
        lock = threading.Lock()

        def work(mutant: Mutant) -> None:
            copy, begun = copies.get(), time.monotonic()
            try:
                line = self._judge(mutant, tests, copy)
            finally:
                copies.put(copy)
            line |= {"name": mutant.name, "new": mutant.new, "took": round(time.monotonic() - begun, 1)}
            with lock, self.results.open("a") as stream:
                if not self.ended:
                    stream.write(json.dumps(line) + "\n")
                    found[mutant.name] = line
                    print(f"  {line['outcome']:8} {line['took']:5.0f} s  {mutant.name}  {line['by']}", flush=True)

        self._side_by_side(work, left)
        return found

    def _judge(self, mutant: Mutant, tests: Map, copy: Copy) -> Line:
        if not (order := tests.order(mutant)):
            return {"outcome": UNSEEN, "by": "", "of": 0}
        place = self.places[mutant.name]
        path = copy.root / place.path.relative_to(ROOT)
        copy.write(path, place.mutated(mutant.new))
        try:
            return self._shown(order, copy)
        finally:
            copy.write(path, place.text)

    def _shown(self, order: list[Test], copy: Copy) -> Line:
        spent, size, ran, waiting = 0.0, _FIRST, 0, list(order)
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
            ran, spent, size = ran + len(part), spent + sum(t.seconds for t in part), size * _MORE
        return {"outcome": SURVIVED, "by": f"{ran} of {len(order)} tests", "of": len(order)}

    def _first_failure(self, part: list[Test], copy: Copy) -> Test | None:
        record, names = copy.root.parent / "record.jsonl", copy.root.parent / "tests.json"
        record.unlink(missing_ok=True)
        names.write_text(json.dumps([t.name for t in part]))
        each = max(_MIN_LIMIT, _PATIENCE * max(t.seconds for t in part))
        arguments = ["-n0", "-x", f"--timeout={each:.0f}", *dict.fromkeys(t.file for t in part)]
        seconds = _MIN_LIMIT + _PATIENCE * sum(t.seconds for t in part) + each
        code = copy.pytest(arguments, {RECORD: str(record), TESTS: str(names)}, seconds)
        done = {line["done"]: line["outcome"] for line in read(record) if "done" in line}
        failed = next((t for t in part if done.get(t.name) == "failed"), None)
        if failed is not None or code == 0:
            return failed
        # killed before it could say so: by time, by a crash, or because a file could not be imported
        return next((t for t in part if t.name not in done), part[0])


def _short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def table(mutants: Sequence[Mutant], found: dict[str, Line]) -> str:
    """Outcomes by area, and by name those that no test minds."""
    lines = ["| area | mutants | killed | survived |", "| --- | --: | --: | --: |"]
    outcomes = [(m, found[m.name]["outcome"]) for m in mutants if m.name in found]
    for area in [*dict.fromkeys(m.area for m in mutants), None]:
        own = [outcome for m, outcome in outcomes if area in (None, m.area) and outcome != GONE]
        killed = own.count(KILLED)
        lines.append(f"| {area or '**all**'} | {len(own)} | {killed} | {len(own) - killed} |")
    for what in (SURVIVED, UNSEEN, GONE):
        if named := [m.name for m, outcome in outcomes if outcome == what]:
            lines += ["", f"{what}:", *(f"* {name}" for name in named)]
    return "\n".join(lines)


def main() -> None:
    """Entry point."""
    parse = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parse.add_argument("--only", action="append", default=[], help="mutants by name or area, with * and ?")
    parse.add_argument("--every", type=int, default=1, help="each N-th of them: 3 leaves 71 of all areas")
    parse.add_argument("--list", action="store_true", help="name the mutants, and those that do not apply any more")
    parse.add_argument("--tests", type=Path, help="another folder of tests, such as an older one")
    parse.add_argument("--jobs", type=int, default=2, help="copies that work side by side")
    parse.add_argument("--scratch", type=Path, default=Path(tempfile.gettempdir()) / "modcal_mutants")
    parse.add_argument("--keep", action="store_true", help="take over what the last map says of unchanged test files")
    parse.add_argument("--most", type=float, default=400.0, help="seconds of tests that one mutant is shown to")
    options = parse.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):  # also in the background: what was started is ended, files put back
        signal.signal(number, signal.default_int_handler)
    meant = lambda m, words: words in m.name or fnmatch(m.name, words) or words == m.area  # noqa: E731
    every = sample()[:: options.every]
    mutants = [m for m in every if not options.only or any(meant(m, words) for words in options.only)]
    if not options.list:
        bench = Bench(options)
        print(table(mutants, bench.judge_all(mutants, bench.map())))
        return
    for mutant in mutants:
        try:
            print(f"{mutant.area:12} {mutant.name}  ({find(ROOT, mutant).path.name})")
        except NotApplicable as error:
            print(f"{mutant.area:12} NOT APPLICABLE {error}")


if __name__ == "__main__":
    sys.exit(main())
