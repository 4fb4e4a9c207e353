"""Forward and inverse kinematics of a Delta in closed form, and how everything moves its tool.

Differentiating |p − C_i| = L2_i with the unit vectors s_i along the rods gives ``s_i · δp = s_i · δC_i + δL2_i``: what
happens to an arm reaches the platform through one number, its share along the rod. With S the rows s_i and g_i the
columns of S⁻¹,

    δp = Σ_i g_i (s_i · δC_i + δL2_i).

So a small twist (v, ω) at a shoulder A_i, or a tower's foot, with its elbow or carriage at E_i moves the tool by
g_i s_i · (v + ω × (E_i − A_i)): a column like any other of the error model (:class:`Loop`).

Two things can go wrong. The platform is *loose* where the three rods lie in one plane: det S = 0, and the arms do not
hold it. An arm is *stretched* where it lies in line with its rod: s_i · ∂C_i/∂θ_i = 0, and its motor moves nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import remainder

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import NotReachable
from modcal_core.geometry import Array, cross
from modcal_core.robots.delta import (
    ARMS,
    AZIMUTH,
    CONSTANTS,
    DISTAL,
    OFFSET,
    PARAMETERS,
    PROXIMAL,
    RATIO,
    ZERO,
    Delta,
    Stand,
    inverse_rows,
    level_rods,
    tilted,
    tilted_loops,
)
from modcal_core.robots.kinematics import Frames, Loop, moved_frame

# rows of an arm's twist: by how much its rods differ, per spacing; behind it that times four lengths (of Stand)
RODS, ROWS = 6, 11
LOOSE = 0.05  # |det S| below which the platform counts as loose; three rods at right angles have 1
STRETCHED = 0.02  # sine of the angle between arm and rod below which the arm counts as stretched


def frames(
    delta: Delta,
    q: ArrayLike,
    twists: Mapping[int, Array] | None = None,
    T_tip_tool: Array | None = None,
    loops: bool = True,
) -> Frames:
    """Frames of every place in the base for joint positions q (N, n) [rad, m]: base, shoulders, shaft, tool.

    twists: small motions (6, N) [m, rad] put in at places, each in the frame of its place; of an arm, five rows more
    say how its two rods differ (see RODS). T_tip_tool: puts the tool's place at the tool instead of the tip. loops:
    whether it is asked how the arms move the tool. A shoulder's frame has x outwards and z along the axis;
    that of a tower, at its foot, has z along the rail. Postures that no platform can take are NaN; :func:`forward`
    refuses them.
    """
    twists = twists or {}
    q = np.asarray(q, dtype=float)
    N, last = len(q), delta.tool_place
    axes, p = np.zeros((last + 1, 3, 3, N)), np.zeros((last + 1, 3, N))
    axes[0] = np.eye(3)[:, :, None]
    if 0 in twists:
        moved_frame(axes[0], p[0], twists[0])
    zero, ratio, azimuth, offset, proximal, distal = delta.constants
    theta = (q[:, :ARMS] * ratio + zero).T  # (3, N)
    arm, centre = np.empty((ARMS, 3, N)), np.empty((ARMS, 3, N))
    stands = np.empty((ARMS, 3, 3, N))  # the arms' axes as the platform knows them
    for i in range(ARMS):
        out = np.array([np.cos(azimuth[i]), np.sin(azimuth[i]), 0.0])
        tangent = np.array([-out[1], out[0], 0.0])
        local = np.stack([out, [0.0, 0.0, -1.0], tangent])
        flat = axes[0].reshape(3, 3 * N)
        axes[1 + i] = stands[i] = (local @ flat).reshape(3, 3, N)
        p[1 + i] = p[0] + offset[i] * axes[1 + i, 0]
        if delta.linear:
            c, s = np.cos(proximal[i]), np.sin(proximal[i])
            out, down, tangent = stands[i]
            axes[1 + i] = c * out + s * down, tangent, s * out - c * down
        if 1 + i in twists:
            moved_frame(axes[1 + i], p[1 + i], twists[1 + i])
        x, y, z = axes[1 + i]
        arm[i] = theta[i] * z if delta.linear else proximal[i] * (np.cos(theta[i]) * x + np.sin(theta[i]) * y)
        centre[i] = p[1 + i] + arm[i]
    platform = _meeting_point(centre, distal, axes[0, 2])
    tip = axes[0].copy()
    stand: Stand | None = None
    if rods := {i: twists[1 + i] for i in range(ARMS) if 1 + i in twists and len(twists[1 + i]) > RODS}:
        unequal = np.zeros((ROWS - RODS, ARMS, N))
        for i, twist in rods.items():
            unequal[:, i] = twist[RODS:ROWS]

        def placed(shift: Array) -> tuple[Array, Array]:
            at = _meeting_point(centre - shift, distal, axes[0, 2])
            return at, (at - centre + shift) / distal[:, None, None]

        stand = tilted(unequal, delta.platform_radius, stands, placed)
        tip = np.einsum("nij,djn->din", stand.R, tip)
        platform = stand.middle + np.einsum("cn,cdn->dn", stand.lengths[1:], tip - axes[0])
    at = platform.copy()
    if delta.has_shaft:
        place = 1 + ARMS
        axes[place], p[place] = tip, at
        if place in twists:
            moved_frame(axes[place], p[place], twists[place])
        c, s = np.cos(delta.shaft_ratio * q[:, ARMS]), np.sin(delta.shaft_ratio * q[:, ARMS])
        x, y, z = axes[place]
        tip, at = np.stack([c * x + s * y, c * y - s * x, z]), p[place]
    T = np.eye(4) if T_tip_tool is None else T_tip_tool
    flat = tip.reshape(3, 3 * N)
    axes[last] = (T[:3, :3].T @ flat).reshape(3, 3, N)
    p[last] = at + (T[:3, 3] @ flat).reshape(3, N)
    if last in twists:
        moved_frame(axes[last], p[last], twists[last])
    return Frames(axes, p, _loops(delta, q, axes, p, arm, centre, platform, stands, stand) if loops else {})


def forward(delta: Delta, q: ArrayLike) -> Array:
    """Tip poses T_base_tip (..., 4, 4) for joint positions q (..., n). Raises NotReachable where no platform fits the
    arms, and where they leave it loose.
    """
    q = np.asarray(q, dtype=float)
    flat = q.reshape(-1, delta.n)
    f = frames(delta, flat)
    _require_held(delta, flat, f)
    return f.transform(-1).reshape(q.shape[:-1] + (4, 4))


def reachable(delta: Delta, q: ArrayLike) -> np.ndarray:
    """True for postures q (N, n) that a platform fits, held by its arms, no arm stretched, (N,)."""
    f = frames(delta, q)
    with np.errstate(invalid="ignore"):
        return (looseness(f) > LOOSE) & (stretch(delta, f) > STRETCHED).all(axis=0)


def looseness(f: Frames) -> Array:
    """|det S|, (N,): 0 where the platform is loose, 1 where its rods stand at right angles; NaN where none fits."""
    s = [f.loops[1 + i].along[0] for i in range(ARMS)]
    return np.abs(np.sum(s[0] * cross(s[1], s[2]), axis=0))


def stretch(delta: Delta, f: Frames) -> Array:
    """Sines of the angles between each arm and its rod as the motor sees them, (3, N); of a linear Delta the cosines of
    those between a tower and its rod, negative where the rod leads upwards.
    """
    rates = np.stack([f.loops[1 + i].rates[0, ZERO] for i in range(ARMS)])
    return -rates if delta.linear else np.abs(rates) / delta.constants[PROXIMAL, :, None]


def delta_inverse(delta: Delta, position: ArrayLike, yaw: float = 0.0) -> Array:
    """The posture q (n,) [rad] with the tip at a position (3,) [m] in the base, turned about z by yaw [rad].

    Of the two postures of an arm the one with its elbow outwards is taken. Raises NotReachable, naming the arm and by
    how much, where it cannot be reached, is outside the limits, or would leave an arm stretched or the platform loose.
    """
    at = np.asarray(position, dtype=float)
    where = f"position ({', '.join(f'{x:.4f}' for x in at)}) m"
    theta = np.empty(ARMS)
    for i, (zero, ratio, azimuth, offset, L1, L2) in enumerate(delta.constants.T):
        c, s = np.cos(azimuth), np.sin(azimuth)
        x, y, z = c * at[0] + s * at[1] - offset, c * at[1] - s * at[0], at[2]
        if delta.linear:  # a carriage h (sin λ, 0, cos λ) is L2 away, above the platform
            lean = np.array([np.sin(L1), np.cos(L1)])
            gap, how = float(np.hypot(lean @ [-z, x], y)) - L2, "too far away"
        else:
            far = float(np.hypot(x, z))
            gap, how = max((np.hypot(far - L1, y) - L2, "too far away"), (L2 - np.hypot(far + L1, y), "too near"))
        if not gap <= 0.0:
            said = f"{1e3 * gap:.1f} mm {how} for {'tower' if delta.linear else 'arm'} {delta.names[i]}"
            raise NotReachable(where, said, "ask for a position within reach", position=float(gap))
        if delta.linear:
            angle = lean @ [x, z] + np.sqrt(L2 * L2 - (gap + L2) ** 2)
        else:  # the elbow L1 (cos θ, 0, −sin θ) is L2 away:  x cos θ − z sin θ = (x² + y² + z² + L1² − L2²) / 2 L1
            wanted = (x * x + y * y + z * z + L1 * L1 - L2 * L2) / (2.0 * L1)
            angle = remainder(np.arctan2(-z, x) - np.arccos(np.clip(wanted / far, -1.0, 1.0)), 2.0 * np.pi)
        theta[i] = (angle - zero) / ratio
    q = np.r_[theta, [yaw / delta.shaft_ratio] * delta.has_shaft]
    for j, name in enumerate(delta.names):
        beyond = max(float(delta.lower[j] - q[j]), float(q[j] - delta.upper[j]))
        if beyond > 1e-9:
            unit = "rad" if delta.revolute[j] else "m"
            said = f"joint {name} would be at {q[j]:.4f} {unit}, {beyond:.4f} {unit} beyond its limits"
            raise NotReachable(where, said, "ask for a position within the limits", posture=q)
    f = frames(delta, q[None])
    _require_held(delta, q[None], f)
    sine = stretch(delta, f)[:, 0]
    worst = int(np.argmin(sine))
    if sine[worst] < STRETCHED:
        said = f"arm {delta.names[worst]} is {np.degrees(sine[worst]):.2f} degrees from in line with its rod, "
        limit = f"{np.degrees(STRETCHED):.2f} are the least"
        raise NotReachable(where, said + limit, "stay away from where the arm is stretched", posture=q)
    return q


def tool_pose(delta: Delta, q: ArrayLike) -> Array:
    """Poses (..., 4, 4) [m] of the drawing's tool in the base for joint positions q (..., n) [rad]."""
    return forward(delta, q) @ delta.T_tip_tool


