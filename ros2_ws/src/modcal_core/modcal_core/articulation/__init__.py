"""Articulated objects: how a handle moves, learned from poses or points of it, and told from what else it could be."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.articulation.choice import Choice, choose, sound
    from modcal_core.articulation.conventions import require_convention
    from modcal_core.articulation.fit import JointFit
    from modcal_core.articulation.joints import JointModel, PlacedJoint
    from modcal_core.articulation.misfit import NONE
    from modcal_core.articulation.online import Tracker, TrackerSettings, TrackerState
    from modcal_core.articulation.track import FEWEST, StampOrder, Track
    from modcal_core.articulation.urdf import JOINT, describe, frames, read
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
