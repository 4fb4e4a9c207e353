"""The Delta robot: three arms, or carriages on towers, hold a platform by parallelograms; a shaft turns the tool.

Base frame: origin in the middle of the fixed platform, z up; the moving platform hangs below. Arm i stands in the
upright plane at azimuth α_i and turns about the horizontal tangent there: at θ_i = 0 it points outwards, and a positive
θ_i lowers it. The parallelogram keeps the platform's orientation, so its two rods are one rod of length L2_i from the
elbow to the platform's centre, the platform's radius taken off that of the shoulder (dB_i = R_i − r_i). With θ_i = k_i
q_i + q_zero,i the centre p obeys

    |p − C_i| = L2_i,    C_i = Rz(α_i) (dB_i + L1_i cos θ_i, 0, −L1_i sin θ_i),    i = 1, 2, 3,

and the tool stands at ``Trans(p) Rz(φ) T_tip_tool``, φ = k_s q_4 for the telescopic shaft, 0 where there is none. A
linear Delta has a carriage at height h_i = k_i q_i + q_zero,i [m] of tower i, which leans outwards by λ_i in L1's
place:

    C_i = Rz(α_i) (dB_i + h_i sin λ_i, 0, h_i cos λ_i).

Rods of a pair that differ in length by δ, at a spacing of d, tilt the platform: with R its orientation, t_i the tangent
along which the rods of arm i stand apart, u_i the way outwards, r the platform's radius and s_i along the rods,

    s_i · (R t_i − t_i) = ε_i = δ_i / d        |p + (R − 1) r u_i − C_i| = L2_i,

exact but for terms of (d / L2) (δ / d)². ε is no structural parameter: it is an effect, found where the data show it.
The first three are equations for R, the others three spheres about shifted elbows. This remains of the closed chain
with 54 parameters (Vischer and Clavel 1998) once each pair's mean is one rod.

Structural parameters, 24 as in CN114571465B: six constants of each arm (q_zero, k, α, dB, L1, L2), and six of the tool
(x, y, z, rx, ry, rz), whose rz is the zero of the shaft. k_s belongs to the drawing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot, BadTable, refusing
from modcal_core.geometry import DIRECTIONS, Array, cross, se3, so3
from modcal_core.robots.chain import Follower, read_only
from modcal_core.robots.kinematics import Loop
from modcal_core.schema import NUMBER, TEXT, Schema, list_of, mapping_of, record, require, stated

ARMS = 3
CONSTANTS = 6
ZERO, RATIO, AZIMUTH, OFFSET, PROXIMAL, DISTAL = range(CONSTANTS)
LEAN = PROXIMAL  # of a tower
# Names and units of an arm's constants, and of a tower's
_OF_ARM = {"zero": "rad", "ratio": "1", "azimuth": "rad", "offset": "m", "proximal": "m", "distal": "m"}
_OF_TOWER = {"zero": "m", "ratio": "1", "azimuth": "rad", "offset": "m", "lean": "rad", "distal": "m"}
PARAMETERS = ARMS * CONSTANTS + len(DIRECTIONS)
_MAX_LEAN = 1.4  # rad from upright; a rail that lies flat moves the platform sideways alone
_LIMITS = {False: (-0.7, 1.3), True: (-0.5, 0.5)}  # rad of an arm, m of a carriage, where none are stated


@dataclass(frozen=True)
class Delta:
    """A Delta robot. Immutable; arrays are read-only.

    names: joints of arms 1, 2, 3 and, where there is one, of the shaft. constants: of the arms, (6, 3), rows as in
    :attr:`units`: q_zero [rad], k [1], α [rad], dB, L1, L2 [m]. lower, upper: limits of the joints [rad, m], (n,).
    linear: whether carriages slide on towers in place of arms that turn: q_zero is in m, and for L1 stands λ [rad].
    tool: where the drawing puts the tool in the tip, (6,): x y z [m] rx ry rz [rad], as ``Trans Rot(exp)``.
    shaft_ratio: turns of the tool per turn of the shaft's joint, −1 where it counts the other way. platform_radius: of
    the moving platform [m], 0 where nothing states it; it shows only where a platform tilts.
    """

    names: tuple[str, ...]
    constants: Array
    lower: Array
    upper: Array
    tool: Array
    shaft_ratio: float = 1.0
    base: str = "base"
    tip: str = "tip"
    platform_radius: float = 0.0
    linear: bool = False

    closed: ClassVar[bool] = True  # its links form loops, which close only where the platform fits its arms
    first_place: ClassVar[int] = 1  # of the first arm's joint; place 0 is the base, which all arms stand on
    links: ClassVar[tuple[str, ...]] = ()  # a Delta's file names none
    follows: ClassVar[tuple[Follower, ...]] = ()  # no joint follows another

    @classmethod
    def build(
        cls,
        names: Sequence[str],
        offset: ArrayLike,
        proximal: ArrayLike,
        distal: ArrayLike,
        azimuth: ArrayLike = (0.0, 2.0 * np.pi / 3.0, -2.0 * np.pi / 3.0),
        zero: ArrayLike = 0.0,
        ratio: ArrayLike = 1.0,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        tool: ArrayLike = (0.0,) * 6,
        shaft_ratio: float = 1.0,
        base: str = "base",
        tip: str = "tip",
        platform_radius: float = 0.0,
        linear: bool = False,
    ) -> Delta:
        """A Delta from its constants [m, rad], one number for all arms or one each. Raises BadRobot for what cannot be.

        lower, upper: of all joints, in the order of the names. proximal: of a linear one how far towers lean [rad].
        """
        n = len(names)
        if n not in (ARMS, ARMS + 1) or len(set(names)) != n:
            said = "names three arms, and perhaps a shaft, each once"
            raise BadRobot(f"delta with joints {', '.join(names) or 'none'}", f"it {said}", "correct the names")
        rows = [np.broadcast_to(row, ARMS) for row in (zero, ratio, azimuth, offset, proximal, distal)]
        wide, far = usual_limits(n, linear)
        out = cls(
            tuple(names),
            read_only(rows),
            read_only(wide if lower is None else lower),
            read_only(far if upper is None else upper),
            read_only(tool),
            float(shaft_ratio),
            base,
            tip,
            float(platform_radius),
            linear,
        )
        _require_sound(out)
        return out

    @property
    def n(self) -> int:
        """Number of joints: 3, or 4 with a shaft."""
        return len(self.names)

    @property
    def own(self) -> np.ndarray:
        """Which joints follow no other, (n,) bool: all."""
        return np.ones(self.n, bool)

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of these joints."""
        return self.names

    def followed(self, q: Array) -> Array:
        """The positions themselves, as no joint follows another."""
        return q

    @property
    def has_shaft(self) -> bool:
        """Whether a shaft turns the tool."""
        return self.n > ARMS

    @property
    def revolute(self) -> np.ndarray:
        """Whether each joint turns, (n,): all do, but for carriages on towers."""
        return (np.arange(self.n) >= ARMS) | (not self.linear)

    @property
    def units(self) -> Mapping[str, str]:
        """Names of the constants of an arm, in their order, each with its unit."""
        return _OF_TOWER if self.linear else _OF_ARM

    @property
    def tool_place(self) -> int:
        """The place of the tool: base, arms, shaft, tool."""
        return self.n + 1

    @property
    def T_base_root(self) -> Array:
        """Pose (4, 4) in the base at which errors of the whole robot are inserted: the base itself."""
        return np.eye(4)

    @property
    def joint_basis(self) -> Array:
        """Directions x, y, z of the place before each joint, for parameter names, (n, 3, 3)."""
        return np.tile(np.eye(3), (self.n, 1, 1))

    @cached_property
    def T_tip_tool(self) -> Array:
        """Pose of the drawing's tool in the tip, (4, 4) [m]."""
        return read_only(se3.transform(so3.exp(self.tool[3:]), self.tool[:3]))

    @cached_property
    def vector(self) -> Array:
        """The structural parameters X, (24,): q_zero, k, α, dB, L1, L2 of the three arms, then the tool [rad, 1, m]."""
        return read_only(np.r_[self.constants.ravel(), self.tool])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of :attr:`vector`, as reports have them."""
        arms = [f"{name}/{constant}" for constant in self.units for name in self.names[:ARMS]]
        return (*arms, *(f"tool/{d}" for d in DIRECTIONS))

    def with_vector(self, X: ArrayLike) -> Delta:
        """The same robot with other structural parameters (24,)."""
        X = np.asarray(X, dtype=float)
        return replace(self, constants=read_only(X[:-6].reshape(CONSTANTS, ARMS)), tool=read_only(X[-6:]))

    def moved(self, deviation: ArrayLike) -> Delta:
        """The same robot with its arms' constants changed by these amounts, (6, 3)."""
        return replace(self, constants=read_only(self.constants + np.asarray(deviation, dtype=float)))

    def with_limits(self, lower: ArrayLike, upper: ArrayLike) -> Delta:
        """The same robot with other limits of its joints [rad or m], (n,) each."""
        return replace(self, lower=read_only(lower), upper=read_only(upper))

    def with_errors(self, E: Array, constants: Array) -> Delta:
        """The same robot with errors (k, 3) of the constants of its arms, which take up small motions of its places."""
        return self.moved(constants[:ARMS].T)

    def length_direction(self, k: int) -> Array:
        """Unit vector of the link to a shoulder, in the frame of place k, (3,); zero behind the arms."""
        return np.array([1.0, 0.0, 0.0]) if k <= ARMS else np.zeros(3)

    def digits(self) -> bytes:
        """Constants of the arms and the shaft's ratio, to 1 nm and 1 nrad, as bytes."""
        return np.round(np.r_[self.constants.ravel(), self.shaft_ratio] * 1e9).astype("<i8").tobytes()

    def reach(self) -> float:
        """An upper bound on the distance from the base to the tip [m], used to recognise wrong units."""
        ends = np.abs(self.constants[RATIO]) * np.maximum(np.abs(self.lower), np.abs(self.upper))[:ARMS]
        arm = ends + np.abs(self.constants[ZERO]) if self.linear else self.constants[PROXIMAL]
        return float((np.sum(np.abs(self.constants[[OFFSET, DISTAL]]), axis=0) + arm).max())


