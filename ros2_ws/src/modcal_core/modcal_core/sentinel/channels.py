"""The signals of an arm at its work, each a linear model of its motion, and how changes of the arm show in them.

Four channels. *Torque*: what a joint's drive gives, by the stated masses, friction, and inertia; of
cells in which the joint moves, for dry friction of one that stands may be anything between both sides. *Following*:
commanded (or a leader's) less measured position, by the joint's effort and speed; where no efforts are reported, by
friction and weight in their place. *Tag*: where a camera on the hand sees a fixed tag, six components. *Contact*:
where the joints put the tool while it rests in a socket, three.

A changed zero of joint k, of δ, puts the arm at q + δ: torques change by ∂g/∂q_k δ, the tag by the joint's Jacobian.
A ratio does so in proportion to q_k, play by half of itself to either side, as the joint is loaded. With an encoder on
the joint's side play shows in following instead: two shapes of one change.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from modcal_core import moves, robots
from modcal_core.geometry import Array, se3
from modcal_core.sentinel.cells import Cells, MonitoredArm

ALL_JOINTS = "all joints"
_MOVES = 0.5  # of the mean sign of the speed in a cell, from which its friction is known
_MASSES, _CENTRES = 0.1, 0.03  # of a stated mass, and m: standard deviations of what descriptions state
_GEOMETRY = 5e-3  # rad or m: standard deviation of a nominal arm's errors, each seen as a joint's zero
_STEP = 1e-3  # rad or m of a difference quotient
_SOFT = 0.05  # of a joint's largest load: below it play rests on neither side
_SLOW = (0.05, 0.3)  # rad/s or m/s at which what dry friction is larger by when slow has fallen to a third
RUBS = (1, 2, -3, -2, -1)  # columns of friction among those of torques
_NEAR = 0.2  # rad or m: a tag or socket that is farther from where it should be is another one
_SURE, _REACH = 1e-3, 0.3  # m: what a nominal arm misses by, and a tool's length
CARRIED = ("mass", "moment:0", "moment:1", "moment:2", "inertia")  # columns of a payload in torques
LIFTED = "lifted "  # begin of their names in what joints yield by


@dataclass(frozen=True)
class SignalRows:
    """One signal of one recording. y (N,). X (N, p): what it depends on. width (p,): standard deviations of the
    coefficients beforehand, inf where nothing is known. loose: how many of the first columns have coefficients that
    differ between recordings. columns: how it moves per unit of each change, (N,). t (N,) [s]. cells: how many there
    could be. geometric: whether the columns are known beyond the motion that has been seen, too.
    """

    y: Array
    X: Array
    width: Array
    loose: int
    columns: Mapping[str, Array]
    t: Array
    cells: int
    geometric: bool = False

    def rows(self, keep: np.ndarray) -> SignalRows:
        """These rows only."""
        columns = {name: x[keep] for name, x in self.columns.items()}
        return replace(self, y=self.y[keep], X=self.X[keep], columns=columns, t=self.t[keep])


@dataclass(frozen=True)
class Placed:
    """Where things are that stay. tag: T_tag_base and T_tip_camera (4, 4). sockets: their places in the base, (3,), by
    frame. ball (3,): what rests in them, in the tip.
    """

    tag: tuple[Array, Array] | None
    sockets: Mapping[str, Array]
    ball: Array


@dataclass(frozen=True)
class _Loads:
    """What the stated bodies ask of every joint: weight, and what motion adds, (N, n); weight by each body's mass and
    moment (N, n, 4 n), and by each joint (N, n, n). carried: 1 kg at the tip, 1 kg m along each axis, and an inertia of
    1 kg m² there, moved as the arm is, (5, N, n). side: on which side play rests, −1 … 1, (N, n).
    """

    weight: Array
    motion: Array
    by_body: Array
    by_joint: Array
    carried: Array
    side: Array


def signals_of(cells: Cells, arm: MonitoredArm, placed: Placed) -> dict[str, SignalRows]:
    """The signals of a recording by name: ``torque JOINT``, ``following TOPIC JOINT``, ``tag 0`` … ``tag 5``, ``contact
    FRAME 0`` … ``contact FRAME 2``.
    """
    loads = _loads(cells, arm)
    out = {}
    efforts = np.nan_to_num(cells["effort"])
    reported = [bool(np.ptp(x)) for x in efforts.T]
    for j, name in enumerate(arm.names):
        if loads is not None and reported[j]:
            out[f"torque {name}"] = _torque(cells, arm, loads, j)
        for topic in cells.of("apart"):
            if np.isfinite(cells[f"apart:{topic}"][:, j]).any():
                form = topic if reported[j] else f"{topic}, without efforts,"  # other columns, so another signal
                out[f"following {form} {name}"] = _following(cells, arm, loads, (topic, j, reported[j]))
    if placed.tag is not None and "tag" in cells.columns:
        out |= _tag(cells, arm, loads, placed.tag)
    for frame in placed.sockets:
        if frame in cells.of("touch"):
            out |= _contact(cells, arm, loads, placed, frame)
    return {name: rows for name, rows in out.items() if len(rows.y)}


def _loads(cells: Cells, arm: MonitoredArm) -> _Loads | None:
    chain, bodies, q = arm.chain, arm.bodies, cells["q"]
    if chain is None or bodies is None or not bodies.known:
        return None
    down, still = robots.STANDARD_GRAVITY * bodies.down, np.zeros_like(q)
    whole = robots.torque(chain, bodies, q, cells["v"], cells["a"], down)
    motion = whole - robots.torque(chain, bodies, q, still, still, down)
    weight, by_body = robots.gravity_columns(chain, bodies, q)
    steps = _STEP * np.eye(chain.n)
    by_joint = [
        (robots.gravity_efforts(chain, bodies, q + h) - robots.gravity_efforts(chain, bodies, q - h)) / (2.0 * _STEP)
        for h in steps
    ]

    def held(mass: float, centre: Array, inertia: Array) -> Array:
        loaded = robots.with_payload(bodies, chain, robots.Payload.checked(mass, centre, np.r_[inertia, 0.0, 0.0, 0.0]))
        return robots.torque(chain, loaded, q, cells["v"], cells["a"], down) - whole

    no, one = np.zeros(3), np.ones(3)
    mass = held(1.0, no, no)  # a point beside it has an inertia about the tip as well
    moments = [held(1.0, axis, no) - mass - held(0.0, no, one - axis) for axis in np.eye(3)]
    carried = np.stack([mass, *moments, held(0.0, no, one)])
    return _Loads(weight, motion, by_body, np.stack(by_joint, axis=2), carried, _rests(weight + motion))


def _rests(load: Array) -> Array:
    return np.asarray(np.tanh(load / np.maximum(_SOFT * np.abs(load).max(axis=0, initial=0.0), 1e-9)))


def _torque(cells: Cells, arm: MonitoredArm, loads: _Loads, j: int) -> SignalRows:
    assert arm.bodies is not None
    q, v, side, one = cells["q"], cells["v"][:, j], cells["side"][:, j], np.ones(len(cells))
    mass = arm.bodies.mass
    rubs = [*(side * np.exp(-np.abs(v) / slow) for slow in _SLOW), side * np.abs(loads.weight + loads.motion)[:, j]]
    X = [one, side, v, loads.weight[:, j], loads.motion[:, j], cells["a"][:, j], *loads.by_body[:, j].T, *rubs]
    masses = (mass[:, None] * np.array([_MASSES, _CENTRES, _CENTRES, _CENTRES])).ravel()
    width = np.r_[np.full(6, np.inf), masses, np.full(3, np.inf)]
    columns = {f"rubs {i}:{arm.names[j]}": X[k] for i, k in enumerate(RUBS)}
    columns |= {f"gain:{arm.names[j]}": loads.weight[:, j] + loads.motion[:, j], f"bias:{arm.names[j]}": one}
    for k, name in enumerate(arm.names):
        columns |= _of_position(name, loads.by_joint[:, j, k], q[:, k], loads.side[:, k])
    columns |= {name: x[:, j] for name, x in zip(CARRIED, loads.carried, strict=True)}
    made = SignalRows(cells["effort"][:, j], np.stack(X, axis=1), width, 5, columns, cells["t"], 0)
    return _usable(made, np.abs(side) > _MOVES)


def _of_position(name: str, by: Array, q: Array, side: Array) -> dict[str, Array]:
    """How a signal moves with what changes a joint's position: by (N,), per unit of it."""
    return {f"zero:{name}": by, f"ratio:{name}": by * q, f"slack:{name}": -0.5 * by * side}  # it sags


