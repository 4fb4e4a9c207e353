"""More steps: joints mixed by linkages, targets on other links, loads and contacts; motion, sockets, wires, a Delta."""

from __future__ import annotations

import re

import numpy as np
from case import DERIVED, Scene, Step, step
from scipy.spatial.transform import Rotation
from transforms import Of, cols, elastic, let, payload, rows
from workcell import Array, joined

DERIVED |= {
    "links": lambda c: c.arm.frames(c.arm.coordinates(c.q)),  # where (N, n, 3) and how turned (N, n, 3, 3)
}
WIDEST = let(i=lambda c: int(np.argmax(c.arm.range[1] - c.arm.range[0])))  # the joint of the widest range
BY_NAME = rows(lambda c: np.array(sorted(c.rows, key=lambda k: str(k + 1))))  # 1, 10, 100, 101, ...

# --- arrays ----------------------------------------------------------------------------------------------------------


def placed(values: Array, where: Array, others: Of) -> Array:
    """The values, with others at some places."""
    out = np.array(values)
    out[where] = others
    return out


def folded(angles: Array) -> Array:
    """Angles by atan where atan2 is meant."""
    return (angles + 0.5 * np.pi) % np.pi - 0.5 * np.pi


def mirrored(R: Rotation) -> Rotation:
    """Rotations written in a frame whose y points the other way."""
    flip = np.diag([1.0, -1.0, 1.0])
    return Rotation.from_matrix(flip @ R.as_matrix() @ flip)


def mixed(first: int, *rows: list[float]) -> Step:
    """Joints from a number on hold a linear map of their true positions, row by row."""
    return cols(np.s_[first : first + len(rows) or None], lambda c, q: q @ np.array(rows, float).T)


def on_link(c: Scene, k: int) -> tuple[Array, Rotation]:
    """What the instrument sees of a target that sits on a link as the tool does on the flange, (N, 3) and (N,)."""
    (p, R), (stand, eye) = c.links, c.cell.tracker
    turn = Rotation.from_matrix(R[:, k])
    return eye.inv().apply(p[:, k] + turn.apply(c.cell.tool[0]) - stand), eye.inv() * turn * c.cell.tool[1]


def typed(value: float) -> float:
    """A number typed with its first two decimals in each other's place."""
    return float(re.sub(r"\.(.)(.)", r".\2\1", f"{value:.5f}"))


def origin(block: str) -> Array:
    """The place of a joint, by its block of a URDF (3,)."""
    return np.array(re.search(r'<origin[^>]*xyz="([^"]*)"', block)[1].split(), float)  # type: ignore[index]


def summed(values: Array, share: float) -> Array:
    """How many of the values so far were larger than this share of them, counted by sign (N,)."""
    return np.cumsum(np.sign(values) * (np.abs(values) > np.quantile(np.abs(values), share)))


# --- loads and contacts ----------------------------------------------------------------------------------------------


@step
def laden(c: Scene, mass: Of) -> None:
    """An elastic arm at the postures that were drawn, with a payload of its own at each, (N,) [kg]."""
    elastic(6e-4)(c)
    state, (q, again), whole = c.rng.bit_generator.state, c.visited(), None
    for kilograms in np.unique(c.of(mass)):
        c.rng.bit_generator.state = state
        payload(kilograms)(c)
        here = c.observe(q, again, *c.bends).only(np.flatnonzero(c.of(mass) == kilograms))
        whole = here if whole is None else joined(whole, here)
        c.bends.pop()
    c.session, c.bends = whole, []


# --- words -----------------------------------------------------------------------------------------------------------

CARRIED = ("payload", "carrie[sd]", "weight", r"\bload of", "mass at")
UNRELATED = ("do(?:es)? not (?:fit|follow|belong|go with)", "unrelated", "nothing to do with", "random")


def SOME(c: Scene) -> list[str]:
    """Words: the joints that were drawn as ``some``."""
    return [c.names[k] for k in c.some]
