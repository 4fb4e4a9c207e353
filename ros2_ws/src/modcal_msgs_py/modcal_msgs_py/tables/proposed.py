"""A proposed mapping as a file to edit: what was found out, its proof, what was assumed, and what is to be asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.files import to_yaml
from modcal_msgs_py.tables.fitted import Fitted
from modcal_msgs_py.tables.propose import Findings

_WIDTH = 116  # of comments


@dataclass(frozen=True)
class Proposal:
    """A proposed mapping. proved: what the data shows, with the second best. open: questions."""

    mapping: Mapping[str, Any]
    proved: tuple[str, ...]
    assumed: tuple[str, ...]
    open: tuple[str, ...]

    def text(self, source: str) -> str:
        """The mapping as YAML, with comments."""
        lines = [f"Mapping for modcal import, found out from {source}. Edit it where it is wrong."]
        for name, said in (("Proved", self.proved), ("Assumed", self.assumed)):
            lines += [f"{name}: {sentence}." for sentence in said]
        return "".join(f"# {part}\n" for line in lines for part in _folded(line)) + to_yaml(self.mapping)


def proposal(found: Findings, urdf: str | None) -> Proposal:
    """The mapping that findings make."""
    numbers, chain, fitted = found.numbers, found.chain, found.fitted
    choice, beside = fitted.choice, found.beside
    entry: dict[str, Any] = {"files": numbers.sniffed.path.name, **numbers.sniffed.form.entry()}
    used = {*choice.joints.columns, *fitted.columns, *beside.used}
    lacking = len(numbers.values) - len(fitted.rows)
    if lacking:
        entry["missing"] = "skip"
    odd = sorted({text for k in used for text in numbers.odd.get(k, ())})
    if odd:
        entry["missing_values"] = odd
    if zeros := _zeros(found):
        entry["zeros_missing"] = [numbers.key(k) for k in zeros]
    if found.joined is not None and found.joined.stated:
        entry["joined"] = list(found.joined.stated)
    entry["time"] = found.time.stated
    turning = np.asarray(chain.revolute, bool)
    unit = choice.angle if turning.any() else choice.length
    entry["joints"] = {"unit": unit}
    if not turning.all() and turning.any():
        sliding = [name for name, turns in zip(chain.names, turning, strict=True) if not turns]
        entry["joints"]["units"] = dict.fromkeys(sliding, choice.length)
    entry["joints"]["columns"] = _by_joint(found, choice.joints.columns)
    entry["joints"] |= beside.joints
    entry |= fitted.entry(numbers)
    if beside.std:
        next(entry[key] for key in ("pose", "point") if key in entry)["std"] = beside.std
    for key, stated in (("temperature", beside.temperature), ("signals", beside.signals)):
        if stated:
            entry[key] = stated
    mapping: dict[str, Any] = {**({"urdf": urdf} if urdf else {}), "tables": [entry]}
    if found.questions:
        mapping = {"undecided": list(found.questions), **mapping}
    return Proposal(mapping, _proved(found), _assumed(found, used, lacking, odd), found.questions)


def _zeros(found: Findings) -> list[int]:
    """Columns that are all zero in rows in which nothing was read; none where there are no such rows."""
    if not isinstance(found.fitted, Fitted):
        return []
    columns = list(found.fitted.body.zeros)
    return columns if (found.numbers.values[:, columns] == 0.0).all(axis=1).any() else []


def _by_joint(found: Findings, columns: tuple[int, ...]) -> dict[str, Any]:
    return {name: found.numbers.key(k) for name, k in zip(found.chain.names, columns, strict=True)}


def _proved(found: Findings) -> tuple[str, ...]:
    return (*found.fitted.proved(found.numbers, found.chain), *found.beside.proved)


def _assumed(found: Findings, used: set[int], lacking: int, odd: Sequence[str]) -> tuple[str, ...]:
    numbers, fitted = found.numbers, found.fitted
    sniffed, total = numbers.sniffed, len(numbers.values)
    out = [f"the arm ends at {found.chain.tip}, and begins at {found.chain.base}", found.time.said]
    shown = ", ".join(
        f"{name} = {numbers.shown(k)}" for name, k in zip(found.chain.names, fitted.choice.joints.columns, strict=True)
    )
    out.append(f"the joints' columns by {fitted.choice.joints.how}: {shown}")
    out += found.joined.said if found.joined is not None else ()
    if not sniffed.sure:
        out.append(f"the text is not UTF-8 and is read as {sniffed.form.encoding}")
    if lacking:
        out.append(f"{lacking} of {total} rows lack a number that is needed, and are left out")
    if odd:
        out.append(f"{', '.join(odd)} mark cells without a number")
    if _zeros(found):
        out.append("rows of zeros are rows in which nothing was read")
    out += (*found.assumed, *found.beside.said)
    taken = {*used, *found.time.columns}
    unused = [numbers.shown(k) for k in numbers.usable() if k not in taken]
    if unused:
        out.append(f"not used: {', '.join(unused[:20])}{' …' if len(unused) > 20 else ''}")
    return tuple(out)


def _folded(text: str) -> list[str]:
    out, line = [], ""
    for word in text.replace("\n", " ").split(" "):
        if line and len(line) + len(word) >= _WIDTH:
            out.append(line)
            line = f"  {word}"
        else:
            line = f"{line} {word}" if line else word
    return [*out, line]
