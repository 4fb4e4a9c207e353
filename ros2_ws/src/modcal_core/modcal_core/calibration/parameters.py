"""Which small twists a fit may use: named, minimal, and of full rank before any data is seen.

Errors sit at *places*: in front of the arm once for every frame it is watched from (place 0), just before each further
joint (places 1 … n − 1), and at the tool (place n). At a place an error is ``E = Trans(t) Rot(exp ω)``, in the frame of
that place turned so that the joint's axis is z; so a parameter is (place, direction).

Not every direction can be told from the others. A turn about or a shift along a revolute joint's own axis commutes with
its motion: it passes through the joint and is seen again at the next place. A sliding joint lets all shifts and the
turn about its axis through. Keeping only what a joint stops leaves 4 directions at a revolute joint and 2 at a sliding
one, plus 6 at the tool: 4 r + 2 p + 6 in all for a pose reading, which is minimal (Everett & Hsu 1988) and stays so for
parallel axes. Other readings see less, several frames more; rather than a rule for each, the directions are put in a
fixed order of preference, their columns are computed at random postures, and each column that adds nothing to the ones
before it is left out. That depends on the robot and the kinds of reading only, never on the data at hand.

A turn about, or a shift along, a revolute joint's axis can stand before the joint or after it; nothing measures which.
In a file that people read and compare the constants of every joint are kept as close to nominal as they can be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from modcal_core.calibration.model import Instrument, Model
from modcal_core.errors import BadTable
from modcal_core.geometry import DIRECTIONS, Array, se3
from modcal_core.measurements.kinds import ORIGIN, kinds
from modcal_core.robots import Chain, Delta, Mechanism, is_serial_arm
from modcal_core.robots import delta as deltas

# How far an arm is expected to be from its drawing, and base and tool from where the drawing's arm would put them.
# It only decides directions that the data hardly shows, so that they cannot drift into large, cancelling values.
PRIOR_LENGTH_M = 0.01
PRIOR_ANGLE_RAD = 0.02
_PRIORS = {"m": PRIOR_LENGTH_M, "rad": PRIOR_ANGLE_RAD, "1": PRIOR_ANGLE_RAD}  # by unit
_WIDE = 5.0

INSTRUMENT = -2  # the place of an instrument's own constants
_UNITS = ("m", "m", "m", "rad", "rad", "rad")


@dataclass(frozen=True)
class ModelParameter:
    """One direction of error at one place.

    name: "frame NAME/rx", "JOINT/x" or "tool/z". place: 0 … n. direction: 0 … 5, index into x y z rx ry rz of the
    place's frame with the joint's axis along z; from 6 on a constant of a Delta's arm. frame: index of the frame at
    place 0, else -1. prior_std: in its unit, inf where nothing at all is expected. seen_std: what it must be known
    better than to count as observed; NaN: the prior's. instrument: index of the instrument
    that it is a constant of (place INSTRUMENT, direction the constant's number), else -1. own_unit: of a constant.
    """

    name: str
    place: int
    direction: int
    frame: int = -1
    prior_std: float = np.inf
    instrument: int = -1
    own_unit: str = ""
    seen_std: float = np.nan

    @property
    def of_arm(self) -> bool:
        """Whether it changes the arm itself, rather than where its base or tool are."""
        return not self.name.startswith(("frame ", "tool/", "instrument "))

    @property
    def expected(self) -> float:
        """How far an arm, its base or its tool are expected to be from their drawing, in its unit."""
        return self.prior_std if np.isnan(self.seen_std) else self.seen_std

    @property
    def turns(self) -> bool:
        """Whether it is one of the three turns of its place."""
        return self.direction >= 3

    @property
    def unit(self) -> str:
        """m or rad; 1 for a ratio."""
        return self.own_unit or _UNITS[self.direction]


@dataclass(frozen=True)
class View:
    """What the instruments see of the arm through one frame: kind of reading, and whether it is a fixed point."""

    kind: str
    frame: int
    same_point: bool = False


def direction_names(basis: Array) -> tuple[str, ...]:
    """Plain names of the six directions of a joint whose aligned basis has these columns, (3, 3)."""
    largest = np.abs(basis).argmax(axis=0)
    plain = np.allclose(np.abs(basis)[largest, range(3)], 1.0, atol=1e-6)
    axes = ["xyz"[k] for k in largest] if plain else ["u", "v", "w"]
    return (*axes, *("r" + a for a in axes))


def ordered_candidates(
    chain: Mechanism,
    frames: Sequence[str],
    views: Sequence[View],
    instruments: Sequence[Instrument] = (),
    leaders: Sequence[int] = (),
) -> list[ModelParameter]:
    """Every direction, the ones to keep first.

    instruments, leaders: as in the model. Constants of instruments come before the tool, which they may be imitated by.

    What each joint of the arm stops comes first, then the tool, then the frames; the first frame's turn about and shift
    along the first joint come late, for that is the pair every single-frame cell has to give up. Last stand the
    directions that pass through a joint (its zero): they are needed only where base or tool are held fixed.
    """
    out, passing = _of_arm(chain)
    for i, instrument in enumerate(instruments):
        for d, constant in enumerate(instrument.constants):
            name = f"instrument {instrument.frame}/{constant.name}"
            frame = frames.index(instrument.frame)
            out.append(ModelParameter(name, INSTRUMENT, d, frame, constant.prior_std, i, constant.unit))
    orientation_seen = any(v.kind == "pose" for v in views)
    tool = [
        ModelParameter(f"tool/{DIRECTIONS[d]}", chain.tool_place, d, prior_std=_prior(d))
        for d in range(6 if orientation_seen else 3)
    ]
    bases: list[ModelParameter] = []
    led = list(leaders) or list(range(len(frames)))
    of_frame = {f: [v for v in views if led[v.frame] == f] for f in range(len(frames))}
    fixed_point = {f: all(v.same_point or kinds()[v.kind].frame == ORIGIN for v in of_frame[f]) for f in of_frame}
    # what shows positions puts its frame where the drawing's arm would; others may err by far more at first
    wide = {f: 1.0 if any(kinds()[v.kind].direct for v in of_frame[f]) else _WIDE for f in of_frame}
    base = direction_names(chain.joint_basis[0])
    for f in [f for f in (*range(1, len(frames)), 0) if led[f] == f]:
        order = (0, 1, 3, 4, 2, 5) if chain.revolute[0] else (3, 4, 0, 1, 2, 5)
        for d in order:
            if d < 3 or not fixed_point[f]:
                bases.append(ModelParameter(f"frame {frames[f]}/{base[d]}", 0, d, f, wide[f] * _prior(d)))
    # where a Delta's tool hardly turns, its place is the base's, which is then what moves
    return [*out, *(tool + bases if is_serial_arm(chain) else bases + tool), *passing]


def _of_arm(chain: Mechanism) -> tuple[list[ModelParameter], list[ModelParameter]]:
    """What the arm itself may be wrong in, and what of it others can say as well: what passes through joints.

    Of a Delta the latter is one arm's azimuth, for turning all arms is turning the base.
    """
    if isinstance(chain, Delta):
        arms = [
            ModelParameter(
                f"{name}/{constant}",
                chain.first_place + i,
                len(DIRECTIONS) + row,
                prior_std=_PRIORS[unit],
                own_unit=unit,
            )
            for row, (constant, unit) in enumerate(chain.units.items())
            for i, name in enumerate(chain.names[: deltas.ARMS])
        ]
        return arms, [arms.pop(deltas.AZIMUTH * deltas.ARMS)]
    out: list[ModelParameter] = []
    passing: list[ModelParameter] = []
    for k in range(1, chain.n):
        names = direction_names(chain.joint_basis[k])
        stopped = (0, 1, 3, 4) if chain.revolute[k] else (3, 4)
        for d in range(6):
            parameter = ModelParameter(f"{chain.names[k]}/{names[d]}", k, d, prior_std=_prior(d))
            (out if d in stopped else passing).append(parameter)
    return out, passing


def _prior(direction: int) -> float:
    return _PRIORS[_UNITS[direction]]


def independent_columns(J: Array, tolerance: Sequence[float] | float = 1e-7) -> np.ndarray:
    """Indices of the columns of J (m, P) that add something to the ones before them, in order.

    Gram-Schmidt with each column scaled to unit length; a column whose remainder is below the tolerance, of all or of
    each (P,), is dropped.
    """
    J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    basis = np.zeros((J.shape[0], 0))
    least = np.broadcast_to(tolerance, J.shape[1:])
    kept = []
    for j in range(J.shape[1]):
        rest = J[:, j]
        for _ in range(2):  # the second pass removes what rounding left of the first
            rest = rest - basis @ (basis.T @ rest)
        size = np.linalg.norm(rest)
        if size > least[j]:
            kept.append(j)
            basis = np.c_[basis, rest / size]
    return np.array(kept, dtype=int)


def drop_fixed(
    parameters: Sequence[ModelParameter], patterns: Sequence[str], all_there: bool = True
) -> list[ModelParameter]:
    """The parameters that no pattern names; raises BadTable for a pattern that names none, if all should.

    A pattern is a name such as "elbow_joint/x", a place such as "tool", or has the wildcards of a shell.
    """
    fixed: set[str] = set()
    for pattern in patterns:
        hit = {p.name for p in parameters if fnmatchcase(p.name, pattern) or p.name.rpartition("/")[0] == pattern}
        if not hit and all_there:
            places = sorted({p.name.rpartition("/")[0] for p in parameters})
            raise BadTable(f"fixed parameter '{pattern}'", "matches no parameter", f"places are {', '.join(places)}")
        fixed |= hit
    return [p for p in parameters if p.name not in fixed]


def with_prior(parameters: Sequence[ModelParameter], scale: float) -> list[ModelParameter]:
    """The same parameters with every finite prior standard deviation multiplied."""
    return [replace(p, prior_std=p.prior_std * scale) for p in parameters]


# --- The same arm written with the least change to its drawing


def least_change(model: Model, nominal: Mechanism) -> Model:
    """The model, predicting the same, whose chain differs least from the nominal one.

    Its first and last constants are the nominal ones: what they would hold belongs to the base frames and to the tool.
    """
    from scipy.optimize import least_squares  # slow to import

    if not is_serial_arm(nominal):
        return model  # a Delta's constants leave no such freedom
    n = nominal.n
    A = se3.transform(nominal.joint_basis)
    inner = se3.inverse(A[:-1]) @ model.serial.origins[1:n] @ A[1:]
    drawn = se3.inverse(se3.inverse(A[:-1]) @ nominal.origins[1:n] @ A[1:])
    unit = np.array([PRIOR_LENGTH_M] * 3 + [PRIOR_ANGLE_RAD] * 3)

    def change(x: Array) -> Array:
        D = _passing(nominal, x)
        moved = se3.inverse(D[..., :-1, :, :]) @ inner @ D[..., 1:, :, :]
        return np.asarray((se3.log(drawn @ moved) / unit).reshape(*x.shape[:-1], -1))

    x = np.zeros(sum(_sizes(nominal)))
    if n > 1:  # of a single joint nothing lies between base and tool
        x = least_squares(change, x, method="lm").x
    D = _passing(nominal, x)
    origins = np.array(model.serial.origins)
    for k in range(1, n):
        origins[k] = A[k - 1] @ se3.inverse(D[k - 1]) @ inner[k - 1] @ D[k] @ se3.inverse(A[k])
    origins[0], origins[n] = nominal.origins[0], nominal.origins[n]
    before = model.serial.origins[0] @ A[0] @ D[0] @ se3.inverse(nominal.origins[0] @ A[0])
    after = se3.inverse(nominal.origins[n]) @ A[-1] @ se3.inverse(D[-1]) @ se3.inverse(A[-1]) @ model.serial.origins[n]
    return replace(
        model,
        chain=model.serial.with_origins(origins),
        T_frame_base=model.T_frame_base @ before,
        T_tip_tool=after @ model.T_tip_tool,
    )


def passing_directions(chain: Chain, T_tip_tool: Array) -> Array:
    """Deviations at places 1 … n, six each, that together change nothing the tool does, (6 n, passing), to first order.

    One column for each direction that passes through a joint: it is taken from behind the joint, and what it was there
    stands before it; for the first joint that is the base, which has no row. Places are those of
    :mod:`modcal_core.calibration.parameters`.
    """
    n = chain.n
    M = chain.along_z
    out = np.zeros((6 * n, sum(_sizes(chain))))
    column = 0
    for k in range(n):
        behind = M[k + 1] @ T_tip_tool if k == n - 1 else M[k + 1]
        seen = se3.adjoint(se3.inverse(behind))
        for d in (2, 5) if chain.revolute[k] else (0, 1, 2, 5):
            out[6 * k : 6 * k + 6, column] = -seen[:, d]
            if k > 0:
                out[6 * (k - 1) + d, column] = 1.0
            column += 1
    return out


def _sizes(chain: Chain) -> list[int]:
    return [2 if turns else 4 for turns in chain.revolute]


def _passing(chain: Chain, x: Array) -> Array:
    """Motions (…, n, 4, 4) that pass through each joint: shift and turn about z, and all shifts where it slides.

    x: (…, P), in units of what a robot is usually wrong by.
    """
    xi = np.zeros((*x.shape[:-1], chain.n, 6))
    for k, part in enumerate(np.split(x, np.cumsum(_sizes(chain))[:-1], axis=-1)):
        turn = 1 if chain.revolute[k] else 3
        shifts = (2,) if chain.revolute[k] else (0, 1, 2)
        xi[..., k, shifts], xi[..., k, 5] = part[..., :turn] * PRIOR_LENGTH_M, part[..., turn] * PRIOR_ANGLE_RAD
    return se3.exp(xi)
