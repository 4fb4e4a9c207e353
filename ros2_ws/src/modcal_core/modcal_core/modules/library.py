"""The modules that arms are put together from, and the product of exponentials of an assembly (Gao et al. 2014).

Every module has an input frame (0) and an output frame (1), z along the way through the flange. A joint acts along z of
its input frame. Which modules there are, and all their figures, are data: see ``published.yaml``. With T^B, T^J, T^L,
T^G the way through each module, joints at zero, and R the quarter turns between neighbours,

    T_1 = T^B R,   T_i = T_{i-1} T^J_{i-1} R T^L_{i-1} R,   T_{n+1} = T_n T^J_n R T^L_n R T^G,

T_i is the input frame of joint i, and ``T(q) = exp(ξ_1 q_1) … exp(ξ_n q_n) T_{n+1}``. In the local form of
:class:`Chain` the constants are M_0 = T_1, M_i = T_i⁻¹ T_{i+1}: each a product of *pieces*, one for every part of a
module and every pair of flanges. Behind each piece stands the error of its owner, a small transform exp(e).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import Array, se3, sealed, so3
from modcal_core.robots import Chain
from modcal_core.schema import NUMBER, POSITIVE, SIZE, TEXT, list_of, mapping_of, record, require, stated, whole

BASE, JOINT, LINK, GRIPPER = "base", "joint", "link", "gripper"
ROLES = (BASE, JOINT, LINK, GRIPPER)
SIZES = 8  # a length is one of eight, of three bits in the published code
TURNS = 4  # and neighbours are bolted at one of four quarter turns


@dataclass(frozen=True)
class ModulePoint:
    """A point that moves with the module's length: ``xyz + length · along``, each (3,) [m, 1], in the input frame."""

    xyz: Array
    along: Array

    def at(self, length: float) -> Array:
        """Where it is for a length [m], (3,) [m]."""
        return self.xyz + length * self.along


@dataclass(frozen=True, eq=False)
class ModuleType:
    """One kind of module.

    name: such as "LR-I". role: base, joint, link or gripper. revolute: whether a joint turns; of no meaning elsewhere.
    code: of a joint's or link's kind in the published code. first, step: length of code n is ``first + n · step`` [m];
    step 0: there is one length only. output: position of the output frame; R: its orientation (3, 3). elbows: corners
    of the body. lower, upper, velocity, effort: of a joint [rad or m, per second, N m or N]. radius: of the body [m].
    mass: [kg], mass_per_metre [kg/m] of length on top.
    """

    name: str
    role: str
    output: ModulePoint
    R: Array
    revolute: bool = True
    code: int = 0
    first: float = 0.0
    step: float = 0.0
    elbows: tuple[ModulePoint, ...] = ()
    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = 1.0
    effort: float = 100.0
    radius: float = 0.03
    mass: float = 0.0
    mass_per_metre: float = 0.0

    @property
    def sizes(self) -> int:
        """How many lengths there are."""
        return SIZES if self.step else 1

    def length(self, size: int) -> float:
        """Its length [m] for a code 0 … 7."""
        return self.first + size * self.step

    @cached_property
    def T_in_out(self) -> Array:
        """Output frame in the input frame, the joint at zero, for every code, (sizes, 4, 4) [m]."""
        return sealed(se3.transform(self.R, np.stack([self.output.at(self.length(n)) for n in range(self.sizes)])))


@dataclass(frozen=True)
class ModuleTolerance:
    """Standard deviations of a physical thing about its drawing: per axis [m, rad], and of a joint's zero [rad]."""

    length: float
    angle: float
    zero: float = 0.0


@dataclass(frozen=True)
class Library:
    """Kinds of modules by name, and how exactly they are made and bolted."""

    name: str
    types: Mapping[str, ModuleType]
    module: ModuleTolerance
    interface: ModuleTolerance

    def type(self, name: str, what: str = "module") -> ModuleType:
        """The kind with this name. Raises BadTable with the names that come close."""
        found = self.types.get(name)
        if found is None:
            close = difflib.get_close_matches(str(name), self.types, n=3, cutoff=0.4) or list(self.types)
            raise BadTable(f"{what} '{name}'", f"is not in the module library '{self.name}'", f"use {', '.join(close)}")
        return found

    def of_role(self, role: str) -> tuple[ModuleType, ...]:
        """The kinds of one role, in the order of their codes."""
        return tuple(sorted((t for t in self.types.values() if t.role == role), key=lambda t: t.code))

    @property
    def base(self) -> ModuleType:
        """The first kind of base."""
        return self.of_role(BASE)[0]

    @property
    def gripper(self) -> ModuleType:
        """The first kind of gripper."""
        return self.of_role(GRIPPER)[0]


