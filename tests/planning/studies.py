"""Arms of MuJoCo, measured from chosen stations and calibrated: what tests and bench compare plans by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from cells import samples_of

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.fit import identify
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.planning.site import Site
from modcal_core.robots.chain import Chain
from modcal_nodes.simulation.mjcf import World


@dataclass(frozen=True)
class Arm:
    """An arm whose every body is displaced, the tracker where the site has it, the target a little off its drawing."""

    chain: Chain
    site: Site
    world: World
    rng: np.random.Generator

    @classmethod
    def made(cls, chain: Chain, site: Site, seed: int) -> Arm:
        rng = np.random.default_rng([seed, 77])
        R = so3.exp(rng.normal(size=3))
        eye = np.zeros(3) if site.tracker is None else site.tracker.position
        T_tip_tool = se3.transform(so3.exp(rng.normal(size=3)), site.target.position + 1e-3 * rng.normal(size=3))
        return cls(chain, site, World(chain, rng, 5e-4, 1e-3, se3.transform(R, -R @ eye), T_tip_tool), rng)

    def error_after(self, q: Array, reading: str, where: Array) -> float:
        """RMS position error [m] at postures (N, n) of the arm calibrated from stations q (k, n), read once each."""
        noise, rng = self.site.noise, self.rng
        repeat = np.where(self.chain.revolute, noise.joint_turn, noise.joint_slide)
        T = self.world.tool_in_tracker(q + repeat * rng.standard_normal(q.shape))
        size = noise.position + noise.per_metre * np.linalg.norm(T[:, :3, 3], axis=1)
        T[:, :3, 3] += size[:, None] * rng.standard_normal((len(q), 3))
        T[:, :3, :3] = T[:, :3, :3] @ so3.exp(noise.rotation * rng.standard_normal((len(q), 3)))
        samples = samples_of(self.chain, q, T, reading)
        start = fit_cell(self.chain, samples, Cell()).model
        fit = identify(start, samples, choose_parameters(start, views_of(samples)).parameters)
        gap = fit.model.predict(where)[:, :3, 3] - self.world.tool_in_tracker(where)[:, :3, 3]
        return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))
