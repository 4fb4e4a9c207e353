"""Readings that a table holds as a goal and a deviation from it, as reports of accuracy tests do.

Such a goal is what the nominal arm says of the joints, and no reading; the reading is the goal plus the deviation or
minus it, as *deviation* is understood. To first order every error of the model explains both alike, with its sign
reversed: no fit tells which it is. So it is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modcal_msgs_py.tables.candidates import Body, Numbers
from modcal_msgs_py.tables.fitted import Fitted, sum_in_words

_GOAL = 0.1  # of what goal plus or minus deviation leaves: the nominal arm reproduces a goal, rounded as it may be


def deviation_columns(numbers: Numbers, taken: set[int]) -> tuple[int, int, int] | None:
    """Columns of a deviation along x, y and z by their labels, some of it negative; None where there is no such three.

    A table in which they are the only labelled positions has no goal, and so no deviation from it.
    """
    found: dict[str, dict[str, int]] = {}
    positions: dict[str, set[str]] = {}
    for k, label in numbers.labels.items():
        if k in taken:
            continue
        if (difference := label.difference) is not None:
            found.setdefault(difference[1], {}).setdefault(difference[0], k)
        elif label.axis is not None:
            positions.setdefault(label.axis[1], set()).add(label.axis[0])
    triples = [(f["x"], f["y"], f["z"]) for f in found.values() if len(f) == 3]
    triples = [t for t in triples if np.nanmin(numbers.values[:, t]) < 0.0]  # others are standard deviations
    return triples[0] if len(triples) == 1 and any(len(axes) == 3 for axes in positions.values()) else None


def with_deviations(numbers: Numbers, places: Sequence[Body], away: tuple[int, int, int] | None) -> list[Body]:
    """The same places, behind each labelled position in the deviation's unit its sum with the deviation, both ways."""
    out: list[Body] = []
    for body in places:
        out.append(body)
        if away is None or not body.named or body.turned is not None or body.points:
            continue
        if numbers.labels[away[0]].unit in (None, numbers.labels[body.position[0]].unit):
            out += [replace(body, away=away, sign=sign, computed=False) for sign in (-1.0, 1.0)]
    return out


def decided(numbers: Numbers, fits: Sequence[Fitted]) -> tuple[list[Fitted], tuple[str, ...]]:
    """Fits without the goals of deviations, or without deviations where nothing is a goal; and what is to be asked."""
    out = [f for f in fits if not f.body.away]
    for plain in [f for f in fits if not f.body.away and f.body.turned is None]:
        sums = [f for f in fits if f.body.away and f.body.position == plain.body.position]
        if len(sums) == 2 and _left(plain) < _GOAL * min(map(_left, sums)):
            minus = min(sums, key=lambda f: f.body.sign)
            goal = ", ".join(numbers.shown(k) for k in plain.body.position)
            question = (
                f"{goal} are goals, for the nominal arm reproduces them; what was reached is "
                f"{sum_in_words(numbers, minus.body)}, or plus it, which no fit can tell: keep minus, or write plus "
                "(the wrong one doubles every error)"
            )
            rest = [f for f in out if set(f.body.position) != set(plain.body.position)]
            return [minus, *(f for f in rest if f.computed)], (question,)
    return out, ()


def _left(fitted: Fitted) -> float:
    return fitted.best.match.typical
