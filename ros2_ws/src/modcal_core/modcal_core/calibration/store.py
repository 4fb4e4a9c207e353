"""A calibration as plain data: everything needed to predict, and to refuse a robot it was not made for.

Values are checked where they are read. Names that are free (frames, joints, signals), and the settings of an effect's
shape, which packages may add to, may be any.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration.covariance import Doubt, Uncertainty
from modcal_core.calibration.fit import Fit
from modcal_core.calibration.model import Fallback, Model, curved_joints
from modcal_core.calibration.noise import NoiseModel
from modcal_core.calibration.prediction import TypicalDriver, predict
from modcal_core.calibration.store_parts import (
    arm_to_data,
    carried_from_data,
    centre_from_data,
    effect_from_data,
    effect_to_data,
    inertias_from_data,
    model_from_data,
    model_to_data,
    typical_from_data,
    typical_to_data,
    uncertainty_from_data,
    uncertainty_to_data,
)
from modcal_core.effects import STEPS, DriverLimits, Effect, NominalArm
from modcal_core.errors import BadRobot, BadTable
from modcal_core.files import read_yaml, to_yaml, write_file
from modcal_core.geometry import Array, sealed
from modcal_core.measurements import Samples, Schema, require, told
from modcal_core.measurements.kinds import kinds
from modcal_core.robots import Mechanism

# --- Which keys a calibration.yaml has. A key that nobody reads is a slip of the editor, or of a later release


def _keys(*names: str, **parts: Any) -> Schema:
    return {"properties": {**{name: {} for name in names}, **parts}, "additionalProperties": False}


def _list_of(part: Schema) -> Schema:
    return {"items": part}


_EFFECT = ("family", "place", "direction", "driver", "shape", "values", "std")
_MODEL = _keys(
    "frames", "tool", "leaders", "delta", "base", "tip", "tip_origin",
    instruments=_list_of(_keys("frame", "kind", "constants", "target")),
    joints=_list_of(_keys("name", "type", "origin", "axis", "limits", follows=_keys("joint", "factor", "offset"))),
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
        "geometry_outside", "left_alone_m", "marks", "claim_mm",
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


FORMAT = 1  # of the file
_ASSUMED = 1e-4  # m, rad; what usual instruments scatter by, where a calibration was not made from readings


@dataclass(frozen=True)
class Calibration:
    """Nominal and calibrated model, both with base frames and tool, and the uncertainty of the fit.

    - geometric: the best model with geometry alone, for comparison.
    - seen: smallest and largest joint positions of the recording, (2, n); the model extrapolates outside.
    - parameters: (name, value, standard deviation, unit). rivals: for each effect, others that explain as much.
    - kind, postures, noise: kind of the readings, some recorded postures (k, n), and noise, to plan further stations.
    - uncertainty: covariance of the calibrated model; None where it was not kept.
    - watched: first and last stamp [s], between which effects of time are known. clock: whether stamps are times.
    - geometry_outside: whether geometry alone is used outside the ranges of learned curves.
    - left_alone: RMS [m] of geometry alone on its own recording, used to weigh both models outside; 0 where unknown.
    - ranges: smallest and largest value of each temperature and signal that effects depend on.
    - typical: average size of each effect, used where a recording lacks its driver.
    - scatter: stated deviation of a reading's position [m] and orientation [rad] beyond the noise; 0 where not stated.
    - converged: whether every fit reached its minimum.
    - marks: fingerprints of the samples it was made from; empty where not kept.
    - claim_mm: what the tool's 95th percentile is claimed to be at most [mm]; None where nothing is claimed.
    """

    nominal: Model
    calibrated: Model
    geometric: Model
    seen: Array
    parameters: tuple[tuple[str, float, float, str], ...] = ()
    rivals: tuple[tuple[Effect, ...], ...] = ()
    kind: str = "pose"
    postures: Array = field(default_factory=lambda: np.empty((0, 0)))
    noise: NoiseModel = field(default_factory=lambda: NoiseModel(_ASSUMED, _ASSUMED))
    uncertainty: Uncertainty | None = None
    watched: tuple[float, float] | None = None
    scatter: tuple[float, float] = (0.0, 0.0)
    converged: bool = True
    clock: bool = True
    geometry_outside: bool = False
    left_alone: float = 0.0
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    typical: tuple[TypicalDriver | None, ...] = ()
    marks: tuple[int, ...] = ()
    claim_mm: float | None = None

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """The calibration in a file, or in the folder that a result was saved to. Raises BadTable."""
        file = Path(path) / "calibration.yaml" if Path(path).is_dir() else Path(path)
        if not file.is_file():
            remedy = "give the folder or calibration.yaml that modcal calibrate wrote"
            raise BadTable(str(file), "does not exist", remedy)
        return sealed(from_data(read_yaml(file), str(file)))

    def save(self, path: str | Path) -> Path:
        """Write the calibration to a file, from which :meth:`load` reads it to the last digit; returns its path."""
        write_file(Path(path), to_yaml(to_data(self)))
        return Path(path)

    def predict(self, q: ArrayLike | Samples, frame: str | None = None) -> Array:
        """Poses of the tool (N, 4, 4) [m] in a frame of the instrument, at joint positions q (N, n) [rad, m].

        q: postures of an arm that stands still, whose last direction of motion is not known; or samples, which say
        more: temperatures, efforts, times, and the frame. frame: one of ``frames``; None: the first. Raises
        MissingDriver where an effect depends on what is not given, and BadTable for an unknown frame.
        """
        model = replace(self.calibrated, fallback=self.fallback(self.calibrated, self.geometric))
        return predict(model, self.nominal.chain, self.driver_limits, q, frame)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the instruments' frames."""
        return self.calibrated.frames

    @property
    def T_frame_base(self) -> Mapping[str, Array]:
        """Pose of the robot's base in each frame, (4, 4) [m], by the frame's name."""
        return dict(zip(self.frames, self.calibrated.T_frame_base, strict=True))

    @property
    def T_tip_tool(self) -> Array:
        """Pose of what the instruments see, in the tip, (4, 4) [m]."""
        return self.calibrated.T_tip_tool

    def with_scatter(self, samples: Samples) -> Samples:
        """The samples; those without a standard deviation of their own get the usual one of this calibration."""
        position, rotation = (
            np.where(np.isfinite(own), own, typical)
            for own, typical in zip((samples.sigma_position, samples.sigma_rotation), self.scatter, strict=True)
        )
        return replace(samples, sigma_position=position, sigma_rotation=rotation)

    @property
    def robot(self) -> str:
        """Fingerprint of the nominal kinematics."""
        return fingerprint(self.nominal.chain)

    def fallback(self, model: Model, alone: Model) -> Fallback | None:
        """What counts outside the joint ranges that were seen, of a model and geometry alone with the same frames."""
        curved = curved_joints(model.effects, self.nominal.chain.names)
        doubt = None if self.geometry_outside else self._doubt
        if not curved.any() or not (self.geometry_outside or doubt):
            return None
        return Fallback(alone.with_effects(()), self.seen[0], self.seen[1], curved, doubt)

    @property
    def _doubt(self) -> Doubt | None:
        """How much the full model should be doubted where it was not seen; None where that was not kept."""
        if self.uncertainty is None or not self.left_alone > 0.0:
            return None
        arm = replace(self.calibrated.arm or NominalArm(self.nominal.chain), limits=self.driver_limits)
        return Doubt(replace(self.calibrated, arm=arm, fallback=None), self.uncertainty, self.left_alone**2)

    @property
    def driver_limits(self) -> DriverLimits:
        """Where the drivers of its effects stop; an order of rows, after what was moved."""
        watched = self.watched
        if watched is not None and not self.clock:
            moved = [e.shape.settings["at"] for e in self.calibrated.effects if e.shape.kind in STEPS]
            watched = max((watched[0], *moved)), watched[1]
        return DriverLimits(watched, self.clock, self.ranges)

    def typical_of(self, effect: int) -> TypicalDriver | None:
        """What the effect with this number was on average, where that was kept."""
        return self.typical[effect] if effect < len(self.typical) else None

    def rivals_of(self, effect: int) -> tuple[Effect, ...]:
        """Others that explain as much as the effect with this number."""
        return self.rivals[effect] if effect < len(self.rivals) else ()

    def require_robot(self, chain: Mechanism) -> None:
        """Raises BadRobot unless the chain is the nominal one this calibration was made for."""
        if chain.names != self.nominal.chain.names:
            said = f"this robot has {', '.join(chain.names)}"
            remedy = "use the calibration of this robot, or --base and --tip of the one it was made for"
            raise BadRobot(f"calibration of joints {', '.join(self.nominal.chain.names)}", said, remedy)
        if fingerprint(chain) != self.robot:
            said = f"this description is robot {fingerprint(chain)}: same joints, other nominal kinematics"
            remedy = "use the URDF it was made from, or calibrate again"
            raise BadRobot(f"calibration of robot {self.robot}", said, remedy)


