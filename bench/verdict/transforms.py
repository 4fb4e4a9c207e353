"""What the steps of a row can be: each changes a scene (see case.py), draws included, one after the other.

A function of the scene, ``lambda c: ...``, stands wherever a value depends on it. Numbers draw nothing; a vector that
is given X
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from arm import Arm
from case import Scene, Step, take
from recordings import plant
from scenarios import SCENARIOS
from scipy.spatial.transform import Rotation
from workcell import BEGIN, PERIOD, REPEAT, Array, SignalTrack, Works, joined  # noqa: F401 (kinds take all names from here)

DAY = 86_400.0
Of = Any  # a value, a name that ``let`` gave, or a function of the scene

# --- draws -----------------------------------------------------------------------------------------------------------


def let(**values: Of) -> Step:
    """Names values, in this order."""

    def step(c: Scene) -> None:
        for name, value in values.items():
            setattr(c, name, value(c) if callable(value) else value)

    return step


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

    def step(c: Scene) -> None:
        c.session = c.clean(count, **options)

    return step


def visit(count: int, returns: int = 6, low: float = 0.0, high: float = 1.0) -> Step:
    """Draws postures q, and which of them are second visits; ``see`` records them."""

    def step(c: Scene) -> None:
        c.session = None
        c.q, c.again = c.postures(count, returns, low, high)

    return step


def see(**options: Any) -> Step:
    """A recording of the postures, with the faults that wait."""

    def step(c: Scene) -> None:
        c.used, c.bends = c.bends, []
        q, again = c.__dict__.pop("q"), c.__dict__.pop("again")
        c.session = c.observe(q, again, *c.used, **options)

    return step


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
    c.parts = []


# --- commands --------------------------------------------------------------------------------------------------------


def asked(*options: str) -> Step:
    """Options of the command."""
    return let(options=options)


def _evaluated(c: Scene, options: tuple[str, ...]) -> None:
    c.imports, c.command, c.options = (("calibrate", "{first}"),), ("evaluate", "{out0}", "{second}"), options


def frozen(*options: str) -> Step:
    """The recording is calibrated, and the calibration evaluated on the one that follows."""

    def step(c: Scene) -> None:
        _evaluated(c, options)
        c.sessions, c.session = {"first": c.session}, None

    return step


def before(count: int | None, *options: str, **observed: Any) -> Step:
    """A calibration on a recording that is made now is evaluated on the one that there is; None: of postures drawn."""

    def step(c: Scene) -> None:
        _evaluated(c, options)
        visits = c.postures(count) if count else (c.__dict__.pop("q"), c.__dict__.pop("again"))
        c.sessions, c.bends = {"first": c.observe(*visits, *c.bends, **observed)}, []

    return step


def also(count: int | None = None) -> Step:
    """Calibrated together with the one that follows; or, with a number, a first one made now with the one there is."""

    def step(c: Scene) -> None:
        c.command = ("calibrate", "{first}", "--also", "{second}")
        c.sessions, c.session = (
            ({"first": c.session}, None) if count is None else ({"first": c.clean(count)}, c.session)
        )

    return step


def truth(**fields: Any) -> Step:
    """Fields of the case that depend on the scene."""

    def step(c: Scene) -> None:
        c.truth |= fields

    return step


# --- bends of the truth ----------------------------------------------------------------------------------------------


def waits(c: Scene, bend: Any, *families: str) -> None:
    """Lets a fault wait for the next recording. families: of effects that are the truth as well."""
    c.bends.append(bend)
    c.planted += families


def joint(error: Of, i: Of = "i") -> Step:
    """A joint is off by an error (N,) [rad]."""

    return lambda c: waits(c, c.joint(int(c.of(i)), lambda s: c.at(s).of(error)))


def tool(shift: Of, turn: Of, when: Callable[[Scene], Array] | None = None) -> Step:
    """The tool is moved by a twist, at the stations that ``when`` says, or all."""
    return _moved("tool", shift, turn, when)


def base(shift: Of, turn: Of, when: Callable[[Scene], Array] | None = None) -> Step:
    """The tracker stands elsewhere, at the stations that ``when`` says, or all."""
    return _moved("base", shift, turn, when)


def _moved(part: str, shift: Of, turn: Of, when: Callable[[Scene], Array] | None) -> Step:
    def step(c: Scene) -> None:
        twist = c.vector(shift), c.vector(turn)
        rows = (lambda s: np.ones(len(s.t))) if when is None else lambda s: when(c.at(s))
        waits(c, getattr(c.w, part)(*twist, rows))

    return step


def bend(part: str, where: Any, by: Of) -> Step:
    """Adds to a part of the deviation (x, tool, tracker, payload) where an index says; the scene has d, t, q, came."""

    def bent(c: Scene, s: Any, d: Any) -> None:
        if part == "payload":
            d.payload += c.of(by)
        else:
            getattr(d, part)[where(c) if callable(where) else where] += c.at(s, d).of(by)

    return lambda c: waits(c, lambda arm, s, d: bent(c, s, d))


def elastic(sag: float = 4e-4, payload: float = 0.0) -> Step:
    """Joints give by some sag [rad] under the arm's weight, and a payload [kg]."""
    return lambda c: waits(c, c.elastic(sag, payload), "compliance", *(("payload",) if payload else ()))


