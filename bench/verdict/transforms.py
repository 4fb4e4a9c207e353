"""What the steps of a row can be: each changes a scene (see case.py), draws included, one after the other.

A function of the scene, ``lambda c: ...``, or a name that ``let`` gave stands wherever a value depends on the scene. A
vector given as a float is a random one of that length; numbers draw nothing. What bends the truth waits for the next
recording, and is asked twice, with and without noise: nothing is drawn there.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from arm import Arm
from case import DERIVED, Scene, Step, step, take
from recordings import plant
from scenarios import SCENARIOS
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from workcell import BEGIN, PERIOD, REPEAT, Array, Recording, SignalTrack, Stations, Works, joined, joint_track
from workcell import ReadingTrack as Readings

Of = Any  # a value, a name that ``let`` gave, or a function of the scene
DAY = 86_400.0
EXACT: dict[str, Any] = {"noise_mm": 0.0, "noise_mrad": 0.0, "repeat": 0.0}
DERIVED |= {
    "travel": lambda c: (c.x - c.arm.range[0, c.i]) / np.ptp(c.arm.range[:, c.i]),  # of the joint, from 0 to 1 (N,)
    "middle": lambda c: c.arm.range.mean(axis=0),  # of the joints' ranges (n,)
    "held": lambda c: c.arm.holding(c.arm.coordinates(c.q))[..., 3],  # torques that hold the arm up (N, n)
    "flange": lambda c: tuple(v[:, -1] for v in c.arm.frames(c.arm.coordinates(c.q))),  # where, how turned (N, 3, 3)
    "tool_axes": lambda c: c.flange[1] @ c.cell.tool[1].as_matrix(),  # (N, 3, 3)
    "up": lambda c: c.cell.tracker[1].inv().apply([0.0, 0.0, 1.0]),  # in the tracker's frame (3,)
    "posture": lambda c: np.unique(c.q, axis=0, return_inverse=True)[1].ravel(),  # by number: second visits alike (N,)
    "far": lambda c: np.linalg.norm(c.p, axis=1, keepdims=True),  # distances of the readings (N, 1)
    "sight": lambda c: c.p / c.far,  # unit vectors from the instrument to the target (N, 3)
    "seen": lambda c: c.R.inv().apply(c.sight),  # the same along the tool's axes (N, 3)
    "azimuth": lambda c: np.arctan2(c.p[:, 1], c.p[:, 0]),  # of the readings (N,)
    "forward": lambda c: c.p.mean(axis=0) / np.linalg.norm(c.p.mean(axis=0)),  # where the readings are seen (3,)
}

# --- draws -----------------------------------------------------------------------------------------------------------


@step
def let(c: Scene, **values: Of) -> None:
    """Names values, in this order."""
    for name, value in values.items():
        setattr(c, name, value(c) if callable(value) else value)


def pick(low: int = 0, high: int | None = None) -> Step:
    """Draws a joint, i; a negative end counts from the last."""
    return let(i=lambda c: c.any_joint(low, high if high is None or high > 0 else c.n + high))


def between(low: int, high: int) -> Callable[[Scene], int]:
    """A whole number, drawn."""
    return lambda c: int(c.rng.integers(low, high))


def uniform(low: float, high: float, size: Any = None) -> Callable[[Scene], Any]:
    """Even numbers, drawn."""
    return lambda c: c.rng.uniform(low, high, size)


def normal(scale: float, size: Any = None) -> Callable[[Scene], Any]:
    """Normal numbers, drawn."""
    return lambda c: c.rng.normal(0, scale, size)


def way(size: float) -> Callable[[Scene], Array]:
    """A random vector of this length."""
    return lambda c: c.way(size)


# --- recordings ------------------------------------------------------------------------------------------------------


def clean(count: int, **options: Any) -> Step:
    """A recording of random postures with the faults that wait. options: of the cell's ``observe``, and returns."""
    return lambda c: take(c, count, **options)


