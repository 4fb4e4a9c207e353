"""Errors as small motions at places: what an effect is, what drives it, and the families that effects come in."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.effects.drivers import Carried, DriverLimits, Drivers, NominalArm, drivers_at, public_driver
    from modcal_core.effects.drivers import remembered
    from modcal_core.effects.effect import ACROSS, ALL, AXIS, EXPECTED_ANGLE, EXPECTED_LENGTH, JOINTS, LENGTH, PAIRS
    from modcal_core.effects.effect import RADIAL, READING, RODS, SHIFT, STEPS, Effect, Knots, Term, all_columns
    from modcal_core.effects.effect import columns, is_large_move, is_move, is_turned, knots_of, motion, place_index
    from modcal_core.effects.effect import plain_columns, prior_stds, shape_columns
    from modcal_core.effects.family import FREE, USUAL, ReportEntry, nothing_plainer
    from modcal_core.effects.registry import candidates, claimed, companionless, complexity, family_named, require_known
    from modcal_core.effects.registry import with_companions
    from modcal_core.effects.shapes import PERIODIC, Shape, periodic
    from modcal_core.effects.sizes import AxisCurves, Quantity, Sizes, component_names, curve, curve_sizes, unit_of
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["ACROSS", "ALL", "AXIS", "EXPECTED_ANGLE", "EXPECTED_LENGTH", "FREE", "JOINTS", "LENGTH", "PAIRS"]
__all__ += ["PERIODIC", "RADIAL", "READING", "RODS", "SHIFT", "STEPS", "USUAL", "AxisCurves", "Carried"]
__all__ += ["DriverLimits", "Drivers", "Effect", "Knots", "NominalArm", "Quantity", "ReportEntry", "Shape", "Sizes"]
__all__ += ["Term", "all_columns", "candidates", "claimed", "columns", "companionless", "complexity"]
__all__ += ["component_names", "curve", "curve_sizes", "drivers_at", "family_named", "is_large_move", "is_move"]
__all__ += ["is_turned", "knots_of", "motion", "nothing_plainer", "periodic", "place_index", "plain_columns"]
__all__ += ["prior_stds", "public_driver", "remembered", "require_known", "shape_columns", "unit_of"]
__all__ += ["with_companions"]