def payload(mass: float) -> Step:
    """A mass at the flange [kg]."""
    return bend("payload", None, mass)


def grows(size: float, begin: float = 0.0, tau: Of = "tau") -> Step:
    """A link grows by a size [m] while it warms up from some time on."""
    return bend("x", np.s_[:, 2, 0], lambda c: size * (1.0 - np.exp(-(c.t - begin) / c.of(tau))))


def gravity(*down: float) -> Step:
    """The arm is mounted otherwise than its URDF stands: gravity in its base."""

    def step(c: Scene) -> None:
        c.arm._model.opt.gravity[:] = down

    return step


def spare(c: Scene) -> None:
    """Another arm of the same type, in a cell of its own."""
    c.w = Works(c.robot, np.random.default_rng(c.rng.integers(1 << 30)))


def tilted(turn: Of) -> Step:
    """A stand turns about the base's origin by rotation vectors (N, 3)."""

    def step(c: Scene) -> None:
        stand = c.cell.tracker[0]

        def bent(arm: Any, s: Any, d: Any) -> None:
            back = Rotation.from_rotvec(-c.at(s).of(turn))
            d.tracker[:, :3] += back.apply(stand) - stand
            d.tracker[:, 3:] += back.as_rotvec()

        waits(c, bent)

    return step


# --- stations --------------------------------------------------------------------------------------------------------


def since(k: Of, end: Of = None) -> Callable[[Scene], Array]:
    """The stations from number k on, and before an end (N,)."""
    return lambda c: (c.rows >= c.of(k)) & (True if end is None else c.rows < c.of(end))


def until(k: Of) -> Callable[[Scene], Array]:
    """The stations before number k (N,)."""
    return lambda c: c.rows < c.of(k)


# --- readings, joint states and descriptions -------------------------------------------------------------------------


def put(**fields: Callable[[Scene], Any]) -> Step:
    """Fields of the recording, all found from it as it is."""

    def step(c: Scene) -> None:
        c.session = replace(c.session, **{name: c.of(value) for name, value in fields.items()})

    return step


def patch(where: Of, **fields: Callable[[Scene], Any]) -> Step:
    """The same in some rows of arrays only, by an index, a name or a function."""

    def step(c: Scene) -> None:
        changed = {name: np.array(getattr(c.session, name)) for name in fields}
        for name, value in fields.items():
            changed[name][c.of(where)] = c.of(value)
        c.session = replace(c.session, **changed)

    return step


def turned(R: Callable[[Scene], Rotation]) -> Step:
    """Orientations turned in the instrument's frame."""
    return put(R=lambda c: R(c) * c.R)


def times(factor: Of) -> Step:
    """Positions times a factor, or one a coordinate or a station."""
    return put(p=lambda c: c.p * c.of(factor))


