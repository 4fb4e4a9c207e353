"""What the steps of a row can be: functions that change a scene, or find something of it, draws included.

A row calls them without the scene c, which gives a step (see case.py). A function of the scene, ``lambda c: ...``,
or a name that ``let`` gave stands wherever a value depends on the scene. A vector given as a float is a random one of
that length; numbers draw nothing. What bends the truth waits for the next recording, and is asked twice, with and
without noise: nothing is drawn there.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
from arms import TURN, Arm
from case import DERIVED, KINDS, Scene, export, kinds, take  # noqa: F401 (rows take all names from here)
from recordings import plant
from scenarios import SCENARIOS
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from sites import *
from sites import turned as off_by

Of = Any  # a value, a name that ``let`` gave, or a function of the scene
DAY = 86_400.0
# Words that name what is wrong: patterns, and what depends on the scene, on the joint i that was drawn most of all.
QUATERNION = ("quaternion", r"\borientation", "rotation")
ORIENTATION = ("euler", "sequence", "convention", r"\borientation", "rotation")
UNIT = (r"\bmm\b", "millimet", r"\bunits?\b", "1000")
TOOL, BASE = (r"\btool\b",), (r"\bbase\b", r"\btracker\b")
EITHER = (*TOOL, *BASE)
LEFT_OUT = ("reject", "left out", "outlier", "plainly wrong", "shift", "apart")
LOAD = ("payload", r"\bload", "compliance", r"\bmass", r"\bkg\b")
COMPUTED = ("comput", "calculat")
FEW = ("station", "readings", "parameters")
BOLTED = ("geometry-only", "geometry only", "not looked for")
TRACKER = (r"\btracker\b", r"\binstrument\b", "place of the target", "distance from", "direction in which")
CLOCK = ("clock", "stamp", "delay", "late", r"\btime\b")
ROW = (r"\brows?\b", r"\border\b", "station before", "previous", "shift", "late", "delay", *CLOCK)
ORDER = (r"\border\b", r"\btime\b", "changed on the way", r"\bdrift\b", r"stations \d+ to")
READINGS = (
    r"\btracker",
    r"\bcamera",
    "reads wrong",
    r"readings? (?:look|depend)",
    "distance from",
    "place of the target",
)
STATIONS = r"stations? \d"
# joints by number; the link behind one; joints from the one that was drawn, counted from it, those that there are
JOINT = lambda *numbers: lambda c: tuple(c.names[k] for k in numbers)  # noqa: E731
LINK = lambda k: lambda c: str(c.arm.links[k])  # noqa: E731
around = lambda low, high: lambda c: tuple(c.names[max(c.i + low, 0) : c.i + high])  # noqa: E731
# the joint, the one before it, and at an end of the arm what is beyond; the first joint, and the link that it stands on
OR_END = lambda c: (*around(-1, 1)(c), *(BASE if c.i == 0 else ("tool",) if c.i == c.n - 1 else ()))  # noqa: E731
FOOT = lambda c: (c.names[0], c.arm.parents[0])  # noqa: E731
J, JJ, JJJ, NEAR = around(0, 1), around(0, 2), around(0, 3), around(-1, 2)
ALL, HAND, WRIST = attrgetter("names"), attrgetter("arm.hand"), JOINT(-3, -2, -1)
DERIVED |= {
    "travel": lambda c: (c.x - c.arm.range[0, c.i]) / np.ptp(c.arm.range[:, c.i]),  # in its range, from 0 to 1 (N,)
    "middle": lambda c: c.arm.range.mean(axis=0),  # of the joints' ranges (n,)
    "held": lambda c: c.arm.loads(c.q)[..., TURN],  # torques that hold the arm up (N, n)
    "links": lambda c: c.arm.frames(c.arm.coordinates(c.q)),  # where (N, n + 1, 3), how turned (N, n + 1, 3, 3)
    "flange": lambda c: tuple(v[:, -1] for v in c.links),  # where, how turned (N, 3, 3)
    "tool_axes": lambda c: c.flange[1] @ c.tool[1].as_matrix(),  # (N, 3, 3)
    "up": lambda c: c.tracker[1].inv().apply([0.0, 0.0, 1.0]),  # in the tracker's frame (3,)
    "posture": lambda c: np.unique(c.q, axis=0, return_inverse=True)[1].ravel(),  # by number: second visits alike (N,)
    "far": lambda c: np.linalg.norm(c.p, axis=1, keepdims=True),  # distances of the readings (N, 1)
    "sight": lambda c: c.p / c.far,  # unit vectors from the instrument to the target (N, 3)
    "seen": lambda c: c.R.inv().apply(c.sight),  # the same along the tool's axes (N, 3)
    "azimuth": lambda c: np.arctan2(c.p[:, 1], c.p[:, 0]),  # of the readings (N,)
    "forward": lambda c: unit(c.p.mean(axis=0)),  # where the readings are seen (3,)
}
VALUES: dict[str, Callable[..., Any]] = {
    # the moment (N, 3) of a centre of mass about the base, times weight, of a stand of two softnesses
    "moment": lambda com, x=1.0, y=1.0: np.stack([-x * com[:, 1], y * com[:, 0], np.zeros(len(com))], axis=1),
    # values brought, about their mean, to an RMS; behind a filter that has been at rest at the first
    "scaled": lambda v, size: size / rms(v - v.mean(axis=0)) * v,
    "filtered": lambda values, b, a=1.0: lfilter(b, a, values - values[0], axis=0) + values[0],
    # how far joints went to each station; to the first one from ``begin``, or not at all
    "moves": lambda q, begin=None: np.diff(q, axis=0, prepend=q[:1] if begin is None else np.asarray(begin)[None]),
    # an origin 8 cm nearer along its longest coordinate; angles by atan where atan2 is meant
    "cut_short": lambda v: v - 0.08 * np.sign(v) * (np.arange(3) == np.argmax(np.abs(v))),
    "folded": lambda angles: (angles + 0.5 * np.pi) % np.pi - 0.5 * np.pi,
    # how many of the values so far were larger than this share of them, counted by sign (N,)
    "summed": lambda v, share: np.cumsum(np.sign(v) * (np.abs(v) > np.quantile(np.abs(v), share))),
}
STEPS: dict[str, Callable[..., Any]] = {
    # draws: a joint i (a negative end counts from the last), a whole number, even and normal ones, a vector of a length
    "pick": lambda c, low=0, high=None: let(c, i=c.any_joint(low, high if high is None or high > 0 else c.n + high)),
    "between": lambda c, low, high: int(c.rng.integers(low, high)),
    "uniform": lambda c, low, high, size=None: c.rng.uniform(low, high, size),
    "normal": lambda c, scale, size=None: c.rng.normal(0, scale, size),
    "way": lambda c, size: c.way(size),
    # recordings: poses or points with the faults that wait, or without (those go on waiting); without
    # any noise; once more the last faults
    "clean": lambda c, count, **options: take(c, count, **options),
    "points": lambda c, count, **options: take(c, count, kind="point", **options),
    "exact": lambda c, count: take(c, count, **EXACT),
    "bare": lambda c, count, **options: let(c, session=c.clean(count, **options)),
    "same": lambda c: let(c, bends=c.bends + c.used),
    # keeps a recording as a part of one; puts the parts and the recording into one bag
    "part": lambda c: c.parts.append(c.session),
    "together": lambda c: let(c, session=joined(*c.parts, c.session)),
    # options of the command, more of them; fields of the case
    "asked": lambda c, *options: let(c, options=c.options + options),
    "truth": lambda c, **fields: c.truth.update(fields),
    # bends of the truth, until the next recording: a joint is off by an error (N,) [rad]; the tracker stands elsewhere
    "joint": lambda c, error, i="i": waits(c, off_by(int(c.of(i)), lambda s: c.at(s).of(error))),
    "base": lambda c, shift, turn, when=None: tool(c, shift, turn, when, "tracker"),
    # springs that sag [rad] under the arm's weight, with a mass [kg]; a mass at the flange; a link that grows [m]
    "elastic": lambda c, sag=4e-4, payload=0.0: waits(
        c, c.elastic(sag, payload), "compliance", *("payload",) * bool(payload)
    ),
    "payload": lambda c, kg: waits(c, lambda s, d: setattr(d, "payload", d.payload + c.of(kg))),
    "grows": lambda c, size, begin=0.0, tau="tau": bend(
        c, "x", np.s_[:, 2, 0], lambda c: size * (1.0 - np.exp(-(c.t - begin) / c.of(tau)))
    ),
    # stations from a number on, and before an end; rows of which some are others
    "since": lambda c, k, end=None: (c.rows >= c.of(k)) & (True if end is None else c.rows < c.of(end)),
    "until": lambda c, k: c.rows < c.of(k),
    "block": lambda c, low, high, order: np.r_[:low, order, high : c.N],
    # readings: positions times a factor, turned orientations, angles of one sequence read as another, other rows
    "times": lambda c, factor: put(c, p=c.p * c.of(factor)),
    "turned": lambda c, R: put(c, R=R(c) * c.R),
    "euler": lambda c, old, new, change=lambda v: v: put(c, R=Rotation.from_euler(new, change(c.R.as_euler(old)))),
    "only": lambda c, order: let(c, session=c.session.only(c.of(order))),
    "rows": lambda c, order: (lambda rows: put(c, p=c.p[rows], R=c.R[rows]))(c.of(order)),
    # joint states: the column of the joint that was drawn, by a ufunc of it or as it is; from it on in another order
    "col": lambda c, x: patch(c, np.s_[:, c.i], q=x(c.x) if isinstance(x, np.ufunc) else c.of(x)),
    "cycle": lambda c, *order, sign=1.0: cols(c, c.i + np.arange(len(order)), lambda c, q: q[:, order] * sign),
    # descriptions: by a regular expression; each joint's block; something in a link's inertial
    "sub": lambda c, pattern, by: described(c, lambda c, text: re.sub(pattern, by, text, flags=re.DOTALL)),
    "each_joint": lambda c, change: STEPS["sub"](c, r"<joint .*?</joint>", lambda found: change(found[0])),
    "pick_having": lambda c, where, test: let(
        c, among=having(c, where, test), i=lambda c: c.names.index(c.among[int(c.rng.integers(len(c.among)))])
    ),
    # the cell: gravity in its base, another arm of its type in a cell of its own
    "gravity": lambda c, *down: c.arm.model.opt.gravity.__setitem__(slice(None), down),
    "spare": lambda c: Cell(c.robot, np.random.default_rng(c.rng.integers(1 << 30))),
    # signals, streams
    "heat_told": lambda c: put(c, signals=signal(f"temperature:{c.arm.parents[2]}", *c.heat, "/temperature")),
    "centres": lambda c, q="q": c.arm.centres(c.of(q)),  # of mass, in the base (N, 3)
    "written": lambda c, change: (lambda whole: put(c, spoken=lambda c: lambda s: whole))(
        change(c.session.recording())
    ),
}


def let(c: Scene, **values: Of) -> None:
    """Names values, in this order."""
    for name, value in values.items():
        assert not hasattr(Scene, name), name
        setattr(c, name, value(c) if callable(value) else value)


def visit(c: Scene, count: int, returns: int = 6, low: float = 0.0, high: float = 1.0) -> None:
    """Draws postures q, and which of them are second visits; ``see`` records them."""
    c.session = None
    c.q, c.again = c.postures(count, returns, low, high)


def see(c: Scene, **options: Any) -> None:
    """A recording of the postures, with the faults that wait."""
    c.used, c.bends = c.bends, []
    c.session = c.observe(*c.visited(), *c.used, **options)


def frozen(c: Scene, *options: str) -> None:
    """The recording is calibrated, and the calibration evaluated on the one that follows."""
    c.imports, c.command, c.options = (("calibrate", "{first}"),), ("evaluate", "{out0}", "{second}"), options
    c.sessions, c.session = {"first": c.session}, None


def before(c: Scene, count: int | None, *options: str, **observed: Any) -> None:
    """A calibration on a recording made now, with faults that wait, is evaluated on what there is; None: of ``q``."""
    second, visits = c.session, c.postures(count) if count else c.visited()
    c.session, c.bends = c.observe(*visits, *c.bends, **observed), []
    frozen(c, *options)
    c.session = second


def also(c: Scene, count: int | None = None) -> None:
    """Calibrated together with the one that follows; or, with a number, a first one made now with the one there is."""
    c.command = ("calibrate", "{first}", "--also", "{second}")
    c.sessions, c.session = ({"first": c.clean(count)}, c.session) if count else ({"first": c.session}, None)


def waits(c: Scene, bend: Any, *families: str) -> None:
    """Lets a fault wait for the next recording. families: of effects that are the truth as well."""
    c.bends.append(bend)
    c.planted += families


def tool(c: Scene, shift: Of, turn: Of, when: Of = None, part: str = "tool") -> None:
    """The tool is moved by a twist, at the stations that ``when`` says, or all."""
    twist = np.concatenate([c.vector(shift), c.vector(turn)])
    waits(c, twisted(part, twist, lambda s: np.ones(len(s.t)) if when is None else c.at(s).of(when)))


def bend(c: Scene, part: str, where: Any, by: Of) -> None:
    """Adds to a part of the deviation (x, tool, tracker) where an index says; the scene has d, t, q, came then."""

    def bent(s: Any, d: Any) -> None:
        getattr(d, part)[where(c) if callable(where) else where] += c.at(s, d).of(by)

    waits(c, bent)


def gear(c: Scene, size: float = 4e-4, i: Of = "i") -> None:
    """A gear that errs, some times a turn."""
    cycles, k = int(c.rng.integers(20, 90)), c.of(i)
    waits(c, off_by(k, lambda s: size * np.sin(cycles * s.q[:, k])))


def tilted(c: Scene, turn: Of, pin: Any = (0.0, 0.0, 0.0)) -> None:
    """A stand turns about the base's origin, or another point, by rotation vectors (N, 3)."""
    stand = c.tracker[0]

    def bent(s: Any, d: Any) -> None:
        back = Rotation.from_rotvec(-c.at(s).of(turn))
        d.tracker += np.concatenate([pin + back.apply(stand - pin) - stand, back.as_rotvec()], axis=1)

    waits(c, bent)


