"""A calibration as plain data: everything needed to predict, and to refuse a robot it was not made for.

Values are checked where they are read. Names that are free (frames, joints, signals), and the settings of an effect's
shape, which packages may add to, may be any.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration.covariance import Doubt, Uncertainty
from modcal_core.calibration.fit import Fit
from modcal_core.calibration.model import Fallback, Model, curved_joints
from modcal_core.calibration.noise import NoiseModel
from modcal_core.calibration.prediction import TypicalDriver, predict, signals_of
from modcal_core.effects import STEPS, Carried, DriverLimits, Effect, NominalArm, require_known, undelayed
from modcal_core.errors import BadRobot, BadTable
from modcal_core.files import read_yaml, to_yaml, write_file
from modcal_core.geometry import Array, sealed
from modcal_core.measurements import Samples, told
from modcal_core.measurements.kinds import kinds
from modcal_core.plain import PlainReader, to_plain
from modcal_core.robots import Chain, Delta, Inertias, Mechanism, delta_from_data, delta_to_data

FORMAT = 2  # of the file
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
        """What counts outside the ranges that were seen, of a model and geometry alone with the same frames."""
        curved = curved_joints(model.effects, self.nominal.chain.names)
        doubt = None if self.geometry_outside else self._doubt
        if not (self.geometry_outside or doubt):
            curved = np.zeros_like(curved)
        signals = {
            (part, lag): self.ranges[undelayed(part, lag)]
            for part, lag in signals_of(model.effects)
            if undelayed(part, lag) in self.ranges
        }
        if not curved.any() and not signals:
            return None
        return Fallback(alone.with_effects(()), self.seen[0], self.seen[1], curved, doubt, signals)

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


# --- As plain data: the three models without the arm that loads are computed from, and that arm once


@dataclass(frozen=True)
class _ArmOfFile:
    inertias: Inertias | None = None
    earlier: Carried | None = None
    centre: Array | None = None
    tool: Array | None = None

    def of(self, chain: Mechanism) -> NominalArm:
        return NominalArm(chain, self.inertias, None, self.earlier, self.centre, self.tool)


def _with_models(calibration: Calibration, change: Callable[[Model], Model]) -> Calibration:
    nominal, calibrated, geometric = map(change, (calibration.nominal, calibration.calibrated, calibration.geometric))
    return replace(calibration, nominal=nominal, calibrated=calibrated, geometric=geometric)


_STEP = {"origin": (4, 4), "axis": (3,)}  # shapes of a joint on the way to a body


def to_data(calibration: Calibration) -> dict[str, Any]:
    """The calibration as nested dictionaries, lists, strings and floats; floats keep every digit."""
    bare = _with_models(calibration, lambda model: replace(model, arm=None, fallback=None))
    arm = calibration.calibrated.arm or NominalArm(calibration.nominal.chain)
    return {
        "modcal_calibration": FORMAT,
        "robot": calibration.robot,
        **to_plain(bare, {Delta: delta_to_data, Uncertainty: _packed}),
        "arm": to_plain(_ArmOfFile(arm.inertias, arm.earlier, arm.centre, arm.tool)),
    }


def _packed(known: Uncertainty) -> dict[str, Any]:
    """The rows of the covariance up to the diagonal, a line of text each: a list of hundreds of thousands of numbers
    takes YAML ten times as long.
    """
    rows = known.covariance.tolist()
    text = "".join(f"{' '.join(map(repr, row[: i + 1]))}\n" for i, row in enumerate(rows))
    return {"parameters": to_plain(known.parameters), "covariance": text}


def from_data(data: Any, source: str = "calibration") -> Calibration:
    """The calibration that :func:`to_data` wrote; raises BadTable, naming the source, for anything else."""
    if not isinstance(data, Mapping) or "modcal_calibration" not in data:
        raise BadTable(source, "is not a modcal calibration", "give the calibration.yaml that modcal calibrate wrote")
    if data["modcal_calibration"] != FORMAT:
        raise BadTable(source, f"format {data['modcal_calibration']}, {FORMAT} is read", "calibrate again")
    own = {Mechanism: _mechanism, Effect: _effect, Uncertainty: _unpacked}
    reader = PlainReader("remove it, or calibrate again", own, frozenset({"lower", "upper", "prior_std"}))
    try:
        read = Calibration(**reader.fields_of(Calibration, data, source, ("modcal_calibration", "robot", "arm")))
        arm = reader.read(_ArmOfFile, data.get("arm", {}), f"{source}: arm").of(read.nominal.chain)
        read = _with_models(read, lambda model: replace(model, arm=arm))
        _require_consistent(read)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ArithmeticError) as error:
        raise BadTable(source, f"damaged: {told(error)}", "calibrate again") from error
    except BadRobot as error:
        raise BadTable(source, f"damaged: {error.offender}: {error.limit}", "calibrate again") from error
    return read


def _mechanism(reader: PlainReader, data: Any, place: str) -> Mechanism:
    if isinstance(data, Mapping) and "modcal_delta" in data:
        return delta_from_data(data, place)
    given = reader.fields_of(Chain, data, place)
    beside = {name: given.pop(name) for name in ("links", "follows") if name in given}
    return replace(Chain.build(**given), **beside)


def _effect(reader: PlainReader, data: Any, place: str) -> Effect:
    effect = Effect(**reader.fields_of(Effect, data, place))
    require_known(effect)
    missing = [name for name in effect.refined if name not in effect.shape.settings]
    if missing or len(effect.values) <= len(effect.refined) or effect.std.shape != effect.values.shape:
        raise ValueError(f"effect {effect.family[:40]} has {len(effect.values)} values, or lacks {', '.join(missing)}")
    return effect


def _unpacked(reader: PlainReader, data: Any, place: str) -> Uncertainty:
    rows = [[float(x) for x in line.split()] for line in data["covariance"].splitlines()]
    if [len(row) for row in rows] != list(range(1, len(rows) + 1)):
        raise ValueError(f"a covariance of {len(rows)} values has rows of 1 to {len(rows)} numbers")
    full = [[rows[max(i, j)][min(i, j)] for j in range(len(rows))] for i in range(len(rows))]
    return Uncertainty(**reader.fields_of(Uncertainty, {**data, "covariance": full}, place))


def _require_consistent(read: Calibration) -> None:
    """Raises ValueError unless the parts of a calibration are of one arm and of the sizes that belong together."""
    first = read.nominal
    n = len(first.chain.names)
    values = sum(len(e.values) for e in read.calibrated.effects)
    wanted: list[tuple[str, Array, tuple[int, ...]]] = [("seen", read.seen, (2, n))]
    wanted += [("postures", read.postures, (len(read.postures), n))] if len(read.postures) else []
    for name in ("nominal", "calibrated", "geometric"):
        model: Model = getattr(read, name)
        if type(model.chain) is not type(first.chain) or model.chain.names != first.chain.names:
            raise ValueError(f"{name} belongs to a different arm than nominal")
        if model.frames != first.frames:
            raise ValueError(f"{name} has different frames than nominal")
        wanted += [
            (f"{name}: T_frame_base", model.T_frame_base, (len(model.frames), 4, 4)),
            (f"{name}: T_tip_tool", model.T_tip_tool, (4, 4)),
        ]
        if isinstance(chain := model.chain, Chain):
            wanted += [(f"{name}: axes", chain.axes, (n, 3))]
            wanted += [(f"{name}: {k}", getattr(chain, k), (n,)) for k in ("revolute", "lower", "upper")]
            if any(not 0 <= f.joint < n for f in chain.follows):
                raise ValueError(f"{name}: a joint that follows is none of the chain's")
        for one in model.instruments:
            if one.kind not in kinds() or one.frame not in model.frames:
                raise ValueError(f"no instrument of kind {one.kind[:40]} in frame {one.frame[:40]}")
            wanted += [(f"{name}: constants of {one.kind}", one.values, one.of_kind.start().shape)]
            wanted += [] if one.target is None else [(f"{name}: target of {one.kind}", one.target, (3,))]
    if (arm := read.calibrated.arm) is not None and (bodies := arm.inertias) is not None:
        wanted += [("mass", bodies.mass, (n,)), ("com", bodies.com, (n, 3)), ("inertia", bodies.inertia, (n, 3, 3))]
        wanted += [("down", bodies.down, (3,)), *(("com", hung.com, (3,)) for hung in bodies.branches)]
        wanted += [(k, getattr(s, k), d) for b in bodies.branches for s in b.steps for k, d in _STEP.items()]
        if any(not 0 <= b.carrier < n for b in bodies.branches):
            raise ValueError("bodies beside the chain hang on none of its joints")
        if (held := bodies.held) is not None and not 0 < held.joints < n:
            raise ValueError("the arm is held behind none of its joints")
    wanted += [] if arm is None or arm.tool is None else [("tool", arm.tool, (3,))]
    if arm is not None and (before := arm.earlier) is not None:
        k = len(before.until)
        wanted += [("mass earlier", before.mass, (k,)), ("moment earlier", before.moment, (k, 3))]
        if list(before.until) != sorted(before.until):
            raise ValueError("what was carried earlier is not in order of time")
    if (known := read.uncertainty) is not None:
        size = len(known.parameters) + values
        wanted += [("covariance", known.covariance, (size, size))]
        if (np.diag(known.covariance) < 0.0).any():
            raise ValueError("a covariance has no negative variance")
    for name, array, shape in wanted:
        if array.shape != shape:
            raise ValueError(f"{name} has the shape {array.shape}, {shape} is needed")
    if read.kind not in (*kinds(), "same_point", "mixed"):
        raise ValueError(f"readings of kind {read.kind[:40]} are not known")
