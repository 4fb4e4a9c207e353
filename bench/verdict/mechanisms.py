"""More vocabulary of rows: mixed joints, targets on other links, loads, contacts; motion, sockets, wires, a Delta;
streams of the whole way, and other arms.
"""

from __future__ import annotations

import copy
from datetime import date

from sites import turned as off_by
from transforms import *
from world import EACH, EPOCH, World

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
    # joints that deflect under weight [rad/N m]
    "soft": lambda c, k: waits(c, off_by(slice(None), lambda s: k * c.torques(s.q)), "compliance"),
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
RESTS = 24  # postures at a socket
Aside = Callable[[Scene, str, Array], Array]


def reaching(c: Scene, q: Array, goals: Array) -> tuple[Array, Array]:
    """Joints (N, n) near q that bring the tool's point to goals (N, 3), and whether they did so within the range."""
    q, good = c.arm.reaching(q, c.tool[0], goals)
    return q, good & np.all((q > c.arm.range[0]) & (q < c.arm.range[1]), axis=1)


def resting(c: Scene, socket: str, goal: Array, aside: Aside | None) -> Array:
    """Postures at which the ball rests in a socket, or aside of it (m, n)."""
    goals = np.repeat(goal[None], 12 * RESTS, axis=0)
    q, good = reaching(c, c.rng.uniform(*c.arm.range, (len(goals), c.n)), goals)
    if aside is not None:
        q, fine = reaching(c, q, goals + aside(c, socket, q))
        good &= fine
    return q[good][:RESTS]


def sockets(c: Scene, aside: Aside | None = None) -> None:
    """A ball on the tool rests in two sockets on each of three plates. aside: of its place (m, 3), by socket, q."""
    usual = tip(c, c.rng.uniform(*c.arm.range, (400, c.n)))
    near = usual[np.argsort(np.linalg.norm(usual - usual.mean(axis=0) - [0.1, 0.1, 0.0], axis=1))][:60]
    found: dict[str, Array] = {}
    for plate, length in PLATES.items():
        for _ in range(30):
            corner, way = near[c.rng.integers(len(near))], c.way(length)
            here = {f"{plate}_{k}": resting(c, f"{plate}_{k}", corner + k * way, aside) for k in range(2)}
            if all(len(q) == RESTS for q in here.values()):
                break
        else:
            raise ArithmeticError("no place for a plate")
        found |= here
    every = np.concatenate(list(found.values()))
    rest, true = c.rng.normal(0, REPEAT, every.shape), tip(c, every)
    at = reaching(c, every, true + c.rng.normal(0, 1e-3 * NOISE_MM, (len(every), 3)))[0] + rest
    p = tip(c, at)
    c.reads = {name: (RESTS * k + np.arange(RESTS), np.zeros((RESTS, 3))) for k, name in enumerate(found)}
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


WAITS = 3.0  # s, of the EACH from one station to the next
RATE, READS = 50.0, 20.0  # Hz, of joint states and of readings
READ_MM, READ_MRAD, SLIP = 0.04, 0.05, 8e-6  # per axis; per joint [rad]
Spoil = Callable[[Scene, Array, Array], tuple[Array, Array]]  # of stamps and values of readings (m,), (m, 7)
More = Callable[[Scene, Array, Array], tuple[tuple[str, ...], Array, Array]]  # of stamps and joints (m,), (m, n)


def went(t: Array, stations: Array, rest: Array) -> Array:
    """Joints at times t (m,), between stations (N, n) that are reached at rest[k] and left WAITS later."""
    return flow(t, stations, rest, EACH - WAITS, WAITS)


def flowing(c: Scene, count: int, spoil: Spoil | None = None, more: More | None = None) -> None:
    """Stations, recorded with all that lies between. spoil: of readings; more: names, stamps, joints of another."""
    session, root = c.clean(count, noise_mm=0.0, noise_mrad=0.0), np.sqrt(3.0)
    (arm_mm, arm_deg, _, _), dwell = session.stated, np.sqrt(WAITS * READS)
    eye_mm, eye_deg = root * READ_MM / dwell, float(np.degrees(root * 1e-3 * READ_MRAD)) / dwell
    stated = arm_mm, arm_deg, eye_mm, eye_deg

    def spoken(s: Session) -> Recording:
        rng = np.random.default_rng([3, len(s)])
        slip, begin, end = rng.normal(0, SLIP, s.q.shape), s.t[0] - 2.0, s.t[-1] + WAITS + 0.5
        t, read = np.arange(begin, end, 1 / RATE), np.arange(begin + 0.013, end, 1 / READS)
        seen = c.sees(went(read, s.q + slip, s.t))
        p = seen.p + rng.normal(0, 1e-3 * READ_MM, seen.p.shape)
        values = poses(p, seen.R * Rotation.from_rotvec(rng.normal(0, 1e-3 * READ_MRAD, p.shape)))
        read, values = (read, values) if spoil is None else spoil(c, read, values)
        q = went(t, s.q, s.t)
        tracks = (joint_track(s.names, EPOCH + t, q), *((joint_track(*more(c, EPOCH + t, q)),) if more else ()))
        return Recording(tracks, (reading(EPOCH + np.round(read, 6), values, frame=s.frame),), s.signals, s.urdf)

    c.session = replace(session, floor_mm=float(np.hypot(arm_mm, eye_mm)), stated=stated, spoken=spoken)