def points(count: int, **options: Any) -> Step:
    """The same, of points."""
    return clean(count, kind="point", **options)


def bare(count: int, **options: Any) -> Step:
    """The same, without the faults that wait: those go on waiting."""
    return let(session=lambda c: c.clean(count, **options))


@step
def visit(c: Scene, count: int, returns: int = 6, low: float = 0.0, high: float = 1.0) -> None:
    """Draws postures q, and which of them are second visits; ``see`` records them."""
    c.session = None
    c.q, c.again = c.postures(count, returns, low, high)


@step
def see(c: Scene, **options: Any) -> None:
    """A recording of the postures, with the faults that wait."""
    c.used, c.bends = c.bends, []
    c.session = c.observe(*c.visited(), *c.used, **options)


def same(c: Scene) -> None:
    """The faults of the last recording once more."""
    c.bends += c.used


def part(c: Scene) -> None:
    """Keeps the recording as a part of one."""
    c.parts.append(c.session)


def together(c: Scene) -> None:
    """The parts and the recording, in one bag."""
    for one in reversed(c.parts):
        c.session = joined(one, c.session)


@step
def dwells(c: Scene, count: int, begin: float = 0.0) -> None:
    """Streams of joint states and readings, ten readings a second while the arm stands."""
    session = c.clean(count, noise_mm=0.0, noise_mrad=0.0, begin=begin)
    arm_mm, arm_deg, _, _ = session.stated
    eye_mm, eye_deg = 0.02 * np.sqrt(3.0), np.degrees(2e-5 * np.sqrt(3.0))
    floor = float(np.hypot(arm_mm, eye_mm / np.sqrt(15)))
    c.session = replace(session, stream=10.0, stated=(arm_mm, arm_deg, eye_mm, eye_deg), floor_mm=floor)


# --- commands --------------------------------------------------------------------------------------------------------


def asked(*options: str) -> Step:
    """Options of the command, more of them."""
    return let(options=lambda c: c.options + options)


@step
def frozen(c: Scene, *options: str) -> None:
    """The recording is calibrated, and the calibration evaluated on the one that follows."""
    c.imports, c.command, c.options = (("calibrate", "{first}"),), ("evaluate", "{out0}", "{second}"), options
    c.sessions, c.session = {"first": c.session}, None


@step
def before(c: Scene, count: int | None, *options: str, **observed: Any) -> None:
    """A calibration on a recording made now, with faults that wait, is evaluated on what there is; None: of ``q``."""
    second, visits = c.session, c.postures(count) if count else c.visited()
    c.session, c.bends = c.observe(*visits, *c.bends, **observed), []
    frozen(*options)(c)
    c.session = second


@step
def also(c: Scene, count: int | None = None) -> None:
    """Calibrated together with the one that follows; or, with a number, a first one made now with the one there is."""
    c.command = ("calibrate", "{first}", "--also", "{second}")
    c.sessions, c.session = ({"first": c.clean(count)}, c.session) if count else ({"first": c.session}, None)


@step
def truth(c: Scene, **fields: Any) -> None:
    """Fields of the case that depend on the scene."""
    c.truth |= fields


# --- bends of the truth ----------------------------------------------------------------------------------------------


def waits(c: Scene, bend: Any, *families: str) -> None:
    """Lets a fault wait for the next recording. families: of effects that are the truth as well."""
    c.bends.append(bend)
    c.planted += families


@step
def joint(c: Scene, error: Of, i: Of = "i") -> None:
    """A joint is off by an error (N,) [rad]."""
    waits(c, c.joint(int(c.of(i)), lambda s: c.at(s).of(error)))


@step
def tool(c: Scene, shift: Of, turn: Of, when: Of = None, part: str = "tool") -> None:
    """The tool is moved by a twist, at the stations that ``when`` says, or all."""
    twist = c.vector(shift), c.vector(turn)
    waits(c, getattr(c.w, part)(*twist, lambda s: np.ones(len(s.t)) if when is None else c.at(s).of(when)))


