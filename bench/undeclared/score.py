"""Was the planted effect named? A report against the truth of its recording."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import permutations
from typing import Any

ANY = "*"


@dataclass(frozen=True)
class Score:
    """matched: how many planted effects have an entry of their own in the report. false: entries that name no planted
    effect; entries: all of them. named: family, and whether the place is right, of each entry.
    """

    planted: int
    matched: int
    false: int
    entries: int
    named: tuple[str, ...]

    @property
    def attributed(self) -> bool:
        """Every planted effect has an entry of its own; where none is planted, there is none."""
        return self.matched == self.planted and (self.planted > 0 or self.entries == 0)


def score(report: dict[str, Any], truth: dict[str, Any]) -> Score:
    """How the effects of a report compare with those that were planted."""
    entries, planted = report.get("effects") or [], truth["effects"]
    fits = [[matches(entry, effect) for effect in planted] for entry in entries]
    padded = [*fits, *([[False] * len(planted)] * len(planted))]
    matched = max(sum(row[k] for k, row in enumerate(order)) for order in permutations(padded, len(planted)))
    named = tuple(f"{e.get('family')}@{'ok' if any(_at(e, p) for p in planted) else 'wrong'}" for e in entries)
    return Score(len(planted), matched, sum(not any(row) for row in fits), len(entries), named)


def matches(entry: dict[str, Any], effect: dict[str, Any]) -> bool:
    """Whether an entry names a planted effect: family, place and driver, as they stand or in ``same_as``.

    What is said to be the same may be another place for the same driver, another place and driver, or all three.
    """
    family, place, driver = (_one_of(entry.get(key), effect[key]) for key in ("family", "place", "driver"))
    if family and place and driver:
        return True
    for text in [text for text in _same(entry) if _says(text, effect["place"])]:
        other = _says(text, effect["driver"])
        if (family and (driver or other)) or (other and _says(text, effect["family"])):
            return True
    return False


def _same(entry: dict[str, Any]) -> list[str]:
    return [str(text) for text in entry.get("same_as") or []]


def _at(entry: dict[str, Any], effect: dict[str, Any]) -> bool:
    """Whether the place is right."""
    return _one_of(entry.get("place"), effect["place"]) or any(_says(text, effect["place"]) for text in _same(entry))


def _one_of(name: Any, accepted: list[str]) -> bool:
    return any(a in (ANY, name) or (a.endswith(ANY) and str(name).startswith(a[:-1])) for a in accepted)


def _says(text: str, accepted: list[str]) -> bool:
    """Whether a text holds one of the names as a word of its own: a joint that is part of a driver is not a place."""
    patterns = [r"[\w/.-]+".join(re.escape(part) for part in name.split(ANY)) for name in accepted]
    return any(re.search(rf"(?<![\w:/-]){pattern}(?![\w/-])", text) for pattern in patterns)
