"""More vocabulary of rows: mixed joints, targets on other links, loads, contacts; motion, sockets, wires, a Delta."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from arms import Arm
from case import Scene, export
from scipy.spatial.transform import Rotation
from transforms import *

from modcal_core.measurements.recording import RANGE

CARRIED = ("payload", "carrie[sd]", "weight", r"\bload of", "mass at")
UNRELATED = ("do(?:es)? not (?:fit|follow|belong|go with)", "unrelated", "nothing to do with", "random")
# rows that belong elsewhere; "stations 40 to 60" or "rejected stations 3, 9" lead there as well
ELSEWHERE = (r"\brows?\b", "order of", "belong", "swapped", "exchanged", "shuffl", "station before", STATIONS)
STEPS = {
    # joints from a number on hold a linear map of their true positions, row by row
    "mixed": lambda c, i, *B: cols(c, np.s_[i : i + len(B) or None], lambda c, q: q @ np.array(B, float).T),
    # these postures, with second visits among them; a smooth course of several sines a joint, of a minute
    "tour": lambda c, q: let(c, visits=c.with_returns(c.of(q)), q=lambda c: c.visits[0], again=lambda c: c.visits[1]),
    "planned": lambda c: let(c, plan=course(c.w, c.rng, 60.0, 0.0)),
    # the second joint has a softer belt; the third link weighs more than any description knows [kg]
    "belt": lambda c, k: waits(c, lambda s, d: d.linear.__setitem__(1, k * d.linear[1])),
    "weighted": lambda c, kg: np.add.at(c.arm.model.body_mass, c.arm.model.body(c.arm.links[2]).id, kg),
    "SOME": lambda c: [c.names[k] for k in c.some],  # words: the joints that were drawn
}


def placed(values: Array, where: Array, others: Of) -> Array:
    """The values, with others at some places."""
    out = np.array(values)
    out[where] = others
    return out


def mirrored(R: Rotation) -> Rotation:
    """Rotations written in a frame whose y points the other way."""
    flip = np.diag([1.0, -1.0, 1.0])
    return Rotation.from_matrix(flip @ R.as_matrix() @ flip)


def on_link(c: Scene, k: int) -> tuple[Array, Rotation]:
    """What the instrument sees of a target that sits on a link as the tool does on the flange, (N, 3) and (N,)."""
    (p, R), (stand, eye) = c.links, c.tracker
    turn = Rotation.from_matrix(R[:, k])
    return eye.inv().apply(p[:, k] + turn.apply(c.tool[0]) - stand), eye.inv() * turn * c.tool[1]


def origin(block: str) -> Array:
    """The place of a joint, by its block of a URDF (3,)."""
    return np.array(re.search(r'<origin[^>]*xyz="([^"]*)"', block)[1].split(), float)  # type: ignore[index]


def sagging(c: Scene) -> Array:
    """How a slender probe sags across, and is pressed upwards, while the truth is bent (N, 2) [m]."""
    vertical = (c.arm.frames(c.d.x)[1][:, -1] @ c.tool[1].as_matrix())[:, 2]
    return -(6e-4 * np.abs(vertical[:, 2:]) * vertical[:, :2] + 4e-4 * np.maximum(vertical[:, 2:], 0.0))


def tip(c: Scene, q: Array) -> Array:
    """Where the tool's point is in the base at postures (N, 3)."""
    return c.arm.tool(q, c.tool[0])[0]


def pressing(c: Scene, force: Array) -> Array:
    """Torques (N, n) by which forces (N,) along the tool's axis, at its point, turn the joints."""
    at, axis, step = tip(c, c.q), c.tool_axes[:, :, 2], 1e-6
    lever = [np.sum((tip(c, c.q + step * e) - at) / step * -axis, axis=1) for e in np.eye(c.n)]
    return np.stack([force * one for one in lever], axis=1)


def as_drawn(c: Scene) -> Cell:
    """The cell with the arm of the drawing, as a controller or a simulation knows it."""
    twin = copy.copy(c.w)
    twin.arm = Arm.of(c.robot)
    return twin


def moving(c: Scene) -> None:
    """The arm on its ``plan``, with the faults that wait: t, q, p and R are those of the readings."""
    plan, s, bends, c.bends = c.plan, c.plan.stations, c.bends, []
    seen, m = c.poses(s, bends), len(s.t)
    p = seen.p + c.rng.normal(0, 1e-3 * NOISE_MM, (m, 3))
    R = seen.R * turn_noise(c.rng, 1e-3 * NOISE_MRAD, m)
    floor, never = float(np.sqrt(3.0)) * NOISE_MM, np.zeros(m, bool)

    def spoken(session: Session) -> Recording:
        stamps = BEGIN + plan.t
        joints = JointTrack(session.names, stamps, plan.q, plan.v, np.full_like(plan.q, np.nan), stamps)
        told = reading(BEGIN + np.round(session.t, 6), session.raw(), session.kind, session.frame)
        return Recording((joints,), (told,), (), session.urdf)

    c.session = Session(c.names, c.arm.urdf, s.t.copy(), s.q, p, R, floor, never, spoken=spoken)