def base(shift: Of, turn: Of, when: Of = None) -> Step:
    """The tracker stands elsewhere, at the stations that ``when`` says, or all."""
    return tool(shift, turn, when, "base")


@step
def bend(c: Scene, part: str, where: Any, by: Of) -> None:
    """Adds to a part of the deviation (x, tool, tracker) where an index says; the scene has d, t, q, came then."""

    def bent(arm: Any, s: Any, d: Any) -> None:
        getattr(d, part)[where(c) if callable(where) else where] += c.at(s, d).of(by)

    waits(c, bent)


@step
def payload(c: Scene, mass: Of) -> None:
    """A mass at the flange [kg]."""
    waits(c, lambda arm, s, d: setattr(d, "payload", d.payload + c.of(mass)))


@step
def elastic(c: Scene, sag: float = 4e-4, payload: float = 0.0) -> None:
    """Joints give by some sag [rad] under the arm's weight, and a payload [kg]."""
    waits(c, c.elastic(sag, payload), "compliance", *(("payload",) if payload else ()))


@step
def gear(c: Scene, size: float = 4e-4, i: Of = "i") -> None:
    """A gear that errs, some times a turn."""
    cycles, k = int(c.rng.integers(20, 90)), c.of(i)
    waits(c, c.joint(k, lambda s: size * np.sin(cycles * s.q[:, k])))


def grows(size: float, begin: float = 0.0, tau: Of = "tau") -> Step:
    """A link grows by a size [m] while it warms up from some time on."""
    return bend("x", np.s_[:, 2, 0], lambda c: size * (1.0 - np.exp(-(c.t - begin) / c.of(tau))))


@step
def tilted(c: Scene, turn: Of, pin: Any = (0.0, 0.0, 0.0)) -> None:
    """A stand turns about the base's origin, or another point, by rotation vectors (N, 3)."""
    stand = c.cell.tracker[0]

    def bent(arm: Any, s: Any, d: Any) -> None:
        back = Rotation.from_rotvec(-c.at(s).of(turn))
        d.tracker[:, :3] += pin + back.apply(stand - pin) - stand
        d.tracker[:, 3:] += back.as_rotvec()

    waits(c, bent)


def pulled(arm: Any, s: Any, d: Any) -> None:
    """A bend: a balancer above the cell pulls the flange towards itself."""
    hook, tip, turned = np.array([0.4, -0.3, 2.5]), arm.frames(d.x)[0][:, -1], []
    pull = 40.0 * (hook - tip) / np.linalg.norm(hook - tip, axis=1, keepdims=True)
    for i in range(arm.n):
        x = d.x.copy()
        x[:, i, 3] += 1e-5
        turned.append(np.sum((arm.frames(x)[0][:, -1] - tip) / 1e-5 * pull, axis=1))
    d.x[..., 3] += 2e-5 * np.stack(turned, axis=1)


@step
def gravity(c: Scene, *down: float) -> None:
    """The arm is mounted otherwise than its URDF stands: gravity in its base."""
    c.arm._model.opt.gravity[:] = down


def spare(c: Scene) -> Works:
    """Another arm of the same type, in a cell of its own."""
    return Works(c.robot, np.random.default_rng(c.rng.integers(1 << 30)))


def instead(c: Scene) -> None:
    """The arm ``twin`` stands where the arm stood, with its tool."""
    c.twin.cell.tool, c.twin.cell.tracker = c.cell.tool, c.cell.tracker
    c.w = c.twin


@step
def scenario(c: Scene, name: str, count: int) -> None:
    """Faults of bench/undeclared, all of which the vocabulary has, wait."""
    c.faults = plant(c.cell, SCENARIOS[name], c.rng, count * PERIOD)
    for fault in c.faults:
        waits(c, fault.bend, *fault.family)


