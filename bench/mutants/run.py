"""Do the tests bite? A fixed sample of faults, each put into a copy of the sources and shown to tests that reach it.

    make mutants                                # the whole sample
    make mutants ARGS="--only so3.log"          # mutants by name or area; --list names them
    make mutants ARGS="--keep"                  # after a change of tests: only what has changed is run again

Which tests reach a mutant is found by one run of all tests over sources with marks in them, which takes as long as the
suite and is kept for the next time. Both runs may be interrupted, and go on where they were.
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
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from copies import Copy, digests
from fragments import Mutant, NotApplicable, Place, find, marked, sample
from probe import RECORD, SKIP, TESTS

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


def write(path: Path, lines: list[Line]) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


@dataclass
class Test:
    """A test of the marked run. waits: whether it starts nodes, which a busy machine may keep waiting."""

    name: str
    seconds: float
    waits: bool
    fixtures: frozenset[str]

    @property
    def file(self) -> str:
        """The file it stands in."""
        return self.name.split("::")[0]


class Map:
    """Tests that pass without any fault, by name, and which of them come by each mutant; from a record."""

    def __init__(self, lines: list[Line]) -> None:
        self.reach: dict[str, set[str]] = defaultdict(set)
        self.tests: dict[str, Test] = {}
        for line in lines:
            if line.get("outcome") == "passed":
                name = line["done"]
                self.tests[name] = Test(name, line["seconds"], line["waits"], frozenset(line["fixtures"]))
        users: dict[str, set[str]] = defaultdict(set)  # those that call a cached helper
        for line in 2 * [line for line in lines if "uses" in line]:  # a helper may call another
            users[line["uses"]] |= self._behind(line, users)
        seen: dict[tuple[str | None, ...], set[str]] = {}
        for line in lines:
            if "mutant" in line:
                key = line["test"], line["shared"], line["file"]
                seen[key] = seen.get(key) or self._behind(line, users)
                self.reach[line["mutant"]] |= seen[key]

    def _behind(self, line: Line, users: dict[str, set[str]]) -> set[str]:
        """The tests that depend on what was going on."""
        name = (line["test"] or "").rpartition(" (")[0]
        file = line["file"] or name.split("::")[0]
        kind, _, what = (line["shared"] or "").partition(" ")
        found = {name} & self.tests.keys()
        if kind == "helper":
            return found | users[what]
        if kind:
            anywhere = kind in ("session", "package")
            return found | {t.name for t in self.tests.values() if what in t.fixtures and (anywhere or t.file == file)}
        return found | {t.name for t in self.tests.values() if line["file"] and t.file == file}

    def order(self, mutant: Mutant) -> list[Test]:
        """The tests for a mutant: cheap files first, and last what else stands in the files that it reaches."""
        reached = [self.tests[name] for name in self.reach.get(mutant.name, ()) if name in self.tests]
        files: dict[str, float] = defaultdict(float)
        for test in reached:
            files[test.file] += test.seconds
        others = [t for t in self.tests.values() if t.file in files and t not in reached]
        return [t for part in (reached, others) for t in sorted(part, key=lambda t: (files[t.file], t.file, t.seconds))]


class Bench:
    """The sample over one checkout and one folder of tests."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.ended = False  # interrupted: what still comes in says nothing
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
        for name in ("record.jsonl", "results.jsonl"):
            lines = [
                (line, *(line[k] for k in ("done", "file", "test", "by") if line.get(k)))
                for line in read(before / name)
            ]
            write(self.kept / name, [line for line, *test in lines if test and test[0].split("::")[0] in same])
        (self.kept / "sample.json").write_text((before / "sample.json").read_text())

    def copy(self, name: str) -> Copy:
        """A copy of the checkout as it is now, for one worker."""
        copy = Copy(self.options.scratch / f"copy-{self.key}" / name, ROOT, self.tests)
        for place in self.places.values():  # one that was interrupted may have been left with a fault in it
            if (path := copy.root / place.path.relative_to(ROOT)).read_text(encoding="utf-8") != place.text:
                copy.write(path, place.text)
        return copy

    def map(self) -> Map:
        """The map, after as much of the marked run as is still to do."""
        if not (self.kept / "finished").exists():
            print(f"marked run of the tests, into {self.kept}", flush=True)
            self._run_marked()
            (self.kept / "finished").touch()
        return Map(read(self.record))

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
        try:  # parts of the suite one after the other, so that an interrupted run loses little
            inside = [p for p in sorted((copy.root / "tests").iterdir()) if not p.name.startswith(("_", "."))]
            for folder in [f"tests/{p.name}" for p in inside if p.is_dir() or p.name.startswith("test_")]:
                begun = time.monotonic()
                self._marked_part(
                    copy, "-n", str(self.options.jobs), "--dist", "loadfile", "--no-loadscope-reorder", folder
                )
                lines = [line for line in read(self.record) if line.get("done", "").startswith(folder)]
                failed = [line["done"] for line in lines if line["outcome"] == "failed"]
                print(f"  {folder}: {len(lines)} tests in {time.monotonic() - begun:.0f} s", flush=True)
                if failed:  # once more, one after the other: what fails by itself says nothing of a mutant
                    write(self.record, [line for line in read(self.record) if line.get("done") not in failed])
                    self._marked_part(copy, "-n0", folder)
        finally:
            for path in by_file:
                copy.write(copy.root / path.relative_to(ROOT), texts[path])

    def _marked_part(self, copy: Copy, *arguments: str) -> None:
        done = self.kept / "done.json"
        done.write_text(json.dumps([line["done"] for line in read(self.record) if "done" in line]))
        copy.pytest(arguments, {RECORD: str(self.record), SKIP: str(done)}, 4 * 3600.0)

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
                if not self.ended:
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