def pulled(c: Scene, force: float, hook: Array) -> None:
    """A balancer pulls the flange of an elastic arm towards a hook."""

    def bent(s: Any, d: Any) -> None:
        tip, levers = c.arm.frames(d.x)[0][:, -1], []
        for i in range(c.n):
            x = d.x.copy()
            x[:, i, TURN] += 1e-5
            levers.append((c.arm.frames(x)[0][:, -1] - tip) / 1e-5)
        d.x[..., TURN] += 2e-5 * np.einsum("inx,nx->ni", levers, force * unit(hook - tip))

    waits(c, bent, "compliance")


def scenario(c: Scene, name: str, count: int) -> None:
    """Faults of bench/undeclared, all of which the vocabulary has, wait."""
    c.faults = plant(c.w, SCENARIOS[name], c.rng, count * PERIOD)
    for fault in c.faults:
        waits(c, fault.bend, *fault.family, *(place for place in fault.place if place in ("tool", "base", "tracker")))


def laden(c: Scene, mass: Of, sag: float = 6e-4) -> None:
    """An elastic arm at the postures that were drawn, with a payload of its own at each, (N,) [kg]."""
    masses, parts = c.of(mass), []
    STEPS["elastic"](c, sag)
    state, (q, again) = c.rng.bit_generator.state, c.visited()
    for kilograms in np.unique(masses):
        c.rng.bit_generator.state = state
        STEPS["payload"](c, kilograms)
        parts.append(c.observe(q, again, *c.bends).only(np.flatnonzero(masses == kilograms)))
        c.bends.pop()
    c.session, c.bends = joined(*parts), []


