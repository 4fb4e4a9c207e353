"""The complete and parametrically continuous model (Zhuang, Roth & Hamano 1992): DH without its jump.

A link is ``R(b) Tx(l_x) Ty(l_y)``: the shortest turn that takes z to the next joint's axis b = (b_x, b_y, b_z), then a
shift across that axis. b_x and b_y are two numbers that pass smoothly through zero where axes are parallel. Base and tool
links have a turn β about z and a shift l_z besides, which makes the model complete. Where the next axis points backwards
the joint is counted the other way round (direction −1), so that b_z never comes near −1, where R(b) has its only gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain


@dataclass(frozen=True)
class CpcTable:
    """links: b_x, b_y, β [rad], l_x, l_y, l_z [m] of links 0 … n, (n + 1, 6). β is zero but at the tool, l_z but at the
    tool and before a sliding joint. direction: ±1 of each joint's motion and, last, of the tool, (n + 1,); a tool of
    direction −1 is turned by half a turn about its x axis.
    """

    names: tuple[str, ...]
    links: Array
    direction: Array
    revolute: np.ndarray


_BACK = np.diag([1.0, -1.0, -1.0, 1.0])  # half a turn about x; its own inverse


def axis_rotation(b: ArrayLike) -> Array:
    """R(b) (3, 3): the shortest rotation that takes z to the unit vector with these x and y (2,) and z ≥ 0."""
    x, y = np.asarray(b, dtype=float)
    z = np.sqrt(max(1.0 - x * x - y * y, 0.0))
    k = 1.0 / (1.0 + z)
    return np.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])


def to_cpc(chain: Chain) -> CpcTable:
    """The CPC table of a chain, with the same kinematics to rounding; every chain has one."""
    links = np.zeros((chain.n + 1, 6))
    direction = np.ones(chain.n + 1)
    passed = np.eye(4)  # what the joint before lets through: it belongs to the link behind
    for k, M in enumerate(chain.along_z):
        X = passed @ M
        back = np.eye(4)
        if X[2, 2] < 0.0:
            back, direction[k] = _BACK, -1.0
        X = X @ back
        Rb = axis_rotation(X[:2, 2])
        turn = Rb.T @ X[:3, :3]
        beta = float(np.arctan2(turn[1, 0], turn[0, 0]))
        shift = Rb.T @ X[:3, 3]
        links[k] = [*X[:2, 2], beta, *shift]
        if k < chain.n:
            links[k, 2] = 0.0
            through = np.zeros(3)
            if chain.revolute[k]:
                links[k, 5], through = 0.0, np.array([0.0, 0.0, shift[2]])
            passed = se3.transform(so3.exp([0.0, 0.0, beta]), through) @ back
    return CpcTable(chain.names, links, direction, chain.revolute)


def from_cpc(table: CpcTable) -> Chain:
    """The chain of a table. Raises BadTable for a wrong shape, or an axis of more than unit length."""
    links, n = np.asarray(table.links, dtype=float), len(table.names)
    if links.shape != (n + 1, 6) or len(table.direction) != n + 1 or not np.isfinite(links).all():
        raise BadTable("CPC table", f"needs {n + 1} links of 6 finite numbers", "give b_x, b_y, β, l_x, l_y, l_z for each")
    if (np.hypot(links[:, 0], links[:, 1]) > 1.0 + 1e-12).any():
        raise BadTable("CPC table", "an axis has b_x² + b_y² above 1", "give the x and y of unit vectors")
    origins = np.tile(np.eye(4), (n + 1, 1, 1))
    for k, (bx, by, beta, *shift) in enumerate(links):
        origins[k] = se3.transform(axis_rotation([bx, by])) @ se3.transform(so3.exp([0.0, 0.0, beta]), shift)
    if table.direction[n] < 0.0:
        origins[n] = origins[n] @ _BACK
    axes = np.c_[np.zeros((n, 2)), table.direction[:n]]
    return Chain.build(table.names, origins, axes, table.revolute)