def rows(order: Callable[[Scene], Array]) -> Step:
    """Readings of other rows beside the joints."""

    def step(c: Scene) -> None:
        of = order(c)
        c.session = replace(c.session, p=c.p[of], R=c.R[of])

    return step


def block(low: int, high: int, order: Any) -> Callable[[Scene], Array]:
    """Rows of which those from low to high are others."""
    return lambda c: np.r_[:low, order, high : c.N]


def quaternion(
    *columns: int, sign: tuple[int, ...] = (1, 1, 1, 1), when: Callable[[Scene], Array] | None = None
) -> Step:
    """Quaternions written with their columns x y z w in another order, and signed; at some rows or all."""

    def step(c: Scene) -> None:
        values = c.raw().copy()
        here = slice(None) if when is None else when(c)
        values[here, 3:] = values[here, 3:][:, columns] * sign
        c.session = replace(c.session, values=values)

    return step


W_FIRST = quaternion(3, 0, 1, 2)


def euler(written: str, read: str, change: Callable[[Array], Array] = lambda angles: angles) -> Step:
    """Orientations as angles of one sequence, changed, read as another."""
    return put(R=lambda c: Rotation.from_euler(read, change(c.R.as_euler(written))))


def col(column: Any) -> Step:
    """The column of the joint that was drawn: a function of the scene, or a ufunc of the column x."""

    def step(c: Scene) -> None:
        q = c.session.q.copy()
        q[:, c.i] = column(c.x) if isinstance(column, np.ufunc) else column(c)
        c.session = replace(c.session, q=q)

    return step


def cols(which: Any, columns: Callable[[Scene, Array], Array]) -> Step:
    """Columns of q (an index, a slice, or a function of the scene), by a function of the scene and of these columns."""

    def step(c: Scene) -> None:
        q, here = c.session.q.copy(), which(c) if callable(which) else which
        q[:, here] = columns(c, q[:, here])
        c.session = replace(c.session, q=q)

    return step


def cycle(*order: int, sign: Any = 1.0) -> Step:
    """From the joint that was drawn on, columns in another order: (1, 0) swaps two."""
    return cols(lambda c: [c.i + k for k in range(len(order))], lambda c, q: q[:, order] * sign)


def shifted(share: float, size: float) -> Step:
    """Some of the stations read elsewhere by the same vector."""

    def step(c: Scene) -> None:
        here = c.rng.permutation(c.N) < share * c.N
        v = c.rng.normal(size=3)
        c.session = replace(c.session, p=c.p + np.where(here[:, None], size * v / np.linalg.norm(v), 0.0))

    return step


def described(change: Callable[[Scene, str], str]) -> Step:
    """Another URDF, by a function of the scene and of the text."""

    def step(c: Scene) -> None:
        text = change(c, c.urdf)
        assert text != c.urdf
        c.session = replace(c.session, urdf=text)

    return step


def sub(pattern: str, by: Any, count: int = 0) -> Step:
    """Another URDF, by a regular expression."""
    return described(lambda c, text: re.sub(pattern, by, text, count=count, flags=re.DOTALL))


def in_block(tag: str, name: Callable[[Scene], str], change: Callable[[Scene, str], str]) -> Step:
    """Another URDF, in which the block of a link or joint is changed."""

    def step(c: Scene, text: str) -> str:
        whole = block_of(text, tag, name(c))
        return text.replace(whole, change(c, whole))

    return described(step)


def block_of(text: str, tag: str, name: str) -> str:
    """The block of a link or joint in a URDF."""
    found = re.search(rf'<{tag} name="{name}".*?</{tag}>', text, re.DOTALL)
    assert found is not None
    return found[0]


def inertial(link: int, pattern: str, by: str) -> Step:
    """Another URDF, in which something of a link's inertial is another."""

    def change(c: Scene, text: str) -> str:
        whole = block_of(text, "link", c.arm.links[link])
        (inside,) = re.findall(r"<inertial>.*?</inertial>", whole, re.DOTALL)
        return text.replace(whole, whole.replace(inside, re.sub(pattern, by, inside, count=1)))

    return described(change)


