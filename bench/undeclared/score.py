"""Was the planted effect named? A report against the truth of its recording."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import permutations
from typing import Any

ANY = "*"


@dataclass(frozen=True)
class Score:
    """attributed: every planted effect has an entry of its own in the report; matched: how many have. false: entries
    that name no planted effect; entries: all of them. named: family, and whether the place is right, of each entry.
    """

    planted: int
    matched: int
    false: int
    entries: int
    named: tuple[str, ...]

    @property
    def attributed(self) -> bool:
        return self.matched == self.planted and (self.planted > 0 or self.entries == 0)


def score(report: dict[str, Any], truth: dict[str, Any]) -> Score:
    """How the effects of a report compare with those that were planted."""
    entries, planted = report.get("effects") or [], truth["effects"]
    fits = [[matches(entry, effect) for effect in planted] for entry in entries]
    padded = [*fits, *([[False] * len(planted)] * len(planted))]
    matched = max(sum(row[k] for k, row in enumerate(order)) for order in permutations(padded, len(planted)))
    return Score(
        planted=len(planted),
        matched=matched,
        false=sum(not any(row) for row in fits),
        entries=len(entries),
        named=tuple(f"{e.get('family')}@{_where(e, planted)}" for e in entries),
    )


def matches(entry: dict[str, Any], effect: dict[str, Any]) -> bool:
    """Whether an entry names a planted effect: family, place and driver, as they stand or in ``same_as``.

    What is said to be the same may be another place for the same driver, another place and driver, or all three.
    """
    family = _one_of(entry.get("family"), effect["family"])
    driver = _one_of(entry.get("driver"), effect["driver"])
    if family and driver and _one_of(entry.get("place"), effect["place"]):
        return True
    for text in map(str, entry.get("same_as") or []):
        place = _says(text, effect["place"])
        if place and (
            (family and (driver or _says(text, effect["driver"])))
            or (_says(text, effect["family"]) and _says(text, effect["driver"]))
        ):
            return True
    return False


def _one_of(name: Any, accepted: list[str]) -> bool:
    return any(a in (ANY, name) or (a.endswith(ANY) and str(name).startswith(a[:-1])) for a in accepted)


def _says(text: str, accepted: list[str]) -> bool:
    """Whether a text holds one of the names as a word of its own: a joint that is part of a driver is not a place."""
    for name in accepted:
        pattern = r"[\w/.-]+".join(re.escape(part) for part in name.split(ANY))
        if re.search(rf"(?<![\w:/-]){pattern}(?![\w/-])", text):
            return True
    return False


def _where(entry: dict[str, Any], planted: list[dict[str, Any]]) -> str:
    """Whether an entry's place is right for any planted effect."""
    same = [str(text) for text in entry.get("same_as") or []]
    right = (_one_of(entry.get("place"), e["place"]) or any(_says(t, e["place"]) for t in same) for e in planted)
    return "ok" if any(right) else "wrong"