def tool_positions(delta: Delta, q: ArrayLike) -> Array:
    """Positions (3, N) [m] of the drawing's tool for joint positions q (N, n) [rad]; NaN where no platform fits."""
    return frames(delta, q, T_tip_tool=delta.T_tip_tool, loops=False).p[-1]


def position_jacobians(delta: Delta, q: ArrayLike) -> tuple[Array, Array, Array]:
    """Positions (N, 3) [m] of the drawing's tool, and their derivatives by :attr:`Delta.vector` (N, 3, 24) and by the
    joints (N, 3, n). NaN where no platform fits.
    """
    q = np.asarray(q, dtype=float)
    f = frames(delta, q, T_tip_tool=delta.T_tip_tool)
    N, last = len(q), delta.tool_place
    of_parameters = np.zeros((N, 3, PARAMETERS))
    of_joints = np.zeros((N, 3, delta.n))
    for i in range(ARMS):
        loop = f.loops[1 + i]
        for row in range(CONSTANTS):
            of_parameters[:, :, row * ARMS + i] = (loop.shift[0] * loop.rates[0, row]).T
        of_joints[:, :, i] = delta.constants[RATIO, i] * (loop.shift[0] * loop.rates[0, ZERO]).T
    if delta.has_shaft:
        lever = f.p[last] - f.p[last - 1]
        of_joints[:, :, ARMS] = delta.shaft_ratio * cross(f.axes[last - 1, 2], lever).T
    of_parameters[:, :, -6:-3] = f.rotation(last) @ delta.T_tip_tool[:3, :3].T  # a shift is along the tip's axes
    return f.p[last].T, of_parameters, of_joints


