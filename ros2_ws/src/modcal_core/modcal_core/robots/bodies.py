"""The bodies of a chain: what gravity asks of every joint, what it must set in motion, and what the arm carries.

Everything is computed in the base frame, where twists, linear first, and inertias of all bodies add: the composite
rigid body algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 6).

At rest a joint gives what gravity asks of it, linear in the mass of every body and in mass times centre, the payload's
included. Beside the payload an estimate has, by joint, the torque constant, an offset and dry friction, which acts
against the side from which the joint came, and the arm's own bodies, which descriptions state roughly. Priors hold all
of them, so that a covariance says what the postures show (Bayesian linear regression, each joint's scatter with it).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRecording, BadRobot, NotEnoughData
from modcal_core.geometry import Array, crossed_rows, se3, sealed, so3
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import Frames, frames, link_frames, spatial_jacobian
from modcal_core.robots.urdf_inertias import HeldBehind, Inertias

STANDARD_GRAVITY = 9.80665  # m/s²
DOWN = np.array([0.0, 0.0, -1.0])  # in the base, where nothing else is known


def chain_gravity_wrench(chain: Chain, inertias: Inertias, q: Array, moved: Array | None = None) -> Array:
    """Weight of the bodies beyond each joint, (n, 6, N): force [N], moment about the joint's origin [N m].

    Both in the frame just before the joint's motion, with its axis along z, so row 5 is the torque about a turning
    joint's axis and row 2 the force along a sliding one's. q: joint positions (N, n). moved: how
    far bodies' centres are from where the inertias have them, behind each joint, (n, N, 3) [m].
    """
    f = frames(chain, q)
    com = inertias.com if moved is None else (inertias.com[:, None] + moved).swapaxes(0, 1)
    centres = se3.apply(link_frames(chain, f), com).transpose(1, 2, 0)
    return _borne(chain, f, inertias.mass, centres, inertias.down, inertias.held)


class HeldWeight:
    """What joints give at rest for the weight of their bodies, of one posture at a time, of an arm held at its base."""

    def __init__(self, chain: Chain, inertias: Inertias) -> None:
        """The bodies of a chain."""
        self._chain, self._inertias = chain, inertias

    def efforts(self, q: Array) -> Array:
        """Torques (n,) [N m; N] that hold the arm at a posture q (n,)."""
        return gravity_efforts(self._chain, self._inertias, q[None])[0]

    def of_load(self, q: Array) -> Array:
        """The same (n,) for 1 kg at the tip."""
        return _against(self._chain, payload_wrench(self._chain, q[None], self._inertias.down))[0]


def gravity_efforts(chain: Chain, inertias: Inertias, q: ArrayLike) -> Array:
    """What joints give to hold the bodies of a chain at postures q (N, n), (N, n) [N m, N]."""
    return _against(chain, chain_gravity_wrench(chain, inertias, np.asarray(q, dtype=float)))


def _against(chain: Chain, wrench: Array) -> Array:
    return np.asarray(-np.where(chain.revolute[:, None], wrench[:, 5], wrench[:, 2]).T)


def payload_wrench(chain: Chain, q: Array, down: Array = DOWN, held: HeldBehind | None = None) -> Array:
    """The same, (n, 6, N), of a mass of 1 kg at the tip. down: unit vector (3,) in the base. held: as of inertias."""
    f = frames(chain, q)
    return _of_tip(chain, f, f.p[-1], down, held)


def offset_wrench(chain: Chain, q: Array, down: Array = DOWN, held: HeldBehind | None = None) -> Array:
    """How the latter changes with each metre that the mass is beside the tip, along the tip's x, y, z, (3, n, 6, N)."""
    f = frames(chain, q)
    own = _of_tip(chain, f, f.p[-1], down, held)
    return np.stack([_of_tip(chain, f, f.p[-1] + axis, down, held) - own for axis in f.axes[-1]])


def _of_tip(chain: Chain, f: Frames, at: Array, down: Array, held: HeldBehind | None) -> Array:
    """The wrenches, (n, 6, N), of 1 kg at points (3, N) that move with the last joint."""
    return _borne(chain, f, np.eye(chain.n)[-1], at, down, None if held is None else held.empty)


