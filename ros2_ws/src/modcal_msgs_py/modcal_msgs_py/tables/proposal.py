"""A proposed mapping as a file to edit: what was found out, its proof, what was assumed, and what is to be asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.files import to_yaml
from modcal_core.plausibility.turning import EULER, MATRIX, QUATERNION
from modcal_msgs_py.tables.propose import Findings, differences, missed, second, turning_words, worse
from modcal_msgs_py.tables.sheet import Form

_WIDTH = 116  # of comments


@dataclass(frozen=True)
class Proposal:
    """A mapping, and what is to be said of it. proved: what the data shows, with what came second. open: questions."""

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
    choice, meaning = fitted.choice, fitted.best.meaning
    entry: dict[str, Any] = {"files": numbers.sniffed.path.name, **_form(numbers.sniffed.form)}
    used = [*choice.joints.columns, *fitted.body.position, *(fitted.body.turned or ())]
    lacking = len(numbers.values) - len(fitted.rows)
    if lacking:
        entry["missing"] = "skip"
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
    if found.commanded is not None:
        entry["joints"]["commanded"] = {"columns": _by_joint(found, found.commanded.columns)}
    reading: dict[str, Any] = {
        "frame": "tracker", "unit": meaning.unit, "position": [numbers.key(k) for k in fitted.body.position],
    }  # fmt: skip
    if meaning.turning is None:
        entry["point"] = reading
    else:
        assert fitted.body.turned is not None
        columns = [numbers.key(fitted.body.turned[i]) for i in meaning.turning.order]
        stated: dict[str, Any] = {"columns": columns}
        if meaning.turning.form == EULER:
            stated["sequence"] = meaning.turning.sequence
        if meaning.turning.form not in (QUATERNION, MATRIX):
            stated["unit"] = "deg" if meaning.turning.degrees else "rad"
        if meaning.turning.conjugate:
            stated["conjugate"] = True
        reading[meaning.turning.form] = stated
        if meaning.inverse:
            reading["inverse"] = True
        entry["pose"] = reading
    warm = {
        "_".join(label.words) or f"column_{k}": numbers.key(k)
        for k, label in numbers.labels.items()
        if k not in used and {"temperature", "temp"} & set(label.words) and k in numbers.usable()
    }
    if warm:
        entry["temperature"] = warm
    mapping: dict[str, Any] = {**({"urdf": urdf} if urdf else {}), "tables": [entry]}
    if found.questions:
        mapping = {"undecided": list(found.questions), **mapping}
    return Proposal(mapping, _proved(found), _assumed(found, used, lacking, warm), found.questions)


def _form(form: Form) -> dict[str, Any]:
    default = Form()
    return {name: value for name, value in vars(form).items() if value != getattr(default, name)}


def _by_joint(found: Findings, columns: tuple[int, ...]) -> dict[str, Any]:
    return {name: found.numbers.key(k) for name, k in zip(found.chain.names, columns, strict=True)}


def _proved(found: Findings) -> tuple[str, ...]:
    fitted, best = found.fitted, found.fitted.best
    direction = "the tracker in the tool (inverse)" if best.meaning.inverse else "the tool in the tracker"
    if best.meaning.turning is None:
        direction = "points of the tool in the tracker"
    joints = fitted.choice.angle if np.any(found.chain.revolute) else fitted.choice.length
    said = "; ".join((turning_words(found.numbers, fitted.body, best), direction, f"positions in {best.meaning.unit}"))
    rows = f"the nominal arm misses {len(fitted.rows)} rows by {missed(best)} (median)"
    out = [f"{said}; joints in {joints}: {rows}"]
    if (other := second(fitted)) is not None:
        pairs = differences(found.numbers, fitted, best, other)
        instead = "; ".join(f"{two} instead of {one}" for one, two in pairs)
        out.append(f"second best, {worse(best, other)}: {instead}")
    return tuple(out)


def _assumed(found: Findings, used: list[int], lacking: int, warm: Mapping[str, Any]) -> tuple[str, ...]:
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
    if found.commanded is not None:
        out.append("columns labelled as commanded are the commanded joints, in the same unit")
    out += found.assumed
    if warm:
        out.append(f"temperatures {', '.join(warm)} are in °C")
    taken = {*used, *found.time.columns, *(found.commanded.columns if found.commanded else ())}
    unused = [numbers.shown(k) for k in numbers.usable() if k not in taken and numbers.key(k) not in warm.values()]
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
