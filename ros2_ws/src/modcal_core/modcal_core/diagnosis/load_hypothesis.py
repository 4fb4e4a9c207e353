"""What may pull on an arm otherwise than its description says: the way of weight, and what the tip carries.

Every load is linear in either, so that of all elastic joints together the best can be sought among a few numbers: with
b what stands before each part of a load, c_j ≥ 0 the joints' compliances and X the motion of the tool by each part at
each joint, the residual's squares that are explained are max_c 2 cᵀ(B v) − cᵀ(B A Bᵀ)c, A = XᵀX, v = Xᵀr. No joint
deflects against its load: that is what tells down from up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import Cell, StatedPayload, nonnegative
from modcal_core.diagnosis.space import Space
from modcal_core.effects import Carried, Drivers, Effect, NominalArm, place_index
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, so3
from modcal_core.measurements import Samples, SignalTrack
from modcal_core.robots import Inertias, is_serial_arm, weightless

USUAL_KG, USUAL_PLACE = 20.0, 0.15  # kg, m from the tip: what arms carry, and where, before the data say more
_WAYS = 150  # directions that are tried, some 15° apart; the best is then refined
_STARTS_KG = (0.0, 3.0)  # masses that are begun from
_PLAIN = 3.0  # gain in units of what is left: then three quarters of what was left are these loads and no others
_RIDGE = 1e-9  # of the largest square; loads of joints may be alike
TOPIC = "/payload_kg"


@dataclass(frozen=True)
class Suspicion:
    """x: numbers of a hypothesis (k,). gain, left: squares of the residual that they explain beyond the arm as it is
    known, and that are left, in units of what it is weighted with.
    """

    x: Array
    gain: float
    left: float

    @property
    def plain(self) -> bool:
        """Whether it explains so much that nothing else can be meant."""
        return self.gain > _PLAIN * self.left


@dataclass(frozen=True)
class LoadHypothesis:
    """Numbers (k,) that make of an arm one that is pulled otherwise.

    arm: as it is known. tilts: whether weight pulls another way, by two turns [rad] across the known one. until: stamps
    [s] between recordings. carries: whether the tip carries more than is known, in each recording something else: mass
    [kg] and mass times place in the tip [kg m], four numbers each; of an arm without masses only how much more than in
    the last, one for each other recording. told: the recorded number that says how many kg are carried, where their
    centre is asked, three numbers [m]; of an arm with masses, and without ``carries``.
    """

    arm: NominalArm
    tilts: bool = False
    until: tuple[float, ...] = ()
    carries: bool = False
    told: str = ""

    @property
    def places(self) -> bool:
        """Whether it is asked where the centre of a stated payload is."""
        return bool(self.told)

    @property
    def carried(self) -> int:
        """How many recordings have a payload of their own to be found."""
        return len(self.until) + int(self.arm.weighed)

    def beside(self, row: LoadHypothesis) -> LoadHypothesis:
        """Both together: the numbers of the other stand behind its own."""
        return replace(self, tilts=self.tilts or row.tilts, carries=row.carries, told=row.told)

    def concerns(self, effect: Effect) -> bool:
        """Whether an effect goes by what it says."""
        return effect.shape.kind in ("carried", "product") if self.places else by_weight(effect)

    @property
    def size(self) -> int:
        """Number of numbers."""
        return len(self.prior_std)

    @property
    def down(self) -> Array:
        """The way of weight as it is known, (3,)."""
        return np.array([0.0, 0.0, -1.0]) if self.arm.inertias is None else self.arm.inertias.down

    @cached_property
    def across(self) -> Array:
        """Two unit vectors across it, (2, 3)."""
        first = np.cross(self.down, np.eye(3)[int(np.argmin(np.abs(self.down)))])
        first = first / np.linalg.norm(first)
        return np.stack([first, np.cross(self.down, first)])

    @property
    def prior_std(self) -> Array:
        """How large each number may be before the data must say more, (k,)."""
        each = [USUAL_KG, *[USUAL_KG * USUAL_PLACE] * 3] if self.arm.weighed else [USUAL_KG]
        return np.array(
            [np.pi] * (2 * self.tilts) + each * (self.carried * self.carries) + [USUAL_PLACE] * (3 * self.places)
        )

    @property
    def steps(self) -> Array:
        """Steps of differences, (k,)."""
        return np.where(np.arange(self.size) < 2 * self.tilts, 1e-4, 1e-2)

    def pulled(self, x: Array) -> NominalArm:
        """The arm with these numbers (k,)."""
        inertias = self.arm.inertias or weightless(self.arm.chain.n)
        if self.tilts:
            inertias = inertias.pulled(so3.exp(x[:2] @ self.across) @ self.down)
        if self.places:
            return replace(self.arm, inertias=inertias, centre=x[2 * self.tilts :])
        if not self.carries:
            return replace(self.arm, inertias=inertias)
        if not self.arm.weighed:
            more = x[2 * self.tilts :]
            return replace(self.arm, inertias=inertias, earlier=Carried(self.until, more, np.zeros((len(more), 3))))
        each = x[2 * self.tilts :].reshape(-1, 4)
        before = each[:-1] - each[-1]
        kept = Carried(self.until, before[:, 0], before[:, 1:]) if self.until else self.arm.earlier
        return replace(self.arm, inertias=_with(inertias, self.arm, each[-1]), earlier=kept)

    def suspected(self, space: Space, drivers: Drivers, worth: float) -> Suspicion | None:
        """What explains most of a residual together with elastic joints; None where the gain over the arm as it is
        known is less than a share ``worth`` of what is left.
        """
        parts = self._parts(drivers)
        X = self._motions(space, parts)
        n, S = len(parts[0]), len(parts)
        A = (X @ X.T).reshape(S, n, S, n)
        v = (X @ space.residual.ravel()).reshape(S, n)
        products = A.transpose(0, 2, 1, 3).reshape(S * S, n * n)

        def missed(x: Array) -> Array:  # (..., k) to (...)
            before = self._before(x)
            both = before[..., :, None] * before[..., None, :]
            M = (both.reshape(*both.shape[:-2], S * S) @ products).reshape(*both.shape[:-2], n, n)
            return np.asarray(np.sum((x / self.prior_std) ** 2, axis=-1) - _explained(M, before @ v))

        total = float(np.sum(space.residual**2))
        most = _all_explained(A.reshape(S * n, S * n), v.ravel())  # each part at each joint for itself
        if most < worth * (total - most):  # whatever the arm as it is known explains of it
            return None
        known = float(missed(np.zeros(self.size)))
        if known + most < worth * (total - most):
            return None
        starts = np.stack(self._starts())
        nearest = starts[np.argsort(missed(starts), kind="stable")[:2]]
        least, x = min((_lowest(missed, start) for start in nearest), key=lambda found: found[0])
        gain, left = known - least, max(total + least, 0.0)
        return Suspicion(x, gain, left) if gain >= worth * left else None

    def _starts(self) -> list[Array]:
        if self.tilts:
            return [np.r_[turn, np.zeros(self.size - 2)] for turn in _ways()]
        if self.places:
            return [np.zeros(self.size)]
        out = []
        for kg in _STARTS_KG:
            x = np.zeros(self.size)
            x[:: 4 if self.arm.weighed else 1] = kg if self.arm.weighed else 0.3 * kg
            out.append(x)
        return out

    def _before(self, x: Array) -> Array:
        """What stands before each part of the load, (..., S), of numbers (..., k)."""
        if self.tilts:
            return np.asarray(so3.exp(x[..., :2] @ self.across) @ self.down)
        return np.concatenate([np.ones((*x.shape[:-1], 1)), x], axis=-1)

    def _parts(self, drivers: Drivers) -> list[Array]:
        """Parts of the joints' loads, (n, N) each, in the order of what stands before them."""
        along = np.where(self.arm.chain.revolute, 5, 2)
        rows = np.arange(self.arm.chain.n)
        weighed = self.arm.weighed

        def load(at: Drivers) -> Array:
            return (at.gravity if weighed else at.payload)[rows, along]

        if self.tilts:
            inertias = self.arm.inertias or weightless(self.arm.chain.n)
            arms = (replace(self.arm, inertias=inertias.pulled(way)) for way in np.eye(3))
            return [load(Drivers(drivers.samples, arm)) for arm in arms]
        at = Drivers(drivers.samples, self.arm)
        if self.places:
            mass = at.values(self.told)
            each = (at.payload, *at.offset)
            parts = [unit[rows, along] * mass for unit in each]
            return [load(at) + parts[0], *parts[1:]]
        bare = Drivers(drivers.samples, replace(self.arm, earlier=None))
        which = np.searchsorted(np.array(self.until), drivers.samples.stamps, side="right")
        units = [bare.payload, *(bare.offset if weighed else ())]
        return [load(at), *((unit[rows, along]) * (which == g) for g in range(self.carried) for unit in units)]

    def _motions(self, space: Space, parts: list[Array]) -> Array:
        """What each part does to the readings at each joint, (S n, 6 N), what is fitted projected out."""
        chain = self.arm.chain
        names, turns = chain.names, chain.revolute
        columns = [space.column(place_index(name, chain), 5 if turns[j] else 2) for j, name in enumerate(names)]
        X = np.stack([column * load for part in parts for column, load in zip(columns, part, strict=True)])
        flat, Q = X.reshape(len(X), -1), space.Q.reshape(-1, space.Q.shape[-1])
        return np.asarray(flat - (flat @ Q) @ Q.T)