def _borne(chain: Chain, f: Frames, mass: Array, centres: Array, down: Array, held: HeldBehind | None) -> Array:
    """Wrenches (n, 6, N) at the joints of bodies (n,) with centres in the base, (n, 3, N) or (3, N) [m]."""
    weight = STANDARD_GRAVITY * mass[:, None, None]
    weights, moments = (np.cumsum(part[::-1], axis=0)[::-1] for part in (weight, weight * centres))
    if held is not None:  # the first joints bear what is before them, the other way round
        own = STANDARD_GRAVITY * held.mass
        weights[: held.joints] -= own + weights[:1]
        moments[: held.joints] -= own * held.com[:, None] + moments[:1]
    way, lever = _way(chain, f, down, held), moments - weights * f.p[:-1]
    turning = so3.cross(lever.swapaxes(0, 1), way[:, None]).swapaxes(0, 1)
    wrench = np.einsum("kdcn,ikcn->kidn", f.axes[:-1], np.stack([weights * way, turning]))
    return np.asarray(wrench.reshape(chain.n, 6, -1))


def _way(chain: Chain, f: Frames, down: Array, held: HeldBehind | None) -> Array:
    """Where weight pulls, in the base, (3, N), which turns where the arm is held elsewhere."""
    if held is None or not held.joints:
        return np.broadcast_to(down[:, None], f.p[0].shape)
    at_zero = frames(chain, np.zeros((1, chain.n)))
    return np.asarray(np.einsum("dcn,d->cn", f.axes[held.joints], at_zero.axes[held.joints, :, :, 0] @ down))


# --- What a joint must set in motion: equivalent inertias, the joint-space inertia matrix, and a payload folded in

_SAME = 1e-9  # how far, relatively, an inertia may be from symmetric, and from what a body can have


@dataclass(frozen=True)
class Payload:
    """What the arm carries: mass [kg], centre (3,) [m] in the tip link, and inertia (3, 3) [kg m²] about the centre."""

    mass: float = 0.0
    centre: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def checked(cls, mass: float, centre: ArrayLike = (0.0, 0.0, 0.0), inertia: ArrayLike = (0.0,) * 6) -> Payload:
        """The payload with these numbers; inertia: ixx iyy izz ixy ixz iyz, as in ROS's Inertia. Raises BadRobot."""
        c, i = np.asarray(centre, dtype=float).ravel(), np.asarray(inertia, dtype=float).ravel()
        if not (np.isfinite(mass) and mass >= 0.0):
            raise BadRobot("payload: mass", f"{mass:g} kg is not 0 or more", "give kilograms")
        if c.shape != (3,) or not np.isfinite(c).all() or np.abs(c).max() > 10.0:
            raise BadRobot("payload: centre", f"{_said(c)} is not a point within 10 m of the tip", "give metres")
        if i.shape != (6,) or not np.isfinite(i).all():
            raise BadRobot("payload: inertia", f"{_said(i)} is not six numbers", "give ixx iyy izz ixy ixz iyz [kg m²]")
        tensor = np.array([[i[0], i[3], i[4]], [i[3], i[1], i[5]], [i[4], i[5], i[2]]])
        least = np.linalg.eigvalsh(0.5 * np.trace(tensor) * np.eye(3) - tensor).min()  # Σ m r rᵀ of a body is not < 0
        if least < -_SAME * max(1e-3, float(np.abs(i).max())):
            said = f"{_said(i)} is not physical: moments obey a + b ≥ c"
            raise BadRobot("payload: inertia", said, "give it about the centre of mass")
        return cls(float(mass), c, tensor)


def with_payload(inertias: Inertias, chain: Chain, payload: Payload) -> Inertias:
    """The bodies of a chain with a payload in its tip link, folded into the body of the last joint (Steiner)."""
    T_joint_tip = chain.origins[-1]
    R, c = T_joint_tip[:3, :3], se3.apply(T_joint_tip, payload.centre)
    mass, com, inertia = (np.array(a) for a in (inertias.mass, inertias.com, inertias.inertia))
    total = float(mass[-1]) + payload.mass
    if total > 0.0:
        between = com[-1] - c
        reduced = float(mass[-1]) * payload.mass / total
        com[-1] = (mass[-1] * com[-1] + payload.mass * c) / total
        inertia[-1] += reduced * (between @ between * np.eye(3) - np.outer(between, between))
    inertia[-1] += R @ payload.inertia @ R.T
    mass[-1] = total
    return sealed(replace(inertias, mass=mass, com=com, inertia=inertia))