@step
def carrying(c: Scene, heavy: Of, mass: Of) -> None:
    """An elastic arm at the postures that were drawn, with a payload at some of them, (N,) of bool."""
    rows, kilograms = c.of(heavy), c.of(mass)
    elastic(3e-4)(c)
    state, (q, again) = c.rng.bit_generator.state, c.visited()
    light = c.observe(q, again, *c.bends)
    payload(kilograms)(c)
    c.rng.bit_generator.state = state
    loaded, c.bends = c.observe(q, again, *c.bends), []
    c.session = joined(light.only(np.flatnonzero(~rows)), loaded.only(np.flatnonzero(rows)))


# --- stations --------------------------------------------------------------------------------------------------------


def since(k: Of, end: Of = None) -> Callable[[Scene], Array]:
    """The stations from number k on, and before an end (N,)."""
    return lambda c: (c.rows >= c.of(k)) & (True if end is None else c.rows < c.of(end))


def until(k: Of) -> Callable[[Scene], Array]:
    """The stations before number k (N,)."""
    return lambda c: c.rows < c.of(k)


def block(low: int, high: int, order: Any) -> Callable[[Scene], Array]:
    """Rows of which those from low to high are others (N,)."""
    return lambda c: np.r_[:low, order, high : c.N]


# --- readings, joint states and descriptions -------------------------------------------------------------------------


@step
def put(c: Scene, **fields: Of) -> None:
    """Fields of the recording, all found from it as it is."""
    c.session = replace(c.session, **{name: c.of(value) for name, value in fields.items()})


@step
def patch(c: Scene, where: Of, **fields: Of) -> None:
    """The same in some rows of arrays only, by an index, a name or a function."""
    changed = {name: np.array(getattr(c.session, name)) for name in fields}
    for name, value in fields.items():
        changed[name][c.of(where)] = c.of(value)
    c.session = replace(c.session, **changed)


def turned(R: Callable[[Scene], Rotation]) -> Step:
    """Orientations turned in the instrument's frame."""
    return put(R=lambda c: R(c) * c.R)


def times(factor: Of) -> Step:
    """Positions times a factor, or one a coordinate or a station."""
    return put(p=lambda c: c.p * c.of(factor))


def only(order: Of) -> Step:
    """These stations alone, in this order."""
    return let(session=lambda c: c.session.only(c.of(order)))


@step
def rows(c: Scene, order: Of) -> None:
    """Readings of other rows beside the joints."""
    of = c.of(order)
    c.session = replace(c.session, p=c.p[of], R=c.R[of])


@step
def quaternion(c: Scene, *columns: int, sign: tuple[int, ...] = (1, 1, 1, 1), when: Of = None) -> None:
    """Quaternions written with their columns x y z w in another order, and signed; at some rows or all."""
    values, here = c.raw().copy(), slice(None) if when is None else c.of(when)
    values[here, 3:] = values[here, 3:][:, columns] * sign
    c.session = replace(c.session, values=values)


W_FIRST = quaternion(3, 0, 1, 2)


def euler(written: str, read: str, change: Callable[[Array], Array] = lambda angles: angles) -> Step:
    """Orientations as angles of one sequence, changed, read as another."""
    return put(R=lambda c: Rotation.from_euler(read, change(c.R.as_euler(written))))


def cols(which: Of, columns: Callable[[Scene, Array], Array]) -> Step:
    """Columns of q (an index, a slice, or a function of the scene), by a function of the scene and of these columns."""
    return patch(lambda c: np.s_[:, c.of(which)], q=lambda c: columns(c, c.q[:, c.of(which)]))


def col(column: Any) -> Step:
    """The column of the joint that was drawn: a function of the scene, or a ufunc of the column x."""
    return cols("i", lambda c, x: column(x) if isinstance(column, np.ufunc) else c.of(column))


def cycle(*order: int, sign: Any = 1.0) -> Step:
    """From the joint that was drawn on, columns in another order: (1, 0) swaps two."""
    return cols(lambda c: [c.i + k for k in range(len(order))], lambda c, q: q[:, order] * sign)


