"""What can move on a serial arm between two recordings, in terms of a fit's minimal parameters.

A minimal set leaves directions out, since others make the same motion: a base that sinks is written as a shift of the
second joint. So each thing that can move is a column of that set: the combination that moves the tool alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.parameters import ModelParameter, direction_names
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.geometry.twists import DIRECTIONS
from modcal_core.robots.chain import Chain

ZERO = "zero"


@dataclass(frozen=True)
class Movable:
    """place: base, tool, or a joint's name. directions: names of k shifts [m] and turns [rad], plain axes of the place;
    "zero" turns a joint about its own axis. columns: of the minimal parameters, (P, k).
    """

    place: str
    directions: tuple[str, ...]
    columns: Array

    @property
    def name(self) -> str:
        """Name as text, such as "base z"."""
        return f"{self.place} {' '.join(self.directions)}"

    @property
    def units(self) -> tuple[str, ...]:
        """m or rad, of each direction."""
        return tuple("rad" if d == ZERO or d.startswith("r") else "m" for d in self.directions)

    @property
    def of_arm(self) -> bool:
        """Whether it is a joint."""
        return self.place not in ("base", "tool")

    @property
    def of_tool(self) -> bool:
        """Whether it is the tool."""
        return self.place == "tool"


def movables(
    chain: Chain,
    frames: Sequence[str],
    rows: Callable[[Sequence[ModelParameter]], Array],
    parameters: Sequence[ModelParameter],
) -> list[Movable]:
    """Base and tool (each direction, all shifts, all six), then each direction of each further joint.

    rows: derivatives of the readings by parameters, (P, m). parameters: the minimal set that the columns are of.
    """
    n = chain.n
    bases = [[ModelParameter("", 0, d, f) for d in range(6)] for f in range(len(frames))]
    places = [[ModelParameter("", k, d) for d in range(6)] for k in range(1, n + 1)]
    wanted = [p for six in (*bases, *places) for p in six]
    J = rows([*parameters, *wanted])
    P = len(parameters)
    M = np.linalg.lstsq(J[:P].T, J[P:].T, rcond=1e-10)[0]  # (P, 6 F + 6 n)
    six: Array = np.asarray(M, dtype=np.float64).reshape(P, -1, 6)
    F = len(frames)
    # place 0 is the first joint, aligned; people speak of the base link's own axes
    before: Array = np.einsum("pfd->pd", six[:, :F])
    base: Array = np.asarray(before @ se3.adjoint(se3.inverse(chain.T_base_root)), dtype=np.float64)
    out = [*_body("base", base), *_body("tool", six[:, F + n - 1])]
    for k in range(1, n):
        names = list(direction_names(chain.joint_basis[k]))
        names[5 if chain.revolute[k] else 2] = ZERO
        signs = _signs(chain.joint_basis[k])
        # a joint's zero is positive along its axis, whichever way that points
        signs[[2, 5]] = 1.0
        columns = six[:, F + k - 1] * signs
        out += [Movable(chain.names[k], (names[d],), columns[:, [d]]) for d in range(6)]
    return out


def _body(place: str, columns: Array) -> list[Movable]:
    """Each direction of a body by itself, its shifts together, and all six."""
    sets = [[d] for d in range(6)] + [[0, 1, 2], list(range(6))]
    return [Movable(place, tuple(DIRECTIONS[d] for d in s), columns[:, s]) for s in sets]


def _signs(basis: Array) -> Array:
    """Whether each aligned direction points along the plain axis that it is named after, (6,)."""
    largest = np.abs(basis).argmax(axis=0)
    signs = np.sign(basis[largest, range(3)])
    return np.r_[signs, signs]
