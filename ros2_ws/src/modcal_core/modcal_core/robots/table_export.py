"""A chain as a table of any convention, with the proof that nothing was lost."""

from __future__ import annotations

from typing import Any

import numpy as np

from modcal_core.errors import BadTable, NotRepresentable
from modcal_core.robots.chain import Chain
from modcal_core.robots.cpc import to_cpc
from modcal_core.robots.dh import to_dh, to_mdh
from modcal_core.robots.kinematics import forward
from modcal_core.robots.tables import from_table

CONVENTIONS = ("cpc", "dh", "mdh")
EXACT = 1e-10  # m, and entries of rotations, by which an exported table may be off
_POSTURES = 64
_SPAN = 3.0  # rad
_SLIDE = 0.5  # m


def to_table(chain: Chain, convention: str, largest_offset: float = 10.0) -> dict[str, Any]:
    """The table of a chain as plain data. Raises NotRepresentable where DH, classical or modified, cannot hold it.

    largest_offset: of a DH row [m]. CPC holds every chain.
    """
    if convention not in CONVENTIONS:
        raise BadTable(f"convention '{convention}'", "is unknown", f"choose {', '.join(CONVENTIONS)}")
    table = {"dh": to_dh, "mdh": to_mdh}[convention](chain, largest_offset) if convention != "cpc" else to_cpc(chain)
    off = loss(chain, table)
    if off > EXACT * max(1.0, largest_offset / 10.0):
        said = f"read back, it is off by {off:.2g}, {EXACT:g} is the limit"
        raise NotRepresentable(f"{convention} table", said, "write a CPC table instead")
    return table


def loss(chain: Chain, table: dict[str, Any]) -> float:
    """The largest difference [m, and of rotations] of the tip's pose between a chain and its table, over postures."""
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (_POSTURES, chain.n)) * np.where(chain.revolute, _SPAN, _SLIDE)
    return float(np.abs(forward(from_table(table), q) - forward(chain, q)).max())