def usual_limits(joints: int, linear: bool) -> Array:
    """Least and largest positions of so many joints, (2, joints) [rad, m], where none are stated."""
    return np.array([_LIMITS[linear]] * ARMS + [(-np.pi, np.pi)] * (joints - ARMS)).T


def _require_sound(delta: Delta) -> None:
    name = f"delta {', '.join(delta.names)}"
    for what, found in (("limits", delta.lower), ("limits", delta.upper), ("tool", delta.tool)):
        count = 6 if what == "tool" else delta.n
        if found.shape != (count,):
            raise BadRobot(name, f"{what} must be {count} numbers", "correct the file")
    if not all(np.isfinite(a).all() for a in (delta.constants, delta.lower, delta.upper, delta.tool)):
        raise BadRobot(name, "has a constant or limit that is not finite", "correct the file")
    for row in (DISTAL,) if delta.linear else (PROXIMAL, DISTAL):
        for arm, length in zip(delta.names, delta.constants[row], strict=False):
            if not 1e-3 < length < 10.0:
                limit = f"{tuple(delta.units)[row]} length {length:g} m, 0.001 to 10 m is allowed"
                raise BadRobot(f"arm {arm}", limit, "give metres")
    if delta.linear and np.abs(delta.constants[LEAN]).max() > _MAX_LEAN:
        said = f"leans by {np.abs(delta.constants[LEAN]).max():g} rad, {_MAX_LEAN} is allowed"
        raise BadRobot(name, f"a tower {said}", "give radians from upright")
    if (delta.constants[RATIO] == 0.0).any() or delta.shaft_ratio == 0.0:
        raise BadRobot(name, "a ratio of 0 moves nothing", "give the ratio, 1 where angles are those of the arm")
    if not (delta.lower < delta.upper).all():
        j = int(np.argmax(delta.lower >= delta.upper))
        raise BadRobot(f"joint {delta.names[j]}", "its lower limit is not below its upper one", "correct the limits")
    turns = np.sort(np.mod(delta.constants[AZIMUTH], 2.0 * np.pi))
    apart = np.diff(np.r_[turns, turns[0] + 2.0 * np.pi])
    if apart.min() < np.radians(10.0):
        limit = f"two arms stand {np.degrees(apart.min()):.1f} degrees apart, at least 10 are needed"
        raise BadRobot(name, limit, "correct the azimuths")


