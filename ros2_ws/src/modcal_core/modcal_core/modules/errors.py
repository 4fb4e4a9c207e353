"""Errors of physical modules, learned over the assemblies that contained them.

A constant M_k between two joints is a product of pieces: ways through modules, and pairs of flanges. Behind each stands
a small error exp(e), so to first order

    δ_k = Σ_pieces Ad(T_tail)⁻¹ e_piece,        T_tail: the product of the pieces behind it within M_k.

A *module* error belongs to a serial number wherever the module is bolted; an *interface* error is new in every
assembly. Both are Gaussian with the deviations that the library states. Interfaces, and modules without a number, are
eliminated assembly by assembly, ``Λ' = (Λ⁻¹ + C Σ Cᵀ)⁻¹``, and one linear least squares over all assemblies is left:

    (Σ_prior⁻¹ + Σ_a B_aᵀ Λ'_a B_a) x = Σ_a B_aᵀ Λ'_a δ_a.

Seen in one assembly only, a module and its flanges share the error in proportion to their prior variances; every
further assembly tells more. Of each recording, fitted like any other, are kept the six deviations of every inner
constant M_1 … M_{n-1} and their information JᵀWJ, base frames and tool eliminated: what the fit chose where the
recording cannot tell carries no weight. M_0 and M_n are one with base and target, which differ after every set-up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from modcal_core.calibration import (
    Cell,
    Fit,
    ModelParameter,
    beyond_chi2,
    choose_parameters,
    fit_cell,
    identify,
    normal_equations,
    row_weights,
    views_of,
)
from modcal_core.errors import BadRecording, BadTable, NotEnoughData, refusing
from modcal_core.geometry import DIRECTIONS, Array, se3
from modcal_core.hypotheses import require_plausible
from modcal_core.measurements import Samples
from modcal_core.modules.coding import assembly_from_data, assembly_to_data
from modcal_core.modules.library import TO_AXIS, Assembly, Library, ModuleTolerance, Piece, chain_of, origins, pieces
from modcal_core.robots import Chain
from modcal_core.schema import NUMBER, SIZE, TEXT, holding, list_of, mapping_of, require, whole

# --- What one recording of an assembly says of the modules in it

_FARTHEST, _MAX_TURNED = 0.015, 0.1  # m, rad; a module that is farther off than this is not the one that is named


@dataclass(frozen=True)
class RecordingEvidence:
    """One assembly and what its recording says.

    deviation: twists (n - 1, 6) [m, rad] with ``M_k exp(deviation)`` the true constant, k = 1 … n - 1, each in the
    frame that M_k ends in. information: of the same, in their order, (6 n - 6, 6 n - 6). stations: how many were seen.
    residual: RMS distance that the fit leaves [m].
    """

    assembly: Assembly
    deviation: Array
    information: Array
    stations: int
    residual: float


def recording_evidence(assembly: Assembly, library: Library, samples: Samples) -> RecordingEvidence:
    """What these samples, whose joints are those of the assembly's chain, say of it; its geometry is fitted first.

    Raises NotEnoughData where there are too few, or where the arm has one joint only and so nothing between joints;
    BadRecording where it is not of this assembly.
    """
    chain = chain_of(assembly, library)
    if chain.n < 2:
        said = "it has one joint, and the parts before and behind it cannot be distinguished from base and tool"
        raise NotEnoughData(f"assembly {assembly.name}", said, "learn from assemblies of two joints or more")
    start = fit_cell(chain, samples, Cell())
    choice = choose_parameters(start.model, views_of(samples))
    fit = identify(start.model, samples, choice.parameters)
    require_plausible(start, fit, samples)
    gap = samples.reading - fit.model.predict_samples(samples)[:, :3, 3]
    inner = slice(1, chain.n)
    deviation = se3.log(se3.inverse(chain.origins[inner]) @ fit.model.serial.origins[inner])
    _require_as_described(assembly, deviation)
    residual = float(np.sqrt(np.average(np.sum(gap**2, axis=1), weights=fit.weights)))
    return RecordingEvidence(assembly, deviation, _information(fit, samples, chain), samples.stations, residual)


def _require_as_described(assembly: Assembly, deviation: Array) -> None:
    """Raises BadRecording where some constant is farther from the drawing than any module is badly made."""
    shift, turn = (np.linalg.norm(deviation[:, at], axis=1) for at in (slice(0, 3), slice(3, 6)))
    k = int(np.argmax(np.maximum(shift / _FARTHEST, turn / _MAX_TURNED)))
    if shift[k] <= _FARTHEST and turn[k] <= _MAX_TURNED:
        return
    raise BadRecording(
        f"assembly {assembly.name}",
        f"between {assembly.joint_names[k]} and {assembly.joint_names[k + 1]} the recording differs from it by "
        f"{1e3 * shift[k]:.0f} mm and {np.degrees(turn[k]):.0f} degrees",
        "correct the modules, lengths and turns there, or give this assembly's recording",
    )


def _information(fit: Fit, samples: Samples, chain: Chain) -> Array:
    """JᵀWJ of all six directions of M_1 … M_{n-1}, after base frames and tool have taken what they can."""
    inner = [
        ModelParameter(f"{chain.names[k]}/{name}", k, d) for k in range(1, chain.n) for d, name in enumerate(DIRECTIONS)
    ]
    outer = [
        ModelParameter(f"frame {frame}/{name}", 0, d, f)
        for f, frame in enumerate(fit.model.frames)
        for d, name in enumerate(DIRECTIONS)
    ]
    outer += [ModelParameter(f"tool/{name}", chain.n, d) for d, name in enumerate(DIRECTIONS)]
    everything = [*inner, *outer]
    model = fit.model.with_effects(())
    weight = row_weights(fit.weights, fit.noise, samples)
    H, _ = normal_equations(model, everything, np.zeros(len(everything)), samples, weight)
    P = len(inner)
    free = H[P:, P:] + np.eye(len(outer))  # base and tool are known to no better than 1 m and 1 rad
    H = H[:P, :P] - H[:P, P:] @ np.linalg.solve(free, H[P:, :P])
    value, vector = np.linalg.eigh(0.5 * (H + H.T))
    return (vector * np.maximum(value, 0.0)) @ vector.T  # rounding must not say that a direction is less than unknown


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

    covariance: of all together, six numbers for each key, in their order: errors of modules that were seen side by side
    are not independent.
    """

    parts: Mapping[Key, ModuleError] = field(default_factory=dict)
    recordings: tuple[RecordingEvidence, ...] = ()
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def keys(self) -> tuple[Key, ...]:
        """The parts that were seen."""
        return tuple(self.parts)

    @property
    def twists(self) -> dict[Key, Array]:
        """Means by key, as :func:`modcal_core.modules.library.chain_of` takes them."""
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
    keys = tuple(dict.fromkeys(key for w in recordings for key in _inner_keys(w.assembly, library)))
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
        errors = dict(zip(keys, x.reshape(-1, 6), strict=True))
        for w, (B, _, _), W in zip(recordings, maps, weights, strict=True):
            pull += B.T @ W @ (w.deviation - deviation_of(w.assembly, library, errors)).ravel()
        x = x + prior * cho_solve(factor, prior * pull)
    covariance = np.outer(prior, prior) * cho_solve(factor, np.eye(len(prior)))
    covariance = 0.5 * (covariance + covariance.T)
    parts = {}
    for i, key in enumerate(keys):
        at = slice(6 * i, 6 * i + 6)
        kind, size = kinds[key[0]]
        seen = sum(key in _inner_keys(w.assembly, library) for w in recordings)
        parts[key] = ModuleError(x[at], covariance[at, at], kind, size, seen)
    return ModuleErrors(parts, tuple(recordings), covariance)