@dataclass(frozen=True)
class Bodies:
    """The bodies of a chain at N postures, seen from the base.

    mass: (n,) [kg]. twists: S, (N, 6, n). centres: of mass, (N, n, 3) [m]. inertias: about them, (N, n, 3, 3) [kg m²].
    """

    mass: Array
    twists: Array
    centres: Array
    inertias: Array

    @classmethod
    def at(cls, chain: Chain, inertias: Inertias, q: ArrayLike) -> Bodies:
        """The bodies at joint positions q (N, n) [rad, m]."""
        q = np.asarray(q, dtype=float)
        f = frames(chain, q)
        T = link_frames(chain, f)
        R = T[..., :3, :3]
        turned = R @ inertias.inertia @ np.swapaxes(R, -1, -2)
        return cls(inertias.mass, spatial_jacobian(chain, q, f), se3.apply(T, inertias.com), turned)

    @cached_property
    def spatial(self) -> Array:
        """I_j about the base's origin, (N, n, 6, 6)."""
        m = self.mass[:, None, None]
        c = so3.hat(self.centres)
        out = np.empty((*self.centres.shape[:2], 6, 6))
        out[..., :3, :3] = m * np.eye(3)
        out[..., :3, 3:] = -m * c
        out[..., 3:, :3] = m * c
        out[..., 3:, 3:] = self.inertias - m * (c @ c)
        return out

    @cached_property
    def matrix(self) -> Array:
        """Joint-space inertia matrices M, (N, n, n) [kg m², kg m, kg]; symmetric."""
        S = self.twists
        momentum = beyond(self.spatial) @ np.swapaxes(S, 1, 2)[..., None]  # (N, n, 6, 1)
        upper = np.swapaxes(S, 1, 2) @ np.swapaxes(momentum[..., 0], 1, 2)  # what is below its diagonal is no matter
        n = upper.shape[-1]
        return np.where(np.arange(n)[:, None] <= np.arange(n), upper, np.swapaxes(upper, 1, 2))


def beyond(values: Array) -> Array:
    """For every joint the sum over the bodies beyond it, its own included: of (N, n, ...) along the second axis."""
    return np.cumsum(values[:, ::-1], axis=1)[:, ::-1]


def mass_matrix(chain: Chain, inertias: Inertias, q: ArrayLike) -> Array:
    """Joint-space inertia matrices M(q) (N, n, n) [kg m², kg m, kg] for joint positions q (N, n)."""
    return Bodies.at(chain, inertias, q).matrix


def equivalent_inertia(chain: Chain, inertias: Inertias, q: ArrayLike) -> Array:
    """Inertia that each joint meets while all others stand still at q (N, n), (N, n) [kg m²; kg]: the diagonal of M."""
    return np.diagonal(mass_matrix(chain, inertias, q), axis1=1, axis2=2)


def _said(values: Array) -> str:
    return f"({', '.join(f'{v:g}' for v in values)})"


FEWEST = 6  # postures with the payload: of two joints that gravity loads they show four numbers three times
_ROUNDS = 30  # of estimating scatter and parameters in turn
_LEAST = 1e-4  # of the largest effort of a joint, its scatter at least: no drive measures its torque so well
_HEAVIEST, _FARTHEST = 100.0, 1.0  # kg, m: standard deviations of a payload before anything is known
_CENTRE = 0.03  # m, standard deviation of the centre of a body that a robot description states
_SURELY = 4.0  # standard deviations beyond which efforts are not of this arm
_FRICTION, _OFFSET = 0.3, 0.3  # of the largest effort of a joint, standard deviations before anything is known


@dataclass(frozen=True)
class Stands:
    """Postures in which an arm stood. q, effort, side: (N, n) [rad, m], [N m, N], and the way each joint came, −1, 0
    (unknown) or 1. loaded: whether it carried the payload.
    """

    q: Array
    effort: Array
    side: Array
    loaded: bool


@dataclass(frozen=True)
class Weighed:
    """mass [kg], centre (3,) [m] in the tip link, and their covariance (4, 4).

    scale: what the efforts that are reported must be multiplied by, (n,); scale_std: its standard deviations. scatter:
    standard deviation of one effort, (n,) [N m, N]. postures: number of those with the payload. friction: dry, with its
    standard deviations, and offset of the efforts, each (n,) [N m, N]. bodies: as they were found, payload included.
    """

    mass: float
    centre: Array
    covariance: Array
    scale: Array
    scale_std: Array
    scatter: Array
    postures: int
    friction: Array
    friction_std: Array
    offset: Array
    bodies: Inertias

    @property
    def std(self) -> Array:
        """Standard deviations of mass [kg] and centre [m], (4,)."""
        return np.sqrt(np.diag(self.covariance))


