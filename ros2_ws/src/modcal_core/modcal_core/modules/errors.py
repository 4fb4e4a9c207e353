"""Errors of physical modules, learned over the assemblies that contained them.

A constant M_k between two joints is a product of pieces: ways through modules, and pairs of flanges. Behind each stands
a small error exp(e), so to first order

    δ_k = Σ_pieces Ad(T_tail)⁻¹ e_piece,        T_tail: the product of the pieces behind it within M_k,

and each recording tells a part of δ (:mod:`~modcal_core.modules.recording_evidence`). A *module* error belongs to a
serial number and is the same wherever the module is bolted; an *interface* error is new in every assembly. Both are
taken as Gaussian about zero with the standard deviations that the library states. The interfaces, and modules without a
number, are eliminated assembly by assembly, ``Λ' = (Λ⁻¹ + C Σ Cᵀ)⁻¹``, and what is left is one linear least squares
over all assemblies at once:

    (Σ_prior⁻¹ + Σ_a B_aᵀ Λ'_a B_a) x = Σ_a B_aᵀ Λ'_a δ_a.

Seen in one assembly only, a module and its two flanges cannot be told apart: the error seen is shared out in
proportion to their prior variances. Every further assembly, in another place or turned otherwise, tells more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from modcal_core.calibration.distributions import beyond_chi2
from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.modules.assembly import Assembly
from modcal_core.modules.library import Library, ModuleTolerance
from modcal_core.modules.poe import TO_AXIS, Piece, pieces
from modcal_core.modules.recording_evidence import RecordingEvidence

Key = tuple[str, str]  # serial number, part of the module
_ROUNDS = 3  # the exact product is put in again; a second round changes nanometres


@dataclass(frozen=True)
class ModuleError:
    """What is known of one part of one physical module.

    twist: mean (6,) [m, rad], in the frame that the part ends in. covariance: (6, 6). kind, size: what the module is.
    seen: assemblies in which it stood between two joints.
    """

    twist: Array
    covariance: Array
    kind: str
    size: int
    seen: int

    @property
    def std(self) -> Array:
        """Standard deviations, (6,)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class ModuleErrors:
    """What is known of all modules seen so far, by (serial number, part), and what it was learned from.

    keys, mean, covariance: of all together, six numbers for each key, in that order: errors of modules that were seen
    side by side are not independent.
    """

    parts: Mapping[Key, ModuleError] = field(default_factory=dict)
    recordings: tuple[RecordingEvidence, ...] = ()
    keys: tuple[Key, ...] = ()
    mean: Array = field(default_factory=lambda: np.empty(0))
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def twists(self) -> dict[Key, Array]:
        """Means by key, as :func:`modcal_core.modules.poe.chain_of` takes them."""
        return {key: part.twist for key, part in self.parts.items()}


@dataclass(frozen=True)
class Surprise:
    """How far an assembly is from what its modules' errors made expect: a χ² value, its degrees of freedom, and p."""

    chi2: float
    freedom: int
    p_value: float


def learn(recordings: Sequence[RecordingEvidence], library: Library) -> ModuleErrors:
    """The errors of all numbered modules in these assemblies. Raises BadTable for a number that means two things."""
    kinds = _kinds(recordings)
    keys = tuple(
        dict.fromkeys(
            (w.assembly.modules[piece.module].serial, piece.part)
            for w in recordings
            for segment in pieces(w.assembly, library)[1:-1]
            for piece in segment
            if not piece.is_interface and w.assembly.modules[piece.module].serial
        )
    )
    if not keys:
        return ModuleErrors(recordings=tuple(recordings))
    prior = np.concatenate([part_std(library.module, part) for _, part in keys])
    normal = np.diag(prior**-2.0)
    maps = [_maps(w.assembly, library, keys) for w in recordings]
    weights = [_without(w.information, C, std) for w, (_, C, std) in zip(recordings, maps, strict=True)]
    for (B, _, _), W in zip(maps, weights, strict=True):
        normal += B.T @ W @ B
    factor = cho_factor(normal * np.outer(prior, prior), lower=True)
    x = np.zeros(len(prior))
    for _ in range(_ROUNDS):
        pull = -x / prior**2
        for w, (B, _, _), W in zip(recordings, maps, weights, strict=True):
            pull += B.T @ W @ (w.deviation - deviation_of(w.assembly, library, _by_key(keys, x))).ravel()
        x = x + prior * cho_solve(factor, prior * pull)
    covariance = np.outer(prior, prior) * cho_solve(factor, np.eye(len(prior)))
    covariance = 0.5 * (covariance + covariance.T)
    parts = {}
    for i, key in enumerate(keys):
        at = slice(6 * i, 6 * i + 6)
        kind, size = kinds[key[0]]
        seen = sum(key in _inner_keys(w.assembly, library) for w in recordings)
        parts[key] = ModuleError(x[at], covariance[at, at], kind, size, seen)
    return ModuleErrors(parts, tuple(recordings), keys, x, covariance)