def surprise(known: ModuleErrors, new: RecordingEvidence, library: Library) -> Surprise:
    """Whether a new assembly is as its modules should be: one that was bent, or mistaken for another, makes p small."""
    own = tuple(sorted({*_inner_keys(new.assembly, library), *known.keys}))
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
    drawn, true = (origins(assembly, library, known)[1:-1] for known in (None, errors))
    return np.asarray(se3.log(se3.inverse(drawn) @ true))


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


def _inner_keys(assembly: Assembly, library: Library) -> list[Key]:
    """The numbered parts that stand between two joints, from the base on."""
    return [
        (assembly.modules[piece.module].serial, piece.part)
        for segment in pieces(assembly, library)[1:-1]
        for piece in segment
        if not piece.is_interface and assembly.modules[piece.module].serial
    ]


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
    """The information that is left when unknown C u is added: ``(Λ⁻¹ + C Σ Cᵀ)⁻¹``, for singular Λ too: by Woodbury on
    a root L of Λ, ``L (1 + Lᵀ C Σ Cᵀ L)⁻¹ Lᵀ``, in which nothing is subtracted.
    """
    value, vector = np.linalg.eigh(information)
    L = vector * np.sqrt(np.maximum(value, 0.0))
    new = L.T @ (C * std)
    left = L @ cho_solve(cho_factor(np.eye(len(L)) + new @ new.T, lower=True), L.T)
    return 0.5 * (left + left.T)


