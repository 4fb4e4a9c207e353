"""A joint type and its motion while it is fitted: what each must answer, and what all of them share.

A motion has minimal parameters, and a latent configuration for each sample. What was seen at configuration a is
*unwound* to configuration 0 and compared with the start there, so that play and bias of handle and tracker look alike
wherever on the path they occur.

Torr and Zisserman, MLESAC (2000): motions through randomly chosen samples are scored by a likelihood that is cut off
where an outlier begins, and the best are kept. Three positions give a circle, two a line, two poses a screw motion.
Samples are drawn by their order only, so a track that is moved or mirrored gets the moved or mirrored guesses.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.joints import JointModel, PathJoint
from modcal_core.articulation.track import Track
from modcal_core.geometry import HAT, Array, crossed, so3

EYE = np.eye(3)
_SINE_AND_TRACE = np.concatenate([0.5 * HAT, EYE.reshape(1, 9)]).T


class Motion(ABC):
    """moves: whether it has a configuration. turns: whether that is an angle. uniform: whether the direction along its
    path is the same for all samples, once unwound. flat: whether its path is a line or a circle. R: rotation (3, 3) of
    the start or of the grasp, None where only positions were seen.
    """

    R: Array | None
    moves: ClassVar[bool] = True
    turns: ClassVar[bool] = False
    uniform: ClassVar[bool] = False
    flat: ClassVar[bool] = False

    @property
    @abstractmethod
    def kind(self) -> str:
        """Name of the joint type."""

    @property
    @abstractmethod
    def size(self) -> int:
        """How many parameters it has."""

    @property
    @abstractmethod
    def start_turn(self) -> int:
        """Which parameter is the first of the three by which the start is turned; with rotations only."""

    @abstractmethod
    def moved(self, z: Array) -> Motion:
        """Motion with its parameters changed by z (size,), limited to plausible values."""

    @abstractmethod
    def configurations(self, track: Track, sigma: tuple[float, float] = (1.0, 1.0)) -> Array:
        """Latent configurations (n,) that are most likely where noise is sigma, (m, rad)."""

    @abstractmethod
    def expanded(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array]:
        """Residuals and, beside them, their derivatives by the parameters (n, m, 1 + size); derivatives by a (n, m)."""

    @abstractmethod
    def prior_terms(self) -> tuple[float, Array, Array]:
        """Half the squared distance from the prior, its gradient (size,) and its curvature (size,), diagonal."""

    @abstractmethod
    def log_prior(self) -> float:
        """What the prior's density has beside its exponent, in the coordinates of the motion."""

    @abstractmethod
    def joint(self, a: float = 0.0) -> JointModel | PathJoint:
        """The joint, with its configuration 0 where this motion has a."""

    @abstractmethod
    def covariance(self, parameters: Array) -> dict[str, Array]:
        """Covariances of the joint's named quantities, from the covariance of the parameters (size, size)."""

    def zero(self, a: Array) -> float:
        """Which configuration is called 0, of those of all samples (n,)."""
        return 0.0

    def counted(self, a: Array, sound: np.ndarray) -> Array:
        """Configurations (n,) counted on beyond a full turn of what turns on. sound (n,): no outliers."""
        return a

    def sound(self) -> bool:
        """Whether all parameters are finite."""
        return True

    def rarity(self) -> float:
        """What to add to a guess's cost, so that ties go to what is built more often."""
        return 0.0

    def residuals(self, track: Track, a: Array) -> Array:
        """Residuals (n, 3) [m], or (n, 6) [m, rad] with rotations, unwound, at configurations a (n,)."""
        return self.linearise(track, a, derivatives=False)[0]

    def linearise(self, track: Track, a: Array, derivatives: bool = True) -> tuple[Array, Array, Array]:
        """Residuals (n, m), their derivatives by a (n, m) and by the parameters (n, m, size); m is 3 or 6."""
        both, by_a = self.expanded(track, a, derivatives)
        return both[:, :, 0], by_a, both[:, :, 1:]


def quick_log(R: Array) -> tuple[Array, Array, Array]:
    """Rotation vectors (n, 3) of rotations (n, 3, 3), by the sine, which is quick; sines and cosines (n,)."""
    found = R.reshape(-1, 9) @ _SINE_AND_TRACE
    v, cosine = found[:, :3], 0.5 * (found[:, 3] - 1.0)
    sine = np.sqrt((v * v).sum(axis=1))
    if cosine.min() < -0.8:
        return so3.log(R), sine, cosine
    return v * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-300))[:, None], sine, cosine


def log_and_jacobian(R: Array) -> tuple[Array, Array]:
    """Rotation vectors φ (n, 3) of rotations (n, 3, 3), and so3.left_jacobian_inverse(−φ) (n, 3, 3).

    I + ½ [φ] + k [φ]² with k = (1 − ½ θ cot ½θ) / θ², and cot ½θ = (1 + cos θ) / sin θ is at hand.
    """
    phi, sine, cosine = quick_log(R)
    square = (phi * phi).sum(axis=1)
    if sine.min() < 1e-3:  # the quotient would lose digits
        return phi, so3.left_jacobian_inverse(-phi)
    k = (1.0 - 0.5 * np.sqrt(square) * (1.0 + cosine) / sine) / square
    W = (phi @ HAT).reshape(-1, 3, 3)
    return phi, 0.5 * W + k[:, None, None] * (W @ W) + EYE


