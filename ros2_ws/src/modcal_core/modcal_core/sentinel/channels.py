"""The signals of an arm at its work, each a linear model of its motion, and how changes of the arm show in them.

Three channels. *Torque*: what a joint's drive gives, by the stated masses, dry and viscous friction, and inertia; of
cells in which the joint moves, for dry friction of one that stands may be anything between both sides. *Following*:
commanded (or a leader's) less measured position, by the joint's effort and speed; where no efforts are reported, by
friction and weight in their place. *Tag*: where a camera on the hand sees a fixed tag, six components.

A changed zero of joint k, of δ, puts the arm at q + δ: torques change by ∂g/∂q_k δ, the tag by the joint's Jacobian.
A ratio does so in proportion to q_k, play by half of itself to either side, as the joint is loaded. With an encoder on
the joint's side play shows in following instead: two shapes of one change.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from modcal_core import moves
from modcal_core.geometry import Array, se3
from modcal_core.robots import (
    STANDARD_GRAVITY,
    Payload,
    body_jacobian,
    chain_forward,
    gravity_columns,
    gravity_efforts,
    torque,
    with_payload,
)
from modcal_core.sentinel.cells import Cells, MonitoredArm

ALL_JOINTS = "all joints"
_MOVES = 0.5  # of the mean sign of the speed in a cell, from which its friction is known
_MASSES, _CENTRES = 0.1, 0.03  # of a stated mass, and m: standard deviations of what descriptions state
_GEOMETRY = 5e-3  # rad or m: standard deviation of a nominal arm's errors, each seen as a joint's zero
_STEP = 1e-3  # rad or m of a difference quotient
_SOFT = 0.05  # of a joint's largest load: below it play rests on neither side
_NEAR = 0.2  # rad or m: a tag that is farther from where it should be is another one
CARRIED = ("mass", "moment:0", "moment:1", "moment:2", "inertia")  # columns of a payload


@dataclass(frozen=True)
class SignalRows:
    """One signal of one recording. y (N,). X (N, p): what it depends on. width (p,): standard deviations of the
    coefficients beforehand, inf where nothing is known. loose: how many of the first columns have coefficients that
    differ between recordings. columns: how it moves per unit of each change, (N,). t (N,) [s]. cells: how many there
    could be.
    """

    y: Array
    X: Array
    width: Array
    loose: int
    columns: Mapping[str, Array]
    t: Array
    cells: int

    def rows(self, keep: np.ndarray) -> SignalRows:
        """These rows only."""
        columns = {name: x[keep] for name, x in self.columns.items()}
        return replace(self, y=self.y[keep], X=self.X[keep], columns=columns, t=self.t[keep])


@dataclass(frozen=True)
class Placed:
    """Where the tag and the camera are: T_tag_base, T_tip_camera (4, 4)."""

    T_tag_base: Array
    T_tip_camera: Array


@dataclass(frozen=True)
class _Loads:
    """What the stated bodies ask of every joint: weight, and what motion adds, (N, n); weight by each body's mass and
    moment (N, n, 4 n), and by each joint (N, n, n). carried: 1 kg at the tip, and an inertia of 1 kg m² there, moved as
    the arm is, (2, N, n). side: on which side play rests, −1 … 1, (N, n).
    """

    weight: Array
    motion: Array
    by_body: Array
    by_joint: Array
    carried: Array
    side: Array


def signals_of(cells: Cells, arm: MonitoredArm, placed: Placed | None) -> dict[str, SignalRows]:
    """The signals of a recording by name: ``torque JOINT``, ``following TOPIC JOINT``, ``tag 0`` … ``tag 5``."""
    loads = _loads(cells, arm)
    out = {}
    efforts = np.nan_to_num(cells["effort"])
    reported = [bool(np.ptp(x)) for x in efforts.T]
    for j, name in enumerate(arm.names):
        if loads is not None and reported[j]:
            out[f"torque {name}"] = _torque(cells, arm, loads, j)
        for topic in cells.topics:
            if np.isfinite(cells[f"apart:{topic}"][:, j]).any():
                out[f"following {topic} {name}"] = _following(cells, arm, loads, (topic, j, reported[j]))
    if placed is not None and arm.chain is not None and "tag" in cells.columns:
        out |= _tag(cells, arm, loads, placed)
    return {name: rows for name, rows in out.items() if len(rows.y)}


def _loads(cells: Cells, arm: MonitoredArm) -> _Loads | None:
    chain, bodies, q = arm.chain, arm.bodies, cells["q"]
    if chain is None or bodies is None or not bodies.known:
        return None
    down, still = STANDARD_GRAVITY * bodies.down, np.zeros_like(q)
    whole = torque(chain, bodies, q, cells["v"], cells["a"], down)
    motion = whole - torque(chain, bodies, q, still, still, down)
    weight, by_body = gravity_columns(chain, bodies, q)
    steps = _STEP * np.eye(chain.n)
    by_joint = [
        (gravity_efforts(chain, bodies, q + h) - gravity_efforts(chain, bodies, q - h)) / (2.0 * _STEP) for h in steps
    ]
    held = (Payload.checked(1.0), Payload.checked(0.0, inertia=(1.0, 1.0, 1.0, 0.0, 0.0, 0.0)))
    load = weight + motion
    carried = []
    for payload in held:
        loaded = replace(with_payload(bodies, chain, payload), down=bodies.down, held=bodies.held)
        carried.append(torque(chain, loaded, q, cells["v"], cells["a"], down) - whole)
    return _Loads(weight, motion, by_body, np.stack(by_joint, axis=2), np.stack(carried), _rests(load))


def _rests(load: Array) -> Array:
    return np.asarray(np.tanh(load / np.maximum(_SOFT * np.abs(load).max(axis=0, initial=0.0), 1e-9)))


def _torque(cells: Cells, arm: MonitoredArm, loads: _Loads, j: int) -> SignalRows:
    assert arm.bodies is not None
    q, v, side, one = cells["q"], cells["v"][:, j], cells["side"][:, j], np.ones(len(cells))
    mass = arm.bodies.mass
    X = [one, side, v, loads.weight[:, j], loads.motion[:, j], cells["a"][:, j], *loads.by_body[:, j].T]
    width = np.r_[np.full(6, np.inf), (mass[:, None] * np.array([_MASSES, _CENTRES, _CENTRES, _CENTRES])).ravel()]
    columns = {f"dry:{arm.names[j]}": side, f"viscous:{arm.names[j]}": v}
    columns |= {f"gain:{arm.names[j]}": loads.weight[:, j] + loads.motion[:, j], f"bias:{arm.names[j]}": one}
    for k, name in enumerate(arm.names):
        columns |= _of_position(name, loads.by_joint[:, j, k], q[:, k], loads.side[:, k])
    columns |= {"mass": loads.carried[0, :, j], "inertia": loads.carried[1, :, j]}
    columns |= {f"moment:{i}": loads.by_body[:, j, i - 3] for i in range(3)}
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
    X.append(cells["a"][:, j])
    wide = np.full(len(X), np.inf)
    return _usable(
        SignalRows(cells[f"apart:{topic}"][:, j], np.stack(X, axis=1), wide, loose, columns, cells["t"], 0), moving
    )


def _tag(cells: Cells, arm: MonitoredArm, loads: _Loads | None, placed: Placed) -> dict[str, SignalRows]:
    """Where the camera is by the tag less where the joints put it, as twists in the camera's axes."""
    chain = arm.chain
    assert chain is not None
    seen = np.isfinite(cells["tag"]).all(axis=1)
    if not seen.any():
        return {}
    q, v = cells["tag_q"][seen], cells["tag_v"][seen]
    T_base_camera = chain_forward(chain, q) @ placed.T_tip_camera
    expected = placed.T_tag_base @ T_base_camera
    apart = se3.log(se3.inverse(expected) @ se3.inverse(se3.from_pose(cells["tag"][seen])))
    near = np.abs(apart).max(axis=1) < _NEAR
    J = se3.adjoint(se3.inverse(placed.T_tip_camera)) @ body_jacobian(chain, q)
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
        made = SignalRows(apart[:, i], X, width, 1, columns, cells["t"][seen], 0)
        out[f"tag {i}"] = _usable(made, near)
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
    arm: MonitoredArm, seen: Iterable[str], friction: Mapping[str, Mapping[str, float]]
) -> list[ChangeColumns]:
    """The changes that signals with these columns can be asked about.

    friction: of each joint in the reference period, as a sum of columns, where it is known.
    """

    def row(kind: str, place: str, *columns: str) -> ChangeColumns:
        return ChangeColumns(moves.CellChange(kind, place), tuple({column: 1.0} for column in columns))

    out = [row(kind, name, f"{shape}:{name}") for name in arm.names for shape, kind in _OF_JOINTS.items()]
    out += [row(moves.EFFORT, name, f"gain:{name}", f"bias:{name}") for name in arm.names]
    out += [ChangeColumns(moves.CellChange(moves.FRICTION, name), (of,)) for name, of in friction.items()]
    out += [row(moves.LATENCY, ALL_JOINTS, "late"), row(moves.LATENCY, "camera", "camera late")]
    out += [row(moves.MASS, "tool", "mass"), row(moves.MASS, "tool", *CARRIED)]
    out += [row(kind, kind, *(f"{kind}:{k}" for k in range(6))) for kind in (moves.CAMERA, moves.TAG)]
    return [one for one in out if all(column.keys() <= set(seen) for column in one.columns)]