def told(c: Scene) -> None:
    """Readings of several frames are recorded: ``reads``, rows among the stations and values by frame."""
    stamps = BEGIN + c.t
    tracks = tuple(reading(stamps[k], v, c.kind, name) for name, (k, v) in c.reads.items())
    written(c, lambda whole: replace(whole, readings=tracks))


PLATES = {"front": 0.05, "left": 0.08, "raised": 0.05}  # length of a plate [m], by its place
EACH = 24  # postures at a socket
Aside = Callable[[Scene, str, Array], Array]


def reaching(c: Scene, q: Array, goals: Array) -> tuple[Array, Array]:
    """Joints (N, n) near q that bring the tool's point to goals (N, 3), and whether they did so within the range."""
    q, good = c.arm.reaching(q, c.tool[0], goals)
    return q, good & np.all((q > c.arm.range[0]) & (q < c.arm.range[1]), axis=1)


def resting(c: Scene, socket: str, goal: Array, aside: Aside | None) -> Array:
    """Postures at which the ball rests in a socket, or aside of it (m, n)."""
    goals = np.repeat(goal[None], 12 * EACH, axis=0)
    q, good = reaching(c, c.rng.uniform(*c.arm.range, (len(goals), c.n)), goals)
    if aside is not None:
        q, fine = reaching(c, q, goals + aside(c, socket, q))
        good &= fine
    return q[good][:EACH]


def sockets(c: Scene, aside: Aside | None = None) -> None:
    """A ball on the tool rests in two sockets on each of three plates. aside: of its place (m, 3), by socket, q."""
    usual = tip(c, c.rng.uniform(*c.arm.range, (400, c.n)))
    near = usual[np.argsort(np.linalg.norm(usual - usual.mean(axis=0) - [0.1, 0.1, 0.0], axis=1))][:60]
    found: dict[str, Array] = {}
    for plate, length in PLATES.items():
        for _ in range(30):
            corner, way = near[c.rng.integers(len(near))], c.way(length)
            here = {f"{plate}_{k}": resting(c, f"{plate}_{k}", corner + k * way, aside) for k in range(2)}
            if all(len(q) == EACH for q in here.values()):
                break
        else:
            raise ArithmeticError("no place for a plate")
        found |= here
    every = np.concatenate(list(found.values()))
    rest, true = c.rng.normal(0, REPEAT, every.shape), tip(c, every)
    at = reaching(c, every, true + c.rng.normal(0, 1e-3 * NOISE_MM, (len(every), 3)))[0] + rest
    p = tip(c, at)
    c.reads = {name: (EACH * k + np.arange(EACH), np.zeros((EACH, 3))) for k, name in enumerate(found)}
    pointed(c, at, p, rms(1e3 * (p - true)))
    c.options = ("--cell", "{cell.yaml}")


def pointed(c: Scene, q: Array, p: Array, floor: float) -> None:
    """A recording of points (N, 3) at joints q, without returns."""
    t, R, never = PERIOD * np.arange(len(q)), Rotation.identity(len(q)), np.zeros(len(q), bool)
    c.session = Session(c.names, c.arm.urdf, t, q, p, R, floor, never, POINT)


def distances(**lengths: float) -> dict[str, str]:
    """The cell file that gives the distance of both sockets of each plate."""
    lines = [f"  - {{between: [{k}_0, {k}_1], distance_m: {v}, std_m: 5.0e-5}}" for k, v in lengths.items()]
    return {"cell.yaml": "distances:\n" + "\n".join(lines) + "\n"}


def wires(c: Scene, count: int, off: Callable[[int, Array, Array], Array]) -> None:
    """Three draw wires, each to its own anchor. off: of its length (N,), by wire, where it goes (N, 3), length."""
    q, again = c.postures(count)
    seen, (stand, eye) = c.observe(q, again, noise_mm=0.0), c.tracker
    true, rows, c.reads = seen.p @ eye.as_matrix().T + stand, np.arange(count), {}
    for k, azimuth in enumerate(c.rng.uniform(0, 0.5) + np.array([0.3, 2.3, 4.4])):
        anchor = np.array([1.9 * np.cos(azimuth), 1.9 * np.sin(azimuth), (0.1, 1.2, 0.5)[k]])
        length = np.linalg.norm(true - anchor, axis=1)
        read = length + off(k, (true - anchor) / length[:, None], length) + c.rng.normal(0, 1e-3 * NOISE_MM, count)
        c.reads[f"wire_{k + 1}"] = (rows, read[:, None])
    exact = c.observe(q, again, noise_mm=0.0, repeat=0.0)
    floor = float(np.hypot(NOISE_MM, 1e3 * rms(seen.p - exact.p) / np.sqrt(3.0)))
    c.session = Session(c.names, c.arm.urdf, seen.t, q, seen.p, seen.R, floor, again, RANGE)


