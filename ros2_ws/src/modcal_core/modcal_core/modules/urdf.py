"""The URDF of an assembly: one link for every module, two for a joint, fixed joints where flanges are bolted.

A module's link has its input frame; a joint module has a second one, in the same place while the joint is at zero,
which moves. So quarter turns and ways through modules stand in the file as they are, and a reader that folds fixed
joints gets the constants of the chain. The tip is ``tool0``, the gripper's output frame.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import numpy as np

from modcal_core.geometry import Array, se3, sealed
from modcal_core.modules.library import (
    BASE_LINK,
    FROM_AXIS,
    JOINT,
    TIP_LINK,
    TO_AXIS,
    TURN,
    WHOLE,
    Assembly,
    Library,
    Module,
    ModuleType,
    module_frames,
)
from modcal_core.robots import added, joint_element, number, origin_element, rotation_to_axis, urdf_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# --- What the modules look like and weigh: a tube from flange to flange, round every corner, as heavy as stated

_SHORTEST = 1e-6  # m; a shorter tube is not drawn
_LIGHTEST = 1e-3  # kg; what a simulator takes for a body that states no mass


@dataclass(frozen=True)
class Tube:
    """A cylinder about z of its frame. T: its middle in the module's input frame, (4, 4) [m]; length, radius [m]."""

    T: Array
    length: float
    radius: float


@dataclass(frozen=True)
class ModuleBody:
    """Tubes of a module, and what they weigh. mass [kg]; centre (3,) [m]; inertia (3, 3) about it [kg m²]."""

    tubes: tuple[Tube, ...]
    mass: float
    centre: Array
    inertia: Array


def path(kind: ModuleType, size: int) -> Array:
    """Points of the body's middle line from the input to the output flange, (k, 3) [m], in the input frame."""
    length = kind.length(size)
    return np.stack([np.zeros(3), *(e.at(length) for e in kind.elbows), kind.output.at(length)])


@cache
def body(kind: ModuleType, size: int) -> ModuleBody:
    """The body of a module with this length code, its mass spread evenly along the tubes."""
    points = path(kind, size)
    tubes = []
    for a, b in pairwise(points):
        length = float(np.linalg.norm(b - a))
        if length > _SHORTEST:
            tubes.append(Tube(se3.transform(rotation_to_axis((b - a) / length), 0.5 * (a + b)), length, kind.radius))
    mass = max(kind.mass + kind.mass_per_metre * kind.length(size), _LIGHTEST)
    if not tubes:  # a plate without height
        tubes.append(Tube(np.eye(4), 0.005, kind.radius))
    share = mass * np.array([t.length for t in tubes]) / sum(t.length for t in tubes)
    middles = np.stack([t.T[:3, 3] for t in tubes])
    centre = share @ middles / mass
    inertia = np.zeros((3, 3))
    for m, tube, r in zip(share, tubes, middles - centre, strict=True):
        across = m * (3.0 * tube.radius**2 + tube.length**2) / 12.0
        R = tube.T[:3, :3]
        inertia += R @ np.diag([across, across, 0.5 * m * tube.radius**2]) @ R.T
        inertia += m * (r @ r * np.eye(3) - np.outer(r, r))  # Steiner
    return sealed(ModuleBody(tuple(tubes), mass, centre, inertia))


_COLOURS = {
    "base": "0.25 0.27 0.30 1",
    "joint": "0.12 0.44 0.92 1",
    "link": "0.75 0.77 0.80 1",
    "gripper": "0.90 0.55 0.15 1",
}


def urdf_of(assembly: Assembly, library: Library, errors: Mapping[tuple[str, str], Array] | None = None) -> str:
    """The URDF text of the arm that an assembly makes; reading it gives ``chain_of`` the same three.

    errors: as there. Raises BadTable where the assembly cannot be built.
    """
    assembly.checked(library)
    robot = ET.Element("robot", name=assembly.name)
    for role, rgba in _COLOURS.items():
        added(added(robot, "material", name=role), "color", rgba=rgba)
    errors = errors or {}

    def error(module: Module, part: str) -> Array:
        found = errors.get((module.serial, part)) if module.serial else None
        return np.eye(4) if found is None else se3.exp(found)

    above, T = "", np.eye(4)  # the link that the next module hangs on, and where
    for link, module in zip(link_names(assembly), assembly.modules, strict=True):
        kind = library.types[module.kind]
        moving = kind.role == JOINT
        _link(robot, f"{link}_housing" if moving else link, kind, module.size, empty=moving)
        if above:
            below = f"{link}_housing" if moving else link
            joint_element(robot, f"{above}_to_{below}", "fixed", above, below, T @ TURN[module.turn])
        if moving:
            _link(robot, link, kind, module.size)
            name, motion = link.removesuffix("_module"), "revolute" if kind.revolute else "prismatic"
            limit = {"effort": kind.effort, "velocity": kind.velocity}
            if np.isfinite(kind.lower) and np.isfinite(kind.upper):
                limit |= {"lower": kind.lower, "upper": kind.upper}
            else:
                motion = "continuous"
            joint = joint_element(robot, name, motion, f"{link}_housing", link, error(module, TO_AXIS))
            added(joint, "axis", xyz="0 0 1")
            added(joint, "limit", **{key: number(value) for key, value in limit.items()})
        above = link
        T = kind.T_in_out[module.size] @ error(module, FROM_AXIS if moving else WHOLE)
    added(robot, "link", name=TIP_LINK)
    joint_element(robot, f"{above}_to_{TIP_LINK}", "fixed", above, TIP_LINK, T)
    return urdf_text(robot)


