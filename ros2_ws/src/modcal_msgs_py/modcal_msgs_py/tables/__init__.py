"""Tables of measurements, as instruments export them: to a recording by a mapping, and to a mapping by what fits.

``convert`` has the keys of a mapping, and does what it states with the columns that ``table`` reads;
``propose`` finds a mapping for a table that has none, and proves it on the data.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_msgs_py.tables.beside import MeasuredArm
    from modcal_msgs_py.tables.convert import import_tables, json_schema, require_mapping
    from modcal_msgs_py.tables.moments import read_track
    from modcal_msgs_py.tables.propose import Proposal, find
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