def _with(inertias: Inertias, arm: NominalArm, carried: Array) -> Inertias:
    """The bodies with a mass [kg] and its mass times place in the tip (4,) [kg m] on the last of them."""
    mass, com = np.array(inertias.mass), np.array(inertias.com)
    assert is_serial_arm(arm.chain)
    tip = arm.chain.origins[-1]
    moment = mass[-1] * com[-1] + carried[0] * tip[:3, 3] + tip[:3, :3] @ carried[1:]
    mass[-1] += carried[0]
    com[-1] = moment / mass[-1] if mass[-1] else 0.0
    return replace(inertias, mass=mass, com=com)


def _lowest(missed: Callable[[Array], Array], start: Array) -> tuple[float, Array]:
    """The least that is found downhill from a start (k,), and where."""
    from scipy.optimize import minimize  # slow to import, and of most arms not asked for

    def missed_by_one(x: Array) -> float:
        return float(missed(x))

    found = minimize(missed_by_one, start, method="BFGS")
    return float(found.fun), np.asarray(found.x)


def _explained(M: Array, v: Array) -> Array:
    """The most of a square, (...), that columns with these products (..., n, n), and these with it (..., n), explain
    without a negative share.
    """
    n = v.shape[-1]
    unit = np.trace(M, axis1=-2, axis2=-1) / max(n, 1)
    some = unit > 0.0
    ridge = np.where(some, _RIDGE * unit, 1.0)[..., None, None] * np.eye(n)
    return np.asarray(np.where(some, np.sum(v * nonnegative(M + ridge, v), axis=-1), 0.0))


