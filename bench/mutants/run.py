"""Do the tests bite? A fixed sample of faults, each put into a copy of the sources and shown to tests that reach it.

    make mutants                                # the whole sample
    make mutants ARGS="--only so3.log"          # by parts of 'area: name'; --list names them; --every 3: each third
    make mutants ARGS="--keep"                  # after a change of tests: only what has changed is run again
    make mutants ARGS="--tests FOLDER"          # another folder of tests, such as an older one

Which tests reach a mutant is found by one run of all tests over sources with marks in them, each file in a process of
its own, so that what is cached in one is computed in the next. It takes half as long again as the suite and is kept for
the next time. Both runs may be interrupted, and go on where they were. --most: seconds of tests for one mutant.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import signal
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
from copies import Copies, Copy, digests
from fragments import Mutant, NotApplicable, Place, find, marked, sample
from harness import ROOT
from probe import FILE, RECORD, TESTS

FIRST, MORE = 15.0, 4.0  # s of tests in the first round, and how many times as many in the next
MIN_LIMIT, PATIENCE = 60.0, 8.0  # s that any test may take, and how many times as long as it usually does
LONGEST = 3600.0  # s of a file of tests
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
    """Tests that pass without any fault, and which of them come by each mutant; from a record.

    What a fixture or a cached helper does is noted of the first test that asks for it; all others of its file are shown
    the mutant as well, after those that were seen to reach it.
    """

    def __init__(self, lines: list[Line]) -> None:
        passed = [line for line in lines if line.get("outcome") == "passed"]
        self.tests = {line["done"]: Test(line["done"], line["file"], line["seconds"], line["waits"]) for line in passed}
        self.reach: dict[str, set[str]] = defaultdict(set)
        for line in (line for line in lines if "mutant" in line):
            self.reach[line["mutant"]] |= {line["test"], line["file"]}

    def order(self, mutant: Mutant) -> list[Test]:
        """The tests for a mutant: cheap files first, and last what else stands in the files that it reaches."""
        reach, cost = self.reach[mutant.name], defaultdict[str, float](float)
        some = [test for test in self.tests.values() if test.file in reach]
        for test in some:
            cost[test.file] += test.seconds * (test.name in reach)
        return sorted(some, key=lambda t: (t.name not in reach, cost[t.file], t.file, t.seconds))


class Bench:
    """The sample over one checkout and one folder of tests."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.most, self.places, self.gone = options.most, dict[str, Place](), dict[str, str]()
        for mutant in sample():  # all are marked, whichever are asked for this time
            try:
                self.places[mutant.name] = find(ROOT, mutant)
            except NotApplicable as error:
                self.gone[mutant.name] = str(error)
        tests = options.tests.resolve() if options.tests else None
        self.files = digests(tests or ROOT / "tests")
        sources = [sorted(digests(ROOT / name).items()) for name in ("ros2_ws/src", "bags", "examples")]
        words = [(m.function, m.old) for m in sample()]
        hashes = (
            hashlib.sha256(repr(w).encode()).hexdigest()[:8] for w in (sources, words, sorted(self.files.items()))
        )
        key = "-".join(hashes)
        self.copies = Copies(options.scratch / f"copy-{key}", tests, options.jobs, self.put_back)
        kept = options.scratch / f"map-{key}"
        self.record, self.results, self.marked = (kept / f"{n}.jsonl" for n in ("record", "results", "sample"))
        if not kept.exists():
            before = sorted(options.scratch.glob("map-*/files.json"), key=lambda path: path.stat().st_mtime)
            kept.mkdir(parents=True)
            if options.keep and before:
                self.take_over(before[-1].parent)
            (kept / "files.json").write_text(json.dumps(self.files))

    def take_over(self, before: Path) -> None:
        """What another map says of test files that have not changed since, and of mutants that these have killed."""
        files = json.loads((before / "files.json").read_text())
        same = {f"tests/{name}" for name, own in self.files.items() if files.get(name) == own}
        print(f"{before.name}: {len(same)} of {len(self.files)} files of tests are as they were")
        for path, key in ((self.record, "file"), (self.results, "by")):
            lines = [line for line in read(before / path.name) if line[key].split("::")[0] in same]
            path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        self.marked.write_text((before / self.marked.name).read_text())

    def put_back(self, copy: Copy) -> None:
        """Take marks and faults out of a copy: one that was interrupted may have been left with them."""
        for place in self.places.values():
            if (path := copy.root / place.path.relative_to(ROOT)).read_text(encoding="utf-8") != place.text:
                copy.write(path, place.text)

    def map(self) -> Map:
        """The map, after as much of the marked run as is still to do."""
        ran = {line["file"] for line in read(self.record) if "ran" in line}
        names = [f"tests/{name}" for name in self.files if Path(name).name.startswith("test_") and name.endswith(".py")]
        if left := [name for name in names if name not in ran]:
            print(f"marked run of {len(left)} files of tests, into {self.record.parent}", flush=True)
            if not self.marked.exists():
                self.marked.write_text(json.dumps(sorted(self.places)))
            marks: dict[Path, dict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
            for name, place in self.places.items():
                marks[place.path][place.line].append(name)
            texts = {place.path: place.text for place in self.places.values()}
            for copy in self.copies.all():
                for path, lines in marks.items():
                    copy.write(copy.root / path.relative_to(ROOT), marked(texts[path], lines))
            self.copies.share(self.run_marked, left)
        return Map(read(self.record))

    def run_marked(self, copy: Copy, file: str) -> None:
        settings, begun = {RECORD: str(self.record), FILE: file}, time.monotonic()
        copy.pytest(["-n0", file], settings, LONGEST)
        lines = [line for line in read(self.record) if line["file"] == file and "done" in line]
        failed = [line["done"] for line in lines if line["outcome"] == "failed"]
        if failed and not self.copies.ended:  # once more: what fails by itself says nothing of a mutant
            copy.pytest(["-n0", file], {**settings, TESTS: copy.names(failed)}, LONGEST)
        if not self.copies.ended:
            with self.record.open("a") as stream:
                stream.write(json.dumps({"ran": True, "file": file}) + "\n")
            print(f"  {file}: {len(lines)} tests in {time.monotonic() - begun:.0f} s", flush=True)

    def judge_all(self, mutants: Sequence[Mutant], tests: Map) -> dict[str, Line]:
        """Outcome of every mutant by name, what is known already included."""
        in_map = set(json.loads(self.marked.read_text()))
        known = {line["name"]: line for line in read(self.results)}
        found, left, lock = dict[str, Line](), list[Mutant](), threading.Lock()
        for mutant in mutants:
            line = known.get(mutant.name, {"new": None})
            if mutant.name in self.gone or mutant.name not in in_map:
                found[mutant.name] = {"outcome": GONE, "by": self.gone.get(mutant.name, "not in the map that is kept")}
            elif line["new"] == mutant.new and (  # else the map has grown
                line.get("outcome") == KILLED or line.get("of") == len(tests.order(mutant))
            ):
                found[mutant.name] = line
            else:
                left.append(mutant)

        def judge(copy: Copy, mutant: Mutant) -> None:
            begun, place = time.monotonic(), self.places[mutant.name]
            path = copy.root / place.path.relative_to(ROOT)
            copy.write(path, place.mutated(mutant.new))
            try:
                line = self.shown(tests.order(mutant), copy)
            finally:
                copy.write(path, place.text)
            line |= {"name": mutant.name, "new": mutant.new, "took": round(time.monotonic() - begun, 1)}
            with lock, self.results.open("a") as stream:
                if not self.copies.ended:
                    stream.write(json.dumps(line) + "\n")
                    found[mutant.name] = line
                    print(f"  {line['outcome']:8} {line['took']:5.0f} s  {mutant.name}  {line['by']}", flush=True)

        if left:
            print(f"{len(left)} mutants", flush=True)
            self.copies.share(judge, left)
        return found

    def shown(self, order: list[Test], copy: Copy) -> Line:
        """What becomes of the fault in a copy, by tests in this order."""
        spent, size, ran, waiting = 0.0, FIRST, 0, list(order)
        while waiting and spent < self.most and not self.copies.ended:
            part: list[Test] = []
            while waiting and (not part or sum(t.seconds for t in part) < size):
                part.append(waiting.pop(0))
            failed = first_failure(part, copy)
            if failed is not None and failed.waits and first_failure([failed], copy) is None:
                # it failed by chance: on with those behind it
                waiting = [*part[part.index(failed) + 1 :], *waiting]
                failed = None
            if failed is not None:
                return {"outcome": KILLED, "by": failed.name}
            ran, spent, size = ran + len(part), spent + sum(t.seconds for t in part), size * MORE
        return {"outcome": SURVIVED if order else UNSEEN, "by": f"{ran} of {len(order)} tests", "of": len(order)}


def first_failure(part: list[Test], copy: Copy) -> Test | None:
    """The first of these tests that fails; None where all pass."""
    record = copy.root.parent / "record.jsonl"
    record.unlink(missing_ok=True)
    each = max(MIN_LIMIT, PATIENCE * max(t.seconds for t in part))
    arguments = ["-n0", "-x", f"--timeout={each:.0f}", *dict.fromkeys(t.file for t in part)]
    settings = {RECORD: str(record), TESTS: copy.names([t.name for t in part])}
    code = copy.pytest(arguments, settings, MIN_LIMIT + PATIENCE * sum(t.seconds for t in part) + each)
    done = {line["done"]: line["outcome"] for line in read(record) if "done" in line}
    failed = next((t for t in part if done.get(t.name) == "failed"), None)
    if failed is not None or code == 0:
        return failed
    # killed before it could say so: by time, by a crash, or because a file could not be imported
    return next((t for t in part if t.name not in done), part[0])


def main() -> None:
    by_name = {f"{m.area}: {m.name}": m for m in sample()}
    options = harness.options(
        __doc__, seeds=0, names=by_name, every=1, list=False, tests=Path, keep=False, most=400.0,
        scratch=Path(tempfile.gettempdir()) / "modcal_mutants",
    )  # fmt: skip
    for number in (signal.SIGINT, signal.SIGTERM):  # also in the background: what was started is ended, files put back
        signal.signal(number, signal.default_int_handler)
    mutants = [by_name[name] for name in list(by_name)[:: options.every] if name in options.names]
    if options.list:
        for mutant in mutants:
            try:
                print(f"{mutant.area:12} {mutant.name}  ({find(ROOT, mutant).path.name})")
            except NotApplicable as error:
                print(f"{mutant.area:12} NOT APPLICABLE {error}")
        return
    bench = Bench(options)
    found = bench.judge_all(mutants, bench.map())
    rows = [{"area": m.area, "name": m.name, **found[m.name]} for m in mutants if m.name in found]
    harness.counts("", rows, "area", "outcome", (KILLED, SURVIVED, UNSEEN, GONE))
    harness.say(*(f"* {row['name']}: {row['outcome']}, {row['by']}" for row in rows if row["outcome"] != KILLED))


if __name__ == "__main__":
    sys.exit(main())