def smoothed(seconds: float) -> Spoil:
    """A first-order filter on everything that is read."""
    a = np.exp(-1 / (READS * seconds))

    def spoil(c: Scene, t: Array, values: Array) -> tuple[Array, Array]:
        signs = np.cumprod(np.r_[1.0, np.sign(np.sum(values[1:, 3:] * values[:-1, 3:], axis=1))])
        out = filtered(np.c_[values[:, :3], values[:, 3:] * signs[:, None]], [1 - a], [1, -a])
        out[:, 3:] /= np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
        return t, out

    return spoil


def hung(c: Scene, t: Array, values: Array) -> tuple[Array, Array]:
    """Ten times the last reading comes again for nine seconds."""
    out = values.copy()
    for k in (np.linspace(0.07, 0.93, 10) * len(t)).astype(int):
        out[k : k + int(9 * READS)] = values[k]
    return t, out


def computed(c: Scene, t: Array, values: Array) -> tuple[Array, Array]:
    """Poses of the nominal flange in the base, 40 ms late and to a micrometre."""
    nominal = World(c.robot, np.random.default_rng(0))
    nominal.rebuild(0.0)
    nominal.tool = nominal.eye = np.zeros(3), Rotation.identity()
    seen = nominal.sees(went(t - 0.04, c.q, c.t))
    return t, np.round(poses(seen.p, seen.R), 6)


def built(c: Scene, robot: str) -> None:
    """A cell of another arm."""
    c.w = type(c.w)(robot, c.rng)


def turning(c: Scene, *joints: int) -> None:
    """A UR5e whose joints of these numbers turn by more than one turn; i is the last of them."""
    c.w, c.i = World("ur5e", c.rng), joints[-1]
    c.w.arm.range[:, list(joints)] = [[-5.5], [5.5]]


def drooping(c: Scene) -> None:
    """The link behind the third joint bends by what it holds, 3 mrad per metre of it that lies flat."""
    axis = np.array(c.joints[2].axis, float)
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])  # across the axis, as in arms.py

    def bent(s: Stations, d: Deviation) -> None:
        p, R = c.at(s).links
        turn = np.cross(p[:, -2] - p[:, 2], [0.0, 0.0, -3e-3])
        before = Rotation.from_rotvec(np.outer(s.q[:, 2], axis)) * Rotation.from_matrix(R[:, 2]).inv()
        d.x[:, 2, 1:] += before.apply(turn) @ np.stack([x, np.cross(axis, x), axis], axis=1)

    waits(c, bent)


def elsewhere(c: Scene, when: Of, p: Of = "p", R: Of = "R", form: str = "matrix") -> None:
    """Readings of other positions or orientations, put together in a form, at the stations that ``when`` says."""
    here, new, old = c.of(when), *(getattr(turn, f"as_{form}")() for turn in (c.of(R), c.R))
    turned = np.where(here.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    at = np.where(here[:, None], c.of(p), c.p)
    c.session = replace(c.session, p=at, R=getattr(Rotation, f"from_{form}")(turned))


def as_dates(c: Scene) -> list[float]:
    """The column of a joint; where an angle's hundredths of a degree are a date, the day's number."""
    out = []
    for x, (day, month) in zip(c.x, (divmod(round(100 * np.degrees(x)), 100) for x in c.x), strict=True):
        known = 1 <= day <= 28 and 1 <= month <= 12
        out.append(np.radians(date(2026, month, day).toordinal() - date(1899, 12, 30).toordinal()) if known else x)
    return out


def warmth(c: Scene) -> Array:
    """How warm a spindle is that runs, has a break of 420 s after 80 stations, and runs on (N,)."""
    tau, noon, rest = 170.0, 80 * PERIOD, 420.0
    left = (1.0 - np.exp(-noon / tau)) * np.exp(-rest / tau)
    after = 1.0 - (1.0 - left) * np.exp(-np.maximum(c.t - noon - rest, 0.0) / tau)
    return np.where(c.t <= noon, 1.0 - np.exp(-np.minimum(c.t, noon) / tau), after)


def along(plan: Plan, late: Array) -> Array:
    """Joints of a plan at its stations, each by so many seconds earlier (m, n)."""
    return np.stack([np.interp(plan.stations.t - s, plan.t, plan.q[:, i]) for i, s in enumerate(late)], axis=1)


export(globals(), STEPS)
WIDEST = let(i=lambda c: int(np.argmax(c.arm.range[1] - c.arm.range[0])))  # the joint of the widest range
BY_NAME = rows(lambda c: np.array(sorted(c.rows, key=lambda k: str(k + 1))))  # 1, 10, 100, 101, ...
