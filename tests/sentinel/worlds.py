"""An arm at its work in MuJoCo: position servos, dry friction that is warmer or colder, cogs, a camera that sees a tag,
a dock that draws the tool in.

The world is rigid-body dynamics with friction as a constraint; nothing of what watches it is used to make it, and its
masses and lengths are not those of the description.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout

from modcal_core.geometry import Array, se3
from modcal_core.measurements import JointTrack, ReadingTrack, Recording
from modcal_core.robots import Chain, chain_forward, read_chain, read_inertias
from modcal_nodes.simulation.mjcf import mjcf, text

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
STEP = 4e-3  # s, and a message at each: 250 Hz
TAG_EVERY = 25  # steps, 10 Hz
CHUNK = 2500  # steps in which friction is as warm
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
    """An arm of a robot description, made a little other than described (seed). tag: whether it has a camera. dock:
    whether it goes to one, from three sides.
    """

    robot: str = "ur10"
    seed: int = 0
    tag: bool = False
    dock: bool = False

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
        tour = self.tour(task, rng)
        docks = self._docks(self._model(NONE)) if self.dock else tour[:0]
        model.site("dock").pos += rng.normal(0.0, 2e-4, 3) if self.dock else 0.0  # how well it is put back
        commands, docked = _course(np.concatenate([tour, docks]), len(docks), seconds, rng.uniform(0.5, 0.9), rng)
        until = len(commands)
        late = change.size / STEP if change.kind == "latency" else 0.0
        offset, ratio = np.zeros(c.n), np.ones(c.n)
        if change.kind == "zero":
            offset[j] = change.size
        if change.kind == "ratio":
            ratio[j] += change.size
        data.qpos[motors] = ratio * commands[0] + offset
        heard = np.arange(until) - late  # a command is held at its first value before it comes
        told = ratio * np.stack([np.interp(heard, np.arange(until), column) for column in commands.T], axis=1) + offset
        control = np.zeros((until, c.n + model.nv + 1))
        control[:, -1] = docked
        control[:, : c.n] = told
        control[:, c.n + np.array(model.jnt_dofadr)[motors]] = self._rough(told, dry)
        spec = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED | mujoco.mjtState.mjSTATE_EQ_ACTIVE
        state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        seen: list[Array] = []
        for k in range(0, until, CHUNK):
            model.dof_frictionloss[motors] = dry * (1.0 + 0.25 * np.exp(-(since + k * STEP) / 600.0))
            states, sensed = rollout.rollout(model, [data], state, control[None, k : k + CHUNK], control_spec=int(spec))
            state = states[0, -1]
            seen.append(sensed[0])
        sensed = np.concatenate(seen)
        q, effort = (sensed[:, : c.n] - offset) / ratio, sensed[:, c.n : 2 * c.n]
        t = 86400.0 * seed + 1e9 if began is None else began
        stamps = t + STEP * np.arange(until)
        counts, tick = 2.0 * np.pi / 2**16, 5e-4 * self.full
        effort = gain * effort + bias + 0.003 * self.full * rng.normal(size=effort.shape)
        unknown, received = np.full((until, c.n), np.nan), np.full(until, np.nan)
        measured = counts * np.round(q / counts), unknown, tick * np.round(effort / tick), received
        asked = JointTrack(c.names, stamps, commands, unknown, unknown, received, "/joint_commands")
        readings = self._seen(sensed[:, 2 * c.n :], t, rng) if self.tag else ()
        if self.dock:
            at = t + STEP * np.flatnonzero(docked)[::TAG_EVERY]
            readings += (ReadingTrack("point", "dock", at, np.zeros((len(at), 3)), np.full(len(at), np.nan)),)
        joints = JointTrack(c.names, stamps, *measured)
        return Recording((joints,), readings, (), self.urdf, f"bag {seed}", commands=(asked,))

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
        xml = xml.replace(
            'timestep="0.001"', f'timestep="{STEP}" integrator="implicitfast" iterations="10" tolerance="1e-6"'
        ).replace('name="tool"', 'name="camera"')
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
        servos = "".join(
            f'<position name="{n}" joint="{n}" kp="{k}" kv="{0.03 * k}"/>' for n, k in zip(c.names, kp, strict=True)
        )
        sensors = "".join(f'<jointpos joint="{n}"/>' for n in c.names)
        sensors += "".join(f'<actuatorfrc actuator="{n}"/>' for n in c.names)
        sensors += "".join(f'<{of} objtype="site" objname="camera"/>' for of in ("framepos", "framequat"))
        more = f"<actuator>{servos}</actuator><sensor>{sensors}</sensor></mujoco>"
        at = text(self._dock_at)
        xml = xml.replace("<worldbody>", f'<worldbody><site name="dock" pos="{at}"/>', 1)
        more = '<equality><connect site1="camera" site2="dock" active="false" solref="0.02 1"/></equality>' + more
        return mujoco.MjModel.from_xml_string(xml.replace("</mujoco>", more))

    @cached_property
    def _dock_at(self) -> Array:
        """The dock in the base [m]: where the description has the camera in the middle of the arm's range."""
        low, high = np.maximum(self.chain.lower, -2.5), np.minimum(self.chain.upper, 2.5)
        return np.asarray((chain_forward(self.chain, (0.5 * low + 0.6 * high)[None])[0] @ T_TIP_CAMERA)[:3, 3])

    def _docks(self, model: mujoco.MjModel) -> Array:
        """Postures (3, n) at the dock, as somebody has taught them at the sound arm."""
        rng, data, site = np.random.default_rng((self.seed, 11)), mujoco.MjData(model), model.site("camera").id
        low, high, out = np.maximum(self.chain.lower, -2.5), np.minimum(self.chain.upper, 2.5), []
        while len(out) < 3:
            q, J = 0.5 * low + 0.6 * high + rng.normal(0.0, 0.4, self.chain.n), np.zeros((3, model.nv))
            for _ in range(50):
                data.qpos[:] = q
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_jacSite(model, data, J, None, site)
                q = q + 0.5 * np.linalg.lstsq(J, self._dock_at - data.site_xpos[site], rcond=1e-3)[0]
            if np.linalg.norm(self._dock_at - data.site_xpos[site]) < 1e-5 and ((q > low) & (q < high)).all():
                out.append(q)
        return np.array(out)

    def _rough(self, told: Array, dry: Array) -> Array:
        """Torques that no model of a sentinel has: cogs along a joint's turn, and friction that is larger when slow."""
        own, v = np.random.default_rng((self.seed, 9)), np.gradient(told, STEP, axis=0)
        cogs = 0.1 * dry * np.sin(own.integers(20, 80, self.chain.n) * told + own.uniform(0.0, 6.0, self.chain.n))
        slow = own.uniform(0.03, 0.2, self.chain.n)  # rad/s
        return np.asarray(cogs - 0.2 * dry * np.tanh(v / 0.01) * np.exp(-((v / slow) ** 2)))

    def _seen(self, camera: Array, t: float, rng: np.random.Generator) -> tuple[ReadingTrack, ...]:
        """Poses of the tag in the camera."""
        at = np.arange(0, len(camera), TAG_EVERY)
        T = se3.from_pose(camera[at][:, [0, 1, 2, 4, 5, 6, 3]])
        return (_readings(se3.inverse(T) @ T_BASE_TAG, t + STEP * at, rng),)