def weigh(
    chain: Chain,
    inertias: Inertias,
    stands: Sequence[Stands],
    constants: float = 0.05,
    masses: float = 0.1,
    torques: bool = False,
) -> Weighed:
    """The payload that explains the efforts.

    constants: standard deviation of a torque constant, relative. masses: of the masses in the robot description,
    relative. torques: whether efforts are known to be torques, which is not asked then. Raises NotEnoughData for fewer
    postures than FEWEST with the payload, and BadRecording where no joint reports an effort, or efforts are not those
    that hold this arm.
    """
    count = sum(len(s.q) for s in stands if s.loaded)
    if count < FEWEST:
        said = f"{count} postures at rest with the payload, {FEWEST} are needed"
        raise NotEnoughData("joint states", said, "hold each of some ten different postures for a second")
    effort = np.concatenate([s.effort for s in stands])
    if not np.nan_to_num(effort).any():
        raise BadRecording("joint states", "report no effort", "record a driver that publishes torques")
    n, q = chain.n, np.concatenate([s.q for s in stands])
    side = np.concatenate([s.side for s in stands])
    loaded = np.concatenate([np.full(len(s.q), s.loaded) for s in stands])
    own, by_body = gravity_efforts(chain, inertias, q), _by_moments(chain, inertias, q)
    held, bodies = by_body[:, :, -1] * loaded[:, None, None], by_body[:, :, :-1].reshape(*own.shape, 4 * n)
    columns = np.concatenate([held, bodies, *(x[:, :, None] * np.eye(n) for x in (side, np.ones_like(q)))], axis=2)
    most = np.nanmax(np.abs(effort), axis=0, initial=1e-9)
    widths = inertias.mass[:, None] * np.array([masses, _CENTRE, _CENTRE, _CENTRE])
    payload = _HEAVIEST * np.array([1.0, _FARTHEST, _FARTHEST, _FARTHEST])
    prior = np.concatenate([payload, widths.ravel(), _FRICTION * most, _OFFSET * most, np.full(n, constants)])
    if not torques:
        more = np.concatenate([held, side[:, :, None]], axis=2)
        _require_torques(chain, own, more, effort, float(np.hypot(constants, masses)))
    x, covariance, scatter = _regression(columns, own, effort, np.maximum(prior, 1e-12), _LEAST * most)
    mass, moment = float(x[0]), x[1:4]
    if mass < -_SURELY * np.sqrt(covariance[0, 0]):
        said = f"would make the payload weigh {mass:.3g} kg"
        raise BadRecording("efforts", said, "check their sign and unit, and the masses of the robot description")
    centre = moment / mass
    # of (m, m c): ∂c/∂m = −c / m, ∂c/∂(m c) = 1 / m
    by = np.block([[np.eye(1), np.zeros((1, 3))], [-centre[:, None] / mass, np.eye(3) / mass]])
    return Weighed(
        mass,
        centre,
        by @ covariance[:4, :4] @ by.T,
        1.0 / x[-n:],
        np.sqrt(np.diag(covariance)[-n:]) / x[-n:] ** 2,
        scatter,
        count,
        np.maximum(x[-3 * n : -2 * n], 0.0),
        np.sqrt(np.diag(covariance)[-3 * n : -2 * n]),
        x[-2 * n : -n],
        _found(chain, inertias, x[: 4 + 4 * n]),
    )


def _found(chain: Chain, inertias: Inertias, x: Array) -> Inertias:
    """The stated bodies with what was found of masses and of masses times centres, the payload's (4,) first."""
    changed = x[4:].reshape(-1, 4)
    mass = np.maximum(inertias.mass + changed[:, 0], 0.0)
    moment = inertias.mass[:, None] * inertias.com + changed[:, 1:]
    com = np.where(mass[:, None] > 0.0, moment / np.maximum(mass[:, None], 1e-12), inertias.com)
    # the payload may be lighter than nothing, where the last body is heavier than stated
    payload = Payload(max(float(x[0]), -float(mass[-1])), x[1:4] / x[0])
    return with_payload(replace(inertias, mass=mass, com=com), chain, payload)


