"""The whole study of a closed chain: indices, variances, gains, and what measuring these stations would leave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.planning.closed_chain import ClosedChain
from modcal_core.planning.designs import sobol_postures
from modcal_core.planning.gain import JointGain, joint_use
from modcal_core.planning.sensitivity import Sensitivity, sensitivity
from modcal_core.planning.variance import ARMS, OUTPUTS, SobolIndices, sobol_indices

_GAIN_POSTURES = 512  # where accuracy counts; derivatives are cheap
_VARIANCE_POSTURES = 32  # each is computed for thousands of arms


@dataclass(frozen=True)
class Measured:
    """Stations that are measured. q: (N, n). kind: point or pose. std_m, std_rad: of a reading per axis."""

    q: Array
    kind: str = "point"
    std_m: float = 5e-5
    std_rad: float = 5e-5


@dataclass(frozen=True)
class Study:
    """closed: what was studied. design: name of the postures q (N, n). indices: over these. variance: by output, over
    postures spread over the joints' ranges, as joint. measured: what joint supposes to be measured.
    """

    closed: ClosedChain
    design: str
    q: Array
    indices: Sensitivity
    variance: dict[str, SobolIndices]
    measured: Measured
    joint: JointGain


def study(
    closed: ClosedChain,
    q: Array,
    design: str,
    sizes: Array,
    base: str,
    measured: Measured,
    rng: np.random.Generator,
    bins: int | None = None,
    arms: int = ARMS,
) -> Study:
    """Everything there is to say of the sensitivity of a closed chain, with errors of these sizes (P,) [m, rad].

    arms: that are drawn for the shares of the variance, a power of two.
    """
    indices = sensitivity(closed, q, sizes, base, bins)
    workspace = sobol_postures(closed.chain, _GAIN_POSTURES, rng)
    G = closed.jacobian(workspace)[:, :3]
    rows = 6 if measured.kind == "pose" else 3
    J = closed.jacobian(measured.q)[:, :rows].reshape(-1, len(sizes))
    std = np.tile(np.repeat([measured.std_m, measured.std_rad], 3)[:rows], len(measured.q))
    few = workspace[:_VARIANCE_POSTURES]
    variance = {output: sobol_indices(closed, few, sizes, rng, output, arms) for output in OUTPUTS}
    return Study(closed, design, q, indices, variance, measured, joint_use(G, sizes, J, std))
