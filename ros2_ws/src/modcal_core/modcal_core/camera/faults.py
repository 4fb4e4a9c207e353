"""How faulty an arm's parameters are expected to be, when every body of it may be displaced a little in all directions.

A fit has a minimal set of parameters. What it leaves out moves the tool as some of those that it has: the length of an
upper arm is off by what the shoulder's side of it is off and by what the elbow's is. So the covariance of the set is
that of all faults, brought to it by the derivatives of a general arm's readings; taken from its own parameters alone it
would have such lengths known to seven tenths of what they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter, View, drop_fixed, ordered_candidates
from modcal_core.calibration.structure import general_samples
from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class ArmFaults:
    """Covariance of an arm's A parameters by faults of lengths, and by faults of angles, of size 1, (A, A) each."""

    lengths: Array
    angles: Array

    def covariance(self, ratio: float = 1.0) -> Array:
        """Prior covariance of the arm's faults, (A, A). ratio: scale of the length faults over that of the angle
        faults.
        """
        return ratio**2 * self.lengths + self.angles

    def information(self, size: float, ratio: float) -> Array:
        """Its inverse, for faults of this size."""
        C = size**2 * self.covariance(ratio)
        scale = 1.0 / np.sqrt(np.diag(C))
        return np.asarray(np.linalg.inv(C * np.outer(scale, scale)) * np.outer(scale, scale))


def arm_faults(
    model: Model, parameters: Sequence[ModelParameter], views: Sequence[View], fixed: Sequence[str] = ()
) -> ArmFaults:
    """The faults of these parameters of an arm. views, fixed: as they were chosen for."""
    every = [p for p in drop_fixed(ordered_candidates(model.chain, model.frames, views), fixed) if p.of_arm]
    samples = general_samples(model, views, each=max(12, len(every)))
    J = linearise(model, every, np.zeros(len(every)), samples).J.T
    at = {p.name: i for i, p in enumerate(every)}
    kept = J[:, [at[p.name] for p in parameters]]
    M = np.linalg.lstsq(kept, J, rcond=None)[0] * np.array([p.prior_std for p in every])
    turns = np.array([p.turns for p in every])
    return ArmFaults(M[:, ~turns] @ M[:, ~turns].T, M[:, turns] @ M[:, turns].T)