def shorter(c: Scene, text: str) -> str:
    """A URDF whose first long link is a tenth shorter."""
    values = [v for v in re.findall(r'xyz="([^"]*)"', text) if max(abs(float(x)) for x in v.split()) > 0.25]
    long = [f"{float(x) * (0.9 if abs(float(x)) > 0.25 else 1.0):.6g}" for x in values[0].split()]
    return text.replace(f'"{values[0]}"', f'"{" ".join(long)}"')


def dwells(count: int, begin: float = 0.0) -> Step:
    """Streams of joint states and readings, ten readings a second while the arm stands."""

    def step(c: Scene) -> None:
        session = c.clean(count, noise_mm=0.0, noise_mrad=0.0, begin=begin)
        arm_mm, arm_deg, _, _ = session.stated
        eye_mm, eye_deg = 0.02 * np.sqrt(3.0), np.degrees(2e-5 * np.sqrt(3.0))
        stated, floor = (arm_mm, arm_deg, eye_mm, eye_deg), float(np.hypot(arm_mm, eye_mm / np.sqrt(15)))
        c.session = replace(session, stream=10.0, stated=stated, floor_mm=floor)

    return step


# --- what the arm is -------------------------------------------------------------------------------------------------


def centres(c: Scene, q: Array | None = None) -> Array:
    """The arm's centre of mass in its base at the postures (N, 3)."""
    model, data, q = c.arm._model, c.arm._data, c.q if q is None else q
    out = np.empty((len(q), 3))
    for i, x in enumerate(c.arm.coordinates(q)):
        c.arm._place(x)
        mujoco.mj_comPos(model, data)
        out[i] = data.subtree_com[1]
    return out


def moment(com: Array, x: float = 1.0, y: float = 1.0) -> Array:
    """The moment (N, 3) of a centre of mass about the base, times weight, of a stand of two softnesses."""
    return np.stack([-x * com[:, 1], y * com[:, 0], np.zeros(len(com))], axis=1)


def scaled(values: Array, size: float) -> Array:
    """Values brought, about their mean, to an RMS."""
    return size / float(np.sqrt(np.mean(np.sum((values - values.mean(axis=0)) ** 2, axis=-1)))) * values


def carrying(heavy: Callable[[Scene], Array], mass: Callable[[Scene], float]) -> Step:
    """An elastic arm at the postures that were drawn, with a payload at some of them, (N,) of bool."""

    def step(c: Scene) -> None:
        rows, kilograms, bends = heavy(c), mass(c), [c.elastic(3e-4)]
        q, again, state = c.__dict__.pop("q"), c.__dict__.pop("again"), c.rng.bit_generator.state
        light = c.observe(q, again, *bends)
        c.rng.bit_generator.state = state
        payload(kilograms)(c)
        loaded = c.observe(q, again, *bends, *c.bends)
        c.session, c.bends = joined(light.only(np.flatnonzero(~rows)), loaded.only(np.flatnonzero(rows))), []

    return step


def kinds_of(q: Array) -> Array:
    """Numbers of the postures, the same for second visits (N,)."""
    return np.unique(q, axis=0, return_inverse=True)[1].ravel()


def flange(c: Scene) -> tuple[Array, Array]:
    """The flange at the postures: where it is (N, 3), and how it is turned (N, 3, 3)."""
    p, R = c.arm.frames(c.arm.coordinates(c.q))
    return p[:, -1], R[:, -1]


def tool_axes(c: Scene) -> Array:
    """How the tool is turned at the postures (N, 3, 3)."""
    return np.asarray(flange(c)[1] @ c.cell.tool[1].as_matrix())


def by_drawing(c: Scene) -> None:
    """Readings are computed from the joints for the arm of the drawing."""
    p, R = Arm(c.robot).frames(c.arm.coordinates(c.q))
    c.session = replace(c.session, p=p[:, -1], R=Rotation.from_matrix(R[:, -1]))


def moves(q: Array, begin: Any = None) -> Array:
    """How far joints went to each station; to the first one from ``begin``, or not at all."""
    return np.diff(q, axis=0, prepend=q[:1] if begin is None else np.asarray(begin)[None])