def carrying(c: Scene, heavy: Of, mass: Of) -> None:
    """The same, softer, with one payload at some postures, (N,) of bool."""
    laden(c, lambda c: c.of(heavy) * c.of(mass), 3e-4)


def instead(c: Scene) -> None:
    """The arm ``twin`` stands where the arm stood, with its tool."""
    c.twin.tool, c.twin.tracker = c.tool, c.tracker
    c.w = c.twin


def put(c: Scene, **fields: Of) -> None:
    """Fields of the recording, all found from it as it is."""
    c.session = replace(c.session, **{name: c.of(value) for name, value in fields.items()})


def patch(c: Scene, where: Of, **fields: Of) -> None:
    """The same in some rows of arrays only, by an index, a name or a function."""
    changed = {name: np.array(getattr(c.session, name)) for name in fields}
    for name, value in fields.items():
        changed[name][c.of(where)] = c.of(value)
    c.session = replace(c.session, **changed)


def quaternion(c: Scene, *columns: int, sign: tuple[int, ...] = (1, 1, 1, 1), when: Of = None) -> None:
    """Quaternions written with their columns x y z w in another order, and signed; at some rows or all."""
    values, here = c.raw().copy(), slice(None) if when is None else c.of(when)
    values[here, 3:] = values[here, 3:][:, columns] * sign
    c.session = replace(c.session, values=values)


