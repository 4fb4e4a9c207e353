"""Cells of the sixth group with generators of their own: motion, sockets, draw wires and a Delta.

They stand beside the cell that the other kinds use; none of them comes from modcal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from case import Case, calibrated
from fault import Fault
from fresh_sixth import TIMING, sixth
from physics import tilted
from recordings import Plan, course
from regimes import BASE
from scipy.spatial.transform import Rotation
from workcell import BEGIN, NOISE_MM, NOISE_MRAD, PERIOD, REPEAT, Array, Bend, Session, Works

from modcal_core.measurements.recording import POINT, POSE, RANGE, JointTrack, ReadingTrack, Recording

# --- motion: joint states at 125 Hz, readings at 50 Hz ---------------------------------------------------------------


@dataclass(frozen=True)
class Moving(Session):
    """A motion: t, q, p, R are those of the readings; the joint states have stamps of their own."""

    plan: Plan | None = None

    def recording(self) -> Recording:
        """Both tracks."""
        assert self.plan is not None
        unknown, stamps = np.full_like(self.plan.q, np.nan), BEGIN + self.plan.t
        joints = JointTrack(self.names, stamps, self.plan.q, self.plan.v, unknown, stamps)
        read = BEGIN + np.round(self.t, 6)
        reading = ReadingTrack(POSE, self.frame, read, self.raw(), read)
        return Recording((joints,), (reading,), self.signals, self.urdf)


def _moving(w: Works, bend: Callable[[Plan], Bend] | None = None, duration: float = 60.0) -> Moving:
    """The arm on a smooth course of several sines a joint; nothing is visited twice."""
    plan = course(w.cell, w.rng, duration, 0.0)
    s = plan.stations
    faults = () if bend is None else (Fault((), (), (), "", bend(plan)),)
    seen, m = w.cell.poses(s, faults), len(s.t)
    p = seen.p + w.rng.normal(0, 1e-3 * NOISE_MM, (m, 3))
    R = seen.R * Rotation.from_rotvec(w.rng.normal(0, 1e-3 * NOISE_MRAD, (m, 3)))
    floor = float(np.sqrt(3.0)) * NOISE_MM
    return Moving(w.names, w.arm.urdf, s.t.copy(), s.q, p, R, floor, np.zeros(m, bool), plan=plan)


@sixth
def stamps_jitter_while_moving(w: Works, rng: np.random.Generator) -> Case:
    """Readings are stamped by a busy computer, up to 8 ms late at random, while the tool moves at 0.3 m/s."""
    session = _moving(w)
    t = np.sort(session.t + rng.uniform(0.0, 8e-3, len(session)))
    return calibrated(replace(session, t=t), (*TIMING, "speed", "moving", "motion", "veloc"))


@sixth
def latency_grows_half_way(w: Works, rng: np.random.Generator) -> Case:
    """Half way the tracker's filter is switched to a smoother one, and its poses come 25 ms later from then on."""
    session = _moving(w)
    late = 25e-3 * (session.t > 31.0)
    return calibrated(replace(session, t=session.t + late), (*TIMING, "speed", "veloc"))


@sixth
def stamps_counted_from_frames(w: Works, rng: np.random.Generator) -> Case:
    """A stamp is the number of the frame times its period, while five frames got lost on the way uncounted."""
    session = _moving(w)
    lost = np.zeros(len(session), int)
    lost[rng.choice(np.arange(200, len(session) - 200), 5, replace=False)] = 1
    t = session.t - 0.02 * np.cumsum(lost)
    return calibrated(replace(session, t=t), (*TIMING, "speed", "veloc"))


@sixth
def swings_with_its_acceleration(w: Works, rng: np.random.Generator) -> Case:
    """A tall pedestal twists under the first joint's acceleration: 6 Hz, nobody waits for it."""

    def bend(plan: Plan) -> Bend:
        a = np.interp(plan.stations.t, plan.t, plan.a[:, 0])
        turn = -np.outer(a / (2 * np.pi * 4.0) ** 2, [0.0, 0.0, 1.0])
        return tilted(w, lambda s: turn)

    return calibrated(_moving(w, bend), (*BASE, w.names[0], w.arm.parents[0], "accelerat"))