# --- A Delta whose parallelograms have two unequal rods: the platform turns, as the closed chain of six rods does

_ROUNDS, _DONE = 12, 1e-13  # iterations, each ten times nearer and more; rad


@dataclass(frozen=True)
class Stand:
    """How a platform stands. R: its turn, (N, 3, 3). middle: (3, N) [m]. along: of the rods, (3 arms, 3, N). radius:
    of the platform, (N,) [m]. out, tangent: of the arms, (3 arms, 3, N), as a level platform has them. share: of each
    arm in a length that comes with ε of all, (3 arms, N). lengths: what the radius is more than the known one, and the
    middle in the level tip, (4, N) [m].
    """

    R: Array
    middle: Array
    along: Array
    radius: Array
    out: Array
    tangent: Array
    share: Array
    lengths: Array


def tilted(unequal: Array, known: float, axes: Array, place: Callable[[Array], tuple[Array, Array]]) -> Stand:
    """How a platform stands whose rods differ.

    unequal: ε, and ε times the four lengths of :class:`Stand`, (5, 3 arms, N). known: the radius [m]. axes: x outwards
    and z along the tangent of each arm, (3 arms, 3 axes, 3, N). place: middle and rods' directions for shifts
    (3 arms, 3, N) of the elbows.
    """
    difference, N = unequal[0], unequal.shape[2]
    square = np.sum(difference**2, axis=0)
    share = np.where(square > 0.0, difference / np.where(square > 0.0, square, 1.0), 0.0)
    lengths = np.einsum("lan,an->ln", unequal[1:], share)
    radius, out, tangent = known + lengths[0], axes[:, 0], axes[:, 2]
    R = np.tile(np.eye(3), (N, 1, 1))
    for _ in range(_ROUNDS):
        middle, along = place(radius * (turned(R, out) - out))
        now = turned(R, tangent)
        missing = difference - np.sum(along * (now - tangent), axis=1)
        turn = np.einsum("icn,in->cn", inverse_rows(np.stack([cross(now[i], along[i]) for i in range(3)])), missing)
        R = so3.exp(turn.T) @ R
        if not np.nanmax(np.abs(turn), initial=0.0) > _DONE:
            break
    middle, along = place(radius * (turned(R, out) - out))
    return Stand(R, middle, along, radius, out, tangent, share, lengths)