def cols(c: Scene, which: Of, columns: Callable[[Scene, Array], Array]) -> None:
    """Columns of q (an index, a slice, or a function of the scene), by a function of the scene and of these columns."""
    patch(c, np.s_[:, c.of(which)], q=columns(c, c.q[:, c.of(which)]))


def shifted(c: Scene, share: float, size: float) -> None:
    """Some of the stations read elsewhere by the same vector."""
    here = c.rng.permutation(c.N) < share * c.N
    put(c, p=c.p + np.where(here[:, None], c.way(size), 0.0))


def five_times(c: Scene) -> None:
    """Each row five times, a tenth of a period apart, with more scatter of the instrument."""
    later = np.tile(0.1 * PERIOD * np.arange(5), c.N)
    c.session = c.session.only(np.repeat(c.rows, 5))
    put(c, t=c.t + later, p=c.p + c.rng.normal(0, 4e-6, c.p.shape))


def by_drawing(c: Scene) -> None:
    """Readings are computed from the joints for the arm of the drawing."""
    p, R = Arm.of(c.robot).frames(c.arm.coordinates(c.q))
    put(c, p=p[:, -1], R=Rotation.from_matrix(R[:, -1]))


def described(c: Scene, change: Callable[[Scene, str], str]) -> None:
    """Another URDF, by a function of the scene and of the text."""
    text = change(c, c.urdf)
    assert text != c.urdf
    c.session = replace(c.session, urdf=text)