def surprise(known: ModuleErrors, new: RecordingEvidence, library: Library) -> Surprise:
    """Whether a new assembly is as its modules, with what is known of them, should be.

    A module that was bent, or mistaken for another, makes p small.
    """
    own = tuple(sorted(_inner_keys(new.assembly, library) | set(known.keys)))
    B, C, std = _maps(new.assembly, library, own)
    spread = np.diag(np.concatenate([part_std(library.module, part) ** 2 for _, part in own]) if own else np.empty(0))
    rows = [6 * own.index(key) + d for key in known.keys for d in range(6)]
    spread[np.ix_(rows, rows)] = known.covariance
    gap = (new.deviation - deviation_of(new.assembly, library, known.twists)).ravel()
    root = np.linalg.cholesky(spread + 1e-24 * np.eye(len(spread))) if own else np.empty((0, 0))
    W = _without(new.information, np.c_[B @ root, C], np.r_[np.ones(root.shape[1]), std])
    seen = np.linalg.eigvalsh(new.information)
    freedom = int((seen > 1e-9 * seen[-1]).sum())
    value = float(gap @ W @ gap)
    return Surprise(value, freedom, beyond_chi2(value, freedom))


def deviation_of(assembly: Assembly, library: Library, errors: Mapping[Key, Array]) -> Array:
    """δ_1 … δ_{n-1}, (n - 1, 6) [m, rad], that these module errors make in an assembly, not only to first order."""
    out = []
    for segment in pieces(assembly, library)[1:-1]:
        true, drawn = np.eye(4), np.eye(4)
        for piece in segment:
            true, drawn = true @ piece.T, drawn @ piece.T
            key = (assembly.modules[piece.module].serial, piece.part)
            if not piece.is_interface and key in errors:
                true = true @ se3.exp(errors[key])
        out.append(se3.log(se3.inverse(drawn) @ true))
    return np.stack(out)


def part_std(tolerance: ModuleTolerance, part: str) -> Array:
    """Standard deviations (6,) [m, rad] of a part about its drawing; a joint's zero is a turn about its axis."""
    std = np.array([tolerance.length] * 3 + [tolerance.angle] * 3)
    if part == TO_AXIS:
        std[5] = np.hypot(tolerance.angle, tolerance.zero)
    return std


def _kinds(recordings: Sequence[RecordingEvidence]) -> dict[str, tuple[str, int]]:
    kinds: dict[str, tuple[str, int]] = {}
    for w in recordings:
        for m in w.assembly.modules:
            if m.serial and kinds.setdefault(m.serial, (m.kind, m.size)) != (m.kind, m.size):
                kind, size = kinds[m.serial]
                said = f"is {m.kind} of length {m.size} in {w.assembly.name} and {kind} of length {size} elsewhere"
                raise BadTable(f"serial number {m.serial}", said, "give each physical module its own number")
    return kinds


def _inner_keys(assembly: Assembly, library: Library) -> set[Key]:
    """The numbered parts that stand between two joints."""
    return {
        (assembly.modules[piece.module].serial, piece.part)
        for segment in pieces(assembly, library)[1:-1]
        for piece in segment
        if not piece.is_interface and assembly.modules[piece.module].serial
    }


def _maps(assembly: Assembly, library: Library, keys: Sequence[Key]) -> tuple[Array, Array, Array]:
    """(B, C, std): δ = B x + C u, of errors x of these keys, and of what is new here, u with its deviations std."""
    segments = pieces(assembly, library)[1:-1]
    index = {key: i for i, key in enumerate(keys)}
    B = np.zeros((6 * len(segments), 6 * len(keys)))
    new: list[Array] = []
    std: list[Array] = []
    for k, segment in enumerate(segments):
        rows = slice(6 * k, 6 * k + 6)
        for piece, Ad in zip(segment, _tails(segment), strict=True):
            key = (assembly.modules[piece.module].serial, piece.part)
            if not piece.is_interface and key in index:
                B[rows, 6 * index[key] : 6 * index[key] + 6] += Ad
                continue
            column = np.zeros((6 * len(segments), 6))
            column[rows] = Ad
            new.append(column)
            std.append(part_std(library.interface if piece.is_interface else library.module, piece.part))
    return B, np.concatenate(new, axis=1), np.concatenate(std)


def _tails(segment: Sequence[Piece]) -> list[Array]:
    """Ad(T_tail)⁻¹ of every piece, (6, 6) each."""
    tail, out = np.eye(4), []
    for piece in reversed(segment):
        out.append(se3.adjoint(se3.inverse(tail)))
        tail = piece.T @ tail
    return out[::-1]


def _without(information: Array, C: Array, std: Array) -> Array:
    """The information that is left when unknown C u is added: ``(Λ⁻¹ + C Σ Cᵀ)⁻¹``, for singular Λ too.

    By Woodbury on a root L of Λ, ``L (1 + Lᵀ C Σ Cᵀ L)⁻¹ Lᵀ``, in which nothing is subtracted.
    """
    value, vector = np.linalg.eigh(information)
    L = vector * np.sqrt(np.maximum(value, 0.0))
    new = L.T @ (C * std)
    left = L @ cho_solve(cho_factor(np.eye(len(L)) + new @ new.T, lower=True), L.T)
    return 0.5 * (left + left.T)


def _by_key(keys: Sequence[Key], x: Array) -> dict[Key, Array]:
    return dict(zip(keys, x.reshape(-1, 6), strict=True))