def _all_explained(A: Array, v: Array) -> float:
    """The most of a square that columns with these products explain."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    values, vectors = np.linalg.eigh(A * np.outer(scale, scale))
    keep = values > _RIDGE * max(float(values[-1]), 1e-300)
    along = vectors[:, keep].T @ (v * scale)
    return float(np.sum(along**2 / values[keep]))


def _ways() -> list[Array]:
    """Turns (2,) [rad] from one direction to others all over the sphere, evenly (Fibonacci's lattice)."""
    k = np.arange(_WAYS) + 0.5
    angle = np.arccos(1.0 - 2.0 * k / _WAYS)
    way = k * np.pi * (3.0 - np.sqrt(5.0))
    return list((angle * np.stack([np.cos(way), np.sin(way)])).T)


def stated_arm(arm: NominalArm, cell: Cell) -> NominalArm:
    """The arm with what it carries by the cell file; the same where nothing is stated or its masses are unknown."""
    if not cell.payloads or not arm.weighed:
        return arm
    hypothesis = LoadHypothesis(arm, until=cell.between, carries=True)
    return hypothesis.pulled(np.concatenate([p.mass * np.array([1.0, *p.place]) for p in _each(cell)]))


def with_stated(samples: Samples, cell: Cell, weighed: bool) -> Samples:
    """Samples with the stated payload as a recorded signal, for an arm without masses; otherwise unchanged.

    Raises BadTable where payloads are stated for another number of recordings.
    """
    if not cell.payloads:
        return samples
    each = _each(cell)
    if weighed or any(track.name.endswith(TOPIC) for track in samples.signals):
        return samples
    stamps = np.unique(samples.stamps)
    mass = np.array([p.mass for p in each])[np.searchsorted(np.array(cell.between), stamps, side="right")]
    return replace(samples, signals=(*samples.signals, SignalTrack(f"signal:{TOPIC}", stamps, mass[:, None], TOPIC)))


def _each(cell: Cell) -> tuple[StatedPayload, ...]:
    """One payload for each recording."""
    count, stated = len(cell.between) + 1, cell.payloads
    if len(stated) not in (1, count):
        said = f"{len(stated)} are stated, and recordings: {count}"
        raise BadTable("cell file: payloads", said, "state one for all recordings, or one for each in their order")
    return stated if len(stated) == count else stated * count


def by_weight(effect: Effect) -> bool:
    """Whether an effect goes by a load that is computed from weight."""
    kind = effect.driver.partition(":")[0]
    return kind in ("load", "payload", "moment", "weight", "tip_weight") or kind.startswith("offset_")