def _following(cells: Cells, arm: MonitoredArm, loads: _Loads | None, which: tuple[str, int, bool]) -> SignalRows:
    topic, j, reported = which
    name, one = arm.names[j], np.ones(len(cells))
    v, side, effort = (cells[key][:, j] for key in ("v", "side", "effort"))
    rests = side if loads is None else loads.side[:, j]
    columns = {"late": v, f"late:{name}": v, f"loose:{name}": 0.5 * rests, f"beside:{name}": one}
    moving = np.ones(len(cells), bool)
    X, loose = [one, v, effort if reported else side], 3
    if reported:
        columns[f"servo:{name}"] = effort
    else:
        columns[f"drag:{name}"], moving = side, np.abs(side) > _MOVES
    if loads is not None and not reported:
        X, loose = [*X, loads.weight[:, j], loads.motion[:, j]], 4
        columns[f"servo:{name}"] = loads.weight[:, j]
        columns |= {f"{LIFTED}{i}:{name}": x[:, j] for i, x in enumerate(loads.carried)}
    X.append(cells["a"][:, j])
    wide = np.full(len(X), np.inf)
    return _usable(
        SignalRows(cells[f"apart:{topic}"][:, j], np.stack(X, axis=1), wide, loose, columns, cells["t"], 0), moving
    )