def _course(
    tour: Array, docks: int, seconds: float, speed: float, rng: np.random.Generator
) -> tuple[Array, np.ndarray]:
    """Commands at every step, from posture to posture without a jerk, with a stop at each; and whether the tool is in
    the dock, as it is for two seconds at the last postures of a tour.
    """
    out, held, at, k, until = [tour[0][None]], [np.zeros(1, bool)], tour[0], 1, round(seconds / STEP)
    while sum(map(len, out)) < until:
        goal, docked = tour[k % len(tour)], k % len(tour) >= len(tour) - docks
        lasts = max(1.9 * float(np.abs(goal - at).max()) / speed, 0.3)
        s = np.linspace(0.0, 1.0, round(lasts / STEP))[:, None]
        stop = round((2.0 if docked else rng.uniform(0.2, 0.8)) / STEP)
        out += [at + (goal - at) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5), np.repeat(goal[None], stop, axis=0)]
        held += [np.zeros(len(s), bool), np.full(stop, docked)]
        at, k = goal, k + 1
    return np.concatenate(out)[:until], np.concatenate(held)[:until]


def _readings(T: Array, t: Array, rng: np.random.Generator) -> ReadingTrack:
    noise = rng.normal(0.0, 1.0, (len(T), 6)) * np.array([5e-4, 5e-4, 1e-3, 2e-3, 2e-3, 1e-3])
    return ReadingTrack("pose", "tag", t, se3.to_pose(T @ se3.exp(noise)), np.full(len(t), np.nan))
