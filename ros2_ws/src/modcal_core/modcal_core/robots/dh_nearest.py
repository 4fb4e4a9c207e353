"""The DH table that is nearest to an arm which no DH table of reasonable size holds.

Two axes that are parallel in the nominal arm are no longer quite so in a calibrated one. Of the two directions in which
one may be tilted against the other, a DH row has one, alpha, about the common normal; a tilt across it needs a common
normal far away and offsets of kilometres (see :mod:`modcal_core.robots.dh`). Here the nearly parallel neighbours are
made parallel, and all numbers of that arm's table, base and tool pose included, are fitted to the poses of the true one
over its joint ranges, which leaves them near where they were. What the table cannot hold is measured at other postures
and comes back with it.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots.chain import Chain
from modcal_core.robots.dh import to_dh, to_mdh
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.tables import from_table

# rad; far more than manufacture leaves between axes that are meant to be parallel, far less than any designed angle
NEARLY_PARALLEL = 0.02
_LEVER = 0.2  # m; a turn of the tip counts as what it moves at this distance, about the length of a tool
_FITTED, _CHECKED = 200, 1000  # postures
_STEP = 1e-6  # m, rad; of the differences, between rounding (1e-10) and curvature (1e-12 / 1e-6)
_ITERATIONS = 10
# Combinations of numbers that move the tip less than this, relative to the strongest, stay: the offsets along two axes
# that are a few mrad from parallel differ by that much only, and would be moved by metres to gain nothing.
_WEAKEST = 0.01
_SLIDE, _TURN = 0.5, np.pi  # m, rad; range of a joint without limits
_KEYS = ("theta", "d", "a", "alpha")


@dataclass(frozen=True)
class NearestTable:
    """A table, and how far the tip is off with it: RMS and largest distance [m], largest angle [rad].

    parallel: the joints whose axes are nearly parallel, in pairs.
    """

    table: dict[str, Any]
    rms: float
    largest: float
    angle: float
    parallel: tuple[tuple[str, str], ...]


def nearest_dh(chain: Chain, convention: str = "dh", largest_offset: float = 10.0) -> NearestTable:
    """The table of a convention, ``dh`` or ``mdh``, that comes nearest to the chain with offsets of ordinary size.

    Neighbours count as nearly parallel where both turn and are within :data:`NEARLY_PARALLEL` of it.
    largest_offset: as in :func:`modcal_core.robots.dh.to_dh` [m]. Raises NotRepresentable where even so a row exceeds
    it, BadTable for another convention.
    """
    if convention not in ("dh", "mdh"):
        raise BadTable(f"convention '{convention}'", "has no nearest table", "choose dh or mdh; cpc holds every arm")
    constants, pairs = _made_parallel(chain)
    snapped = replace(chain, origins=constants, axes=np.tile([0.0, 0.0, 1.0], (chain.n, 1)))
    table = (to_dh if convention == "dh" else to_mdh)(snapped, largest_offset)
    rng = np.random.default_rng(0)
    fitted, checked = _postures(chain, _FITTED, rng), _postures(chain, _CHECKED, rng)
    table = _fit(table, fitted, chain_forward(chain, fitted))
    off = _off(table, checked, chain_forward(chain, checked))
    distance, angle = np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1) / _LEVER
    return NearestTable(
        table=table,
        rms=float(np.sqrt(np.mean(distance**2))),
        largest=float(distance.max()),
        angle=float(angle.max()),
        parallel=tuple((chain.names[k - 1], chain.names[k]) for k in pairs),
    )


def _made_parallel(chain: Chain) -> tuple[Array, list[int]]:
    """The constants with joint axes along z, nearly parallel neighbours made parallel, and which: (n + 1, 4, 4)."""
    constants, pairs = np.array(chain.along_z), list[int]()
    for k in range(1, chain.n):
        z = constants[k][:3, 2]
        sine = float(np.hypot(z[0], z[1]))
        if not (chain.revolute[k - 1] and chain.revolute[k]) or sine > np.sin(NEARLY_PARALLEL):
            continue
        side = 1.0 if z[2] > 0.0 else -1.0
        turn = np.array([z[1], -z[0], 0.0]) * side  # z × (0, 0, side)
        if sine > 0.0:
            constants[k][:3, :3] = so3.exp(turn / sine * np.arcsin(sine)) @ constants[k][:3, :3]
        pairs.append(k)
    return constants, pairs


def _postures(chain: Chain, count: int, rng: np.random.Generator) -> Array:
    """Postures (count, n) within the limits, and within a turn where there are none."""
    span = np.where(chain.revolute, _TURN, _SLIDE)
    lower, upper = np.maximum(chain.lower, -span), np.minimum(chain.upper, span)
    out: Array = rng.uniform(np.minimum(lower, upper), np.maximum(lower, upper), (count, chain.n))
    return out


def _fit(table: Mapping[str, Any], q: Array, T: Array) -> dict[str, Any]:
    """The table whose numbers bring its poses nearest to T (N, 4, 4) at q (N, n): Gauss-Newton, shortest steps."""
    places = [(i, key) for i in range(len(table["joints"])) for key in _KEYS]
    best, off = copy.deepcopy(dict(table)), _off(table, q, T)
    for _ in range(_ITERATIONS):
        steps = _STEP * np.eye(len(places) + 12)
        J = np.stack([(_off(_moved(best, places, s), q, T) - off).ravel() for s in steps], axis=1) / _STEP
        step: Array = np.asarray(np.linalg.lstsq(J, -off.ravel(), rcond=_WEAKEST)[0], float)
        tried = _moved(best, places, step)
        now = _off(tried, q, T)
        if not np.sum(now**2) < np.sum(off**2):
            break
        best, off = tried, now
        if np.abs(step).max() < 1e-9:
            break
    return best


def _moved(table: Mapping[str, Any], places: list[tuple[int, str]], step: Array) -> dict[str, Any]:
    """The table with its numbers at these places, and twists of its base and tool, changed by a step."""
    out = copy.deepcopy(dict(table))
    for (i, key), value in zip(places, step, strict=False):
        out["joints"][i][key] += float(value)
    for key, twist in (("base", step[-12:-6]), ("tool", step[-6:])):
        T = se3.transform(so3.from_rpy(out[key]["rpy"]), out[key]["xyz"]) @ se3.exp(twist)
        out[key] = {"xyz": [float(v) for v in T[:3, 3]], "rpy": [float(v) for v in so3.to_rpy(T[:3, :3])]}
    return out


def _off(table: Mapping[str, Any], q: Array, T: Array) -> Array:
    """How far the table's tip is off (N, 6): position [m], and rotation times the lever [m]."""
    found = chain_forward(from_table(table), q)
    turn = so3.log(np.swapaxes(T[:, :3, :3], 1, 2) @ found[:, :3, :3])
    return np.concatenate([found[:, :3, 3] - T[:, :3, 3], _LEVER * turn], axis=1)
