"""Numbers that somebody gives joint by joint, by name: ``elbow_joint=1.2``."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from modcal_core.errors import BadTable


def numbers_by_joint(said: Iterable[str], option: str) -> dict[str, float]:
    """JOINT=NUMBER texts as numbers by joint; empty ones are passed over. Raises BadTable, naming the option."""
    out: dict[str, float] = {}
    for text in filter(None, said):
        name, _, number = text.partition("=")
        try:
            out[name] = float(number)
        except ValueError:
            out[name] = np.nan
        if not name or not np.isfinite(out[name]):
            raise BadTable(f"{option} {text}", "is not JOINT=NUMBER", "write it as elbow_joint=1.2")
    return out
