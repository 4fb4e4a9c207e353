"""An arm that pulls at furniture, stepped by MuJoCo: servos that lag, a wrist sensor that is not tared, a true grasp.

It keeps no time of its own but MuJoCo's, so a study may run it as fast as it will go and a node at the clock's pace.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from modcal_core.articulation import FEWEST, Track, choose
from modcal_core.errors import BadCommand, BadRobot
from modcal_core.files import to_json, write_folder
from modcal_core.geometry import Array, se3
from modcal_core.report import URDF, Articulation, VerbResult, articulation_report
from modcal_core.robots import Chain, Inertias, chain_forward, read_chain, read_inertias
from modcal_nodes.simulation.furniture import Furniture
from modcal_nodes.simulation.mjcf import OBJECT, SECOND, Servo, furniture_mjcf

_SETTLE = 0.3  # s before time zero, for the grasp to take up what is left of the start posture's rounding
_LONGEST_JUMP = 0.3  # rad; a driver refuses a reference further from the last one


class Pulling:
    """The scene at one moment. ``time`` [s] is zero when the arm stands still with the closed handle in its hand."""

    def __init__(
        self,
        chain: Chain,
        inertias: Inertias,
        servo: Servo,
        scene: Furniture,
        rng: np.random.Generator,
        noise_n: float,
        noise_nm: float,
    ) -> None:
        """Let the arm take hold. noise: of the wrist sensor, one standard deviation per axis [N, N m]."""
        self.chain, self.scene = chain, scene
        self._noise, self._rng = np.array([noise_n] * 3 + [noise_nm] * 3), rng
        self.model = mujoco.MjModel.from_xml_string(furniture_mjcf(chain, inertias, servo, scene))
        self.data, self._step = mujoco.MjData(self.model), float(self.model.opt.timestep)
        self._arm = [self.model.joint(name).qposadr[0] for name in chain.names]
        self._arm_v = [self.model.joint(name).dofadr[0] for name in chain.names]
        assert self._arm == list(range(self._arm[0], self._arm[0] + chain.n)), self._arm
        names = [self.model.joint(k).name for k in range(self.model.njnt)]
        self.object_joints = tuple(name for name in (OBJECT, SECOND) if name in names)
        self._object = [self.model.joint(name).qposadr[0] for name in self.object_joints]
        self._object_v = [self.model.joint(name).dofadr[0] for name in self.object_joints]
        self._tool, self._handle = self.model.site("tool").id, self.model.site("handle").id
        self._wrist, self._grasp = self._sensor("force"), self._sensor("grasp_force")
        self._resistance, self._lever = scene.resistance, scene.radius if scene.turns else 1.0
        self._servo, self._reference, self._wound = servo, np.array(scene.q, dtype=float), np.zeros(chain.n)
        self._way: tuple[Array, Array] | None = None
        self._grasp_of_hand, self._takes_hold = self.model.equality("grasp").id, -math.inf
        self._peak, self._peak_size, self._sum, self._steps = np.zeros(6), 0.0, 0.0, 0
        self.data.qpos[self._arm] = scene.q
        self.start = 0.0
        self.advance(_SETTLE)
        self.start = float(self.data.time)
        self.forget()

    @classmethod
    def of(
        cls,
        urdf_xml: str,
        chain: Chain,
        scene: Furniture,
        rng: np.random.Generator,
        servo: Servo | None = None,
        noise_n: float = 0.2,
        noise_nm: float = 0.01,
    ) -> Pulling:
        """The scene with the arm of a URDF, its masses and its torques. Raises BadRobot where it states no masses."""
        inertias = read_inertias(urdf_xml, chain)
        if not (inertias.mass > 0.0).all():
            light = chain.names[int(np.argmin(inertias.mass))]
            raise BadRobot(f"joint {light}", "moves no mass in this URDF", "give an arm with inertials")
        servo = servo or Servo(effort_limits(urdf_xml, chain.names))
        return cls(chain, inertias, servo, scene, rng, noise_n, noise_nm)

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return float(self.data.time) - self.start

    def advance(self, seconds: float) -> None:
        """Let so much time pass, in whole steps of a millisecond or less."""
        for _ in range(round(seconds / self._step)):
            if self._way is not None:
                times, postures = self._way
                self._reference = np.array([np.interp(self.data.time, times, column) for column in postures.T])
            if self.moves_freely and self.data.time > self._takes_hold:
                self.data.eq_active[self._grasp_of_hand] = 1
            self._drive()
            self._resist()
            mujoco.mj_step(self.model, self.data)
            force = self.data.sensordata[self._grasp : self._grasp + 3]
            size = math.sqrt(float(force @ force))
            if size > self._peak_size:
                self._peak, self._peak_size = self.contact(), size
            self._sum += size
            self._steps += 1

    def _drive(self) -> None:
        """Send the servos to their references, and by as much beyond as their integral parts have summed up."""
        if self._servo.integral_s > 0.0:
            missing = self._reference - self.data.qpos[self._arm]
            if self._servo.cascaded:
                missing = missing - self._servo.lag_s * self.data.qvel[self._arm_v]
            self._wound += missing * (self._step / self._servo.integral_s)
        self.data.ctrl[:] = self._reference + self._wound

    def _resist(self) -> None:
        """Hold the object back by the law of its scene, which is one of the handle's way."""
        if self._resistance is None:
            return
        at, moved, lever = self._object[0], self._object_v[0], self._lever
        force = self._resistance.force(lever * self.data.qpos[at], lever * self.data.qvel[moved])
        self.data.qfrc_applied[moved] = -lever * force

    def refer(self, q: ArrayLike) -> None:
        """Send the servos to a posture (n,) at once. Raises BadCommand for none, or one that is a jump away."""
        q = np.asarray(q, dtype=float)
        if q.shape != (self.chain.n,) or not np.isfinite(q).all():
            raise BadCommand("joint_references", "has wrong positions", f"give {self.chain.n} finite numbers")
        jump = np.abs(q - self._reference)
        if jump.max() > _LONGEST_JUMP:
            worst = self.chain.names[int(np.argmax(jump))]
            raise BadCommand(
                f"joint_references: {worst}",
                f"is {jump.max():.3g} away from the last one, {_LONGEST_JUMP:g} is the limit",
                "start references where the arm is, and move in small steps",
            )
        self._way, self._reference = None, q.copy()

    def follow(self, legs: Sequence[tuple[float, Array]]) -> None:
        """Go through postures (n,) by their seconds from now, straight from one to the next."""
        times = self.data.time + np.array([0.0, *(after for after, _ in legs)])
        self._way = times, np.array([self._reference, *(q for _, q in legs)])

    def approach(self, seconds: float = 6.0, turn: float = 0.35) -> None:
        """Let go of the handle, go off and come back within some seconds, and then take hold of it again.

        turn: by which every joint goes one way, and half of which it goes the other way, where its range allows [rad].
        """
        start = np.array(self.scene.q)
        off = np.where(start + turn < self.chain.upper, turn, -turn)
        off = np.where(self.chain.revolute, off, 0.2 * off)
        share = np.linspace(0.0, 1.0, 250)
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        ends = [start, start + off, np.clip(start - 0.5 * off, self.chain.lower + 0.01, self.chain.upper - 0.01), start]
        legs = [a + (b - a) * s for a, b in pairwise(ends) for s in smooth[1:]]
        self.data.eq_active[self._grasp_of_hand] = 0
        self.follow([(seconds * (k + 1) / len(legs), q) for k, q in enumerate(legs)])
        self._takes_hold = float(self.data.time) + seconds + _SETTLE

    @property
    def moves_freely(self) -> bool:
        """Whether the hand is on its way to the handle, and does not hold it yet."""
        return not self.data.eq_active[self._grasp_of_hand]

    def joints(self) -> tuple[Array, Array]:
        """Positions and velocities of the arm's joints, (n,) each."""
        return self.data.qpos[self._arm].copy(), self.data.qvel[self._arm_v].copy()

    def efforts(self) -> Array:
        """What the drives give (n,) [N m; N], the weight that they bear included."""
        return np.asarray(self.data.qfrc_actuator[self._arm_v] + self.weight())

    def weight(self) -> Array:
        """What the arm's own weight and the tool's take of the drives (n,) [N m; N]."""
        return self.data.qfrc_gravcomp[self._arm_v].copy()

    def reference(self) -> Array:
        """Where the servos are sent (n,)."""
        return self._reference.copy()

    def wrench(self) -> Array:
        """Reading of the wrist's sensor (6,): what acts on the tool, in the tool and about its origin [N, N m].

        Pushed along its x, the tool reads a positive force x. Its weight, the sensor's zero and noise are in it.
        """
        # MuJoCo's sensor tells what the wrist does to the tool, which balances all the rest
        felt = -self.data.sensordata[self._wrist : self._wrist + 6]
        return felt + self.scene.tool_bias + self._noise * self._rng.standard_normal(6)

    def contact(self) -> Array:
        """True force and torque (6,) of the hand on the handle, in the handle and about its origin [N, N m]."""
        return -self.data.sensordata[self._grasp : self._grasp + 6]

    def peak(self) -> Array:
        """The :meth:`contact` (6,) of the largest force since :meth:`forget`, every millisecond looked at."""
        return self._peak.copy()

    def mean(self) -> float:
        """Mean of the size of those forces since :meth:`forget` [N]."""
        return self._sum / max(self._steps, 1)

    def forget(self) -> None:
        """Restart peak and mean."""
        self._peak, self._peak_size, self._sum, self._steps = np.zeros(6), 0.0, 0.0, 0

    def object_state(self) -> tuple[Array, Array]:
        """True positions and velocities of ``object_joints`` [rad; m]."""
        return self.data.qpos[self._object].copy(), self.data.qvel[self._object_v].copy()

    @property
    def opened(self) -> float:
        """How far the object is open [rad; m]; both hinges together where it folds."""
        positions = self.data.qpos[self._object]
        return float(positions.sum() if self.scene.kind == "folding" else positions[0])

    def tool(self) -> Array:
        """True pose (4, 4) of the tool in the base."""
        return self._site(self._tool)

    def handle(self) -> Array:
        """True pose (4, 4) of the handle in the base."""
        return self._site(self._handle)

    def _site(self, number: int) -> Array:
        T = np.eye(4)
        T[:3, :3] = self.data.site_xmat[number].reshape(3, 3)
        T[:3, 3] = self.data.site_xpos[number]
        return T

    def _sensor(self, name: str) -> int:
        return int(self.model.sensor(name).adr[0])