# --- sockets ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Told(Session):
    """Readings of several frames, each with its rows among the stations."""

    reads: tuple[tuple[str, str, Array, Array], ...] = ()  # kind, frame, rows, values (m, k)

    def recording(self) -> Recording:
        """One track of joint states, and one a frame."""
        unknown, stamps = np.full_like(self.q, np.nan), BEGIN + self.t
        joints = JointTrack(self.names, stamps, self.q, unknown, unknown, stamps)
        tracks = tuple(ReadingTrack(kind, frame, stamps[rows], v, stamps[rows]) for kind, frame, rows, v in self.reads)
        return Recording((joints,), tracks, self.signals, self.urdf or None)


def _put(w: Works, q: Array, goals: Array) -> tuple[Array, Array]:
    """Joints (N, n) near q that bring the tool's point to goals (N, 3), and whether they did so within the range."""

    def point(q: Array) -> Array:
        p, R = w.arm.frames(w.arm.coordinates(q))
        return p[:, -1] + R[:, -1] @ w.cell.tool[0]

    for _ in range(25):
        at = point(q)
        J = np.stack([(point(q + 1e-6 * e) - at) / 1e-6 for e in np.eye(w.arm.n)], axis=2)
        step = np.swapaxes(J, 1, 2) @ np.linalg.solve(
            J @ np.swapaxes(J, 1, 2) + 1e-6 * np.eye(3), (goals - at)[..., None]
        )
        q = q + np.clip(step[..., 0], -0.3, 0.3)
    good = np.linalg.norm(point(q) - goals, axis=1) < 1e-7
    return q, good & np.all((q > w.arm.range[0]) & (q < w.arm.range[1]), axis=1)


PLATES = {"front": 0.05, "left": 0.08, "raised": 0.05}  # length of a plate [m], by its place


def _sockets(w: Works, off: Callable[[str, Array], Array] | None = None, each: int = 24) -> Told:
    """A ball on the tool that rests in two sockets on each of three plates. off: of its place (m, 3), by socket, q."""
    rng, names, q, frames = w.rng, [], [], []
    p, R = w.arm.frames(w.arm.coordinates(rng.uniform(*w.arm.range, (400, w.arm.n))))
    usual = p[:, -1] + R[:, -1] @ w.cell.tool[0]
    near = usual[np.argsort(np.linalg.norm(usual - usual.mean(axis=0) - [0.1, 0.1, 0.0], axis=1))][:60]
    for plate, length in PLATES.items():
        for _ in range(30):
            corner, way = near[rng.integers(len(near))], w.way(length)
            found = []
            for k in range(2):
                goal = np.repeat((corner + k * way)[None], 12 * each, axis=0)
                begin = rng.uniform(*w.arm.range, (len(goal), w.arm.n))
                reached, good = _put(w, begin, goal)
                if off is not None:
                    moved, fine = _put(w, reached, goal + off(f"{plate}_{k}", reached))
                    reached, good = moved, good & fine
                found.append(reached[good][:each])
            if all(len(f) == each for f in found):
                break
        else:
            raise ArithmeticError("no place for a plate")
        for k in range(2):
            names.append(f"{plate}_{k}")
            frames += [f"{plate}_{k}"] * each
            q.append(found[k])
    where, every = np.array(frames), np.concatenate(q)
    rest = rng.normal(0, REPEAT, every.shape)
    at, lean = _put(w, every, _point(w, every) + rng.normal(0, 1e-3 * NOISE_MM, (len(every), 3)))[0] + rest, []
    for name in names:
        rows = np.flatnonzero(where == name)
        lean.append((POINT, name, rows, np.zeros((len(rows), 3))))
    t = PERIOD * np.arange(len(every))
    off_by = 1e3 * (_point(w, at) - _point(w, every))
    floor = float(np.sqrt(np.mean(np.sum(off_by**2, axis=1))))
    none = np.zeros(len(every), bool)
    return Told(
        w.names, w.arm.urdf, t, at, _point(w, at), Rotation.identity(len(at)), floor, none, POINT, reads=tuple(lean)
    )


def _point(w: Works, q: Array) -> Array:
    p, R = w.arm.frames(w.arm.coordinates(q))
    return p[:, -1] + R[:, -1] @ w.cell.tool[0]


def _distances(**lengths: float) -> str:
    lines = [f"  - {{between: [{k}_0, {k}_1], distance_m: {v}, std_m: 5.0e-5}}" for k, v in lengths.items()]
    return "distances:\n" + "\n".join(lines) + "\n"


