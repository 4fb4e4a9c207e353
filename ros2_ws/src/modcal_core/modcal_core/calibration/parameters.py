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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import numpy as np

from modcal_core.calibration.instruments import Instrument
from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.geometry.twists import DIRECTIONS
from modcal_core.measurements.kinds.kind import ORIGIN
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.robots import delta as deltas
from modcal_core.robots.delta import Delta
from modcal_core.robots.mechanism import Mechanism, is_serial_arm

# How far an arm is expected to be from its drawing, and base and tool from where the drawing's arm would put them.
# It only decides directions that the data hardly shows, so that they cannot drift into large, cancelling values.
PRIOR_LENGTH_M = 0.01
PRIOR_ANGLE_RAD = 0.02
_WIDE = 5.0

INSTRUMENT = -2  # the place of an instrument's own constants
_UNITS = ("m", "m", "m", "rad", "rad", "rad", *deltas.UNITS)


@dataclass(frozen=True)
class ModelParameter:
    """One direction of error at one place.

    name: "frame NAME/rx", "JOINT/x" or "tool/z". place: 0 … n. direction: 0 … 5, index into x y z rx ry rz of the
    place's frame with the joint's axis along z; from 6 on a constant of a Delta's arm. frame: index of the frame at
    place 0, else -1. prior_std: in its unit, inf where nothing at all is expected. seen_std: what it must be known
    better than to count as observed; NaN: the prior's. instrument: index of the instrument
    that it is a constant of (place INSTRUMENT, direction the constant's number, own_unit its unit), else -1.
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
                f"{name}/{constant}", chain.first_place + i, len(DIRECTIONS) + row, prior_std=_prior(6 + row)
            )
            for row, constant in enumerate(deltas.CONSTANTS)
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
    return PRIOR_LENGTH_M if _UNITS[direction] == "m" else PRIOR_ANGLE_RAD


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


def drop_fixed(parameters: Sequence[ModelParameter], patterns: Sequence[str]) -> list[ModelParameter]:
    """The parameters that no pattern names; raises BadTable for a pattern that names none.

    A pattern is a name such as "elbow_joint/x", a place such as "tool", or has the wildcards of a shell.
    """
    fixed: set[str] = set()
    for pattern in patterns:
        hit = {p.name for p in parameters if fnmatchcase(p.name, pattern) or p.name.rpartition("/")[0] == pattern}
        if not hit:
            places = sorted({p.name.rpartition("/")[0] for p in parameters})
            raise BadTable(f"fixed parameter '{pattern}'", "matches no parameter", f"places are {', '.join(places)}")
        fixed |= hit
    return [p for p in parameters if p.name not in fixed]


def with_prior(parameters: Sequence[ModelParameter], scale: float) -> list[ModelParameter]:
    """The same parameters with every finite prior standard deviation multiplied."""
    return [replace(p, prior_std=p.prior_std * scale) for p in parameters]