def fingerprint(chain: Mechanism) -> str:
    """Sixteen hexadecimal digits that change when joint names or nominal kinematics (to 1 nm, 1 nrad) do."""
    digits = hashlib.sha256("|".join(chain.names).encode())
    digits.update(chain.digits())
    return digits.hexdigest()[:16]


def parameter_table(fit: Fit) -> tuple[tuple[str, float, float, str], ...]:
    """(name, value, standard deviation, unit) of every parameter of a fit."""
    return tuple(
        (p.name, float(v), float(s), p.unit) for p, v, s in zip(fit.parameters, fit.values, fit.std, strict=True)
    )


def to_data(calibration: Calibration) -> dict[str, Any]:
    """The calibration as nested dictionaries, lists, strings and floats; floats keep every digit."""
    return {
        "modcal_calibration": FORMAT,
        "robot": calibration.robot,
        "nominal": model_to_data(calibration.nominal),
        "calibrated": model_to_data(calibration.calibrated),
        "geometric": model_to_data(calibration.geometric),
        "seen": {
            name: [float(low), float(high)]
            for name, low, high in zip(calibration.nominal.chain.names, *calibration.seen, strict=True)
        },
        "parameters": [
            {"name": name, "value": value, "std": std, "unit": unit}
            for name, value, std, unit in calibration.parameters
        ],
        "effects": [
            {
                **effect_to_data(effect),
                "rivals": [effect_to_data(r) for r in calibration.rivals_of(i)],
                **typical_to_data(calibration.typical_of(i)),
            }
            for i, effect in enumerate(calibration.calibrated.effects)
        ],
        "recorded": {
            "kind": calibration.kind,
            "spread": [calibration.noise.position, calibration.noise.rotation],
            "scatter": np.array(calibration.scatter).tolist(),
            "converged": calibration.converged,
            **({"spread_of": dict(calibration.noise.others)} if calibration.noise.others else {}),
            "postures": calibration.postures.tolist(),
            **({"stamps": np.array(calibration.watched).tolist()} if calibration.watched else {}),
            **({} if calibration.clock else {"clock": False}),
            **({"geometry_outside": True} if calibration.geometry_outside else {}),
            **({"left_alone_m": calibration.left_alone} if calibration.left_alone > 0.0 else {}),
            **({"marks": list(calibration.marks)} if calibration.marks else {}),
            **({} if calibration.claim_mm is None else {"claim_mm": float(calibration.claim_mm)}),
            **({"ranges": {n: [float(a), float(b)] for n, (a, b) in r.items()}} if (r := calibration.ranges) else {}),
        },
        **({"uncertainty": uncertainty_to_data(calibration.uncertainty)} if calibration.uncertainty else {}),
        "arm": arm_to_data(calibration.calibrated.arm),
    }