def _tag(cells: Cells, arm: MonitoredArm, loads: _Loads | None, placed: tuple[Array, Array]) -> dict[str, SignalRows]:
    """Where the camera is by the tag less where the joints put it, as twists in the camera's axes."""
    chain = arm.chain
    assert chain is not None
    seen = np.isfinite(cells["tag"]).all(axis=1)
    if not seen.any():
        return {}
    q, v = cells["tag_q"][seen], cells["tag_v"][seen]
    T_tag_base, T_tip_camera = placed
    T_base_camera = robots.chain_forward(chain, q) @ T_tip_camera
    expected = T_tag_base @ T_base_camera
    apart = se3.log(se3.inverse(expected) @ se3.inverse(se3.from_pose(cells["tag"][seen])))
    near = np.abs(apart).max(axis=1) < _NEAR
    J = se3.adjoint(se3.inverse(T_tip_camera)) @ robots.body_jacobian(chain, q)
    turned = se3.adjoint(se3.inverse(T_base_camera))  # of the base before the tag
    late = np.einsum("nij,nj->ni", J, v)
    rests = np.sign(v) if loads is None else loads.side[seen]
    out, n = {}, chain.n
    for i in range(6):
        X = np.column_stack([np.ones(len(q)), turned[:, i], late[:, i], J[:, i]])
        columns = {f"camera:{k}": np.full(len(q), float(k == i)) for k in range(6)}
        columns |= {f"tag:{k}": turned[:, i, k] for k in range(6)} | {"camera late": late[:, i]}
        for k, name in enumerate(arm.names):
            columns |= _of_position(name, J[:, i, k], q[:, k], rests[:, k])
        width = np.r_[np.full(8, np.inf), np.full(n, _GEOMETRY)]
        made = SignalRows(apart[:, i], X, width, 1, columns, cells["t"][seen], 0, geometric=True)
        out[f"tag {i}"] = _usable(made, near)
    return out


def ball_and_sockets(arm: MonitoredArm, touches: Mapping[str, Array]) -> Placed:
    """Where sockets and what rests in them are, by the joints (N, n) at each. One that these miss by far is none."""
    if arm.chain is None or not touches:
        return Placed(None, {}, np.zeros(3))
    T = robots.chain_forward(arm.chain, np.concatenate(list(touches.values())))
    which = np.repeat(np.eye(len(touches)), [len(q) for q in touches.values()], axis=0)
    A = np.concatenate([T[:, :3, :3], -np.einsum("nf,ij->nifj", which, np.eye(3)).reshape(len(T), 3, -1)], axis=2)
    held = np.eye(3, A.shape[2]) * _SURE / _REACH  # of orientations that are alike nothing tells the ball's place
    y = np.r_[-T[:, :3, 3].ravel(), np.zeros(3)]
    found = np.linalg.lstsq(np.concatenate([A.reshape(-1, A.shape[2]), held]), y, rcond=None)[0]
    missed = np.abs(A @ found + T[:, :3, 3]).max(axis=1)
    sockets = dict(zip(touches, found[3:].reshape(-1, 3), strict=True))
    near = [np.median(missed[of > 0.0]) < _NEAR for of in which.T]
    return Placed(None, {f: at for (f, at), close in zip(sockets.items(), near, strict=True) if close}, found[:3])