@step
def shifted(c: Scene, share: float, size: float) -> None:
    """Some of the stations read elsewhere by the same vector."""
    here, v = c.rng.permutation(c.N) < share * c.N, c.rng.normal(size=3)
    c.session = replace(c.session, p=c.p + np.where(here[:, None], size * v / np.linalg.norm(v), 0.0))


def five_times(c: Scene) -> None:
    """Each row five times, a tenth of a period apart, with more scatter of the instrument."""
    often, later = c.session.only(np.repeat(c.rows, 5)), np.tile(0.1 * PERIOD * np.arange(5), c.N)
    c.session = replace(often, t=often.t + later, p=often.p + c.rng.normal(0, 4e-6, often.p.shape))


def by_drawing(c: Scene) -> None:
    """Readings are computed from the joints for the arm of the drawing."""
    p, R = Arm(c.robot).frames(c.arm.coordinates(c.q))
    c.session = replace(c.session, p=p[:, -1], R=Rotation.from_matrix(R[:, -1]))


@step
def described(c: Scene, change: Callable[[Scene, str], str]) -> None:
    """Another URDF, by a function of the scene and of the text."""
    text = change(c, c.urdf)
    assert text != c.urdf
    c.session = replace(c.session, urdf=text)


def sub(pattern: str, by: Any, count: int = 0) -> Step:
    """Another URDF, by a regular expression."""
    return described(lambda c, text: re.sub(pattern, by, text, count=count, flags=re.DOTALL))


def block_of(text: str, tag: str, name: str) -> str:
    """The block of a link or joint in a URDF."""
    return re.search(rf'<{tag} name="{name}".*?</{tag}>', text, re.DOTALL)[0]  # type: ignore[index]


def in_block(tag: str, names: Of, change: Callable[[Scene, str], str]) -> Step:
    """Another URDF, in which the blocks of a link or joint, or of some, are changed."""

    def changed(c: Scene, text: str) -> str:
        some = c.of(names)
        for name in [some] if isinstance(some, str) else some:
            text = text.replace(old := block_of(text, tag, name), change(c, old))
        return text

    return described(changed)


def having(c: Scene, where: str, test: Callable[[Array], Any], first: int = 1) -> list[str]:
    """The arm's joints, by default but the first, with an attribute ``where`` whose numbers pass a test."""
    found: list[Array] = []
    out = []
    for name in c.names[first:]:
        found.clear()
        numbers(block_of(c.urdf, "joint", name), where, lambda v: found.append(v) or v)  # type: ignore[func-returns-value]
        out += [name] if found and test(found[0]) else []
    return out


def pick_having(where: str, test: Callable[[Array], Any]) -> Step:
    """Draws a joint, i, among those."""
    among = lambda c: having(c, where, test)  # noqa: E731
    return let(among=among, i=lambda c: c.names.index(c.among[int(c.rng.integers(len(c.among)))]))


def inertial(link: int, pattern: str, by: str) -> Step:
    """Another URDF, in which something of a link's inertial is another."""
    inside = re.compile(r"<inertial>.*?</inertial>", re.DOTALL)
    change = lambda found: re.sub(pattern, by, found[0], count=1)  # noqa: E731
    return in_block("link", lambda c: c.arm.links[link], lambda c, text: inside.sub(change, text, count=1))


def numbers(text: str, where: str, change: Callable[[Array], Array], digits: int = 9) -> str:
    """A URDF, or a block of one, with other numbers in an attribute: ``"origin xyz"``."""
    tag, key = where.split()

    def changed(found: re.Match[str]) -> str:
        return f'{found[1]}"{" ".join(f"{v:.{digits}g}" for v in change(np.array(found[2].split(), float)))}"'

    return re.sub(rf'(<{tag} [^>]*?{key}=)"([^"]*)"', changed, text)


def each_joint(change: Callable[[str], str]) -> Step:
    """Another URDF, in which the block of every joint is changed."""
    return sub(r"<joint .*?</joint>", lambda found: change(found[0]))


