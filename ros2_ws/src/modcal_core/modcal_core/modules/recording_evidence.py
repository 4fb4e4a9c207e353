"""What one recording of an assembly says of the modules in it: how far every inner constant is off, and how surely.

The arm is fitted with its minimal parameters, like any other. The fit chooses where to put what passes through joints;
so what is kept are the six deviations of every inner constant M_1 … M_{n-1} together with their information JᵀWJ over
all six directions, base frames and tool eliminated. It is singular along what the recording cannot tell, and so what
was chosen there carries no weight. M_0 and M_n do not appear: they are one with where the base stands and where the
instrument's target sits, which differs after every set-up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.identify import Fit, identify
from modcal_core.calibration.normal_equations import normal_equations
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.geometry.twists import DIRECTIONS
from modcal_core.measurements.samples import Samples
from modcal_core.modules.assembly import Assembly
from modcal_core.modules.library import Library
from modcal_core.modules.poe import chain_of
from modcal_core.plausibility.require import require_plausible
from modcal_core.robots.chain import Chain

_FARTHEST, _MAX_TURNED = 0.015, 0.1  # m, rad; a module that is farther off than this is not the one that is named
_ANYWHERE = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # m, rad: base and tool are free


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
        raise NotEnoughData(
            f"assembly {assembly.name}",
            "it has one joint, and the parts before and behind it cannot be distinguished from base and tool",
            "learn from assemblies of two joints or more",
        )
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
    H, _ = normal_equations(model, everything, np.zeros(len(everything)), samples, _row_weights(fit, samples))
    P = len(inner)
    free = H[P:, P:] + np.diag(np.tile(_ANYWHERE, len(outer) // 6) ** -2.0)
    H = H[:P, :P] - H[:P, P:] @ np.linalg.solve(free, H[P:, :P])
    value, vector = np.linalg.eigh(0.5 * (H + H.T))
    return (vector * np.maximum(value, 0.0)) @ vector.T  # rounding must not say that a direction is less than unknown


def _row_weights(fit: Fit, samples: Samples) -> Array:
    """Weight of each row of a linearisation, (3 N + 3 M,), as the fit had them."""
    pose = samples.is_pose
    known_p, known_r = np.nan_to_num(samples.sigma_position), np.nan_to_num(samples.sigma_rotation[pose])
    position = fit.weights / (fit.noise.position**2 + known_p**2)
    rotation = fit.weights[pose] / (fit.noise.rotation**2 + known_r**2)
    return np.concatenate([np.tile(position, 3), np.tile(rotation, 3)])
