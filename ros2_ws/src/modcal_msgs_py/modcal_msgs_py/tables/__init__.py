"""Tables of measurements, as instruments export them: to a recording by a mapping, and to a mapping by what fits.

``convert`` does what a mapping states (``schema`` has its keys) with the columns that ``sheet`` and ``table`` read;
``propose`` finds a mapping for a table that has none, and proves it on the data.
"""

from __future__ import annotations

from modcal_msgs_py.tables.convert import Tables, import_tables, read_tables

__all__ = ["Tables", "import_tables", "read_tables"]
