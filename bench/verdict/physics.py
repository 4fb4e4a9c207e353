"""What an arm, its tool or its stand do that no entry of the vocabulary was written for; what the URDF has wrong."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
from case import Case, calibrated, kind
from regimes import BASE, EITHER
from scipy.spatial.transform import Rotation
from workcell import Array, Bend, Session, Works, joined

LOAD = ("payload", r"\bload", "compliance", r"\bmass", r"\bkg\b")


def centres(w: Works, q: Array) -> Array:
    """The arm's centre of mass in its base (N, 3), and from there its moment: times weight."""
    model, data = w.arm._model, w.arm._data
    out = np.empty((len(q), 3))
    for i, x in enumerate(w.arm.coordinates(q)):
        w.arm._place(x)
        mujoco.mj_comPos(model, data)
        out[i] = data.subtree_com[1]
    return out


def tilted(w: Works, turn: Callable[[object], Array]) -> Bend:
    """A stand that turns about the base's origin by rotation vectors (N, 3) of the stations."""
    stand = w.cell.tracker[0]

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        back = Rotation.from_rotvec(-turn(stations))
        deviation.tracker[:, :3] += back.apply(stand) - stand
        deviation.tracker[:, 3:] += back.as_rotvec()

    return bend


def scaled(values: Array, size: float) -> float:
    """The factor that brings values about their mean to an RMS."""
    return size / float(np.sqrt(np.mean(np.sum((values - values.mean(axis=0)) ** 2, axis=-1))))


@kind()
def base_tilts_under_load(w: Works, rng: np.random.Generator) -> Case:
    """The stand deflects under the arm's moment, more one way than the other."""
    q, again = w.postures(150)
    com = centres(w, q)
    soft = rng.uniform(0.5, 1.5, 2)
    moment = np.stack([-soft[0] * com[:, 1], soft[1] * com[:, 0], np.zeros(len(q))], axis=1)
    turn = scaled(moment, 4e-4) * moment
    return calibrated(w.observe(q, again, tilted(w, lambda s: turn)), (*BASE, w.names[0], w.arm.parents[0]))


@kind()
def stand_settles(w: Works, rng: np.random.Generator) -> Case:
    """The tripod turns and sinks, ever more slowly."""
    tau, v = rng.uniform(100, 250), w.way(4e-4)
    bend = tilted(w, lambda s: np.outer(1 - np.exp(-s.t / tau), v))
    return calibrated(w.clean(150, bend), (*BASE, w.names[0], "drift"))


@kind()
def two_arms(w: Works, rng: np.random.Generator) -> Case:
    """Another arm, whose joints are recorded too, weighs on the torso that carries both."""
    q, again = w.postures(160)
    other = rng.uniform(*w.arm.range, q.shape)
    com = centres(w, other)
    moment = np.stack([-com[:, 1], com[:, 0], np.zeros(len(q))], axis=1)
    turn = scaled(moment, 2e-3) * moment
    session = w.observe(q, again, tilted(w, lambda s: turn))
    more = {f"left_{name}": other[:, i] for i, name in enumerate(w.names)}
    return calibrated(replace(session, more=more), ("left_", *BASE))