def _require_torques(chain: Chain, own: Array, more: Array, effort: Array, unsure: float) -> None:
    """Raises BadRecording where a joint's efforts are another multiple of what holds the stated bodies than unsure
    constants and masses allow, whatever is carried: currents, another sign, another arm.

    own: efforts for the stated bodies, (N, n). more: what they may depend on besides, (N, n, K).
    """
    for j, name in enumerate(chain.names):
        rows = np.isfinite(effort[:, j])
        design = np.column_stack([own[rows, j], more[rows, j], np.ones(int(rows.sum()))])
        if len(design) < 2 * design.shape[1]:
            continue
        x, (singular, V) = np.linalg.lstsq(design, effort[rows, j], rcond=1e-9)[0], np.linalg.svd(design)[1:]
        left = float(np.sum((effort[rows, j] - design @ x) ** 2)) / (len(design) - design.shape[1])
        std = np.sqrt(left * np.sum((V[:, 0] / np.maximum(singular, 1e-9 * singular[0])) ** 2))
        if abs(x[0] - 1.0) > _SURELY * np.hypot(std, unsure):
            said = f"are {x[0]:.2g} times what holds the links of the robot description"
            remedy = "publish torques [N m] that hold the arm up, not currents, or correct the masses"
            raise BadRecording(f"efforts of {name}", said, remedy)


def gravity_columns(chain: Chain, inertias: Inertias, q: Array) -> tuple[Array, Array]:
    """Efforts for the stated bodies (N, n), and by each body's mass and mass times centre (N, n, 4 n)."""
    own = gravity_efforts(chain, inertias, q)
    return own, _by_moments(chain, inertias, q)[:, :, :-1].reshape(*own.shape, 4 * chain.n)


def _by_moments(chain: Chain, inertias: Inertias, q: Array) -> Array:
    """Efforts by mass and mass times centre of every body, and of one in the tip link, (N, n, n + 1, 4)."""
    f, held, joints = frames(chain, q), inertias.held, np.arange(chain.n)
    T = np.concatenate([link_frames(chain, f), f.transform(-1)[:, None]], axis=1)
    way = STANDARD_GRAVITY * _way(chain, f, inertias.down, held).T
    pulled = np.zeros((*T.shape[:2], 4, 6))  # by a unit of each: the force, and its moment about the base's origin
    pulled[..., 0, :3] = way[:, None]
    pulled[..., 3:] = crossed_rows(T[..., :3, [3, 0, 1, 2]].swapaxes(-1, -2), way[:, None, None])
    borne = np.arange(chain.n + 1) >= joints[:, None]
    signs = borne.astype(float) - (joints < (0 if held is None else held.joints))[:, None]
    return np.asarray(-np.einsum("nsj,nkes,jk->njke", spatial_jacobian(chain, q, f), pulled, signs, optimize=True))


def _regression(columns: Array, own: Array, effort: Array, prior: Array, least: Array) -> tuple[Array, Array, Array]:
    """Most probable parameters, their covariance, and the scatter of each joint (n,).

    The last n parameters multiply what the others give beside the stated bodies, own (N, n): what is reported of it.
    Scaling what was read instead would let a scale of zero explain everything.
    """
    n, known = own.shape[1], np.isfinite(effort)
    mean = np.r_[np.zeros(len(prior) - n), np.ones(n)]
    x, scatter = mean.copy(), np.maximum(np.nanstd(effort, axis=0), least)
    for _ in range(_ROUNDS):
        given = own + columns @ x[:-n]
        left = np.where(known, effort - x[-n:] * given, 0.0)
        slope = np.concatenate([x[-n:, None] * columns, given[:, :, None] * np.eye(n)], axis=2) * known[:, :, None]
        white = (slope / scatter[:, None]).reshape(-1, len(prior))
        scaled = white * prior
        covariance = np.linalg.inv(scaled.T @ scaled + np.eye(len(prior))) * prior * prior[:, None]
        x = x + covariance @ (white.T @ (left / scatter).ravel() + (mean - x) / prior**2)
        left = np.where(known, effort - x[-n:] * (own + columns @ x[:-n]), 0.0)
        spread = np.einsum("njp,pq,njq->nj", slope, covariance, slope).sum(axis=0)
        # by what is left and by what the parameters may have taken of it (EM); of few efforts it is known only roughly,
        # which makes a Student's t of the normal distribution
        free = np.maximum(known.sum(axis=0) - spread / scatter**2, 3.0)
        scatter = np.sqrt(((left**2).sum(axis=0) + spread) / known.sum(axis=0).clip(1) * free / (free - 2.0))
        scatter = np.maximum(scatter, least)
    return x, covariance, scatter