def _in_sockets(session: Told, words: tuple[str, ...], lengths: dict[str, float] = PLATES) -> Case:
    steps = (("calibrate", "{bag}", "--cell", "{cell.yaml}"),)
    return Case({"bag": session}, steps, True, words, floor=False, files={"cell.yaml": _distances(**lengths)})


@sixth
def one_socket_worn(w: Works, rng: np.random.Generator) -> Case:
    """One socket is worn: the ball lies up to 0.8 mm aside, to where the tool leans."""

    def off(socket: str, q: Array) -> Array:
        _, R = w.arm.frames(w.arm.coordinates(q))
        return 8e-4 * R[:, -1, :, 0] if socket == "left_1" else np.zeros((len(q), 3))

    return _in_sockets(_sockets(w, off), ("left_1",))


@sixth
def postures_under_another_sockets_name(w: Works, rng: np.random.Generator) -> Case:
    """The operator changed the socket eight postures before he changed its name."""
    session = _sockets(w)
    reads = list(session.reads)
    a, b = (next(k for k, r in enumerate(reads) if r[1] == name) for name in ("raised_0", "raised_1"))
    moved = reads[b][2][:8]
    for k, rows in ((a, np.r_[reads[a][2], moved]), (b, reads[b][2][8:])):
        reads[k] = (POINT, reads[k][1], rows, np.zeros((len(rows), 3)))
    return _in_sockets(replace(session, reads=tuple(reads)), ("raised_0", "raised_1", r"stations \d"))


@sixth
def distances_of_two_plates_exchanged(w: Works, rng: np.random.Generator) -> Case:
    """The cell file gives the distance of the long plate's sockets for a short plate's, and the other way round."""
    lengths = {**PLATES, "front": PLATES["left"], "left": PLATES["front"]}
    return _in_sockets(_sockets(w), ("distance", "front_[01]", "left_[01]"), lengths)


# --- draw wires ------------------------------------------------------------------------------------------------------


def _wired(w: Works, off: Callable[[int, Array, Array], Array]) -> Told:
    """Three draw wires, each to its own anchor. off: of its length (N,), by wire, where it goes (N, 3), length."""
    q, again = w.postures(150)
    seen = w.observe(q, again, noise_mm=0.0)
    true, rows, reads = seen.p @ w.cell.tracker[1].as_matrix().T + w.cell.tracker[0], np.arange(150), []
    for k, azimuth in enumerate(w.rng.uniform(0, 0.5) + np.array([0.3, 2.3, 4.4])):
        anchor = np.array([1.9 * np.cos(azimuth), 1.9 * np.sin(azimuth), (0.1, 1.2, 0.5)[k]])
        length = np.linalg.norm(true - anchor, axis=1)
        read = length + off(k, (true - anchor) / length[:, None], length) + w.rng.normal(0, 1e-3 * NOISE_MM, 150)
        reads.append((RANGE, f"wire_{k + 1}", rows, read[:, None]))
    exact = w.observe(q, again, noise_mm=0.0, repeat=0.0)
    missed = 1e3 * float(np.sqrt(np.mean((seen.p - exact.p) ** 2)))
    session = Told(w.names, w.arm.urdf, seen.t, q, seen.p, seen.R, float(np.hypot(NOISE_MM, missed)), again, RANGE)
    return replace(session, reads=tuple(reads))


@sixth
def draw_wire_climbs_its_drum(w: Works, rng: np.random.Generator) -> Case:
    """Short of half its length the second wire lies in two layers on its drum: each turn is 0.2 % longer there."""
    return calibrated(_wired(w, lambda k, way, d: 2e-3 * np.minimum(d - np.median(d), 0.0) * (k == 1)), ("wire_2",))


@sixth
def draw_wire_bends_round_its_eyelet(w: Works, rng: np.random.Generator) -> Case:
    """The third wire leaves its box round a rounded edge of 16 mm, and lies on it more the farther aside it is."""

    def off(k: int, way: Array, d: Array) -> Array:
        if k != 2:
            return np.zeros(len(d))
        out = way.mean(axis=0) + [0.0, 0.0, 0.5]
        angle = np.arccos(np.clip(way @ out / np.linalg.norm(out), -1.0, 1.0))
        return 16e-3 * (angle - np.sin(angle)) + 2e-3 * angle

    return calibrated(_wired(w, off), ("wire_3",))


# --- a Delta, by three spheres ---------------------------------------------------------------------------------------

