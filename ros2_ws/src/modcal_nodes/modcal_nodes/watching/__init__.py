"""Parts of ``modcal watch``: what it has received, what it listens to, and how that is shown."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.watching.snapshot import Changes, Heard, Listener, table
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
