"""Which keys a calibration.yaml has. A key that nobody reads is a slip of the editor, or of a later release.

Values are checked where they are read (:mod:`store`). Names that are free (frames, joints, signals), and the
settings of an effect's shape, which packages may add to, may be any.
"""

from __future__ import annotations

from typing import Any

from modcal_core.measurements.schema import Schema


def _keys(*names: str, **parts: Any) -> Schema:
    return {"properties": {**{name: {} for name in names}, **parts}, "additionalProperties": False}


def _list_of(part: Schema) -> Schema:
    return {"items": part}


_EFFECT = ("family", "place", "direction", "driver", "shape", "values", "std")
_MODEL = _keys(
    "frames", "tool", "leaders", "delta", "base", "tip", "tip_origin",
    instruments=_list_of(_keys("frame", "kind", "constants", "target")),
    joints=_list_of(_keys("name", "type", "origin", "axis", "limits")),
)  # fmt: skip
SCHEMA: Schema = _keys(
    "modcal_calibration", "robot", "seen",
    nominal=_MODEL,
    calibrated=_MODEL,
    geometric=_MODEL,
    parameters=_list_of(_keys("name", "value", "std", "unit")),
    effects=_list_of(_keys(*_EFFECT, rivals=_list_of(_keys(*_EFFECT)), usual=_keys("mean", "cost_m2"))),
    recorded=_keys(
        "kind", "spread", "scatter", "converged", "spread_of", "postures", "stamps", "clock", "ranges",
        "geometry_outside", "left_alone_m", "marks",
    ),
    uncertainty=_keys(
        "covariance",
        parameters=_list_of(_keys("name", "place", "direction", "frame", "prior", "instrument", "unit")),
    ),
    arm=_keys(
        "mass", "com", "down", "centre",
        earlier=_keys("until", "mass", "moment"),
        held=_keys("joints", "mass", "com"),
        branches=_list_of(
            _keys("carrier", "mass", "com", steps=_list_of(_keys("origin", "axis", "turns", "joint", "motion")))
        ),
    ),
)  # fmt: skip
