"""Points of a body that fit no marker where it is: a detector's misreadings, or a marker that is not as its file says.

Misreadings are spread over markers and images, and what is left of the points says as much as if they had not been
read. A marker most of whose points are out has another number, or another place, than the target's file states, or came
loose. Either is said; it speaks against the fit only where it is more than the others outvote.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.corners import CornerTable

_SIGHTINGS = 8  # images of a marker, for most of them to say something of the marker
_MOSTLY = 0.5  # of these, beyond which it is the marker that is not as stated
_PASSED = 0.05  # share of points left out that a verdict passes over (verdict.md)
# Share beyond which what is left is no majority to rely on: where a fifth of markers is misread, every second image
# that shows three has a misread one among them.
_TOO_MANY = 0.2
_NAMED = 3  # markers in a sentence


@dataclass(frozen=True)
class LeftOutPoints:
    """problems: what speaks against the fit. open: what a verdict may not pass over, though the fit stands."""

    problems: tuple[str, ...] = ()
    open: tuple[str, ...] = ()


def left_out_points(cameras: Sequence[tuple[str, CornerTable]], target: MarkerBundle) -> LeftOutPoints:
    """What is to be said of the points that were left out of the images of a body.

    cameras: (what a sentence calls it, corners, weight 0 where they are left out), of each that sees this body.
    """
    problems, open_ = [], []
    for name, table in cameras:
        out = table.weight == 0.0
        strange = [k for k in range(table.markers) if _mostly_out(table, table.marker == k)]
        if strange:
            named = ", ".join(target.markers[k].label for k in strange[:_NAMED])
            more = f" and {len(strange) - _NAMED} more" if len(strange) > _NAMED else ""
            open_.append(
                f"Most points of {named}{more}{name} are nowhere near their place, and are left out: check number, "
                "place and corner_order in the target file, and whether it came loose."
            )
        rest = ~np.isin(table.marker, strange)
        share = float(out[rest].mean()) if rest.any() else 0.0
        if max(share, len(strange) / max(table.markers, 1)) > _TOO_MANY:
            problems.append(f"{100.0 * float(out.mean()):.0f} % of all points{name} fit no body of the stated form.")
        elif share > _PASSED:
            open_.append(
                f"{100.0 * share:.0f} % of the points{name} are misread, spread over markers and images, and left out."
            )
    return LeftOutPoints(tuple(problems), tuple(open_))


def _mostly_out(table: CornerTable, rows: np.ndarray) -> bool:
    """Whether most of these points are out, in images enough to say so."""
    images = len(np.unique(table.view[rows]))
    return images >= _SIGHTINGS and float((table.weight[rows] == 0.0).mean()) > _MOSTLY
