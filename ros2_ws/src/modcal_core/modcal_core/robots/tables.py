"""A chain from a kinematic table of any known convention."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from modcal_core.errors import BadTable, refusing
from modcal_core.robots.chain import Chain
from modcal_core.robots.cpc import from_cpc
from modcal_core.robots.dh import from_dh, from_mdh

_READERS = {"dh": from_dh, "mdh": from_mdh, "cpc": from_cpc}


@refusing
def from_table(table: Mapping[str, Any]) -> Chain:
    """The chain of a DH, modified DH or CPC table, which must say its ``convention``. Raises BadTable."""
    convention = table.get("convention") if isinstance(table, Mapping) else None
    if convention not in _READERS:
        said = "has no key 'convention'" if convention is None else f"convention {convention!r} is unknown"
        raise BadTable("kinematic table", said, f"write convention: {', '.join(_READERS)}")
    return _READERS[convention](table)