def cut_short(v: Array) -> Array:
    """An origin 8 cm nearer along its longest coordinate."""
    return v - 0.08 * np.sign(v) * (np.arange(3) == np.argmax(np.abs(v)))


def shorter(c: Scene, text: str) -> str:
    """A URDF whose first long link is a tenth shorter."""
    values = next(v for v in re.findall(r'xyz="([^"]*)"', text) if max(abs(float(x)) for x in v.split()) > 0.25)
    long = [f"{float(x) * (0.9 if abs(float(x)) > 0.25 else 1.0):.6g}" for x in values.split()]
    return text.replace(f'"{values}"', f'"{" ".join(long)}"')


# --- arrays ----------------------------------------------------------------------------------------------------------


def centres(c: Scene, q: Array | None = None) -> Array:
    """The arm's centre of mass in its base at the postures (N, 3)."""
    q, out = c.q if q is None else q, []
    for x in c.arm.coordinates(q):
        c.arm._place(x)
        mujoco.mj_comPos(c.arm._model, c.arm._data)
        out.append(c.arm._data.subtree_com[1].copy())
    return np.array(out)


def moment(com: Array, x: float = 1.0, y: float = 1.0) -> Array:
    """The moment (N, 3) of a centre of mass about the base, times weight, of a stand of two softnesses."""
    return np.stack([-x * com[:, 1], y * com[:, 0], np.zeros(len(com))], axis=1)


def scaled(values: Array, size: float) -> Array:
    """Values brought, about their mean, to an RMS."""
    return size / float(np.sqrt(np.mean(np.sum((values - values.mean(axis=0)) ** 2, axis=-1)))) * values


def loaded(c: Scene, size: Any = 1.0, axis: int = 3) -> Array:
    """A size times the load on the joint that was drawn, or across it, over its RMS (N,)."""
    load = c.arm.holding(c.arm.coordinates(c.q))[:, c.i, axis]
    return size * load / np.sqrt(np.mean(load**2))


def share(c: Scene, *joints: int) -> Array:
    """Where joints are in their ranges, from -1 to 1 (joints, N)."""
    return ((c.q - c.middle) / (0.5 * np.ptp(c.arm.range, axis=0)))[:, joints].T


def moves(q: Array, begin: Any = None) -> Array:
    """How far joints went to each station; to the first one from ``begin``, or not at all."""
    return np.diff(q, axis=0, prepend=q[:1] if begin is None else np.asarray(begin)[None])


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


def filtered(values: Array, b: Any, a: Any = 1.0) -> Array:
    """Values behind a filter that has been at rest at the first."""
    return lfilter(b, a, values - values[0], axis=0) + values[0]


def flipped(c: Scene) -> tuple[Array, Array]:
    """Angles (N,) and axes (N, 3) that bring a flat marker to its other tilt."""
    along, normal = c.sight, c.R.apply([0.0, 0.0, 1.0])
    other = 2.0 * np.sum(normal * along, axis=1, keepdims=True) * along - normal
    axis = np.cross(normal, other)
    return np.arccos(np.clip(np.sum(normal * other, axis=1), -1.0, 1.0)), axis / np.linalg.norm(axis, axis=1)[:, None]


# --- signals, and what is recorded in place of one reading a station -------------------------------------------------


def signal(name: str, clock: Array, values: Array, topic: str) -> tuple[SignalTrack, ...]:
    """A signal at times since the beginning of the session."""
    return (SignalTrack(name, BEGIN + clock, np.reshape(values, (len(clock), -1)), topic),)


def warm(begin: float, seconds: float, low: float, high: float) -> Callable[[Scene], tuple[Array, Array]]:
    """Times and a temperature that goes up and down, of a phase that is drawn."""
    clock = np.arange(begin, begin + seconds, 2.0)
    angle = 2 * np.pi * clock / 310.0
    return lambda c: (clock, low + (high - low) * (0.5 - 0.5 * np.cos(angle + c.rng.uniform(0, 2 * np.pi))))


