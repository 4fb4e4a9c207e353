"""What an arm carries, from the efforts of its joints while it stands in several postures.

At rest a joint gives what gravity asks of it. That is linear in the mass of every body and in mass times centre, the
payload's included. Beside the payload the estimate has, by joint, the torque constant, an offset and dry friction,
which acts against the side from which the joint came; and the arm's own bodies, which a robot description states only
roughly. All of them are held by priors, so that a covariance says what the postures show (Bayesian linear regression;
the scatter of each joint is estimated with it). Recordings without the payload show the arm's own part by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import Array
from modcal_core.robots.bodies import Payload, chain_gravity_wrench, with_payload
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf_inertias import Inertias

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


def gravity_efforts(chain: Chain, inertias: Inertias, q: ArrayLike) -> Array:
    """What joints give to hold the bodies of a chain at postures q (N, n), (N, n) [N m, N]."""
    wrench = chain_gravity_wrench(chain, inertias, np.asarray(q, dtype=float))
    return np.asarray(-np.where(chain.revolute[:, None], wrench[:, 5], wrench[:, 2]).T)


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
    own, bodies = gravity_columns(chain, inertias, q)
    held = _held(chain, inertias, q, own) * loaded[:, None, None]
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
    T = chain.origins[-1]
    total = max(float(mass[-1] + x[0]), 0.0)
    if total > 0.0:  # the payload may be lighter than nothing, where the last body is heavier than stated
        com[-1] = (mass[-1] * com[-1] + x[0] * T[:3, 3] + T[:3, :3] @ x[1:4]) / total
    mass[-1] = total
    return replace(inertias, mass=mass, com=com)


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
    columns = []
    for k in range(chain.n):
        at_origin = _of_one(chain, inertias, q, k, np.zeros(3))
        shifts = [_of_one(chain, inertias, q, k, axis) - at_origin for axis in np.eye(3)]
        columns += [at_origin, *shifts]
    by_mass = np.stack(columns, axis=2)
    stated = np.column_stack([inertias.mass, inertias.mass[:, None] * inertias.com]).ravel()
    return by_mass @ stated, by_mass


def _of_one(chain: Chain, inertias: Inertias, q: Array, k: int, centre: Array) -> Array:
    mass, com = np.zeros(chain.n), np.zeros((chain.n, 3))
    mass[k], com[k] = 1.0, centre
    return gravity_efforts(chain, replace(inertias, mass=mass, com=com, branches=()), q)


def _held(chain: Chain, inertias: Inertias, q: Array, own: Array) -> Array:
    """Efforts by the payload's mass and mass times centre, (N, n, 4)."""

    def of(centre: Array) -> Array:
        loaded = with_payload(inertias, chain, Payload.checked(1.0, centre))
        return gravity_efforts(chain, replace(loaded, down=inertias.down, held=inertias.held), q) - own

    at_tip = of(np.zeros(3))
    return np.stack([at_tip, *(of(axis) - at_tip for axis in np.eye(3))], axis=2)


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
