"""The modcal command: one file per verb, gathered in main."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.cli.inputs import described, numbers_by_joint
    from modcal_nodes.cli.main import run
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
