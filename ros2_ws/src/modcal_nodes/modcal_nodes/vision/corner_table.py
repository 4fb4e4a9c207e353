"""Corners that another program found: a CSV with a row for each, in place of a folder of images."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from modcal_core.camera.target import PrintedTarget
from modcal_core.camera.views import BoardView
from modcal_core.errors import BadTable, NotEnoughData
from modcal_nodes.vision.images import ImageFolder, joints_of_text, text_of

_COLUMNS = ("image", "id", "u", "v")
_SIGMA_PX = 0.1  # of a corner whose row has none: that of a sharp ChArUco corner
_LARGEST_PX = 100_000  # of a side of an image


def read_corner_table(
    file: Path, joints: Path, names: Sequence[str], target: PrintedTarget, size: tuple[int, int] | None = None
) -> ImageFolder:
    """The corners of a table as the views of a folder's images.

    file: CSV, its first line the columns: image, id (of the target's corner), u, v [px], and, where they are known,
    sigma [px], width and height of the images [px]. joints, names: as of a folder. size: of the images, where the table
    has none. Raises ModcalError.
    """
    source = str(file)
    rows = list(csv.reader(text_of(file).splitlines()))
    header = [cell.strip() for cell in rows[0]] if rows else []
    if missing := [name for name in _COLUMNS if name not in header]:
        said = f"has no column {missing[0]} (it has {', '.join(header)[:120]})"
        raise BadTable(source, said, f"give columns {', '.join(_COLUMNS)}, and sigma where it is known")
    found: dict[str, list[tuple[int, float, float, float]]] = {}
    for number, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        try:
            one = {name: cell.strip() for name, cell in zip(header, row, strict=True)}
            corner = int(one["id"]), float(one["u"]), float(one["v"]), float(one.get("sigma") or _SIGMA_PX)
            if "width" in one and "height" in one:
                size = _size(source, number, size, (int(one["width"]), int(one["height"])))
        except ValueError as error:
            raise BadTable(f"{source}: line {number}", "holds a value that cannot be read", "give numbers") from error
        if not 0 <= corner[0] < len(target.points):
            said = f"has corner {corner[0]}, the target has 0 to {len(target.points) - 1}"
            raise BadTable(f"{source}: line {number}", said, "number the corners as docs/camera.md does")
        if not np.isfinite(corner[1:]).all() or corner[3] <= 0.0:
            raise BadTable(f"{source}: line {number}", "holds a number that is not finite, or no size", "correct it")
        found.setdefault(one["image"], []).append(corner)
    if not found:
        raise NotEnoughData(source, "holds no corner", "give a row for each corner that was found")
    if size is None:
        raise BadTable(
            source, "does not say how large the images are", "add columns width and height, or --camera-info"
        )
    table = joints_of_text(text_of(joints), names, str(joints))
    views, at, left_out = [], [], {}
    for name, corners in found.items():
        values = np.array(corners)
        ids = values[:, 0].astype(int)
        if len(np.unique(ids)) < len(ids):
            raise BadTable(f"{source}: image {name[:80]}", "has a corner twice", "give each corner of an image once")
        if (place := table.at(Path(name))) is None:
            left_out[name] = "the table has no joints for it: give it a row"
            continue
        cov = np.eye(2) * (values[:, 3] ** 2)[:, None, None]
        views.append(BoardView(name, ids, values[:, 1:3], cov))
        at.append(place)
    if not views:
        raise NotEnoughData(source, "names no image that the table of joints has", "name the images alike in both")
    q, velocity = (np.stack(part) for part in zip(*at, strict=True))
    return ImageFolder(tuple(views), q, velocity, size, left_out)


def _size(source: str, number: int, before: tuple[int, int] | None, own: tuple[int, int]) -> tuple[int, int]:
    """The images' size by this row, which must be that of the rows before."""
    if not (0 < own[0] < _LARGEST_PX and 0 < own[1] < _LARGEST_PX):
        raise BadTable(f"{source}: line {number}", f"has images of {own[0]} × {own[1]} pixels", "correct it")
    if before is not None and own != before:
        said = f"is of an image of {own[0]} × {own[1]}, those before of {before[0]} × {before[1]}"
        raise BadTable(f"{source}: line {number}", said, "give images of one size")
    return own