def eyelet(k: int, way: Array, length: Array) -> Array:
    """What the third wire is longer that lies on a rounded edge of its box, the more the farther aside it is (N,)."""
    out = way.mean(axis=0) + [0.0, 0.0, 0.5]
    angle = np.arccos(np.clip(way @ out / np.linalg.norm(out), -1.0, 1.0))
    return (16e-3 * (angle - np.sin(angle)) + 2e-3 * angle) * (k == 2)


DELTA = """modcal_delta: 1
joints: [arm_1, arm_2, arm_3]
arms: {proximal_m: 0.28, distal_m: 0.75, fixed_radius_m: 0.19, platform_radius_m: 0.05}
limits_rad: {arm_1: [-0.6, 1.2], arm_2: [-0.6, 1.2], arm_3: [-0.6, 1.2]}
tool: {position_m: [0.05, -0.03, -0.09], rotation_rad: [0.0, 0.0, 0.0]}
"""


def platform(theta: Array, offset: Array, proximal: Array, distal: Array, azimuth: Array) -> Array:
    """Where the platform hangs (N, 3): the lower of two points at rods' lengths (N, 3) from three elbows."""
    out = offset + proximal * np.cos(theta)
    elbows = np.stack([out * np.cos(azimuth), out * np.sin(azimuth), -proximal * np.sin(theta)], axis=-1)
    ex, across = elbows[:, 1] - elbows[:, 0], elbows[:, 2] - elbows[:, 0]
    d = np.linalg.norm(ex, axis=1, keepdims=True)
    ex = ex / d
    i = np.sum(ex * across, axis=1, keepdims=True)
    ey = across - i * ex
    ey /= np.linalg.norm(ey, axis=1, keepdims=True)
    j, r = np.sum(ey * across, axis=1, keepdims=True), distal**2
    x = (r[:, :1] - r[:, 1:2] + d**2) / (2 * d)
    y = (r[:, :1] - r[:, 2:] + i**2 + j**2 - 2 * i * x) / (2 * j)
    z, ez = np.sqrt(r[:, :1] - x**2 - y**2), np.cross(ex, ey)
    return elbows[:, 0] + x * ex + y * ey - np.sign(ez[:, 2:]) * z * ez


def delta(c: Scene, count: int, lost: Callable[[Array], Array], longer: Callable[[Array], Array]) -> None:
    """Points of a Delta that is off as built. lost: of the second encoder, by row; longer: its rods, by its angle."""
    rng, side = c.rng, np.array([0.0, 1.0, 0.0])
    q = rng.uniform(-0.45, 1.0, (3 * count, 3))
    q = q[np.ptp(q, axis=1) < 1.0][: count - 6]
    q = q[np.r_[np.arange(len(q)), rng.choice(len(q) - 20, 6, replace=False)]]
    zero, offset, proximal = (rng.normal(0, s, 3) for s in (1e-3, 5e-4, 5e-4))
    rods, azimuth = 0.75 + rng.normal(0, 5e-4, 3), np.radians([0.0, 120.0, -120.0]) + rng.normal(0, 1e-3, 3)
    tool = np.array([0.05, -0.03, -0.09]) + rng.normal(0, 5e-4, 3)
    turn, at = Rotation.random(rng=rng), rng.normal(0, 1.0, 3) + [0.0, 0.0, 2.0]
    rows = np.arange(count)

    def seen(q: Array) -> Array:
        theta = q + zero + np.outer(lost(rows), side)
        rod = rods + longer(theta) * side
        return turn.apply(platform(theta, 0.14 + offset, 0.28 + proximal, rod, azimuth) + tool) + at

    exact, real = seen(q), seen(q + rng.normal(0, REPEAT, q.shape))
    p = real + rng.normal(0, 1e-3 * NOISE_MM, real.shape)
    floor = 1e3 * rms(p - exact)
    pointed(c, q, p, floor)
    c.session = replace(c.session, names=("arm_1", "arm_2", "arm_3"), urdf="", again=rows >= count - 6)
    c.options = ("--delta", "{delta.yaml}")


export(globals(), STEPS)
WIDEST = let(i=lambda c: int(np.argmax(c.arm.range[1] - c.arm.range[0])))  # the joint of the widest range
BY_NAME = rows(lambda c: np.array(sorted(c.rows, key=lambda k: str(k + 1))))  # 1, 10, 100, 101, ...
