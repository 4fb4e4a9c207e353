"""Rigid-body geometry on plain arrays, batched over any leading axes."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.geometry.descent import Descent, combined, descend
    from modcal_core.geometry.read_only import sealed, view
    from modcal_core.geometry.single import along_screw, crossed, crossed_rows, pose_error, posed, relative
    from modcal_core.geometry.single import rotation_vector, speeds, tool_from, turned
    from modcal_core.geometry.so3 import HAT, Array, cross
    from modcal_core.geometry.twists import DIRECTIONS, error_transform, error_values, local_twists
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