def turned(R: Array, v: Array) -> Array:
    """Vectors (3 arms, 3, N) turned by R (N, 3, 3)."""
    return np.asarray(np.einsum("nij,ajn->ain", R, v))


def inverse_rows(a: Array) -> Array:
    """Columns (3, 3, N), column i at index i, of the inverse of a matrix with rows a (3, 3, N)."""
    columns = np.stack([cross(a[1], a[2]), cross(a[2], a[0]), cross(a[0], a[1])])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(columns / np.sum(a[0] * columns[0], axis=0))


def level_rods(axes: Array, along: Array, gains: Array, radius: float, base: Array) -> Array:
    """How a level platform turns and its middle shifts by each arm's rods, as of :class:`Loop`, (3 arms, 5, 2, 3, N),
    by axes as of :func:`tilted`, of the rods along and gains (3 arms, 3, N), and those of the base (3, 3, N).
    """
    turns = inverse_rows(np.stack([cross(axes[i, 2], along[i]) for i in range(3)]))
    out = np.zeros((3, 5, 2, *turns.shape[1:]))
    for rods, turn in zip(out, turns, strict=True):
        lean = -np.sum([gains[j] * np.sum(along[j] * cross(turn, axes[j, 0]), axis=0) for j in range(3)], axis=0)
        rods[0] = turn, radius * lean
        rods[1:, 1] = lean, *(cross(turn, axis) for axis in base)
    return out