DELTA = """modcal_delta: 1
joints: [arm_1, arm_2, arm_3]
arms: {proximal_m: 0.28, distal_m: 0.75, fixed_radius_m: 0.19, platform_radius_m: 0.05}
limits_rad: {arm_1: [-0.6, 1.2], arm_2: [-0.6, 1.2], arm_3: [-0.6, 1.2]}
tool: {position_m: [0.05, -0.03, -0.09], rotation_rad: [0.0, 0.0, 0.0]}
"""


def _platform(theta: Array, offset: Array, proximal: Array, distal: Array, azimuth: Array) -> Array:
    """Where the platform hangs (N, 3): the lower of two points at rods' lengths (N, 3) from three elbows."""
    out = offset + proximal * np.cos(theta)
    c = np.stack([out * np.cos(azimuth), out * np.sin(azimuth), -proximal * np.sin(theta)], axis=-1)
    ex = c[:, 1] - c[:, 0]
    d = np.linalg.norm(ex, axis=1, keepdims=True)
    ex = ex / d
    across = c[:, 2] - c[:, 0]
    i = np.sum(ex * across, axis=1, keepdims=True)
    ey = across - i * ex
    ey /= np.linalg.norm(ey, axis=1, keepdims=True)
    j = np.sum(ey * across, axis=1, keepdims=True)
    r = distal**2
    x = (r[:, :1] - r[:, 1:2] + d**2) / (2 * d)
    y = (r[:, :1] - r[:, 2:] + i**2 + j**2 - 2 * i * x) / (2 * j)
    z = np.sqrt(r[:, :1] - x**2 - y**2)
    ez = np.cross(ex, ey)
    return c[:, 0] + x * ex + y * ey - np.sign(ez[:, 2:]) * z * ez


def _delta(w: Works, lost: Array, longer: Callable[[Array], Array]) -> Case:
    """Points of a Delta that is off as built. lost: of its encoders (N, 3); longer: of its rods, by its angles."""
    rng, count = w.rng, len(lost)
    q = rng.uniform(-0.45, 1.0, (3 * count, 3))
    q = q[np.ptp(q, axis=1) < 1.0][: count - 6]
    order, again = np.r_[np.arange(len(q)), rng.choice(len(q) - 20, 6, replace=False)], np.zeros(count, bool)
    again[-6:] = True
    q = q[order]
    zero, offset, proximal = (rng.normal(0, s, 3) for s in (1e-3, 5e-4, 5e-4))
    rods, azimuth = 0.75 + rng.normal(0, 5e-4, 3), np.radians([0.0, 120.0, -120.0]) + rng.normal(0, 1e-3, 3)
    tool = np.array([0.05, -0.03, -0.09]) + rng.normal(0, 5e-4, 3)
    turn, at = Rotation.random(rng=rng), rng.normal(0, 1.0, 3) + [0.0, 0.0, 2.0]

    def seen(q: Array) -> Array:
        theta = q + zero + lost
        return turn.apply(_platform(theta, 0.14 + offset, 0.28 + proximal, rods + longer(theta), azimuth) + tool) + at

    exact, real = seen(q), seen(q + rng.normal(0, REPEAT, q.shape))
    p = real + rng.normal(0, 1e-3 * NOISE_MM, real.shape)
    floor = 1e3 * float(np.sqrt(np.mean(np.sum((p - exact) ** 2, axis=1))))
    t, R, names = PERIOD * np.arange(count), Rotation.identity(count), ("arm_1", "arm_2", "arm_3")
    session = Told(names, "", t, q, p, R, floor, again, POINT, reads=((POINT, "tracker", np.arange(count), p),))
    steps = (("calibrate", "{bag}", "--delta", "{delta.yaml}"),)
    return Case({"bag": session}, steps, True, ("arm_2",), files={"delta.yaml": DELTA})


@sixth
def delta_belt_jumps_a_tooth(w: Works, rng: np.random.Generator) -> Case:
    """The belt of a Delta's second arm jumps by a small tooth half way: 4 mrad from there on."""
    lost = np.zeros((120, 3))
    lost[66:, 1] = 4e-3
    return _delta(w, lost, lambda theta: np.zeros_like(theta))


@sixth
def delta_rod_ends_worn(w: Works, rng: np.random.Generator) -> Case:
    """The ball ends of a Delta's second rods are worn: 0.4 mm longer where the arm is low and pulls at them."""
    side = np.array([0.0, 1.0, 0.0])
    return _delta(w, np.zeros((130, 3)), lambda theta: 4e-4 * (theta > 0.35) * side)
