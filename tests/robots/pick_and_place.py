"""A pick and place of the UR10, timed by its drives' torque or by constant bounds, and played in MuJoCo.

MuJoCo reads the URDF, payload and friction included, with its own parser and moves it by its own mechanics; the motion is
held by its planned torque and a stiff servo, and what the drives give at every step is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from robots.random_arms import Mujoco, inertial_link

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.acceleration import Drives, LoadedArm, Window, torque
from modcal_core.robots.bodies import Payload
from modcal_core.robots.chain import Chain
from modcal_core.robots.fastest_motion import JointPath, Timing, constant_bounds, motion, within_bounds, within_torque
from modcal_core.robots.mechanism import inverse
from modcal_core.robots.urdf import read_chain

URDF = Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf"
SHARE = 0.95  # of the torque is planned with; the servo has the rest
_STEP = 5e-4  # s
_STIFF = np.array([8000.0, 8000.0, 4000.0, 800.0, 500.0, 200.0])  # N m/rad
_BOX = (0.05, 0.05, 0.04, 0.0, 0.0, 0.0)  # kg m²: of what is carried


@dataclass(frozen=True)
class Played:
    """What the drives gave, (m, n) [N m], and how far the joints were from where they should be [rad]."""

    torque: Array
    miss: float


@dataclass(frozen=True)
class PickAndPlace:
    """The arm with its load and friction, and the way: down at one place, over an obstacle, down at the other."""

    payload_kg: float = 5.0
    dry: float = 0.02  # of the torque
    viscous: float = 0.01  # of the torque per rad/s

    @cached_property
    def text(self) -> str:
        """The URDF with friction."""
        text = URDF.read_text()
        for effort in {"330", "150", "54"}:
            t = float(effort)
            dynamics = f'<dynamics damping="{self.viscous * t!r}" friction="{self.dry * t!r}"/>'
            at = [p for p in text.split("<limit ") if f'effort="{effort}"' in p.split("/>")[0]]
            for piece in at:
                text = text.replace(f"<limit {piece}", f"{dynamics}<limit {piece}")
        return text

    @cached_property
    def chain(self) -> Chain:
        return read_chain(self.text)

    @cached_property
    def drives(self) -> Drives:
        return self.arm.drives

    @cached_property
    def arm(self) -> LoadedArm:
        return LoadedArm.read(self.text).carrying(Payload.checked(self.payload_kg, (0.0, 0.0, 0.1), _BOX)).using(SHARE)

    @cached_property
    def path(self) -> JointPath:
        """Postures above and at two places, the tool pointing down, the second a third of a turn away."""
        down = so3.exp([np.pi, 0.0, 0.0])
        places = [(0.7, -0.5, 0.1), (0.7, -0.5, 0.35), (0.75, 0.0, 0.5), (0.6, 0.6, 0.35), (0.6, 0.6, 0.1)]
        q, out = np.array([-0.6, -1.2, 1.8, -2.2, -1.57, 0.0]), []
        for place in places:
            q = inverse(self.chain, se3.transform(down, place), q)
            out.append(q)
        return JointPath.through(out)

    def by_torque(self) -> Timing:
        return within_torque(self.arm, self.path)

    def windows(self, q: Array, rng: np.random.Generator | None) -> Window:
        """What the drives leave at these postures, at speeds drawn between the limits, or at rest."""
        v = None if rng is None else rng.uniform(-1.0, 1.0, q.shape) * self.drives.speed
        return self.arm.window(q, v)

    def by_constants(self, windows: Window, weights: Array | None = None, places: int = 500) -> Timing:
        """By the largest constant bounds that these windows have in common."""
        return within_bounds(self.path, *constant_bounds(windows, weights), self.drives.speed, places)

    def workspace(self, count: int, rng: np.random.Generator) -> Array:
        """Postures anywhere within the limits, a turn at most."""
        return rng.uniform(np.maximum(self.chain.lower, -np.pi), np.minimum(self.chain.upper, np.pi), (count, 6))

    def play(self, timing: Timing) -> Played:
        """The motion in MuJoCo."""
        world = Mujoco(self.text.replace("</robot>", self._load() + "</robot>"), self.chain)
        model, data, at = world.model, world.data, world.at
        model.opt.timestep = _STEP
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        t = np.arange(0.0, timing.duration + 0.05, _STEP)
        q, v, a = motion(self.path, timing, t)
        v[-1:], a[t > timing.duration] = 0.0, 0.0
        friction = self.drives.coulomb * np.sign(v) + self.drives.viscous * v
        planned = torque(self.chain, self.arm.loaded, q, v, a) + friction
        data.qpos[at], data.qvel[at] = q[0], 0.0
        given, miss = np.empty_like(q), 0.0
        for k in range(len(t)):
            gap, slip = q[k] - data.qpos[at], v[k] - data.qvel[at]
            given[k] = planned[k] + _STIFF * gap + 0.02 * _STIFF * slip
            data.qfrc_applied[at] = given[k]
            mujoco.mj_step(model, data)
            miss = max(miss, float(np.abs(gap).max()))
        return Played(given, miss)

    def _load(self) -> str:
        body = inertial_link("load", self.payload_kg, np.array([0.0, 0.0, 0.1]), (0.0, 0.0, 0.0), list(_BOX))
        bolt = f'<joint name="grasp" type="fixed"><parent link="{self.chain.tip}"/><child link="load"/></joint>'
        return body + bolt