# --- What is known of modules as plain data: for people and for the next assembly, and enough to learn on from

_FORMAT = 1  # of the file
_FIX = "give a file that modcal modules learn wrote"
_KIND = holding(("parts",), parts=mapping_of(holding(("mean",), mean=list_of(NUMBER, 6, 6))))
_OWN = ("stations", "residual_m", "deviation", "information")  # beside what an assembly's file holds
_RECORDING = holding(
    _OWN,
    stations=whole(0, 10**9),
    residual_m=SIZE,
    deviation=list_of(list_of(NUMBER, 6, 6)),
    information=list_of(NUMBER),
)
_SCHEMA = holding(
    ("modcal_module_store", "library", "modules", "assemblies"),
    modcal_module_store={"enum": [_FORMAT]},
    library=TEXT,
    modules=mapping_of(_KIND),
    assemblies=list_of(_RECORDING),
)


def store_to_data(known: ModuleErrors, library: Library) -> dict[str, Any]:
    """The store as nested dictionaries, lists, strings and floats; floats keep every digit."""
    modules: dict[str, dict[str, Any]] = {}
    for (serial, part), error in known.parts.items():
        entry = modules.setdefault(serial, {"kind": error.kind, "length": error.size, "parts": {}})
        entry["parts"][part] = {
            "assemblies": error.seen,
            "mean": error.twist.tolist(),
            "std": error.std.tolist(),
            "covariance": error.covariance.tolist(),
        }
    return {
        "modcal_module_store": _FORMAT,
        "library": library.name,
        "modules": modules,
        "assemblies": [_recording_to_data(w, library) for w in known.recordings],
    }


@refusing
def store_from_data(data: Any, library: Library, source: str) -> ModuleErrors:
    """The store, with everything learned again from its assemblies. Raises BadTable for what is no store."""
    require(data, _SCHEMA, source, _FIX)
    if data["library"] != library.name:
        said = f"its modules are of the library '{data['library']}', not of '{library.name}'"
        raise BadTable(source, said, "give --library")
    recordings = enumerate(data["assemblies"], 1)
    return learn([_recording_from_data(w, library, f"{source}: assembly {i}") for i, w in recordings], library)


@refusing
def twists_from_data(data: Any, source: str) -> dict[Key, Array]:
    """Means by (serial number, part) as the store states them. Raises BadTable for what is no store."""
    require(data, _SCHEMA, source, _FIX)
    return {
        (serial, part): np.array(error["mean"], dtype=float)
        for serial, entry in data["modules"].items()
        for part, error in entry["parts"].items()
    }


def with_recording(known: ModuleErrors, new: RecordingEvidence, library: Library) -> ModuleErrors:
    """What is known after one more assembly; one of the same name is replaced, for it is the same flanges seen again.
    Raises BadTable where it is of other modules.
    """
    for old in known.recordings:
        if old.assembly.name == new.assembly.name and old.assembly != new.assembly:
            said, remedy = "is a different assembly in this store", "give each its own name, also when rebuilt"
            raise BadTable(f"assembly {new.assembly.name}", said, remedy)
    kept = [w for w in known.recordings if w.assembly.name != new.assembly.name]
    return learn([*kept, new], library)


def _recording_to_data(w: RecordingEvidence, library: Library) -> dict[str, Any]:
    lower = np.tril_indices(len(w.information))
    spec = assembly_to_data(w.assembly, library)
    spec.pop("aim")
    return {
        **spec,
        "stations": w.stations,
        "residual_m": w.residual,
        "deviation": w.deviation.tolist(),
        "information": w.information[lower].tolist(),
    }


def _recording_from_data(data: Mapping[str, Any], library: Library, source: str) -> RecordingEvidence:
    assembly: Assembly = assembly_from_data({k: v for k, v in data.items() if k not in _OWN}, library, source)
    size = 6 * (assembly.n - 1)
    lower, deviation = np.tril_indices(size), np.array(data["deviation"], dtype=float)
    if len(deviation) != assembly.n - 1 or len(data["information"]) != len(lower[0]):
        raise BadTable(source, f"is not of {assembly.n} joints", _FIX)
    information = np.zeros((size, size))
    information[lower] = data["information"]
    information += np.tril(information, -1).T
    return RecordingEvidence(assembly, deviation, information, data["stations"], data["residual_m"])