def effort_limits(urdf_xml: str, names: Sequence[str]) -> Array:
    """Largest torque or force of the joints (n,) [N m; N]; inf where the URDF states none, or zero."""
    stated = {joint.get("name"): joint.find("limit") for joint in ElementTree.fromstring(urdf_xml).iterfind("joint")}
    limits = [stated.get(name) for name in names]
    efforts = np.array([0.0 if limit is None else float(limit.get("effort", 0.0)) for limit in limits])
    return np.where(efforts > 0.0, efforts, np.inf)


_PERIOD = 0.04  # s between two poses of the hand that are kept: some millimetres of the way
_STILL = 2e-4  # rad or m by which some joint must have gone since the last one: waiting says nothing of the way
_MAX = 2000  # of them; a minute has 1500


class PullRecord:
    """The hand's way during a pull, from joint states, and the largest force at the handle [N]."""

    def __init__(self) -> None:
        self.force = 0.0
        self._chain: Chain | None = None
        self._stamps: list[float] = []
        self._postures: list[Array] = []

    def describe(self, urdf_xml: str) -> None:
        """Take the arm from its description. Raises BadRobot."""
        self._chain = read_chain(urdf_xml)

    @property
    def begun(self) -> bool:
        """Whether the arm and a posture of it are known; of a pull that begins earlier the start would be missing."""
        return bool(self._postures)

    def take(self, names: list[str], positions: list[float], stamp: float) -> None:
        """One joint state [rad, m]. Other joints are left out, and what is too near the last one, in time or in way."""
        if self._chain is None or len(self._stamps) >= _MAX or not set(self._chain.names) <= set(names):
            return
        if self._stamps and stamp - self._stamps[-1] < _PERIOD:
            return
        at = dict(zip(names, positions, strict=False))
        q = np.array([at[name] for name in self._chain.names])
        if self._postures and np.abs(q - self._postures[-1]).max() < _STILL:
            return
        self._stamps.append(stamp)
        self._postures.append(q)

    def feel(self, force: Array) -> None:
        """A force at the handle (3,) [N]."""
        size = float(np.linalg.norm(force))
        if np.isfinite(size):
            self.force = max(self.force, size)

    def write(self, source: str, outcome: str, out: Path) -> tuple[str, ...]:
        """Write what was learned into a folder, with pull.json for programs; returns sentences.

        outcome: how the pull ended. Too short a way leaves pull.json alone.
        """
        learned = self._articulation(source)
        sentences = ["Too few joint states were received during the pull: nothing was learned."]
        files: dict[str, str] = {}
        if learned is not None:
            sentences, files = [str(one) for one in learned.said], dict(learned.files)
        data = {
            "modcal_pull": 1,
            "object": source,
            "sentences": [outcome, *sentences],
            "largest_force_n": self.force,
            "seconds": self._stamps[-1] - self._stamps[0] if self._stamps else 0.0,
            "files": list(files),
        }
        write_folder(out, {**files, "pull.json": to_json(data)})
        if URDF not in files:  # one of an earlier pull would tell of another joint
            (out / URDF).unlink(missing_ok=True)
        return (outcome, *sentences)

    def _articulation(self, source: str) -> VerbResult | None:
        """What was learned of the object, None of too short a way."""
        if self._chain is None or len(self._stamps) < FEWEST:
            return None
        poses = se3.to_pose(chain_forward(self._chain, np.array(self._postures)))
        track = Track.of_poses(poses, np.array(self._stamps))
        choice = choose(track, np.random.default_rng(0))
        return articulation_report(Articulation(source, self._chain.base, track, choice))