def tilted_loops(stand: Stand, distal: Array, rates: Array, ends: Array, base: Array, levers: Array) -> list[Loop]:
    """For each arm how the platform moves with its rods' difference, and with a motion of its elbow.

    The platform's twist (δp, δw) solves two equations for each arm, the length of its mean rod and what its rods differ
    by. distal: lengths (3,). rates: along the rods per unit of each constant, (3 arms, constants, N). ends: what an
    elbow moves by per unit of each, (3 arms, constants, 3, N). base: its axes, (3, 3, N). levers: (3 arms, 3, N) [m].
    """
    N = stand.middle.shape[1]
    now_out, now_tangent = turned(stand.R, stand.out), turned(stand.R, stand.tangent)
    apart, leant = now_tangent - stand.tangent, now_out - stand.out
    s = stand.along
    g = (apart - s * np.sum(s * apart, axis=1, keepdims=True)) / distal[:, None, None]
    A = np.empty((N, 6, 6))
    for i in range(3):
        arm = stand.radius * now_out[i]
        A[:, i, :3], A[:, i, 3:] = s[i].T, cross(arm, s[i]).T
        A[:, 3 + i, :3], A[:, 3 + i, 3:] = g[i].T, (cross(arm, g[i]) + cross(now_tangent[i], s[i])).T
    known = np.isfinite(A).all(axis=(1, 2))
    X = np.full((N, 6, 6), np.nan)
    X[known] = np.linalg.inv(A[known])
    by = np.moveaxis(X, (1, 2), (1, 0))  # equation, component, N
    by_radius = -np.sum([by[i] * np.sum(s[i] * leant[i], axis=0) for i in range(3)], axis=0)
    by_radius = by_radius - np.sum([by[3 + i] * np.sum(g[i] * leant[i], axis=0) for i in range(3)], axis=0)
    up, none = base[2], np.zeros((3, N))
    lever = np.einsum("cn,cdn->dn", stand.lengths[1:], base)
    swings = turned(stand.R, base) - base  # what a length along each axis shifts the tool by
    swing = np.einsum("cn,cdn->dn", stand.lengths[1:], swings)
    found = []
    for i in range(3):
        lean = stand.share[i] * by_radius
        own = by[3 + i] - stand.lengths[0] * lean
        # lengths come with ε of all arms: one arm's ε alone takes its share of them back
        rods = [(own[3:], own[:3] - stand.share[i] * swing), (lean[3:], lean[:3])]
        rods += [(none, stand.share[i] * swings[c]) for c in range(3)]
        first, second = rates[i].copy(), np.einsum("cn,kcn->kn", g[i], ends[i])
        # an arm's azimuth turns its tangent and its way out as well
        swung = stand.radius * (turned(stand.R, cross(up, stand.out[i])[None])[0] - cross(up, stand.out[i]))
        skewed = turned(stand.R, cross(up, stand.tangent[i])[None])[0] - cross(up, stand.tangent[i])
        first[AZIMUTH] -= np.sum(s[i] * swung, axis=0)
        second[AZIMUTH] -= np.sum(g[i] * swung, axis=0) + np.sum(s[i] * skewed, axis=0)
        along, both, twist = np.stack([s[i], g[i]]), np.stack([first, second]), by[[i, 3 + i]]
        hub = stand.middle - lever
        found.append(Loop(along, twist[:, :3], twist[:, 3:], both, levers[i], hub, np.array(rods)))
    return found


# --- A Delta as plain data, the way its YAML file holds it: docs/delta.md describes every key

_FORMAT = 1
_ROWS, _TOWER_ROWS = (  # in the order of constants
    tuple(name if unit == "1" else f"{name}_{unit}" for name, unit in units.items()) for units in (_OF_ARM, _OF_TOWER)
)
_RADII = ("fixed_radius_m", "platform_radius_m")
_EACH: Schema = {"type": ["number", "array"], "items": NUMBER, "minItems": ARMS, "maxItems": ARMS}
_LIMITED = mapping_of(list_of(NUMBER, 2, 2))
_SCHEMA = record(
    ("modcal_delta", "joints"),
    modcal_delta={"enum": [_FORMAT]},
    joints=list_of(TEXT, ARMS, ARMS + 1),
    arms=record(("proximal_m", "distal_m"), **dict.fromkeys((*_ROWS, *_RADII), _EACH)),
    towers=record(("distal_m",), **dict.fromkeys((*_TOWER_ROWS, *_RADII), _EACH)),
    shaft_ratio=NUMBER,
    limits_rad=_LIMITED,
    limits_m=_LIMITED,
    tool=record((), position_m=list_of(NUMBER, 3, 3), rotation_rad=list_of(NUMBER, 3, 3)),
    base=TEXT,
    tip=TEXT,
)
_SEE = "see docs/delta.md"