def from_data(data: Any, source: str = "calibration") -> Calibration:
    """The calibration that :func:`to_data` wrote; raises BadTable, naming the source, for anything else."""
    if not isinstance(data, Mapping) or "modcal_calibration" not in data:
        raise BadTable(source, "is not a modcal calibration", "give the calibration.yaml that modcal calibrate wrote")
    if data["modcal_calibration"] != FORMAT:
        raise BadTable(source, f"format {data['modcal_calibration']}, {FORMAT} is read", "calibrate again")
    require(data, SCHEMA, source, "remove it, or calibrate again")
    try:
        nominal, calibrated = model_from_data(data["nominal"]), model_from_data(data["calibrated"])
        carried = data.get("arm")
        arm = NominalArm(
            nominal.chain,
            inertias_from_data(carried),
            earlier=carried_from_data(carried),
            centre=centre_from_data(carried),
        )
        effects = tuple(effect_from_data(e) for e in data["effects"])
        nominal, calibrated = replace(nominal, arm=arm), replace(calibrated, arm=arm, effects=effects)
        geometric = replace(model_from_data(data["geometric"]), arm=arm)
        seen = np.array([data["seen"][name] for name in nominal.chain.names], dtype=float).T
        recorded = data["recorded"]
        rivals = tuple(tuple(effect_from_data(r) for r in e["rivals"]) for e in data["effects"])
        postures = np.array(recorded["postures"], dtype=float).reshape(-1, nominal.chain.n)
        others = {str(kind): float(x) for kind, x in recorded.get("spread_of", {}).items()}
        noise = NoiseModel(float(recorded["spread"][0]), float(recorded["spread"][1]), others)
        parameters = tuple(
            (str(p["name"]), float(p["value"]), float(p["std"]), str(p["unit"])) for p in data["parameters"]
        )
        known = uncertainty_from_data(data.get("uncertainty"), calibrated)
        alone, converged = (float(recorded["scatter"][0]), float(recorded["scatter"][1])), bool(recorded["converged"])
        clock, outside = bool(recorded.get("clock", True)), bool(recorded.get("geometry_outside", False))
        left_alone = float(recorded.get("left_alone_m", 0.0))
        ranges = {str(n): (float(a), float(b)) for n, (a, b) in recorded.get("ranges", {}).items()}
        marks = tuple(int(mark) for mark in recorded.get("marks", ()))
        claim_mm = float(recorded["claim_mm"]) if "claim_mm" in recorded else None
        typical = tuple(typical_from_data(e.get("usual")) for e in data["effects"])
        first, last = (float(t) for t in recorded["stamps"]) if "stamps" in recorded else (np.nan, np.nan)
        kind = str(recorded["kind"])
        _require_consistent(calibrated, geometric, nominal, seen, parameters, kind)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ArithmeticError) as error:
        raise BadTable(source, f"damaged: {told(error)}", "calibrate again") from error
    except BadRobot as error:
        raise BadTable(source, f"damaged: {error.offender}: {error.limit}", "calibrate again") from error
    watched = (first, last) if np.isfinite([first, last]).all() else None
    return Calibration(
        *(nominal, calibrated, geometric, seen, parameters, rivals, kind, postures, noise, known),
        *(watched, alone, converged, clock, outside, left_alone, ranges, typical, marks, claim_mm),
    )


def _require_consistent(
    calibrated: Model,
    geometric: Model,
    nominal: Model,
    seen: Array,
    parameters: tuple[tuple[str, float, float, str], ...],
    kind: str,
) -> None:
    """Raises ValueError unless the parts of a calibration are of one arm, and all numbers finite."""
    models = {"nominal": nominal, "calibrated": calibrated, "geometric": geometric}
    for name, model in models.items():
        if type(model.chain) is not type(nominal.chain) or model.chain.names != nominal.chain.names:
            raise ValueError(f"{name} belongs to a different arm than nominal")
        if model.frames != nominal.frames:
            raise ValueError(f"{name} has different frames than nominal")
    if not np.isfinite(seen).all() or seen.shape != (2, len(nominal.chain.names)):
        raise ValueError("seen has two finite numbers for each joint")
    if not all(np.isfinite(value) for _, value, _, _ in parameters):
        raise ValueError("a parameter is not finite")
    if kind not in (*kinds(), "same_point", "mixed"):
        raise ValueError(f"readings of kind {kind[:40]} are not known")