# --- Which modules are bolted together, in which order, and how each is turned against the one before it

_NEXT = {"": (BASE,), BASE: (JOINT,), JOINT: (LINK,), LINK: (JOINT, GRIPPER), GRIPPER: ()}


@dataclass(frozen=True)
class Module:
    """One module in its place.

    kind: its name in the library. size: code 0 … 7 of its length. turn: quarter turns about z, 0 … 3, of its input
    frame against the output frame of the module before it; 0 for a base. serial: of the physical module; "" unknown.
    """

    kind: str
    size: int = 0
    turn: int = 0
    serial: str = ""


@dataclass(frozen=True)
class Assembly:
    """A chain of modules: a base, then a joint and a link as often as wanted, then a gripper."""

    modules: tuple[Module, ...]
    name: str = "modular_arm"

    @classmethod
    def build(
        cls,
        base: tuple[int, int],
        subassemblies: Iterable[tuple[str, int, str, int, int]],
        base_kind: str = "B",
        gripper_kind: str = "G",
        name: str = "modular_arm",
    ) -> Assembly:
        """The assembly in the order of the published code.

        base: (size, turn), the turn being that of the first joint on the base. subassemblies: (joint kind, turn, link
        kind, size, turn), the first turn being that of the link on the joint, the second that of what comes next on
        the link.
        """
        modules = [Module(base_kind, base[0])]
        turn = base[1]
        for joint, link_turn, link, size, next_turn in subassemblies:
            modules += [Module(joint, 0, turn), Module(link, size, link_turn)]
            turn = next_turn
        return cls((*modules, Module(gripper_kind, 0, turn)), name)

    @property
    def joints(self) -> tuple[Module, ...]:
        """The joints, base to gripper."""
        return self.modules[1:-1:2]

    @property
    def links(self) -> tuple[Module, ...]:
        """The links, base to gripper; link i is bolted onto joint i."""
        return self.modules[2:-1:2]

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints in the arm that comes of it: joint_1 …"""
        return tuple(f"joint_{k + 1}" for k in range(self.n))

    def checked(self, library: Library, source: str = "assembly") -> Assembly:
        """The same assembly, if it can be built from this library. Raises BadTable at the first fault."""
        before = ""
        seen: dict[str, int] = {}
        for i, module in enumerate(self.modules):
            what = f"{source}: module {i + 1}"
            kind = library.type(module.kind, what)
            if kind.role not in _NEXT[before]:
                after = f"stands after a {before}" if before else "stands first"
                wanted = " or a ".join(_NEXT[before]) or "nothing"
                raise BadTable(f"{what} ({module.kind})", f"a {kind.role} {after}", f"use a {wanted} here")
            if isinstance(module.size, bool) or not isinstance(module.size, int) or not 0 <= module.size < kind.sizes:
                limit = f"its length code is {module.size!r}, 0 to {kind.sizes - 1} are there"
                raise BadTable(f"{what} ({module.kind})", limit, "choose a length of the library")
            if isinstance(module.turn, bool) or not isinstance(module.turn, int) or not 0 <= module.turn < TURNS:
                said = f"it is turned by {module.turn!r} quarter turns, 0 to {TURNS - 1} are possible"
                raise BadTable(f"{what} ({module.kind})", said, "give 0, 1, 2 or 3, or degrees 0, 90, 180, 270")
            if i == 0 and module.turn:
                raise BadTable(f"{what} ({module.kind})", "a base has no turn", "turn the first joint")
            if module.serial and module.serial in seen:
                said = f"serial number {module.serial} is at module {seen[module.serial]} already"
                raise BadTable(f"{what} ({module.kind})", said, "give each physical module its own")
            seen[module.serial] = i + 1
            before = kind.role
        if before != GRIPPER:
            ends = f"it ends in a {before}" if before else "it is empty"
            raise BadTable(source, ends, "end it in a gripper")
        return self


# --- A module library from plain data, as its YAML file holds it, checked at the door

_FORMAT = 1
_SEE = "see docs/modules.md"
_TOLERANCES = {  # where a library states none
    "module": {"length_m": 3e-4, "angle_rad": 1e-3, "zero_rad": 3e-3},
    "interface": {"length_m": 3e-5, "angle_rad": 2e-4},
}
_LONGEST = 10.0  # m; a module that is longer was written in millimetres
_PLACE = {"xyz": list_of(NUMBER, 3, 3), "along": list_of(NUMBER, 3, 3)}
_TYPE = record(
    ("role", "output"),
    role={"enum": ROLES},
    code=whole(0, 3),
    motion={"enum": ("revolute", "prismatic")},
    length_m=record((), first=NUMBER, step=NUMBER),
    output=record((), rpy=list_of(NUMBER, 3, 3), **_PLACE),
    elbows=list_of(record((), **_PLACE)),
    limits=record((), lower=NUMBER, upper=NUMBER, velocity=SIZE, effort=SIZE),
    radius_m=POSITIVE,
    mass_kg=SIZE,
    mass_kg_per_m=SIZE,
)
_DEVIATION = {**POSITIVE, "maximum": 1}
_TOLERANCE = record((), length_m=_DEVIATION, angle_rad=_DEVIATION, zero_rad={**SIZE, "maximum": 1})
_SCHEMA = record(
    ("modcal_modules", "modules"),
    modcal_modules={"enum": [_FORMAT]},
    name=TEXT,
    tolerances=record((), module=_TOLERANCE, interface=_TOLERANCE),
    modules=mapping_of(_TYPE),
)


def published_text() -> str:
    """The text of the library that is used where no other is given."""
    return files("modcal_core.modules").joinpath("published.yaml").read_text(encoding="utf-8")


def published() -> Library:
    """The published library: B, G, JR, JP, LC, LP, LR-I, LR-II."""
    import yaml

    return library_from_data(yaml.safe_load(published_text()), "published.yaml")


@refusing
def library_from_data(data: Any, source: str) -> Library:
    """The library that nested mappings and lists describe; ``source`` is named in refusals. Raises BadTable."""
    top = stated(data)
    require(top, _SCHEMA, source, _SEE)
    types = {name: _type(name, kind, f"{source}: {name}") for name, kind in top["modules"].items()}
    for role in ROLES:
        codes = [t.code for t in types.values() if t.role == role]
        if not codes:
            raise BadTable(f"{source}: modules", f"there is no {role}", f"add a module with role: {role}")
        if role in (JOINT, LINK) and len(set(codes)) < len(codes):
            raise BadTable(f"{source}: modules", f"two kinds of {role} have the same code", "give each its own code")
    given = top.get("tolerances", {})
    module, interface = (
        ModuleTolerance(**{name.partition("_")[0]: value for name, value in {**own, **given.get(key, {})}.items()})
        for key, own in _TOLERANCES.items()
    )
    return Library(top.get("name", source), types, module, interface)


def _type(name: str, data: Mapping[str, Any], what: str) -> ModuleType:
    role, motion = data["role"], data.get("motion", "revolute")
    if ("motion" in data) != (role == JOINT):
        raise BadTable(what, "a joint, and nothing else, has a motion", "give motion: revolute or prismatic")
    length, output, limits = data.get("length_m", {}), data["output"], data.get("limits", {})
    place, step = _point(output), float(length.get("step", 0.0))
    if role != JOINT and step and not place.along.any():
        raise BadTable(f"{what}: output", "has a length without a direction", "give along: [x, y, z]")
    low, high = float(limits.get("lower", -np.inf)), float(limits.get("upper", np.inf))
    if not low < high:
        raise BadTable(f"{what}: limits", f"run from {low:g} to {high:g}", "give lower below upper")
    if motion == "prismatic" and not np.isfinite([low, high]).all():
        raise BadTable(f"{what}: limits", "a sliding joint has an end", "give lower and upper")
    made = ModuleType(
        name=name,
        role=role,
        output=place,
        R=so3.from_rpy(output.get("rpy", (0.0, 0.0, 0.0))),
        revolute=motion == "revolute",
        code=data.get("code", 0 if motion == "revolute" else 1),
        first=float(length.get("first", 0.0)),
        step=step,
        elbows=tuple(_point(elbow) for elbow in data.get("elbows", ())),
        lower=low,
        upper=high,
        velocity=float(limits.get("velocity", 1.0)),
        effort=float(limits.get("effort", 100.0)),
        radius=float(data.get("radius_m", 0.03)),
        mass=float(data.get("mass_kg", 0.0)),
        mass_per_metre=float(data.get("mass_kg_per_m", 0.0)),
    )
    longest = max(float(np.linalg.norm(made.output.at(made.length(n)))) for n in (0, SIZES - 1))
    if longest > _LONGEST:
        raise BadTable(what, f"is {longest:.0f} m long, {_LONGEST:g} m is the limit", "give metres, not millimetres")
    return made


def _point(data: Mapping[str, Any]) -> ModulePoint:
    return ModulePoint(*(np.array(data.get(key, (0.0, 0.0, 0.0)), dtype=float) for key in _PLACE))


BASE_LINK, TIP_LINK = "base_link", "tool0"
# Which part of an owner a piece is: the way through a module, or, of a joint, the way to its axis and from it on.
WHOLE, TO_AXIS, FROM_AXIS = "whole", "to_axis", "from_axis"


# about z by 0, 90, 180, 270 degrees, exactly, (4, 4, 4)
TURN = sealed(
    np.stack([np.linalg.matrix_power(se3.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), k) for k in range(4)])
)


@dataclass(frozen=True)
class Piece:
    """One factor of a constant of the chain.

    T: nominal, (4, 4) [m]. module: index of the module it belongs to, or of the module behind the flanges that it is.
    part: "interface", or which part of the module.
    """

    T: Array
    module: int
    part: str = WHOLE

    @property
    def is_interface(self) -> bool:
        """Whether it is a pair of flanges, which is bolted again in every assembly."""
        return self.part == "interface"


def pieces(assembly: Assembly, library: Library) -> tuple[tuple[Piece, ...], ...]:
    """The factors of M_0 … M_n of the arm, base to tip, (n + 1) tuples; the assembly has been checked."""
    out: list[list[Piece]] = [[]]
    for i, module in enumerate(assembly.modules):
        kind = library.types[module.kind]
        if i:
            out[-1].append(Piece(TURN[module.turn], i, "interface"))
        if kind.role == JOINT:
            out[-1].append(Piece(np.eye(4), i, TO_AXIS))
            out.append([Piece(kind.T_in_out[module.size], i, FROM_AXIS)])
        else:
            out[-1].append(Piece(kind.T_in_out[module.size], i))
    return tuple(tuple(segment) for segment in out)


def chain_of(assembly: Assembly, library: Library, errors: Mapping[tuple[str, str], Array] | None = None) -> Chain:
    """The arm that an assembly makes, from base_link to tool0. Raises BadTable where it cannot be built.

    errors: twists (6,) [m, rad] by (serial number, part), of physical modules whose true geometry is known, each in the
    frame that its part ends in; parts are "whole", and "to_axis" and "from_axis" of joints.
    """
    assembly.checked(library)
    M = origins(assembly, library, errors)
    kinds = [library.types[m.kind] for m in assembly.joints]
    return Chain.build(
        names=assembly.joint_names,
        origins=M,
        revolute=[k.revolute for k in kinds],
        lower=[k.lower for k in kinds],
        upper=[k.upper for k in kinds],
        base=BASE_LINK,
        tip=TIP_LINK,
    )


def origins(assembly: Assembly, library: Library, errors: Mapping[tuple[str, str], Array] | None = None) -> Array:
    """M_0 … M_n of the arm, (n + 1, 4, 4) [m], errors put in as of :func:`chain_of`; the assembly has been checked."""
    M = []
    for segment in pieces(assembly, library):
        T = np.eye(4)
        for piece in segment:
            T = T @ piece.T
            serial = assembly.modules[piece.module].serial
            if errors and not piece.is_interface and serial and (serial, piece.part) in errors:
                T = T @ se3.exp(errors[serial, piece.part])
        M.append(T)
    return np.stack(M)


def module_frames(assembly: Assembly, library: Library, q: Array | None = None) -> Array:
    """Where every module is at postures q (..., n) [rad, m], default zero: (..., modules + 1, 4, 4) [m] in the base.

    Of each module the input frame, of a joint after its motion; then the gripper's output frame.
    """
    q = np.zeros(assembly.n) if q is None else q
    T, out, k = np.eye(4), [], 0
    for module in assembly.modules:
        kind = library.types[module.kind]
        T = T @ TURN[module.turn]
        if kind.role == JOINT:
            T, k = T @ se3.exp(q[..., k, None] * np.eye(6)[5 if kind.revolute else 2]), k + 1
        out.append(T)
        T = T @ kind.T_in_out[module.size]
    return np.stack(np.broadcast_arrays(*out, T), axis=-3)
