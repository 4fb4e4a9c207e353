"""Cells in NumPy alone, of five arms that the other groups do not have: of the eighth group and its healthy cells.

Truth is a product of matrices in which every link is displaced by half a millimetre and a milliradian; what bends or
slips is put between two of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from workcell import Array, Bend, Cellwork, Stations

EPOCH, EACH = 1.75e9, 6.0  # s
X, Y, Z = np.eye(3)
H = np.pi / 2


@dataclass(frozen=True)
class Joint:
    """A joint as a drawing has it. xyz, rpy: of its frame in the one before; mass: of the link that it moves [kg]."""

    name: str
    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    axis: Array
    low: float
    high: float
    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slides: bool = False


def _ur5(d1: float, a3: float, d4: float, d5: float, d6: float) -> tuple[Joint, ...]:
    return (
        Joint("shoulder_pan_joint", (0, 0, d1), (0, 0, 0), Z, -2.8, 2.8, 3.7),
        Joint("shoulder_lift_joint", (0, 0, 0), (H, 0, 0), Z, -2.6, -0.5, 8.4, (-0.21, 0, 0.13)),
        Joint("elbow_joint", (-0.425, 0, 0), (0, 0, 0), Z, -2.2, 2.2, 2.3, (-0.2, 0, 0.02)),
        Joint("wrist_1_joint", (a3, 0, d4), (0, 0, 0), Z, -2.8, 2.8, 1.2),
        Joint("wrist_2_joint", (0, -d5, 0), (H, 0, 0), Z, -2.5, 2.5, 1.2),
        Joint("wrist_3_joint", (0, d6, 0), (-H, 0, 0), Z, -2.8, 2.8, 0.2),
    )


UR5E = _ur5(0.1625, -0.3922, 0.1333, 0.0997, 0.0996)
UR5 = _ur5(0.089159, -0.39225, 0.10915, 0.09465, 0.0823)
ARMS: dict[str, tuple[Joint, ...]] = {
    "ur5e": UR5E,
    "irb": (
        Joint("joint_1", (0, 0, 0.399), (0, 0, 0), Z, -2.7, 2.7, 12.0),
        Joint("joint_2", (0, 0, 0), (0, 0, 0), Y, -1.3, 1.6, 13.0, (0.02, 0, 0.22)),
        Joint("joint_3", (0, 0, 0.448), (0, 0, 0), Y, -1.6, 0.9, 9.0, (0.08, 0, 0.03)),
        Joint("joint_4", (0.16, 0, 0.042), (0, 0, 0), X, -2.7, 2.7, 4.0, (0.15, 0, 0)),
        Joint("joint_5", (0.291, 0, 0), (0, 0, 0), Y, -2.0, 2.0, 1.3),
        Joint("joint_6", (0.082, 0, 0), (0, 0, 0), X, -2.9, 2.9, 0.3),
    ),
    "iiwa7": (
        Joint("lbr_A1", (0, 0, 0.1475), (0, 0, 0), Z, -2.6, 2.6, 3.5),
        Joint("lbr_A2", (0, 0, 0.1925), (0, 0, 0), Y, -1.7, 1.7, 3.5, (0, 0, 0.1)),
        Joint("lbr_A3", (0, 0, 0.2075), (0, 0, 0), Z, -2.6, 2.6, 3.5, (0, 0, 0.1)),
        Joint("lbr_A4", (0, 0, 0.1925), (0, 0, 0), -Y, -1.8, 1.8, 3.5, (0, 0, 0.1)),
        Joint("lbr_A5", (0, 0, 0.2075), (0, 0, 0), Z, -2.6, 2.6, 3.5, (0, 0, 0.1)),
        Joint("lbr_A6", (0, 0, 0.1925), (0, 0, 0), Y, -1.8, 1.8, 1.8),
        Joint("lbr_A7", (0, 0, 0.081), (0, 0, 0), Z, -2.6, 2.6, 1.2, (0, 0, 0.02)),
    ),
    "rail": (Joint("rail_joint", (0, 0, 0.4), (0, 0, H), X, 0.0, 1.5, 30.0, slides=True), *UR5E),
    "scara": (
        Joint("scara_1", (0, 0, 0.35), (0, 0, 0), Z, -2.0, 2.0, 5.0),
        Joint("scara_2", (0.3, 0, 0), (0, 0, 0), Z, -2.3, 2.3, 4.0),
        Joint("scara_z", (0.25, 0, 0.05), (0, 0, 0), -Z, 0.0, 0.2, 1.0, slides=True),
        Joint("scara_4", (0, 0, -0.1), (0, 0, 0), Z, -3.0, 3.0, 0.5),
    ),
}


def described(joints: tuple[Joint, ...]) -> str:
    """A URDF of these joints: link_0, link_1, ... and tool0 where the last one ends."""
    lines = ['<robot name="arm">', '<link name="link_0"/>']
    for i, j in enumerate(joints, 1):
        lines += [
            f'<link name="link_{i}"><inertial><origin xyz="{j.com[0]} {j.com[1]} {j.com[2]}"/><mass value="{j.mass}"/>',
            '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>',
            f'<joint name="{j.name}" type="{"prismatic" if j.slides else "revolute"}">',
            f'<parent link="link_{i - 1}"/><child link="link_{i}"/>',
            f'<origin xyz="{j.xyz[0]} {j.xyz[1]} {j.xyz[2]}" rpy="{j.rpy[0]} {j.rpy[1]} {j.rpy[2]}"/>',
            f'<axis xyz="{j.axis[0]} {j.axis[1]} {j.axis[2]}"/>',
            f'<limit lower="{j.low - 4}" upper="{j.high + 4}" effort="100" velocity="3"/></joint>',
        ]
    tip = f'<link name="tool0"/><joint name="flange" type="fixed"><parent link="link_{len(joints)}"/>'
    return "\n".join([*lines, f'{tip}<child link="tool0"/></joint></robot>'])


def small(twist: Array) -> Array:
    """Matrices (N, 4, 4) of small displacements (N, 6): metres and a rotation vector."""
    T = np.tile(np.eye(4), (len(twist), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(twist[:, 3:]).as_matrix()
    T[:, :3, 3] = twist[:, :3]
    return T


class Wrong:
    """How the arm truly is at N stations.

    x (N, n, 4): joints, the last of four, as in the other cells. tracker, tool (N, 6): twists of the base and in the
    target. behind: by number of a joint, twists (N, 6) of what it carries, in its own frame.
    """

    def __init__(self, q: Array) -> None:
        self.x = np.zeros((*q.shape, 4))
        self.x[..., 3] = q
        self.tracker, self.tool = np.zeros((len(q), 6)), np.zeros((len(q), 6))
        self.behind: dict[int, Array] = {}


class World(Cellwork):
    """An arm as built, its target and its tracker."""

    noise = 0.025, 0.03, 8e-6
    period, epoch = EACH, EPOCH

    def __init__(self, robot: str, rng: np.random.Generator) -> None:
        self.robot, self.rng, self.joints = robot, rng, ARMS[robot]
        self.names = tuple(j.name for j in self.joints)
        self.urdf = described(self.joints)
        self.low, self.high = (np.array([getattr(j, end) for j in self.joints]) for end in ("low", "high"))
        self.turns = np.array([not j.slides for j in self.joints])
        self.rebuild()
        self.target = self.way(0.06) + np.array([0.02, 0.0, 0.08]), Rotation.random(rng=rng)
        self.eye = np.array([0.3, -0.4, 0.5]) + rng.normal(0, 1.0, 3), Rotation.random(rng=rng)

    def rebuild(self) -> None:
        """Another arm of the series."""
        scale = np.r_[np.full(3, 5e-4), np.full(3, 1e-3)]
        self.built = small(self.rng.normal(0, scale, (len(self.names), 6)))

    def any_joint(self, low: int = 0, high: int | None = None) -> int:
        """The number of a joint that turns, drawn."""
        return int(self.rng.choice([i for i in range(low, high or len(self.names)) if self.turns[i]]))

    def frames(self, q: Array, wrong: Wrong | None = None) -> Array:
        """The frame behind every joint in the base (N, n, 4, 4)."""
        wrong = Wrong(q) if wrong is None else wrong
        T, q, out = small(wrong.tracker), wrong.x[..., 3], []
        for i, j in enumerate(self.joints):
            fixed = np.eye(4)
            fixed[:3, :3], fixed[:3, 3] = Rotation.from_euler("xyz", j.rpy).as_matrix(), j.xyz
            move = np.zeros((len(q), 6))
            move[:, slice(0, 3) if j.slides else slice(3, 6)] = q[:, i, None] * j.axis
            T = T @ fixed @ self.built[i] @ small(move)
            if i in wrong.behind:
                T = T @ small(wrong.behind[i])
            out.append(T)
        return np.stack(out, axis=1)

    def sees(self, q: Array, wrong: Wrong | None = None) -> tuple[Array, Rotation]:
        """Where the target truly is in the tracker's frame: (N, 3) and N turns."""
        T, (at, turned), (stand, eye) = self.frames(q, wrong)[:, -1], self.target, self.eye
        if wrong is not None and wrong.tool.any():
            T = T @ small(np.r_[at, 0, 0, 0][None]) @ small(wrong.tool)
            at = np.zeros(3)
        p = T[:, :3, 3] + T[:, :3, :3] @ at
        return eye.apply(p) + stand, eye * (Rotation.from_matrix(T[:, :3, :3]) * turned)

    def torques(self, q: Array, payload: Array | float = 0.0) -> Array:
        """Of weight about each axis (N, n) [N m], with a mass [kg] where the target is."""
        T = self.frames(q)
        pay = np.broadcast_to(np.asarray(payload, dtype=float), len(q))
        out = np.zeros(q.shape)
        for i in np.flatnonzero(self.turns):
            axis, at = T[:, i, :3, :3] @ self.joints[i].axis, T[:, i, :3, 3]
            for k in range(i, len(self.names)):
                com = np.einsum("nab,b->na", T[:, k], np.r_[self.joints[k].com, 1.0])[:, :3]
                out[:, i] += np.sum(axis * np.cross(com - at, [0, 0, -9.81 * self.joints[k].mass]), axis=1)
            tip = np.einsum("nab,b->na", T[:, -1], np.r_[self.target[0], 1.0])[:, :3]
            out[:, i] += np.sum(axis * np.cross(tip - at, [0, 0, -9.81]), axis=1) * pay
        return out

    def postures(self, count: int, returns: int = 6, low: float = 0.0, high: float = 1.0) -> tuple[Array, Array]:
        """Random postures (count, n), the last visits of which come back from other sides: and which those are."""
        q = self.low + (self.high - self.low) * self.rng.uniform(low, high, (count - returns, len(self.names)))
        order, again = list(range(len(q))), [False] * len(q)
        for i in self.rng.choice(len(q) // 2, returns, replace=False):
            here = order.index(i)
            came = np.sign(q[i] - (q[order[here - 1]] if here else 0.5 * (self.low + self.high)))
            best = max(range(here + 4, len(order)), key=lambda k: int(np.sum(came * (q[i] - q[order[k - 1]]) < 0)))
            order.insert(best, int(i))
            again.insert(best, True)
        return q[order], np.array(again)

    def begins(self, q: Array) -> Array:
        """The first posture: nobody knows how it was reached."""
        return q[:1]

    def truth(self, reached: Stations, meant: Stations, bends: tuple[Bend, ...]) -> tuple[Array, Rotation]:
        """By products of matrices; faults go by the postures that are meant."""
        wrong = Wrong(reached.q)
        for bend in bends:
            bend(self, meant, wrong)
        return self.sees(reached.q, wrong)
