"""Tables of corners whose columns are of cameras, markers or corners, such as left_marker3_corner0_u: row by row.

One row then has what all cameras saw of a corner, or all that was seen at a posture. The name of a column says which
camera, marker and corner it is of, in words (``cam``, ``marker``, ``tag``, ``corner``, …, each with its number, and any
other word is of the camera), or in bare numbers: of a table with a column ``id`` or ``marker`` that of the camera, else
corner, or marker and corner, or camera, marker and corner.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from modcal_core.errors import BadTable

_COORDINATES = (("u", "v"), ("x", "y"))  # in the order in which they are looked for
_THIRD = {"x": "z", "y": "z"}  # with which they are a place in space
_MARKERS, _CORNERS = ("marker", "tag", "aruco", "m", "id"), ("corner", "point", "pt", "p", "c")
_UNIT = ("px", "pix", "pixel", "pixels")
_REMEDY = "name columns such as left_marker3_corner0_u and left_marker3_corner0_v, or give a row for each corner"


@dataclass(frozen=True)
class WideColumn:
    """A pair of columns. u, v: their names. fields: what they are of: camera, marker, corner, id; as text."""

    u: str
    v: str
    fields: dict[str, str] = field(default_factory=dict)


def wide_columns(header: Sequence[str], source: str) -> tuple[WideColumn, ...]:
    """The pairs of columns of corners in a header, none where it has columns u and v. Raises BadTable."""
    if "u" in header and "v" in header:
        return ()
    numbered = bool({"id", "marker"} & set(header))
    for first, second in _COORDINATES:
        pairs = _pairs(header, first, second)
        if pairs:
            out = tuple(WideColumn(u, v, _fields(rest, numbered, u, source)) for u, v, rest in pairs)
            kept: dict[tuple[tuple[str, str], ...], str] = {}
            for one in out:
                before = kept.setdefault(tuple(sorted(one.fields.items())), one.u)
                if before != one.u:
                    raise BadTable(source, f"has columns {before} and {one.u} of the same corner", _REMEDY)
            return out
    return ()


def long_rows(row: Mapping[str, str], columns: Sequence[WideColumn], number: int) -> list[dict[str, str]]:
    """The rows, one a corner, that a row of a table holds. number: of the row, its name where no column image has one.

    A table without such columns has a row a corner already.
    """
    named = {"image": row.get("image") or row.get("stamp") or str(number)}
    if not columns:
        return [{**row, **named}]
    of_pairs = {name for one in columns for name in (one.u, one.v)}
    rest = {name: cell for name, cell in row.items() if name not in of_pairs} | named
    return [{**rest, **one.fields, "u": row[one.u], "v": row[one.v]} for one in columns]


def camera_key(name: str) -> str:
    """The same text for all ways in which a camera's name is written: cam1, Camera_1 and 1 are one camera."""
    plain = "".join(_tokens(name))
    for word in ("camera", "cam"):
        if plain.startswith(word) and plain != word:
            return plain[len(word) :]
    return plain


def _tokens(name: str) -> list[str]:
    return re.findall(r"[a-z]+|\d+", name.lower())


def _pairs(header: Sequence[str], first: str, second: str) -> list[tuple[str, str, list[str]]]:
    """(column of u, column of v, the tokens that both share)."""
    by_tokens = {tuple(_tokens(name)): name for name in header}
    out = []
    for tokens, name in by_tokens.items():
        if tokens.count(first) != 1:
            continue
        at = tokens.index(first)

        def other(letter: str, tokens: tuple[str, ...] = tokens, at: int = at) -> str | None:
            return by_tokens.get((*tokens[:at], letter, *tokens[at + 1 :]))

        pair = other(second)
        if pair is None or (first in _THIRD and other(_THIRD[first]) is not None):
            continue
        out.append((name, pair, [t for i, t in enumerate(tokens) if i != at and t not in _UNIT]))
    return out


def _fields(tokens: Sequence[str], numbered: bool, name: str, source: str) -> dict[str, str]:
    """Camera, marker, corner and id that a column is of, by the tokens of its name."""
    out: dict[str, str] = {}
    bare: list[str] = []
    camera: list[str] = []
    marked = any(t in _MARKERS for t in tokens)
    for i, token in enumerate(tokens):
        before = tokens[i - 1] if i else ""
        if not token.isdigit():
            short_camera = token == "c" and not marked  # c3 of a table without markers
            if token not in (*_MARKERS, *_CORNERS) or short_camera:
                camera.append(token)
        elif before in _MARKERS:
            out["marker"] = token
        elif before in _CORNERS and (before != "c" or marked):
            out["corner"] = token
        elif before and not before.isdigit():
            camera.append(token)
        else:
            bare.append(token)
    if len(bare) == 3 or (bare and numbered and not camera):
        camera.append(bare.pop(0))
    for key in ("marker", "corner"):
        if bare and key not in out and (key == "corner" or len(bare) == 2):
            out[key] = bare.pop(0)
    if bare:
        raise BadTable(source, f"column {name} has numbers that nothing says the meaning of", _REMEDY)
    if "marker" not in out and "corner" in out and not numbered:
        out["id"] = out.pop("corner")
    if camera:
        out["camera"] = "".join(camera)
    return out