def in_block(c: Scene, tag: str, names: Of, change: Callable[[Scene, str], str]) -> None:
    """Another URDF, in which the blocks of a link or joint, or of some, are changed."""

    def changed(c: Scene, text: str) -> str:
        for name in np.atleast_1d(c.of(names)):
            text = text.replace(old := block_of(text, tag, name), change(c, old))
        return text

    described(c, changed)


def inertial(c: Scene, link: int, pattern: str, by: str) -> None:
    """Another URDF, in which something of a link's inertial is another."""
    inside = re.compile(r"<inertial>.*?</inertial>", re.DOTALL)
    change = lambda found: re.sub(pattern, by, found[0], count=1)  # noqa: E731
    in_block(c, "link", [c.arm.links[link]], lambda c, text: inside.sub(change, text, count=1))


def block_of(text: str, tag: str, name: str) -> str:
    """The block of a link or joint in a URDF."""
    return re.search(rf'<{tag} name="{name}".*?</{tag}>', text, re.DOTALL)[0]  # type: ignore[index]


def having(c: Scene, where: str, test: Callable[[Array], Any], first: int = 1) -> list[str]:
    """The arm's joints, by default but the first, with an attribute ``where`` whose numbers pass a test."""
    pattern, out = '<{} [^>]*?{}="([^"]*)"'.format(*where.split()), []
    for name in c.names[first:]:
        found = re.search(pattern, block_of(c.urdf, "joint", name))
        out += [name] if found and test(np.array(found[1].split(), float)) else []
    return out


