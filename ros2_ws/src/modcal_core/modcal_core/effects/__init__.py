"""Errors as small motions at places: what an effect is, what drives it, and the families that effects come in."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.effects.drivers import Carried, DriverLimits, Drivers, NominalArm, public_driver
    from modcal_core.effects.drivers import undelayed
    from modcal_core.effects.effect import ACROSS, ALL, AXIS, EXPECTED_ANGLE, EXPECTED_LENGTH, JOINTS, LENGTH, PAIRS
    from modcal_core.effects.effect import RADIAL, READING, RODS, SHIFT, STEPS, ZERO, Effect, Knots, Term, all_columns
    from modcal_core.effects.effect import columns, is_large_move, is_move, is_of_clock, is_turned, knots_of
    from modcal_core.effects.effect import motion, place_index
    from modcal_core.effects.effect import plain_columns, prior_stds, shape_columns, zeros
    from modcal_core.effects.family import FREE, PLAIN, USUAL, Family, ReportEntry, nothing_plainer
    from modcal_core.effects.placements import AS_LIKELY, by_hand, of_readings, one_motion, put_back_first
    from modcal_core.effects.registry import both_signs, candidates, carried_signals, claimed, companionless, complexity
    from modcal_core.effects.registry import family_named, known_families, require_known, with_companions
    from modcal_core.effects.shapes import PERIODIC, Setting, Shape, ShapeKind, periodic
    from modcal_core.effects.sizes import AxisCurves, Quantity, Sizes, component_names, curve, curve_sizes, unit_of
    from modcal_core.effects.sizes import value
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
