"""What of images and joints belongs together otherwise, where as they stand they miss each other by more than any arm.

Tables go wrong in a few ways: rows of joints one image early or late, two joints exchanged, one of the other sign,
pixels mirrored since u and v were exchanged or v was counted from the bottom. Each is tried with the poses that the
images show; where one meets the arm as nothing else does, it is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from modcal_core.camera.corners import CornerTable
from modcal_core.camera.lens import PINHOLE, Lens
from modcal_core.camera.mounting import mounting_misfit
from modcal_core.camera.pnp import BoardPose
from modcal_core.errors import BadRecording, ModcalError
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import forward

_NEAR = 0.03  # misfit as a share of the reach: no arm is built worse than that
_CLEAR = 3.0  # times that of any other way
_P1 = 6  # of a lens's values
_Posed = Callable[[CornerTable, Lens], BoardPose]


def explained(
    error: BadRecording, chain: Chain, q: Array, table: CornerTable, lens: Lens, posed: _Posed, on_tip: bool | None
) -> BadRecording:
    """The error with what would make images and joints meet, or as it was where nothing does.

    q: (N, n) of the images of the table. posed: the target's poses in them. on_tip: the mounting where it is stated.
    """
    try:
        seen = posed(table, lens)
        found = [(_misfit(chain, at, seen, rows, on_tip), said, remedy) for said, remedy, at, rows in _joints(chain, q)]
        mirrored = posed(_mirrored(table, lens), _mirrored_lens(lens))
    except ModcalError:
        return error
    every = np.arange(len(q))
    said = "with the pixels mirrored", "exchange u and v, or count v from the top: they may be the other way round"
    found.append((_misfit(chain, q, mirrored, every, on_tip), *said))
    found.sort(key=lambda one: one[0])
    (best, what, remedy), second = found[0], found[1][0]
    if best > _NEAR * max(chain.reach(), 0.3) or second < _CLEAR * best:
        return error
    return BadRecording(error.offender, f"{error.limit}; {what} they are {1e3 * best:.0f} mm off", remedy)


def _joints(chain: Chain, q: Array) -> Iterator[tuple[str, str, Array, np.ndarray]]:
    """(what, what to do about it, joints, images that they are of) of every way in which a table of joints is wrong."""
    N, names = len(q), chain.names
    for way, last, first in (("before", q[:-1], np.arange(1, N)), ("after", q[1:], np.arange(N - 1))):
        yield f"with the joints of the image {way}", "give each image its own row of joints", last, first
    every = np.arange(N)
    for i in range(chain.n):
        turned = q.copy()
        turned[:, i] *= -1.0
        yield f"with {names[i]} of the other sign", "state joints as the URDF turns them", turned, every
        for j in range(i + 1, chain.n):
            other = q.copy()
            other[:, [i, j]] = q[:, [j, i]]
            yield f"with {names[i]} and {names[j]} exchanged", "name the columns of joints as they are", other, every


def _misfit(chain: Chain, q: Array, poses: BoardPose, rows: np.ndarray, on_tip: bool | None) -> float:
    """By how much images (rows of the poses) miss these joints (m, n) [m]."""
    return mounting_misfit(forward(chain, q), replace(poses, T=poses.T[rows], cost=poses.cost[rows]), on_tip)


def _mirrored(table: CornerTable, lens: Lens) -> CornerTable:
    pixels = table.pixels.copy()
    pixels[:, 1] = lens.size[1] - 1.0 - pixels[:, 1]
    return replace(table, pixels=pixels)


def _mirrored_lens(lens: Lens) -> Lens:
    """The lens by which a mirrored image is seen as the other one is by this."""
    values = lens.values.copy()
    values[3] = lens.size[1] - 1.0 - values[3]
    if lens.model == PINHOLE:
        values[_P1] = -values[_P1]
    return Lens(values, lens.size, lens.model)
