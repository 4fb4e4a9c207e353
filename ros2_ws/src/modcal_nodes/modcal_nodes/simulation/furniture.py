"""A piece of furniture drawn at random: what moves, how hard it is to move, and where it stands before the arm.

Nothing here is a model that modcal fits: the axis and the rest are handed to MuJoCo, whose own joint is the truth. A
scene is only drawn again where no posture of the arm could follow the handle, which a person would see beforehand.

Each law is a force at the handle, so that it means the same for a door of any width. It acts on the object's joint,
where MuJoCo integrates it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, NotReachable
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots import Chain, body_jacobian, inverse

_AT_REST = 2e-3  # m/s of the handle: below it, dry friction is as if it stood
_ENGAGES = 1e-3  # m: a preload does not act through a closed stop
_CREEPS = 0.05  # m/s up to which what sticks does more than what slides, roughly

Law = Callable[[float, float], float]


@dataclass(frozen=True)
class Resistance:
    """force: at the handle [N], which closes where it is positive, at way [m] and speed [m/s] of the handle.

    size: what it is at most, pulled slowly [N].
    """

    name: str
    size: float
    force: Law


def closer(size: float, damping: float = 40.0) -> Resistance:
    """A door closer: a preload that hardly rises, and oil."""
    return Resistance("closer", size, lambda s, v: size * min(max(s, 0.0) / _ENGAGES, 1.0) + damping * v)


def magnet(size: float, reach: float = 4e-3) -> Resistance:
    """Holds a closed front, and lets it go after some millimetres."""
    return Resistance("magnet", size, lambda s, v: size * max(1.0 - max(s, 0.0) / reach, 0.0) ** 2)


def gasket(size: float, reach: float = 12e-3) -> Resistance:
    """A magnetic seal that is peeled off over a centimetre or two, with some oil in it."""
    return Resistance("gasket", size, lambda s, v: size * math.exp(-max(s, 0.0) / reach) + 10.0 * v)


def stick_slip(size: float, slides: float = 0.4) -> Resistance:
    """Friction that is less, by a share, once it slides."""

    def force(s: float, v: float) -> float:
        dry = size * (slides + (1.0 - slides) * math.exp(-((v / _CREEPS) ** 2)))
        return dry * math.tanh(v / _AT_REST)

    return Resistance("stick_slip", size, force)


def detents(size: float, apart: float = 0.05) -> Resistance:
    """Balls that drop into notches, so far [m] apart."""
    return Resistance("detents", size, lambda s, v: size * math.sin(2.0 * math.pi * max(s, 0.0) / apart))


def over_centre(size: float, at: float = 0.12) -> Resistance:
    """A spring that closes up to some way [m], and opens beyond it."""

    def force(s: float, v: float) -> float:
        return size * min(max(s, 0.0) / (0.15 * at), 1.0) * max(1.0 - max(s, 0.0) / at, -0.6) + 15.0 * v

    return Resistance("over_centre", size, force)


def soft_end(size: float, begins: float = 0.15) -> Resistance:
    """A damper and a spring that come in over the last part of the way."""
    return Resistance(
        "soft_end", size, lambda s, v: min(max(s - begins, 0.0) / 0.05, 1.0) * size + (60.0 * v if s > begins else 0.0)
    )


KNOWN: dict[str, Callable[[float], Resistance]] = {
    law.__name__: law for law in (closer, magnet, gasket, stick_slip, detents, over_centre, soft_end)
}


def resistance(text: str) -> Resistance | None:
    """Resistance from its name and force [N], such as ``closer 25``; None for an empty text. Raises BadTable."""
    if not text.strip():
        return None
    name, _, size = text.strip().partition(" ")
    try:
        force = float(size)
    except ValueError:
        force = math.nan
    if name not in KNOWN or not 0.0 < force <= 500.0:
        raise BadTable(
            f"resistance '{text}'", f"is not one of {', '.join(KNOWN)} and a force", "write it as: closer 25"
        )
    return KNOWN[name](force)


KINDS = ("door", "drawer", "screw", "folding")
GRASP_STIFFNESS = 20e3  # N/m: fingers, their pads and the panel behind a handle deflect before anything else does
GRASPS = ("weld", "ball")
GOAL_TURN = np.radians(60.0)  # rad, of what turns
GOAL_SLIDE = 0.30  # m, of a drawer
FREE = -1.0  # as stop: none but its own end

_STEPS = 14  # postures along the way that must be found
_BEYOND = 1.05  # of the goal, the way must be open to
_LIMIT_MARGIN = 0.08  # rad to every joint limit
_MIN_SINGULAR = 0.04  # of the body Jacobian along the way
_LONGEST_STEP = 0.6  # rad of one joint between two of the postures
_HANDLE = 0.05  # m that a handle stands out from its panel
FOLDS_AT = np.radians(20.0)  # rad, where the first hinge of a folding door ends and the second begins
# a posture in which a Panda's hand points forward; every other arm begins in the middle of its range
_SEED = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 3.2, 0.785])


@dataclass(frozen=True)
class Furniture:
    """One object and the arm that holds its handle.

    kind: door (a hinge), drawer (a slide), screw (a hinge whose slide is coupled to it), folding (a hinge that ends
    after 20° where a second one, nearer to the handle and stiffer, opens: no single joint describes it).
    axis (3,), point (3,) [m]: of its motion in the arm's base. pitch: of a screw [m/rad].
    T_base_handle: the closed handle, which is where the tool is. q: the arm's posture then (n,).
    friction: dry [N m; a drawer's N], damping [N m s/rad; N s/m], spring: that closes it [N m/rad; N/m].
    mass: of what moves [kg]. stop: where it jams for good [rad; m], 0 where it is locked, -1 nowhere.
    resistance: what holds it back besides, None where nothing does.
    tool_mass [kg], tool_com (3,) [m, in the tool]: beyond the wrist sensor. tool_bias (6,): the sensor's zero [N, N m].
    fingers: stiffness of the grasp [N/m].
    """

    kind: str
    grasp: str
    axis: Array
    point: Array
    pitch: float
    T_base_handle: Array
    q: Array
    friction: float
    damping: float
    spring: float
    mass: float
    stop: float
    tool_mass: float
    tool_com: Array
    tool_bias: Array
    resistance: Resistance | None = None
    fingers: float = GRASP_STIFFNESS

    @property
    def turns(self) -> bool:
        """Whether its joint turns; else it slides."""
        return self.kind != "drawer"

    @property
    def goal(self) -> float:
        """How far it is to be opened [rad; m]."""
        return GOAL_TURN if self.turns else GOAL_SLIDE

    @property
    def radius(self) -> float:
        """Distance of the handle from the axis [m]; inf for a drawer."""
        arm = self.T_base_handle[:3, 3] - self.point
        return float(np.linalg.norm(np.cross(self.axis, arm))) if self.turns else float("inf")

    @property
    def direction(self) -> Array:
        """Unit vector in the base (3,) along which the closed handle sets off."""
        if not self.turns:
            return self.axis
        way = np.cross(self.axis, self.T_base_handle[:3, 3] - self.point) + self.pitch * self.axis
        return way / np.linalg.norm(way)

    def handle(self, opened: float) -> Array:
        """The pose (4, 4) of the handle in the base when its joint stands at ``opened``, nominal; not when folded."""
        return se3.exp(self.twist * opened) @ self.T_base_handle

    @property
    def twist(self) -> Array:
        """Space twist (v, ω) (6,) of its motion, per radian or metre."""
        if not self.turns:
            return np.concatenate([self.axis, np.zeros(3)])
        return np.concatenate([np.cross(self.point, self.axis) + self.pitch * self.axis, self.axis])


def draw(chain: Chain, rng: np.random.Generator, chosen: Mapping[str, Any] | None = None) -> Furniture:
    """A scene whose handle the arm can follow to the goal, found by drawing again and again.

    chosen: what is not left to chance: ``kind``, ``grasp``, ``radius_m``, ``friction``, ``damping``, ``spring``,
    ``mass_kg``, ``stop``, ``resistance``; an empty text, and a number below zero, leave it to chance. Raises BadTable.
    """
    wish = dict(chosen or {})
    for name, known in (("kind", KINDS), ("grasp", GRASPS)):
        if wish.get(name) and wish[name] not in known:
            raise BadTable(f"{name} '{wish[name]}'", f"there are {', '.join(known)}", "name one of them, or none")
    kind = wish.get("kind") or str(rng.choice(KINDS[:2]))
    grasp = wish.get("grasp") or str(rng.choice(GRASPS))
    character = _character(kind, rng)
    for _ in range(400):
        placed = _place(kind, grasp, wish, character, rng)
        q = _posture(chain, placed, rng)
        if q is not None:
            return replace(placed, q=q)
    raise BadTable(
        f"a {kind} of radius {wish.get('radius_m', -1.0):g} m",
        "the arm can follow none",
        "choose another radius or arm",
    )


def _character(kind: str, rng: np.random.Generator) -> dict[str, float]:
    """How hard it is to move: drawn once, so that drawing its place again does not favour what is light."""
    if kind == "drawer":
        low_high = {"friction": (1.0, 6.0), "damping": (2.0, 20.0), "spring": (0.0, 15.0), "mass_kg": (1.0, 6.0)}
    elif kind == "screw":
        low_high = {"friction": (0.2, 0.8), "damping": (0.05, 0.5), "spring": (0.0, 0.5), "mass_kg": (0.5, 2.0)}
    else:
        low_high = {"friction": (0.3, 2.0), "damping": (0.1, 1.5), "spring": (0.0, 3.0), "mass_kg": (2.0, 12.0)}
    return {name: float(rng.uniform(low, high)) for name, (low, high) in low_high.items()}


def _place(
    kind: str, grasp: str, wish: Mapping[str, Any], character: Mapping[str, float], rng: np.random.Generator
) -> Furniture:
    yaw, tilt, roll = rng.uniform([-0.6, -0.3, -0.6], [0.6, 0.3, 0.6])
    forward = so3.exp([0.0, 0.0, yaw]) @ so3.exp([0.0, np.pi / 2 + tilt, 0.0]) @ so3.exp([0.0, 0.0, np.pi + roll])
    handle = se3.transform(forward, rng.uniform([0.40, -0.35, 0.20], [0.70, 0.35, 0.70]))
    # the hand does not point squarely at what it holds
    out = so3.exp(np.radians(6.0) * rng.standard_normal(3)) @ -forward[:, 2]
    beside = np.cross([0.0, 0.0, 1.0], out)
    beside /= np.linalg.norm(beside)
    quarter = rng.choice([0.0, 0.5, 1.0, 1.5], p=[0.4, 0.1, 0.4, 0.1])  # hinges left, above, right, below
    angle = np.pi * quarter + np.radians(4.0) * rng.standard_normal()
    side = np.cos(angle) * beside + np.sin(angle) * np.cross(out, beside)
    span = (0.08, 0.2) if kind == "screw" else (0.22, 0.60)
    radius = float(rng.uniform(*span))
    if wish.get("radius_m", -1.0) > 0.0:
        radius = float(wish["radius_m"])
    inwards = min(_HANDLE, 0.5 * radius)
    point = handle[:3, 3] + np.sqrt(radius**2 - inwards**2) * side - inwards * out
    turns = kind != "drawer"
    given = {name: float(wish[name]) for name in character if wish.get(name, -1.0) >= 0.0}
    made = {**character, **given}
    return Furniture(
        kind=kind,
        grasp=grasp,
        axis=np.cross(out, side) if turns else out,
        point=point if turns else np.zeros(3),
        pitch=float(rng.uniform(0.02, 0.08)) if kind == "screw" else 0.0,
        T_base_handle=handle,
        q=np.empty(0),
        friction=made["friction"],
        damping=made["damping"],
        spring=made["spring"],
        mass=made["mass_kg"],
        stop=float(wish.get("stop", FREE)),
        resistance=resistance(str(wish.get("resistance", ""))),
        tool_mass=float(rng.uniform(0.3, 1.0)),
        tool_com=rng.uniform(-0.02, 0.02, 3) - np.array([0.0, 0.0, 0.06]),
        tool_bias=np.concatenate([rng.uniform(-3.0, 3.0, 3), rng.uniform(-0.2, 0.2, 3)]),
    )


def _posture(chain: Chain, scene: Furniture, rng: np.random.Generator) -> Array | None:
    """A posture that holds the closed handle and from which the whole way can be followed; None where there is none."""
    middle = 0.5 * (np.clip(chain.lower, -np.pi, np.pi) + np.clip(chain.upper, -np.pi, np.pi))
    seed = np.clip(_SEED, chain.lower, chain.upper) if chain.n == len(_SEED) else middle
    opened = np.linspace(0.0, _BEYOND * scene.goal, _STEPS)
    handles = [scene.handle(float(a)) for a in opened]
    if max(float(np.linalg.norm(T[:3, 3])) for T in handles) > chain.reach():
        return None
    for _ in range(3):
        try:
            path = [seed + 0.3 * rng.standard_normal(chain.n)]
            for T in handles:
                path.append(inverse(chain, T, path[-1], restarts=0))
        except NotReachable:
            continue
        way = np.array(path[1:])
        margin = min((way - chain.lower).min(), (chain.upper - way).min())
        weakest = np.linalg.svd(body_jacobian(chain, way), compute_uv=False)[:, -1].min()
        if margin > _LIMIT_MARGIN and weakest > _MIN_SINGULAR and np.abs(np.diff(way, axis=0)).max() < _LONGEST_STEP:
            return way[0]
    return None
