"""Corners that another program found: a CSV with a row for each, of one camera or several, in place of images.

One row then has what all cameras saw of a corner, or all that was seen at a posture: the name of a column says which
camera, marker and corner it is of, such as ``left_marker3_corner0_u``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modcal_core.camera import APRIL_GRID, ARUCO_GRID, MARKER_CORNERS, TAG, BoardView, MarkerBundle, PrintedTarget
from modcal_core.errors import BadTable, NotEnoughData
from modcal_nodes.vision.images import ImageFolder, JointTable, csv_rows, joints_of_text, text_of

_MARKER, _CORNER = r"(?:marker|tag|aruco|m|id)[_ -]?", r"(?:corner|point|p|c)[_ -]?"
_WIDE = re.compile(
    rf"(?:(?P<camera>(?!{_MARKER}\d|(?:corner|point|p)[_ -]?\d).+?)[_ -])?(?:{_MARKER}(?P<marker>\d+)[_ -])?"
    rf"(?:{_CORNER}(?P<corner>\d+)[_ -])?(?P<axis>[uvxyz])",
    re.IGNORECASE,
)
_COORDINATES = (("u", "v"), ("x", "y"))  # in the order in which they are looked for
_REMEDY = "name columns such as left_marker3_corner0_u and left_marker3_corner0_v, or give a row for each corner"


@dataclass(frozen=True)
class WideColumn:
    """A pair of columns. u, v: their names. fields: what they are of: camera, marker, corner, id; as text."""

    u: str
    v: str
    fields: dict[str, str]


def wide_columns(header: Sequence[str], source: str) -> tuple[WideColumn, ...]:
    """The pairs of columns of corners in a header, none where it has columns u and v. Raises BadTable."""
    if "u" in header and "v" in header:
        return ()
    numbered, found = bool({"id", "marker"} & set(header)), dict[tuple[tuple[str, str], ...], dict[str, str]]()
    for name in header:
        if (match := _WIDE.fullmatch(name)) is None:
            continue
        fields = {key: match[key] for key in ("camera", "marker", "corner") if match[key]}
        if "corner" in fields and "marker" not in fields and not numbered:
            fields["id"] = fields.pop("corner")
        columns = found.setdefault(tuple(fields.items()), {})
        before = columns.setdefault(match["axis"].lower(), name)
        if before != name:
            raise BadTable(source, f"has columns {before} and {name} of the same corner", _REMEDY)
    for u, v in _COORDINATES:  # beside a column z, x and y are a place in space
        pairs = [(key, own) for key, own in found.items() if u in own and v in own and not (u == "x" and "z" in own)]
        if pairs:
            return tuple(WideColumn(own[u], own[v], dict(key)) for key, own in pairs)
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
    plain = "".join(re.findall(r"[a-z]+|\d+", name.lower()))
    return re.sub(r"^cam(?:era)?(?=.)", "", plain)


_COLUMNS = ("image", "u", "v")
_SIGMA_PX = 0.1  # of a corner whose row has none: that of a sharp ChArUco corner
# u and v of a corner that an image does not show, as tables with a row for each have it; no corner is found at exactly
# the upper left pixel's middle
_NOT_SEEN = ("", "nan")
_NOWHERE = (0.0, -1.0)
_LARGEST_PX = 100_000  # of a side of an image
_ROWS_REMEDY = "give columns image, id (or marker and corner), u, v, and camera and sigma where they are known"
_ROWS_MARKERS = (ARUCO_GRID, APRIL_GRID, TAG)  # sheets whose corners are those of numbered markers
_Size = tuple[int, int]


@dataclass(frozen=True)
class _Row:
    """A corner. point: of the target, None of a marker that is not on it. size: of the image [px], where known."""

    camera: str
    image: str
    point: int | None
    values: tuple[float, float, float]
    size: _Size | None


def read_corner_tables(
    file: Path,
    joints: Path,
    names: Sequence[str],
    target: PrintedTarget | MarkerBundle,
    sizes: Mapping[str, _Size] | None = None,
) -> dict[str, ImageFolder]:
    """The corners of a table as the views of a folder's images, by camera, in the order in which the table has these.

    file: CSV, its first line the columns: image, u, v [px] and id, or marker and corner (0 to 3, empty for a marker's
    middle), and, where they are known, camera, sigma [px], width and height of the images [px]; rows without u and v
    (empty, nan, both 0 or both -1) are of corners that were not seen. Columns may be of cameras, markers and corners
    (wide_columns). Without a column image, rows of both files belong together by their number. joints, names: as of a
    folder. sizes: of the images by camera_key of the camera, "" for any, where the table has none. Raises ModcalError.
    """
    source = str(file)
    text = text_of(file)
    rows = corners_of_text(text, target, source)
    header = csv_rows(text, source)[0]
    by_row = not {"image", "stamp"} & set(header)
    if by_row and joints.resolve() != file.resolve():
        counts = [len(csv_rows(one, name)) - 1 for one, name in ((text, source), (text_of(joints), str(joints)))]
        if counts[0] != counts[1]:
            said = f"has {counts[0]} rows and no column image, {joints} has {counts[1]} rows"
            raise BadTable(source, said, "say in a column image of both which rows belong together")
    table = joints_of_text(text_of(joints), names, str(joints), joints.resolve() == file.resolve(), by_row)
    out = {}
    for camera in dict.fromkeys(row.camera for row in rows):
        own = [row for row in rows if row.camera == camera]
        stated = {row.size for row in own if row.size is not None}
        if len(stated) > 1:
            said = " and of ".join(f"{width} × {height}" for width, height in sorted(stated)[:2])
            raise BadTable(source, f"has images of {said}", "give images of one size")
        size = min(stated, default=None) or (sizes or {}).get(camera_key(camera), (sizes or {}).get(""))
        if size is None:
            whose, named = (f" of {camera}", f"{camera}=") if camera else ("", "")
            remedy = f"add columns width and height, or --camera-info {named}FILE"
            raise BadTable(source, f"does not say how large the images{whose} are", remedy)
        out[camera] = _folder(source, own, table, target, size)
    return out


def _folder(
    source: str, rows: Sequence[_Row], table: JointTable, target: PrintedTarget | MarkerBundle, size: _Size
) -> ImageFolder:
    """The images of one camera. Raises ModcalError."""
    found: dict[str, list[_Row]] = {}
    for row in rows:
        if row.point is not None:
            found.setdefault(row.image, []).append(row)
    notes = []
    if strangers := sum(row.point is None for row in rows):
        notes.append(f"{strangers} rows of {source} are of markers that the target does not have.")
    views, at, left_out = [], [], {}
    for name, corners in found.items():
        count = Counter(row.point for row in corners)
        if max(count.values()) > 1:
            if isinstance(target, PrintedTarget):
                remedy = "give each corner of an image once"
                raise BadTable(f"{source}: image {name[:80]}", "has a corner twice", remedy)
            corners = [row for row in corners if count[row.point] == 1]  # one of the two is misread
            notes.append(f"Image {name[:80]} has a marker twice, which is left out of it.")
        if not corners:
            left_out[name] = "no point of the target stands once: give each once"
            continue
        if (place := table.at(Path(name))) is None:
            left_out[name] = "the table has no joints for it: give it a row"
            continue
        values = np.array([row.values for row in corners])
        cov = np.eye(2) * (values[:, 2] ** 2)[:, None, None]
        views.append(BoardView(name, np.array([row.point for row in corners]), values[:, :2], cov))
        at.append(place)
    if not views:
        raise NotEnoughData(source, "names no image that the table of joints has", "name the images alike in both")
    q, velocity = (np.stack(part) for part in zip(*at, strict=True))
    return ImageFolder(tuple(views), q, velocity, size, left_out, notes=tuple(dict.fromkeys(notes)))


def corners_of_text(text: str, target: PrintedTarget | MarkerBundle, source: str) -> list[_Row]:
    """The rows of a table of corners in a text, checked. Raises ModcalError, naming the source."""
    rows = csv_rows(text, source)
    header = rows[0] if rows else []
    wide = wide_columns(header, source)
    if not wide:
        missing = [name for name in _COLUMNS if name not in header]
        missing += [] if {"id", "marker"} & set(header) else ["id"]
        if missing:
            raise BadTable(source, f"has no column {missing[0]} (it has {', '.join(header)[:120]})", _ROWS_REMEDY)
    out = []
    for number, row in enumerate(rows[1:], start=1):
        where = f"{source}: line {number + 1}"
        if len(row) != len(header):
            raise BadTable(where, f"has {len(row)} cells, the header {len(header)}", "correct the line")
        for one in long_rows(dict(zip(header, row, strict=True)), wide, number):
            found = _read_row(one, target, where)
            out += [] if found is None else [found]
    if not out:
        raise NotEnoughData(source, "holds no corner", "give a row for each corner that was found")
    return out


def _read_row(one: Mapping[str, str], target: PrintedTarget | MarkerBundle, where: str) -> _Row | None:
    """The corner that a row says, None for one that was not seen. Raises BadTable."""
    if one["u"].lower() in _NOT_SEEN and one["v"].lower() in _NOT_SEEN:
        return None
    try:
        values = float(one["u"]), float(one["v"]), float(one.get("sigma") or _SIGMA_PX)
        size = (int(one["width"]), int(one["height"])) if "width" in one and "height" in one else None
        point = _point(one, target, where)
    except ValueError as error:
        raise BadTable(where, "holds a value that cannot be read", "give numbers") from error
    if not np.isfinite(values).all() or values[2] <= 0.0:
        raise BadTable(where, "holds a number that is not finite, or no size", "correct it")
    if size is not None and not 0 < min(size) <= max(size) < _LARGEST_PX:
        raise BadTable(where, f"has images of {size[0]} × {size[1]} pixels", "correct it")
    if values[0] == values[1] and values[0] in _NOWHERE:
        return None
    return _Row(one.get("camera", ""), one["image"], point, values, size)


def _point(one: Mapping[str, str], target: PrintedTarget | MarkerBundle, where: str) -> int | None:
    """The number of the target's point that a row is of, None of another target's marker. Raises BadTable."""
    corner = int(one["corner"]) if one.get("corner") else None
    said = one.get("marker", one.get("id"))
    if said is None:
        raise BadTable(where, "does not say which corner it is of", _ROWS_REMEDY)
    number = int(said)
    if corner is not None and not 0 <= corner < MARKER_CORNERS:
        raise BadTable(where, f"has corner {corner} of a marker", "number them from 0 to 3, or leave it empty")
    if isinstance(target, MarkerBundle):
        return target.point(number, corner)
    if "marker" in one:
        if target.kind not in _ROWS_MARKERS or corner is None:
            raise BadTable(where, f"has a marker, which a {target.kind} has none of", "give id, the target's corner")
        number = MARKER_CORNERS * (number - target.first_id) + corner
        if not 0 <= number < len(target.points):
            return None
    if not 0 <= number < len(target.points):
        said = f"has corner {number}, the target has 0 to {len(target.points) - 1}"
        raise BadTable(where, said, "number the corners as docs/camera.md does")
    return number