def payload_wrench(delta: Delta, q: ArrayLike, weight: float) -> Array:
    """What a weight [N] at the tip, along −z, asks of every joint, (n, 6, N); row 5 is the torque about its axis [N m].
    By virtual work.
    """
    f = frames(delta, q)
    out = np.zeros((delta.n, 6, f.p.shape[2]))
    for i in range(ARMS):
        loop, none = f.loops[1 + i], np.zeros(3)
        for d, axis in enumerate(f.axes[1 + i]):
            out[i, d] = -weight * loop.moved(axis, none, f.p[-1])[0][2]
            out[i, 3 + d] = -weight * loop.moved(none, axis, f.p[-1])[0][2]
    if delta.has_shaft:
        out[ARMS, :3] = -weight * f.axes[1 + ARMS, :, 2]
    return out


def _meeting_point(C: Array, L: Array, up: Array) -> Array:
    """The lower of the two points (3, N) at distances L (3,) from three centres C (3, 3, N); NaN: there is none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        b, c = C[1] - C[0], C[2] - C[0]
        d = np.sqrt(np.sum(b * b, axis=0))
        ex = b / d
        i = np.sum(ex * c, axis=0)
        ey = c - i * ex
        j = np.sqrt(np.sum(ey * ey, axis=0))
        ey = ey / j
        ez = cross(ex, ey)
        ez = ez * -np.where(np.sum(ez * up, axis=0) < 0.0, -1.0, 1.0)
        x = (L[0] ** 2 - L[1] ** 2 + d * d) / (2.0 * d)
        y = (L[0] ** 2 - L[2] ** 2 + i * i + j * j - 2.0 * i * x) / (2.0 * j)
        z = np.sqrt(L[0] ** 2 - x * x - y * y)
        return np.asarray(C[0] + x * ex + y * ey + z * ez)


def _loops(
    delta: Delta,
    q: Array,
    axes: Array,
    p: Array,
    arm: Array,
    centre: Array,
    platform: Array,
    stands: Array,
    stand: Stand | None,
) -> dict[int, Loop]:
    distal = delta.constants[DISTAL]
    along = (platform - centre) / distal[:, None, None] if stand is None else stand.along  # (3 arms, 3, N)
    gains = inverse_rows(along)
    up = axes[0, 2]
    rates, ends = np.empty((ARMS, CONSTANTS, q.shape[0])), np.zeros((ARMS, CONSTANTS, 3, q.shape[0]))
    for i in range(ARMS):
        axis, lever = axes[1 + i, 2], arm[i]
        ends[i, ZERO] = axis if delta.linear else cross(axis, lever)
        ends[i, RATIO] = q[:, i] * ends[i, ZERO]
        ends[i, AZIMUTH] = cross(up, centre[i] - p[0])
        out = np.cos(delta.constants[AZIMUTH, i]) * axes[0, 0] + np.sin(delta.constants[AZIMUTH, i]) * axes[0, 1]
        ends[i, OFFSET] = out
        leant = (q[:, i] * delta.constants[RATIO, i] + delta.constants[ZERO, i]) * axes[1 + i, 0]
        ends[i, PROXIMAL] = leant if delta.linear else lever / delta.constants[PROXIMAL, i]
        rates[i] = np.einsum("cn,kcn->kn", along[i], ends[i])
        rates[i, DISTAL] = 1.0
    if stand is not None:
        return dict(enumerate(tilted_loops(stand, distal, rates, ends, axes[0], arm), 1))
    rods = level_rods(stands, along, gains, delta.platform_radius, axes[0])
    level, out = np.zeros((1, *platform.shape)), dict[int, Loop]()
    for i in range(ARMS):
        own = along[i : i + 1], gains[i : i + 1], level, rates[i : i + 1]
        out[1 + i] = Loop(*own, arm[i], platform, rods[i])
    return out


def _require_held(delta: Delta, q: Array, f: Frames) -> None:
    det = looseness(f)
    missing = np.flatnonzero(~np.isfinite(det))
    if len(missing):
        k = int(missing[0])
        gap = _shortfall(delta, q[k])
        said = f"no platform fits: the rods are {1e3 * gap:.1f} mm too short to meet"
        raise NotReachable(_posture(delta, q[k], len(missing)), said, "correct the constants, or leave it out", gap)
    worst = int(np.argmin(det)) if len(det) else 0
    if len(det) and det[worst] < LOOSE:
        said = f"the rods lie nearly in one plane (det {det[worst]:.4f}, {LOOSE} is the least): the platform is loose"
        count = int((det < LOOSE).sum())
        raise NotReachable(_posture(delta, q[worst], count), said, "stay away from it, or leave it out")


def _posture(delta: Delta, q: Array, count: int) -> str:
    values = ", ".join(f"{name} {x:.3f}" for name, x in zip(delta.names, q, strict=True))
    return f"posture {values} {'m' if delta.linear else 'rad'}" + (f" and {count - 1} more" if count > 1 else "")


def _shortfall(delta: Delta, q: Array) -> float:
    """By how much the rods are too short to meet [m], the same for all: found by making them longer together."""
    low, high = 0.0, delta.reach()
    for _ in range(60):
        middle = 0.5 * (low + high)
        longer = delta.moved(np.outer(np.eye(CONSTANTS)[DISTAL], np.full(ARMS, middle)))
        fits = np.isfinite(frames(longer, q[None]).p[-1]).all()
        low, high = (low, middle) if fits else (middle, high)
    return high