def dragged(values: Array, slack: float) -> Array:
    """What follows values over a slack only, as friction holds it."""
    held, out = np.zeros_like(values[0]), []
    for value in values:
        held = np.clip(held, value - slack, value + slack)
        out.append(held)
    return np.array(out)


def middle(c: Scene) -> Array:
    """The middle of the joints' ranges (n,)."""
    return np.asarray(c.arm.range.mean(axis=0))


def share(c: Scene, *joints: int) -> Array:
    """Where joints are in their ranges, from -1 to 1 (joints, N)."""
    return ((c.q - middle(c)) / (0.5 * np.ptp(c.arm.range, axis=0)))[:, joints].T


def travel(c: Scene) -> Array:
    """Where the joint that was drawn is in its range, from 0 to 1 (N,)."""
    low, high = c.arm.range[:, c.i]
    return (c.x - low) / (high - low)


def far(c: Scene) -> Array:
    """Distances of the readings (N, 1)."""
    return np.linalg.norm(c.p, axis=1, keepdims=True)


def sight(c: Scene) -> Array:
    """Unit vectors from the instrument to the target (N, 3)."""
    return c.p / far(c)


def azimuth(c: Scene) -> Array:
    """Azimuths of the readings (N,)."""
    return np.arctan2(c.p[:, 1], c.p[:, 0])


def gear(size: float = 4e-4, i: Of = "i") -> Step:
    """A gear that errs, some times a turn."""

    def step(c: Scene) -> None:
        cycles, k = int(c.rng.integers(20, 90)), c.of(i)
        waits(c, c.joint(k, lambda s: size * np.sin(cycles * s.q[:, k])))

    return step


def warm(begin: float, seconds: float, low: float, high: float) -> Callable[[Scene], tuple[Array, Array]]:
    """Times and a temperature that goes up and down, of a phase that is drawn."""

    def made(c: Scene) -> tuple[Array, Array]:
        clock = np.arange(begin, begin + seconds, 2.0)
        phase = c.rng.uniform(0, 2 * np.pi)
        return clock, low + (high - low) * (0.5 - 0.5 * np.cos(2 * np.pi * clock / 310.0 + phase))

    return made


def signal(name: str, clock: Array, values: Array, topic: str) -> tuple[SignalTrack, ...]:
    """A signal at times since the beginning of the session."""
    return (SignalTrack(name, BEGIN + clock, np.reshape(values, (len(clock), -1)), topic),)


EXACT: dict[str, Any] = {"noise_mm": 0.0, "noise_mrad": 0.0, "repeat": 0.0}


def heat_told(c: Scene) -> None:
    """The temperature ``heat``, times and values, is recorded as that of the third joint's link."""
    c.session = replace(c.session, signals=signal(f"temperature:{c.arm.parents[2]}", *c.heat, "/temperature"))


def scenario(name: str, count: int) -> Step:
    """Faults of bench/undeclared, of which the vocabulary has all, wait; what sensors they have is kept."""

    def step(c: Scene) -> None:
        c.faults = plant(c.cell, SCENARIOS[name], c.rng, count * PERIOD)
        for fault in c.faults:
            waits(c, fault.bend, *fault.family)

    return step


def sensed(c: Scene) -> None:
    """The temperatures of planted faults are recorded."""
    clock = np.arange(0.0, c.N * PERIOD + 1.0)
    for link, temperature in (fault.sensor for fault in c.faults if fault.sensor is not None):
        seen = temperature(clock) + c.rng.normal(0, 0.05, len(clock))
        c.session = replace(c.session, signals=signal(f"temperature:{link}", clock, seen, "/temperature"))


def five_times(c: Scene) -> None:
    """Each row five times, a tenth of a period apart, with more scatter of the instrument."""
    often = c.session.only(np.repeat(c.rows, 5))
    later = np.tile(0.1 * PERIOD * np.arange(5), c.N)
    c.session = replace(often, t=often.t + later, p=often.p + c.rng.normal(0, 4e-6, often.p.shape))