def link_names(assembly: Assembly) -> list[str]:
    """Names of the modules' links, base to gripper: base_link, joint_1_module, link_1 … gripper."""
    out = [BASE_LINK]
    for k in range(assembly.n):
        out += [f"joint_{k + 1}_module", f"link_{k + 1}"]
    return [*out, "gripper"]


def _link(robot: ET.Element, name: str, kind: ModuleType, size: int, empty: bool = False) -> None:
    """One link. A joint's housing is empty: module and motor are taken to move with the joint."""
    link = added(robot, "link", name=name)
    if empty:
        return
    made = body(kind, size)
    inertial = added(link, "inertial")
    origin_element(inertial, se3.transform(p=made.centre))
    added(inertial, "mass", value=number(made.mass))
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    added(inertial, "inertia", **{key: number(made.inertia[at]) for key, at in names.items()})
    for tag in ("visual", "collision"):
        for tube in made.tubes:
            shape = added(link, tag)
            origin_element(shape, tube.T)
            geometry = added(shape, "geometry")
            added(geometry, "cylinder", radius=number(tube.radius), length=number(tube.length))
            if tag == "visual":
                added(shape, "material", name=kind.role)


# --- A picture of an assembly, as SVG text. Matplotlib is imported only when one is drawn

_PICTURE_COLOURS = {"base": "#40454d", "joint": "#1f6feb", "link": "#b0b7c3", "gripper": "#e08a26"}
_POINTS_PER_RADIUS = 160.0  # line width per metre of radius, for an arm one metre high
_AXIS = 0.10  # m


def picture(assembly: Assembly, library: Library, q: Array | None = None, title: str = "") -> str:
    """The arm at a posture q (n,) [rad, m], default zero, from the side and askew, joints numbered on their axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.4))
    figure.subplots_adjust(0.0, 0.02, 0.97, 0.94, 0.05)
    frames = module_frames(assembly, library, q)
    high = max(float(np.ptp(frames[:, :3, 3], axis=0).max()), 0.2)
    for place, (elevation, azimuth) in enumerate(((22.0, -55.0), (0.0, -90.0))):
        axes: Any = figure.add_subplot(1, 2, place + 1, projection="3d", computed_zorder=False)
        axes.set_proj_type("ortho")
        axes.view_init(elev=elevation, azim=azimuth)
        joint = 0
        for module, T in zip(assembly.modules, frames[:-1], strict=True):
            kind = library.types[module.kind]
            _draw(axes, kind, path(kind, module.size), T, high)
            if kind.role == JOINT:
                joint += 1
                _mark(axes, kind, T, joint)
        for direction, colour in zip(frames[-1, :3, :3].T, ("#d1495b", "#3a7d44", "#1f6feb"), strict=True):
            axes.plot(*np.stack([frames[-1, :3, 3], frames[-1, :3, 3] + 0.06 * direction]).T, color=colour, lw=1.5)
        _scale(axes, frames, high)
        if elevation == 0.0:  # seen along y, its numbers lie on top of each other
            axes.set_yticks([])
            axes.set_ylabel("")
    names = " ".join(m.kind + (f"({m.size})" if m.size else "") for m in assembly.modules)
    figure.suptitle(title or f"{assembly.name}: {names}", fontsize=9)
    return _svg(figure)


def _draw(axes: Any, kind: ModuleType, points: Array, T: Array, high: float) -> None:
    world = se3.apply(T, points)
    width = 2.0 * _POINTS_PER_RADIUS * kind.radius / high
    axes.plot(*world.T, color=_PICTURE_COLOURS[kind.role], lw=width, solid_capstyle="butt", solid_joinstyle="round")
    for p in world[[0, -1]]:  # flanges
        axes.plot(*p[:, None], "o", color="#20242b", ms=0.25 * width)


def _mark(axes: Any, kind: ModuleType, T: Array, number: int) -> None:
    """A joint's axis, whole where it turns, dashed where it slides."""
    middle = T[:3, 3] + 0.5 * T[:3, :3] @ kind.output.at(0.0)
    ends = middle + np.outer([-_AXIS, _AXIS], T[:3, 2])
    axes.plot(*ends.T, color="#d1495b", lw=1.0, ls="-" if kind.revolute else "--")
    axes.text(*ends[1], str(number), color="#d1495b", fontsize=8)


def _scale(axes: Any, frames: Array, high: float) -> None:
    """The same scale along all axes, in metres."""
    p = frames[:, :3, 3]
    middle, half = 0.5 * (p.min(axis=0) + p.max(axis=0)), 0.5 * high + 0.06
    for name, m in zip("xyz", middle, strict=True):
        getattr(axes, f"set_{name}lim")(m - half, m + half)
        getattr(axes, f"set_{name}label")(f"{name}, m", fontsize=7)
    axes.set_box_aspect((1.0, 1.0, 1.0))
    axes.tick_params(labelsize=6)


def _svg(figure: Figure) -> str:
    import matplotlib

    # fixed ids and no date: the same assembly gives the same bytes
    with matplotlib.rc_context({"svg.hashsalt": "modcal", "svg.fonttype": "none"}):
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :]