def _mixed(w: Works, q: Array, again: Array, heavy: Array, mass: float) -> Session:
    elastic = w.elastic(3e-4)

    def payload(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.payload += mass

    state = w.rng.bit_generator.state
    light = w.observe(q, again, elastic)
    w.rng.bit_generator.state = state
    loaded = w.observe(q, again, elastic, payload)
    return joined(light.only(np.flatnonzero(~heavy)), loaded.only(np.flatnonzero(heavy)))


@kind()
def payload_from_the_middle(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm picks up some kilograms half way."""
    session = _mixed(w, *w.postures(160), np.arange(160) >= 80, rng.uniform(4.0, 8.0))
    return calibrated(session, (*LOAD, *EITHER, *w.names, "step"))


@kind()
def payload_of_the_posture(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm carries a part in some postures, each time it is there, and nothing recorded says which."""
    q, again = w.postures(160)
    kinds = np.unique(q, axis=0, return_inverse=True)[1].ravel()
    heavy = (rng.random(160) < 0.5)[kinds]
    return calibrated(_mixed(w, q, again, heavy, rng.uniform(6.0, 10.0)), (*LOAD, *w.names))


@kind()
def payload_at_random(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm carries a part now and then. Nothing is visited twice, so that it may be taken for scatter."""
    session = _mixed(w, *w.postures(160, 0), rng.random(160) < 0.5, rng.uniform(6.0, 10.0))
    return calibrated(session, (*LOAD, *w.names), shown=False)


def _described(session: Session, change: Callable[[str], str]) -> Session:
    text = change(session.urdf)
    assert text != session.urdf
    return replace(session, urdf=text)


def _inertial(link: str, pattern: str, by: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        whole = re.search(rf'<link name="{link}".*?</link>', text, re.DOTALL)
        assert whole is not None
        inertial = re.search(r"<inertial>.*?</inertial>", whole[0], re.DOTALL)
        assert inertial is not None
        return text.replace(whole[0], whole[0].replace(inertial[0], re.sub(pattern, by, inertial[0], count=1)))

    return change


@kind()
def centre_of_mass_far_off(w: Works, rng: np.random.Generator) -> Case:
    """A link's centre of mass is written in millimetres: it lies half a kilometre away."""
    link = w.arm.links[2]
    session = _described(w.clean(150, w.elastic()), _inertial(link, r'xyz="[^"]*"', 'xyz="0.0 0.0 500.0"'))
    return calibrated(session, (link, "centre of mass", "mass"))


@kind()
def mass_hundredfold(w: Works, rng: np.random.Generator) -> Case:
    """A link's mass is written in units of ten grams."""
    link = w.arm.links[-2]
    session = _described(w.clean(150, w.elastic()), _inertial(link, r'(<mass value=")[^"]*', r"\g<1>150.0"))
    return calibrated(session, (link, *LOAD, *w.names), shown="if left")


@kind()
def masses_missing(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm whose URDF knows no masses."""
    session = _described(
        w.clean(150, w.elastic(6e-4)), lambda text: re.sub(r"<inertial>.*?</inertial>", "", text, flags=re.DOTALL)
    )
    return calibrated(session, (*LOAD, *w.names), shown="if left")


@kind()
def tool_has_free_play(w: Works, rng: np.random.Generator) -> Case:
    """The tool drops to the lower side of a loose seat: three tenths of a millimetre."""
    q, again = w.postures(150)
    _, R = w.arm.frames(w.arm.coordinates(q))
    tool = R[:, -1] @ w.cell.tool[1].as_matrix()
    side = np.sign(tool[:, 2, 0])

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, 0] += 3e-4 * side

    return calibrated(w.observe(q, again, bend), (r"\btool\b", *w.arm.hand, *w.names[-3:]))


@kind()
def cable_drags(w: Works, rng: np.random.Generator) -> Case:
    """A cable that becomes taut over two joints pulls one of them."""
    i = w.any_joint(0, w.arm.n - 2)
    centre, half = w.arm.range.mean(axis=0), 0.5 * np.ptp(w.arm.range, axis=0)

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        u, v = ((stations.q - centre) / half)[:, [i, i + 1]].T
        return 6e-4 * np.maximum(u + v - 0.2, 0.0) * (1.0 + 0.5 * np.cos(2.0 * u * v))

    return calibrated(w.clean(180, w.joint(i, off)), (w.names[i], w.names[i + 1]))


@kind()
def joint_with_memory(w: Works, rng: np.random.Generator) -> Case:
    """A joint's error follows its motion only over a wide slack, so that it hangs on more than the last arrival."""
    i, slack = w.any_joint(0, 4), 0.8

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        held, out = 0.0, []
        for x in stations.q[:, i]:
            held = min(max(held, x - slack), x + slack)
            out.append(x - held)
        return 5e-4 * np.array(out)

    return calibrated(w.clean(180, w.joint(i, off)), (w.names[i],))


@kind()
def two_joints_together(w: Works, rng: np.random.Generator) -> Case:
    """A joint is off by a product of functions of two others: no curve of one of them."""
    i, j, k = rng.permutation(w.arm.n)[:3]

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        return 6e-4 * np.sin(1.7 * stations.q[:, j]) * np.sin(1.3 * stations.q[:, k] + 0.4)

    return calibrated(w.clean(200, w.joint(int(i), off)), (w.names[i], w.names[j], w.names[k]))


@kind()
def tracker_bends_its_rays(w: Works, rng: np.random.Generator) -> Case:
    """A tracker whose readings are off with the direction in which it looks, by 0.2 mrad."""
    session = w.clean(160)
    p = session.p
    azimuth = np.arctan2(p[:, 1], p[:, 0])
    turn = Rotation.from_rotvec(2.5e-4 * np.sin(3.0 * azimuth)[:, None] * w.way(1.0))
    return calibrated(replace(session, p=turn.apply(p)), ("tracker", "reading", r"\bbase\b", w.names[0]))


@kind()
def tracker_scale_with_distance(w: Works, rng: np.random.Generator) -> Case:
    """A camera whose scale is wrong the more the farther the target is."""
    session = w.clean(160)
    far = np.linalg.norm(session.p, axis=1, keepdims=True)
    return calibrated(
        replace(session, p=session.p * (1.0 + 4e-4 * (far - far.mean()) ** 2)),
        ("tracker", "reading", "scale", r"\bbase\b"),
    )


@kind()
def joints_lag(w: Works, rng: np.random.Generator) -> Case:
    """One joint's logged position lags the arm by a share of its last move."""
    session, i = w.clean(160), w.any_joint(0, 4)
    q = session.q.copy()
    before = np.r_[q[0, i], q[:-1, i]]
    q[:, i] -= 1.5e-3 * (q[:, i] - before)
    return calibrated(replace(session, q=q), (w.names[i],))


@kind()
def all_joints_lag(w: Works, rng: np.random.Generator) -> Case:
    """All joints are logged before they have arrived: a share of the last move is missing, each joint its own."""
    session = w.clean(160)
    q = session.q.copy()
    share = rng.uniform(5e-4, 2e-3, w.arm.n)
    q[1:] -= share * np.diff(session.q, axis=0)
    return calibrated(replace(session, q=q), w.names)


@kind()
def other_robot(w: Works, rng: np.random.Generator) -> Case:
    """The URDF is of another arm of the family: its forearm is four centimetres shorter."""
    session = w.clean(140)
    values = [v for v in re.findall(r'xyz="([^"]*)"', session.urdf) if max(abs(float(x)) for x in v.split()) > 0.25]
    long = [f"{float(x) * (0.9 if abs(float(x)) > 0.25 else 1.0):.6g}" for x in values[0].split()]
    return calibrated(
        _described(session, lambda text: text.replace(f'"{values[0]}"', f'"{" ".join(long)}"')), shown="if left"
    )


@kind()
def spring_that_hardens_one_way(w: Works, rng: np.random.Generator) -> Case:
    """A stop of rubber: beyond some angle a joint is pushed back by the square of the way."""
    i = w.any_joint(1, 4)
    middle = w.arm.range[:, i].mean()

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        return 1.2e-3 * np.maximum(stations.q[:, i] - middle - 0.5, 0.0) ** 2

    return calibrated(w.clean(160, w.joint(i, off)), (w.names[i],))


@kind()
def step_in_a_joint(w: Works, rng: np.random.Generator) -> Case:
    """An encoder lost counts: from some station on a joint is off by a milliradian."""
    i, k = w.any_joint(), int(rng.integers(50, 110))
    rows = np.arange(160) >= k
    session = w.clean(160, w.joint(i, lambda s: 1e-3 * rows[: len(s.t)]))
    near = {w.names[max(i - 1, 0)], w.names[i], *(("tool",) if i == w.arm.n - 1 else ()), *(BASE if i == 0 else ())}
    return calibrated(session, tuple(near))


@kind()
def few_stations(w: Works, rng: np.random.Generator) -> Case:
    """Twelve poses."""
    return calibrated(w.clean(12, returns=0), ("station", "readings", "parameters"), floor=False)


@kind()
def few_points(w: Works, rng: np.random.Generator) -> Case:
    """Twenty points of an arm that has a gear error besides."""
    bend = w.joint(2, lambda s: 4e-4 * np.sin(37 * s.q[:, 2]))
    return calibrated(w.clean(20, bend, returns=0, kind="point"), ("station", "readings", "parameters"), floor=False)


@kind()
def computed_from_the_drawing(w: Works, rng: np.random.Generator) -> Case:
    """The readings are the tool centre point that a driver computes from the joints with the URDF."""
    return calibrated(computed(w, nominal=True), ("comput", "calculat", "joint"))


@kind()
def computed_by_the_controller(w: Works, rng: np.random.Generator) -> Case:
    """The readings are the tool centre point that the controller computes with its own calibrated model."""
    return calibrated(computed(w, nominal=False), ("comput", "calculat"))


@kind()
def computed_and_rounded(w: Works, rng: np.random.Generator) -> Case:
    """The same as a pendant shows it: to a micrometre and a microradian."""
    session = computed(w, nominal=bool(rng.random() < 0.5))
    R = Rotation.from_rotvec(np.round(session.R.as_rotvec(), 6))
    return calibrated(replace(session, p=np.round(session.p, 6), R=R), ("comput", "calculat"))


def computed(w: Works, nominal: bool) -> Session:
    """Readings without any noise, of the nominal arm or of one that is displaced, at the joints that are reported."""
    session = w.observe(*w.postures(120), noise_mm=0.0, noise_mrad=0.0, repeat=0.0)
    if not nominal:
        return session
    from arm import Arm

    p, R = Arm(w.robot).frames(w.arm.coordinates(session.q))
    return replace(session, p=p[:, -1], R=Rotation.from_matrix(R[:, -1]))