def numbers(text: str, where: str, change: Callable[[Array], Array], digits: int = 9) -> str:
    """A URDF, or a block of one, with other numbers in an attribute: ``"origin xyz"``."""
    tag, key = where.split()

    def changed(found: re.Match[str]) -> str:
        return f'{found[1]}"{" ".join(f"{v:.{digits}g}" for v in change(np.array(found[2].split(), float)))}"'

    return re.sub(rf'(<{tag} [^>]*?{key}=)"([^"]*)"', changed, text)


def shorter(c: Scene, text: str) -> str:
    """A URDF whose first long link is a tenth shorter."""
    values = next(v for v in re.findall(r'xyz="([^"]*)"', text) if max(abs(float(x)) for x in v.split()) > 0.25)
    long = [f"{float(x) * (0.9 if abs(float(x)) > 0.25 else 1.0):.6g}" for x in values.split()]
    return text.replace(f'"{values}"', f'"{" ".join(long)}"')


def loaded(c: Scene, size: Any = 1.0, axis: int = 3) -> Array:
    """A size times the load on the joint that was drawn, or across it, over its RMS (N,)."""
    load = c.arm.loads(c.q)[:, c.i, axis]
    return c.of(size) * load / np.sqrt(np.mean(load**2))


def share(c: Scene, *joints: int) -> Array:
    """Where joints are in their ranges, from -1 to 1 (joints, N)."""
    return ((c.q - c.middle) / (0.5 * np.ptp(c.arm.range, axis=0)))[:, joints].T


def dragged(values: Array, slack: Any) -> Array:
    """What follows values over a slack only, as friction holds it."""
    held, out = np.zeros_like(values[0]), []
    for value in values:
        held = np.clip(held, value - slack, value + slack)
        out.append(held)
    return np.array(out)


def continuous(R: Rotation) -> Array:
    """Quaternions (N, 4), each on the side of the one before."""
    quat = R.as_quat()
    return quat * np.cumprod(np.r_[1.0, np.where(np.sum(quat[1:] * quat[:-1], axis=1) < 0, -1.0, 1.0)])[:, None]


def flipped(c: Scene) -> tuple[Array, Array]:
    """Angles (N,) and axes (N, 3) that bring a flat marker to its other tilt."""
    along, normal = c.sight, c.R.apply([0.0, 0.0, 1.0])
    other = 2.0 * np.sum(normal * along, axis=1, keepdims=True) * along - normal
    axis = np.cross(normal, other)
    return np.arccos(np.clip(np.sum(normal * other, axis=1), -1.0, 1.0)), axis / np.linalg.norm(axis, axis=1)[:, None]


def signal(name: str, clock: Array, values: Array, topic: str) -> tuple[SignalTrack, ...]:
    """A signal at times since the beginning of the session."""
    return (SignalTrack(name, BEGIN + clock, np.reshape(values, (len(clock), -1)), topic),)


