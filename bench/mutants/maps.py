"""Which tests come by which mutant, as a marked run has recorded it."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fragments import Mutant


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


@dataclass
class Map:
    """Tests that pass without any fault, by name, and which of them come by each mutant."""

    tests: dict[str, Test] = field(default_factory=dict)
    reach: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))

    @classmethod
    def read(cls, lines: Iterable[dict[str, Any]]) -> Map:
        """The map that a record makes."""
        lines = list(lines)
        out = cls()
        for line in lines:
            if "done" in line and line["outcome"] == "passed":
                name = line["done"]
                out.tests[name] = Test(name, line["seconds"], line["waits"], frozenset(line["fixtures"]))
        users: dict[str, set[str]] = defaultdict(set)  # those that call a cached helper
        for _ in range(2):  # a helper may call another
            for line in lines:
                if "uses" in line:
                    users[line["uses"]] |= out._behind(line, users)
        seen: dict[tuple[str | None, ...], set[str]] = {}
        for line in lines:
            if "mutant" in line:
                key = line["test"], line["shared"], line["file"]
                seen[key] = seen.get(key) or out._behind(line, users)
                out.reach[line["mutant"]] |= seen[key]
        return out

    def _behind(self, line: dict[str, Any], users: dict[str, set[str]]) -> set[str]:
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


def lines_of(path: Path) -> list[dict[str, Any]]:
    """What a record says, line by line; nothing where there is none."""
    out = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            out.append(json.loads(line))
        except json.JSONDecodeError:  # the last one, where a run was interrupted
            continue
    return out