def scaled(size: float, by: float, limits: tuple[float, float]) -> float:
    """A size times exp(by), by a factor of e at most, and within limits."""
    return min(max(size * math.exp(min(max(float(by), -1.0), 1.0)), limits[0]), limits[1])


_TRIES = 40  # random triples of samples
KEEP = 2  # guesses that are fitted
_SCORED = 50  # samples that a guess is scored on
ROUGH = (5e-3, 0.07)  # m and rad: noise when nothing is known of it yet
_CUT = 9.0  # squared, normalised residual at which an outlier begins
_PAIRS = 10  # of rotations
M = TypeVar("M", bound=Motion)


def few(track: Track) -> Track:
    """Some of its samples, evenly chosen, that guesses are scored on."""
    return track.part(np.unique(np.linspace(0, len(track) - 1, _SCORED).round().astype(int)))


def best_of(guesses: Iterable[M], track: Track, keep: int) -> list[M]:
    """The best of these guesses, best first, by a likelihood that is cut off."""
    sound = [g for g in guesses if g.sound()]
    scored = sorted((_score(g, track), i) for i, g in enumerate(sound))
    return [sound[i] for _, i in scored[:keep]]


def _score(guess: Motion, track: Track) -> float:
    e = guess.residuals(track, guess.configurations(track, ROUGH))
    z = (e[:, :3] ** 2).sum(axis=1) / ROUGH[0] ** 2
    if e.shape[1] == 6:
        z = np.minimum(z, _CUT) + np.minimum((e[:, 3:] ** 2).sum(axis=1) / ROUGH[1] ** 2, _CUT)
    cost = float(np.minimum(z, 2.0 * _CUT if e.shape[1] == 6 else _CUT).sum())
    # The rise of a thread and the width of a circle are bounded by what exists; ties go to the nearer axis.
    return cost + guess.rarity()


def some_three(track: Track, rng: np.random.Generator) -> Iterator[tuple[int, NDArray[np.integer[Any]]]]:
    """The number of each try, and three rows that are drawn for it, in their order."""
    for t in range(_TRIES):
        yield t, np.sort(rng.choice(len(track), 3, replace=False))


def far_apart(track: Track) -> tuple[int, int, int]:
    """Rows of the two samples that are farthest apart, with one between them in the middle."""
    p = track.positions
    middle = p - p.mean(axis=0)
    first = int(np.argmax((middle * middle).sum(axis=1)))
    away = ((p - p[first]) ** 2).sum(axis=1)
    last = int(np.argmax(away))
    return first, int(np.argmin(np.abs(away - 0.25 * away[last]))), last


def frame(e: Array) -> Array:
    """A frame (3, 3) whose first axis is along e."""
    e = e / math.sqrt(e @ e)
    n = np.eye(3)[int(np.argmin(np.abs(e)))]
    n = n - e * (e @ n)
    n = n / math.sqrt(n @ n)
    return np.array([e, n, crossed(e, n)]).T


def middle_rotation(rotations: Array) -> Array:
    """The rotation with the smallest median distance to the others: a median that outliers do not move."""
    some = rotations[np.unique(np.linspace(0, len(rotations) - 1, _PAIRS * 3).round().astype(int))]
    apart = np.linalg.norm(some[:, None] - some[None], axis=(2, 3))
    return some[int(np.argmin(np.median(apart, axis=1)))]


Kind: TypeAlias = str  # name of a joint type


@dataclass(frozen=True)
class InUrdf:
    """How URDF writes a joint. type: of its element. reach: configurations either way that are stated where none are
    known [rad or m]. rises: whether a second joint mimics the first along the same axis.
    """

    type: str
    reach: float = 0.0
    rises: bool = False


class ArticulationModel(ABC):
    """A joint type. name: in reports. share: how often it is met among all that moves.

    moves: whether a handle on it moves at all. usual: whether nothing can be said before it was weighed. slots: which
    of four rounds of an incremental selection begin with a new guess of it; none: it is weighed on whole tracks only.
    urdf: how URDF writes it, None where it cannot.
    """

    name: str
    share: float
    moves: ClassVar[bool] = True
    usual: ClassVar[bool] = False
    slots: ClassVar[Sequence[int]] = ()
    urdf: ClassVar[InUrdf | None] = None

    @abstractmethod
    def guesses(self, track: Track, rng: np.random.Generator) -> Sequence[Motion]:
        """The best few first guesses, best first, robust to gross outliers. rng: picks samples."""

    def quick_guess(self, track: Track, known: Mapping[Kind, Motion], turn: int) -> Motion | None:
        """One quick guess, None where there is none. known: results of other types. turn: number of the attempt."""
        return None