def warm(c: Scene, begin: float, seconds: float, low: float, high: float) -> tuple[Array, Array]:
    """Times and a temperature that goes up and down, of a phase that is drawn."""
    clock = np.arange(begin, begin + seconds, 2.0)
    return clock, low + (high - low) * (0.5 - 0.5 * np.cos(2 * np.pi * clock / 310.0 + c.rng.uniform(0, 2 * np.pi)))


def sensed(c: Scene) -> None:
    """The temperature of a planted fault is recorded."""
    ((link, temperature),) = (fault.sensor for fault in c.faults)
    clock = np.arange(0.0, c.N * PERIOD + 1.0)
    told = temperature(clock) + c.rng.normal(0, 0.05, len(clock))
    put(c, signals=signal(f"temperature:{link}", clock, told, "/temperature"))


def dwells(c: Scene, count: int, begin: float = 0.0) -> None:
    """Streams of joint states and readings, ten readings a second while the arm stands."""
    c.session = c.clean(count, noise_mm=0.0, noise_mrad=0.0, begin=begin)
    (arm_mm, arm_deg, _, _), eye_mm, eye_deg = c.stated, 0.02 * np.sqrt(3.0), np.degrees(2e-5 * np.sqrt(3.0))
    floor = float(np.hypot(arm_mm, eye_mm / np.sqrt(15)))
    put(c, stream=10.0, stated=(arm_mm, arm_deg, eye_mm, eye_deg), floor_mm=floor)


def restamped(c: Scene, stamps: Callable[[Array], Array]) -> None:
    """Readings with other stamps."""

    def change(whole: Recording) -> Recording:
        (track,) = whole.readings
        other = stamps(track.stamps)
        return replace(whole, readings=(replace(track, stamps=other, received=other),))

    STEPS["written"](c, change)


def zeros_between(whole: Recording) -> Recording:
    """A second publisher of zeros among the joint states."""
    (joints,) = whole.joints
    stamps = np.concatenate([joints.stamps, joints.stamps + 0.013])
    q, order = np.concatenate([joints.position, np.zeros_like(joints.position)]), np.argsort(stamps, kind="stable")
    return replace(whole, joints=(joint_track(joints.names, stamps[order], q[order]),))


def stream(c: Scene, count: int, rate: float = 25.0) -> None:
    """Joint states and readings all the time: clock, flow (joints), sent (p, R) without noise; ``streamed`` ends it."""
    q, again = c.postures(count)
    c.session = session = c.observe(q, again, **EXACT)
    reached, half = q + c.rng.normal(0, REPEAT, q.shape), 0.5 * PERIOD
    c.clock = np.round((session.t[:, None] - half + np.arange(0.0, PERIOD, 1.0 / rate)).ravel(), 6)
    c.flow, real = (flow(c.clock, ends, session.t, half, half, 0.1) for ends in (q, reached))
    c.sent = c.poses(Stations(real, c.clock, np.ones_like(real)))
    missed = c.poses(Stations(reached, session.t, np.ones_like(q))).p - session.p
    put(c, floor_mm=float(np.hypot(1e3 * rms(missed), 0.035 / np.sqrt(25.0))))


def streamed(c: Scene, read: Of = None, p: Of = None, R: Of = None, received: bool = False) -> None:
    """The stream is recorded, with noise: stamps, positions and turns of the readings are others where given."""
    at, turn, stamps = (c.sent.p if p is None else c.of(p)), (c.sent.R if R is None else c.of(R)), BEGIN + c.clock
    at = at + c.rng.normal(0, 2e-5, at.shape)
    turn = turn * turn_noise(c.rng, 2e-5, len(at))
    told = stamps if read is None else c.of(read)
    readings = replace(reading(told, poses(at, turn), c.kind, c.frame), received=told if received else stamps)
    whole = Recording((joint_track(c.names, stamps, c.flow),), (readings,), (), c.urdf)
    c.session = replace(c.session, spoken=lambda session: whole)


globals().update(VALUES)
export(globals(), STEPS)
W_FIRST = quaternion(3, 0, 1, 2)
