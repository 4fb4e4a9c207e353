"""Data of YAML and JSON files, and texts, that are nearly right."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 3, 2**31, 2**64, 10**400, -0.0, 1e-300, 1e300, float("nan"), float("inf"), "", "x", " ",
    "nan", "1e9", "\x1b[31m", "{", "{0}", "{stem}", "../../x", "*", "a" * 3000, [], {}, [[]], [{}], [1, 2], [1.0, 2.0, 3.0],
    ["x", "y", "z"], {"a": 1}, {"x": {}}, [0.0] * 7, [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
    [float("nan")] * 3, "2001-01-01", b"x", (1, 2), {1: 2}, {None: None},
)  # fmt: skip


def places(data: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to every value, but in long lists to the first and last few."""
    out = []
    items: Any = ()
    if isinstance(data, dict):
        items = list(data.items())
    elif isinstance(data, list):
        items = [(i, data[i]) for i in range(len(data)) if i < 3 or i > len(data) - 2]
    for key, value in items:
        out.append((*way, key))
        out += places(value, (*way, key))
    return out


def case(base: Any, ways: list[tuple[Any, ...]], rng: np.random.Generator) -> Any:
    """The data with one to three values changed, left out, doubled, or put under another key."""
    data = copy.deepcopy(base)
    for _ in range(1 if rng.integers(3) else int(rng.integers(2, 4))):
        way = ways[int(rng.integers(len(ways)))]
        place: Any = data
        try:
            for key in way[:-1]:
                place = place[key]
            key, what = way[-1], int(rng.integers(6))
            if what == 0:
                del place[key]
            elif what == 1 and isinstance(place, dict):
                place[str(rng.integers(100)) if rng.integers(2) else f"{key}s"] = place.pop(key)
            elif what == 1:
                place.insert(0, place[key])
            elif what == 2:
                other = ways[int(rng.integers(len(ways)))]
                value: Any = base
                for step in other:
                    value = value[step]
                place[key] = copy.deepcopy(value)
            else:
                place[key] = copy.deepcopy(VALUES[int(rng.integers(len(VALUES)))])
        except (KeyError, IndexError, TypeError, AttributeError):
            continue  # what was to be changed was changed before
    return data


def text_case(base: str, words: tuple[str, ...], rng: np.random.Generator) -> str:
    """The text with pieces left out, doubled, moved, or words put in."""
    out = base
    for _ in range(int(rng.integers(1, 4))):
        i, j = sorted(int(k) for k in rng.integers(len(out) + 1, size=2))
        j = min(j, i + int(rng.integers(1, 120)))
        what = int(rng.integers(5))
        if what == 0:
            out = out[:i] + out[j:]
        elif what == 1:
            out = out[:j] + out[i:j] + out[j:]
        elif what == 2:
            out = out[:i] + words[int(rng.integers(len(words)))] + out[i:]
        elif what == 3:
            out = out[:i] + words[int(rng.integers(len(words)))] + out[j:]
        else:
            out = out[:i] + chr(int(rng.integers(1, 300))) + out[i + 1 :]
    return out
