"""Kinds of reading: one file each, registered in :mod:`modcal_core.measurements.kinds.registry`."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.measurements.kinds.distance import DistanceKind
    from modcal_core.measurements.kinds.kind import KIND_NAMES, ORIGIN, PLANE, POSE_OF_FRAME, Constant, Kind, Scene
    from modcal_core.measurements.kinds.kind import Sight, frame_on_plane, scene_in
    from modcal_core.measurements.kinds.registry import is_direct, kinds
    from modcal_core.measurements.samples import dimensions, indirect_rows
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