def _contact(
    cells: Cells, arm: MonitoredArm, loads: _Loads | None, placed: Placed, frame: str
) -> dict[str, SignalRows]:
    """Where the socket is less where the joints put the ball, in the base's axes."""
    chain, q = arm.chain, cells[f"touch:{frame}"]
    assert chain is not None
    seen = np.isfinite(q).all(axis=1)
    q = q[seen]
    T, J = robots.chain_forward(chain, q), robots.body_jacobian(chain, q)
    R = T[:, :3, :3]
    apart = placed.sockets[frame] - T[:, :3, 3] - R @ placed.ball
    by = R @ (J[:, :3] + np.cross(J[:, 3:], placed.ball[:, None], axisa=1, axisb=0, axisc=1))
    rests = np.zeros_like(q) if loads is None else loads.side[seen]
    out = {}
    for i in range(3):
        columns = {f"socket {frame}:{k}": np.full(len(q), float(k == i)) for k in range(3)}
        columns |= {f"ball:{k}": R[:, i, k] for k in range(3)}
        for k, name in enumerate(arm.names):
            columns |= _of_position(name, by[:, i, k], q[:, k], rests[:, k])
        width = np.r_[np.full(4, np.inf), np.full(chain.n, _GEOMETRY)]
        X = np.column_stack([np.ones(len(q)), R[:, i], by[:, i]])
        made = SignalRows(apart[:, i], X, width, 1, columns, cells["t"][seen], 0, geometric=True)
        out[f"contact {frame} {i}"] = _usable(made, np.abs(apart).max(axis=1) < _NEAR)
    return out


def _usable(rows: SignalRows, keep: np.ndarray) -> SignalRows:
    """The rows in which everything is known, and how many could be."""
    known = keep & np.isfinite(rows.y) & np.isfinite(rows.X).all(axis=1)
    kept = rows.rows(known)
    return replace(kept, cells=len(kept.y))


@dataclass(frozen=True)
class ChangeColumns:
    """A change that can be asked about. columns: sums of named columns, one for every size."""

    change: moves.CellChange
    columns: tuple[Mapping[str, float], ...]


_OF_JOINTS = {"zero": moves.ZERO, "ratio": moves.GEAR, "slack": moves.SLACK, "loose": moves.SLACK}
_OF_JOINTS |= {"late": moves.LATENCY, "servo": moves.SERVO, "beside": moves.OFFSET}


def candidates(
    arm: MonitoredArm, seen: Collection[str], shares: Iterable[tuple[str, str, tuple[Mapping[str, float], ...]]]
) -> list[ChangeColumns]:
    """The changes that signals with these columns can be asked about. shares: kind, joint and sums of columns."""

    def row(kind: str, place: str, *columns: str) -> ChangeColumns:
        return ChangeColumns(moves.CellChange(kind, place), tuple({column: 1.0} for column in columns))

    out = [row(kind, name, f"{shape}:{name}") for name in arm.names for shape, kind in _OF_JOINTS.items()]
    out += [ChangeColumns(moves.CellChange(kind, name), of) for kind, name, of in shares]
    out += [row(moves.LATENCY, ALL_JOINTS, "late"), row(moves.LATENCY, "camera", "camera late")]
    out += [row(moves.MASS, "tool", "mass"), row(moves.MASS, "tool", *CARRIED)]
    out += [row(kind, kind, *(f"{kind}:{k}" for k in range(6))) for kind in (moves.CAMERA, moves.TAG)]
    out.append(row(moves.TOOL, "tool", *(f"ball:{k}" for k in range(3))))
    frames = sorted({name.rpartition(":")[0].removeprefix("socket ") for name in seen if name.startswith("socket ")})
    out += [row(moves.FRAME, frame, *(f"socket {frame}:{k}" for k in range(3))) for frame in frames]
    return [one for one in out if all(column.keys() <= set(seen) for column in one.columns)]
