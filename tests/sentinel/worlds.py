"""An arm at its work in MuJoCo: position servos, dry friction that is warmer or colder, a camera that sees a tag.

The world is rigid-body dynamics with friction as a constraint; nothing of what watches it is used to make it, and its
masses and lengths are not those of the description.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np

from modcal_core.geometry import Array, se3
from modcal_core.measurements import JointTrack, ReadingTrack, Recording
from modcal_core.robots import Chain, read_chain, read_inertias
from modcal_nodes.simulation.mjcf import mjcf, text

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
STEP, PER = 2e-3, 2  # s; steps to a message, 250 Hz
TAG_EVERY = 50  # steps, 10 Hz
T_TIP_CAMERA = se3.from_pose([0.03, -0.05, 0.06, 0.1, 0.0, 0.0, 0.995])
T_BASE_TAG = se3.from_pose([0.6, 0.1, 0.02, 1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Change:
    """kind: zero, ratio, play, friction, payload, latency, camera; size: rad, 1, rad, share, kg, s, m."""

    kind: str = ""
    joint: int = -1
    size: float = 0.0


NONE = Change()


@dataclass(frozen=True)
class ArmWorld:
    """An arm of a robot description, made a little other than described (seed). tag: whether it has a camera."""

    robot: str = "ur10"
    seed: int = 0
    tag: bool = False

    @cached_property
    def urdf(self) -> str:
        return (ROBOTS / f"{self.robot}.urdf").read_text()

    @cached_property
    def chain(self) -> Chain:
        return read_chain(self.urdf)

    @cached_property
    def full(self) -> Array:
        """Largest effort of each joint [N m], as the weight of the stretched arm suggests."""
        bodies, reach = read_inertias(self.urdf, self.chain), np.linalg.norm(self.chain.origins[1:, :3, 3], axis=1)
        beyond = np.cumsum(bodies.mass[::-1])[::-1]
        return np.maximum(2.0 * 9.81 * beyond * np.cumsum(reach[::-1])[::-1], 20.0)

    def tour(self, task: int, rng: np.random.Generator) -> Array:
        """Postures (6, n) of a task, each time a little otherwise."""
        c, own = self.chain, np.random.default_rng(1000 * self.seed + task)
        low, high = np.maximum(c.lower, -2.5), np.minimum(c.upper, 2.5)
        middle, room = 0.5 * (low + high), 0.5 * (high - low)
        around = middle + own.uniform(-0.35, 0.35, c.n) * room
        return np.asarray(around + (own.uniform(-0.3, 0.3, (6, c.n)) + rng.normal(0.0, 0.02, (6, c.n))) * room)

    def record(
        self, seed: int, seconds: float = 60.0, task: int = 0, change: Change = NONE, began: float | None = None
    ) -> Recording:
        """A recording of one day. began: its first stamp [s]; default: the day that the seed says."""
        rng, c = np.random.default_rng((self.seed, seed)), self.chain
        model = self._model(change)
        data, own, j = mujoco.MjData(model), np.random.default_rng(self.seed), change.joint
        motors = np.array([model.joint(name).id for name in c.names])
        dry = 0.04 * self.full * own.uniform(0.7, 1.3, c.n)
        viscous = 0.04 * self.full * own.uniform(0.7, 1.3, c.n)
        if change.kind == "friction":
            dry[j], viscous[j] = (1.0 + change.size) * dry[j], (1.0 + change.size) * viscous[j]
        model.dof_damping[motors] = viscous
        since = rng.uniform(0.0, 3600.0)  # s that the arm has been warming up for
        bias, gain = 0.002 * self.full * rng.normal(size=c.n), 1.0 + 0.02 * own.normal(size=c.n)
        commands, until = _course(self.tour(task, rng), seconds, rng.uniform(0.5, 0.9), rng)
        late = round(change.size / STEP) if change.kind == "latency" else 0
        offset, ratio = np.zeros(c.n), np.ones(c.n)
        if change.kind == "zero":
            offset[j] = change.size
        if change.kind == "ratio":
            ratio[j] += change.size
        data.qpos[motors] = ratio * commands[0] + offset
        site = model.site("camera").id
        N = until // PER
        q, effort, tags, t_tags = np.empty((N, c.n)), np.empty((N, c.n)), [], []
        for k in range(N * PER):
            if k % 500 == 0:
                model.dof_frictionloss[motors] = dry * (1.0 + 0.25 * np.exp(-(since + k * STEP) / 600.0))
            data.ctrl[:] = ratio * commands[max(k - late, 0)] + offset
            mujoco.mj_step(model, data)
            if k % PER == 0:
                q[k // PER], effort[k // PER] = (data.qpos[motors] - offset) / ratio, data.actuator_force
            if self.tag and k % TAG_EVERY == 0:
                mujoco.mj_kinematics(model, data)
                T = se3.transform(data.site_xmat[site].reshape(3, 3), data.site_xpos[site])
                tags.append(se3.inverse(T) @ T_BASE_TAG)
                t_tags.append(k * STEP)
        t = 86400.0 * seed + 1e9 if began is None else began
        stamps = t + STEP * PER * np.arange(N)
        counts, tick = 2.0 * np.pi / 2**16, 5e-4 * self.full
        effort = gain * effort + bias + 0.003 * self.full * rng.normal(size=effort.shape)
        unknown, received = np.full((N, c.n), np.nan), np.full(N, np.nan)
        seen = counts * np.round(q / counts), unknown, tick * np.round(effort / tick), received
        told = JointTrack(c.names, stamps, commands[: N * PER : PER], unknown, unknown, received, "/joint_commands")
        readings = (_readings(np.array(tags), t + np.array(t_tags), rng),) if self.tag else ()
        joints = JointTrack(c.names, stamps, *seen)
        return Recording((joints,), readings, (), self.urdf, f"bag {seed}", commands=(told,))

    def _model(self, change: Change) -> mujoco.MjModel:
        own, c = np.random.default_rng((self.seed, 7)), self.chain
        bodies = read_inertias(self.urdf, c)
        mass = bodies.mass * own.normal(1.0, 0.04, c.n)
        com = bodies.com + own.normal(0.0, 0.004, (c.n, 3)) * (bodies.mass > 0.0)[:, None]
        off = np.concatenate([own.normal(0.0, 3e-4, (c.n + 1, 3)), own.normal(0.0, 1e-3, (c.n + 1, 3))], axis=1)
        camera = T_TIP_CAMERA
        if change.kind == "camera":
            camera = camera @ se3.exp(np.r_[change.size * np.array([0.6, 0.8, 0.0]), 0.0, 0.0, 0.0])
        xml = mjcf(c, c.origins @ se3.exp(off), camera, replace(bodies, mass=mass, com=com))
        xml = xml.replace('timestep="0.001"', f'timestep="{STEP}" integrator="implicitfast"').replace(
            'name="tool"', 'name="camera"'
        )
        for name, rotor in zip(c.names, np.maximum(0.004 * self.full, 0.3), strict=True):
            hard = 'solreffriction="0.004 1"'  # dry friction as hard as the step allows
            xml = xml.replace(f'<joint name="{name}" ', f'<joint name="{name}" armature="{rotor}" {hard} ')
        if change.kind == "payload":
            xml = xml.replace('mass="1e-09" diaginertia="1e-09 1e-09 1e-09"/></body><site',
                              f'mass="{change.size}" diaginertia="1e-3 1e-3 1e-3"/></body><site')  # fmt: skip
            assert f'mass="{change.size}"' in xml
        if change.kind == "play":
            name, axis = c.names[change.joint], text(c.axes[change.joint])
            ends = f"{-0.5 * change.size} {0.5 * change.size}"
            loose = (f'<joint name="loose" type="hinge" axis="{axis}" range="{ends}" armature="0.02" damping="0.5" '
                     'solreflimit="0.006 1" solimplimit="0.95 0.99 0.001"/>')  # fmt: skip
            at = xml.index(f'<joint name="{name}"')
            end = xml.index("/>", at) + 2
            xml = xml[:end] + loose + xml[end:]
        kp = 60.0 * self.full
        servos = "".join(f'<position joint="{n}" kp="{k}" kv="{0.03 * k}"/>' for n, k in zip(c.names, kp, strict=True))
        return mujoco.MjModel.from_xml_string(xml.replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>"))


def _course(tour: Array, seconds: float, speed: float, rng: np.random.Generator) -> tuple[Array, int]:
    """Commands at every step: from posture to posture without a jerk, with a stop at each."""
    out, at, k, until = [tour[0][None]], tour[0], 1, round(seconds / STEP)
    while sum(map(len, out)) < until:
        goal = tour[k % len(tour)]
        lasts = max(1.9 * float(np.abs(goal - at).max()) / speed, 0.3)
        s = np.linspace(0.0, 1.0, round(lasts / STEP))[:, None]
        out += [at + (goal - at) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5)]
        out += [np.repeat(goal[None], round(rng.uniform(0.2, 0.8) / STEP), axis=0)]
        at, k = goal, k + 1
    return np.concatenate(out)[:until], until


def _readings(T: Array, t: Array, rng: np.random.Generator) -> ReadingTrack:
    noise = rng.normal(0.0, 1.0, (len(T), 6)) * np.array([5e-4, 5e-4, 1e-3, 2e-3, 2e-3, 1e-3])
    return ReadingTrack("pose", "tag", t, se3.to_pose(T @ se3.exp(noise)), np.full(len(t), np.nan))