@refusing
def delta_from_data(data: Any, source: str) -> Delta:
    """The Delta that this data describes. Raises BadTable, naming the source, for what is missing or not understood,
    and BadRobot for constants that no Delta has.
    """
    top = stated(data)
    require(top, _SCHEMA, source, _SEE)
    if len(kind := [key for key in ("arms", "towers") if key in top]) != 1:
        raise BadTable(source, "needs either arms, which turn, or towers, on which carriages slide", _SEE)
    part, linear, tool = kind[0], kind[0] == "towers", top.get("tool", {})
    names, turning = top["joints"], top["joints"][ARMS:] if linear else top["joints"]
    arms = {key: np.broadcast_to(np.array(value, dtype=float), ARMS) for key, value in top[part].items()}
    if all(key in arms for key in _RADII) and "offset_m" not in arms:
        arms["offset_m"] = arms[_RADII[0]] - arms[_RADII[1]]
    elif "offset_m" not in arms or _RADII[0] in arms:
        raise BadTable(f"{source}: {part}", f"needs either offset_m, or both {' and '.join(_RADII)}", _SEE)
    limits: dict[str, Any] = {}
    for key, own in (("limits_rad", turning), ("limits_m", [name for name in names if name not in turning])):
        limits |= top.get(key, {})
        if strangers := [name for name in top.get(key, {}) if name not in own]:
            said = ("turns" if strangers[0] in turning else "slides") if strangers[0] in names else "is no joint of it"
            raise BadTable(f"{source}: {key}", f"{strangers[0]} {said}", f"name {', '.join(own) or 'none'}")
    radius = arms.pop("platform_radius_m", np.zeros(ARMS)).mean().round(12)
    constants = {key.partition("_")[0]: arms[key] for key in (*_ROWS, *_TOWER_ROWS) if key in arms}
    if linear:
        constants["proximal"] = constants.pop("lean", np.zeros(ARMS))
    usual = zip(names, *usual_limits(len(names), linear), strict=True)
    lower, upper = np.array([limits.get(name, ends) for name, *ends in usual], dtype=float).T
    return Delta.build(
        names,
        **constants,
        lower=lower,
        upper=upper,
        tool=[*tool.get("position_m", (0.0,) * 3), *tool.get("rotation_rad", (0.0,) * 3)],
        shaft_ratio=float(top.get("shaft_ratio", 1.0)),
        base=top.get("base", "base"),
        tip=top.get("tip", "tip"),
        platform_radius=float(radius),
        linear=linear,
    )


def delta_to_data(delta: Delta) -> dict[str, Any]:
    """The data that :func:`delta_from_data` reads back as the same Delta, no digit lost."""
    shaft = {"shaft_ratio": delta.shaft_ratio} if delta.has_shaft else {}
    radius = {"platform_radius_m": delta.platform_radius} if delta.platform_radius else {}
    part, rows = ("towers", _TOWER_ROWS) if delta.linear else ("arms", _ROWS)
    limits: dict[str, dict[str, list[float]]] = {}
    for name, turns, *ends in zip(delta.names, delta.revolute, delta.lower, delta.upper, strict=True):
        limits.setdefault("limits_rad" if turns else "limits_m", {})[name] = [float(end) for end in ends]
    return {
        "modcal_delta": _FORMAT,
        "base": delta.base,
        "tip": delta.tip,
        "joints": list(delta.names),
        part: {**{key: row.tolist() for key, row in zip(rows, delta.constants, strict=True)}, **radius},
        **shaft,
        **limits,
        "tool": {"position_m": delta.tool[:3].tolist(), "rotation_rad": delta.tool[3:].tolist()},
    }
