"""Joint types, one a file: each is all of its type, and is registered as a package's own is (:mod:`.registry`)."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.articulation.models.parametric import ParametricModel, ShapeParameter
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