def heat_told(c: Scene) -> None:
    """The temperature ``heat``, times and values, is recorded as that of the third joint's link."""
    c.session = replace(c.session, signals=signal(f"temperature:{c.arm.parents[2]}", *c.heat, "/temperature"))


def sensed(c: Scene) -> None:
    """The temperature of a planted fault is recorded."""
    ((link, temperature),) = (fault.sensor for fault in c.faults)
    clock = np.arange(0.0, c.N * PERIOD + 1.0)
    seen = temperature(clock) + c.rng.normal(0, 0.05, len(clock))
    c.session = replace(c.session, signals=signal(f"temperature:{link}", clock, seen, "/temperature"))


@step
def written(c: Scene, change: Callable[[Recording], Recording]) -> None:
    """A bag that holds something else than the session's arrays say."""
    whole = change(c.session.recording())
    c.session = replace(c.session, spoken=lambda session: whole)


def restamped(stamps: Callable[[Array], Array]) -> Step:
    """Readings with other stamps."""

    def change(whole: Recording) -> Recording:
        (track,) = whole.readings
        other = stamps(track.stamps)
        return replace(whole, readings=(Readings(track.kind, track.frame, other, track.values, other),))

    return written(change)


def zeros_between(whole: Recording) -> Recording:
    """A second publisher of zeros among the joint states."""
    (joints,) = whole.joints
    stamps = np.concatenate([joints.stamps, joints.stamps + 0.013])
    q, order = np.concatenate([joints.position, np.zeros_like(joints.position)]), np.argsort(stamps, kind="stable")
    return replace(whole, joints=(joint_track(joints.names, stamps[order], q[order]),))


@step
def stream(c: Scene, count: int, rate: float = 25.0) -> None:
    """Joint states and readings all the time: clock, flow (joints), sent (p, R) without noise; ``streamed`` ends it."""
    q, again = c.postures(count)
    session = c.observe(q, again, **EXACT)
    when = np.arange(0.0, PERIOD, 1.0 / rate)
    u = np.clip(when / (0.5 * PERIOD), 0.0, 1.0)[:, None]
    reached = q + c.rng.normal(0, REPEAT, q.shape)

    def flow(ends: Array) -> Array:
        start = np.concatenate([ends[:1] - 0.1, ends[:-1]])
        return (start[:, None] + (10 * u**3 - 15 * u**4 + 6 * u**5) * (ends - start)[:, None]).reshape(-1, c.n)

    c.clock, c.flow = np.round((session.t[:, None] - 0.5 * PERIOD + when).ravel(), 6), flow(q)
    c.sent = c.cell.poses(Stations(flow(reached), c.clock, np.ones_like(c.flow)), ())
    missed = c.cell.poses(Stations(reached, session.t, np.ones_like(q)), ()).p - session.p
    floor = np.hypot(1e3 * np.sqrt(np.mean(np.sum(missed**2, axis=1))), 0.035 / np.sqrt(25.0))
    c.session = replace(session, floor_mm=float(floor))


@step
def streamed(c: Scene, read: Of = None, p: Of = None, R: Of = None, received: bool = False) -> None:
    """The stream is recorded, with noise: stamps, positions and turns of the readings are others where given."""
    at, turn = (c.sent.p if p is None else c.of(p)), (c.sent.R if R is None else c.of(R))
    at = at + c.rng.normal(0, 2e-5, at.shape)
    turn = turn * Rotation.from_rotvec(c.rng.normal(0, 2e-5, at.shape))
    stamps = BEGIN + c.clock
    told = stamps if read is None else c.of(read)
    values = np.concatenate([at, turn.as_quat()], axis=1)
    readings = Readings(c.kind, c.frame, told, values, told if received else stamps)
    whole = Recording((joint_track(c.names, stamps, c.flow),), (readings,), (), c.urdf)
    c.session = replace(c.session, spoken=lambda session: whole)
