"""A picture of an assembly, as SVG text. Matplotlib is imported only when one is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.modules.assembly import Assembly
from modcal_core.modules.bodies import path
from modcal_core.modules.library import JOINT, Library, ModuleType
from modcal_core.modules.poe import module_frames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = {"base": "#40454d", "joint": "#1f6feb", "link": "#b0b7c3", "gripper": "#e08a26"}
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
        _tip(axes, frames[-1])
        _scale(axes, frames, high)
        if elevation == 0.0:  # seen along y, its numbers lie on top of each other
            axes.set_yticks([])
            axes.set_ylabel("")
    figure.suptitle(
        title or f"{assembly.name}: " + " ".join(_short(m.kind, m.size) for m in assembly.modules), fontsize=9
    )
    return _svg(figure)


def _short(kind: str, size: int) -> str:
    return kind + (f"({size})" if size else "")


def _draw(axes: Any, kind: ModuleType, points: Array, T: Array, high: float) -> None:
    world = se3.apply(T, points)
    width = 2.0 * _POINTS_PER_RADIUS * kind.radius / high
    axes.plot(*world.T, color=_COLOURS[kind.role], lw=width, solid_capstyle="butt", solid_joinstyle="round")
    for p in world[[0, -1]]:  # flanges
        axes.plot(*p[:, None], "o", color="#20242b", ms=0.25 * width)


def _mark(axes: Any, kind: ModuleType, T: Array, number: int) -> None:
    """A joint's axis, whole where it turns, dashed where it slides."""
    middle = T[:3, 3] + 0.5 * T[:3, :3] @ kind.output.at(0.0)
    ends = middle + np.outer([-_AXIS, _AXIS], T[:3, 2])
    axes.plot(*ends.T, color="#d1495b", lw=1.0, ls="-" if kind.revolute else "--")
    axes.text(*ends[1], str(number), color="#d1495b", fontsize=8)


def _tip(axes: Any, T: Array) -> None:
    for direction, colour in zip(T[:3, :3].T, ("#d1495b", "#3a7d44", "#1f6feb"), strict=True):
        axes.plot(*np.stack([T[:3, 3], T[:3, 3] + 0.06 * direction]).T, color=colour, lw=1.5)


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
