"""Cells of arms that the other groups do not have: of the eighth group, and of healthy builds.

Every link that moves is displaced by half a millimetre and a milliradian; the base is level, the tracker sees it from
anywhere, and faults go by the postures that are meant.
"""

from __future__ import annotations

import numpy as np
from arms import DESCRIBED, FOLDER, TURN, Arm, Joint, described, joint, link, standing
from scipy.spatial.transform import Rotation
from sites import Array, Cell, Deviation, Seen, Stations

EPOCH, EACH = 1.75e9, 6.0  # s
X, Y, Z, AGAINST_Y = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0)
NONE = (0, 0, 0)
H = np.pi / 2


def _ur5(d1: float, a3: float, d4: float, d5: float, d6: float) -> tuple[Joint, ...]:
    return (
        Joint("shoulder_pan_joint", (0, 0, d1), NONE, Z, -2.8, 2.8, 3.7),
        Joint("shoulder_lift_joint", NONE, (H, 0, 0), Z, -2.6, -0.5, 8.4, (-0.21, 0, 0.13)),
        Joint("elbow_joint", (-0.425, 0, 0), NONE, Z, -2.2, 2.2, 2.3, (-0.2, 0, 0.02)),
        Joint("wrist_1_joint", (a3, 0, d4), NONE, Z, -2.8, 2.8, 1.2),
        Joint("wrist_2_joint", (0, -d5, 0), (H, 0, 0), Z, -2.5, 2.5, 1.2),
        Joint("wrist_3_joint", (0, d6, 0), (-H, 0, 0), Z, -2.8, 2.8, 0.2),
    )


UR5E = _ur5(0.1625, -0.3922, 0.1333, 0.0997, 0.0996)
UR5 = _ur5(0.089159, -0.39225, 0.10915, 0.09465, 0.0823)
ARMS: dict[str, tuple[Joint, ...]] = {
    "ur5e": UR5E,
    "irb": (
        Joint("joint_1", (0, 0, 0.399), NONE, Z, -2.7, 2.7, 12.0),
        Joint("joint_2", NONE, NONE, Y, -1.3, 1.6, 13.0, (0.02, 0, 0.22)),
        Joint("joint_3", (0, 0, 0.448), NONE, Y, -1.6, 0.9, 9.0, (0.08, 0, 0.03)),
        Joint("joint_4", (0.16, 0, 0.042), NONE, X, -2.7, 2.7, 4.0, (0.15, 0, 0)),
        Joint("joint_5", (0.291, 0, 0), NONE, Y, -2.0, 2.0, 1.3),
        Joint("joint_6", (0.082, 0, 0), NONE, X, -2.9, 2.9, 0.3),
    ),
    "iiwa7": (
        Joint("lbr_A1", (0, 0, 0.1475), NONE, Z, -2.6, 2.6, 3.5),
        Joint("lbr_A2", (0, 0, 0.1925), NONE, Y, -1.7, 1.7, 3.5, (0, 0, 0.1)),
        Joint("lbr_A3", (0, 0, 0.2075), NONE, Z, -2.6, 2.6, 3.5, (0, 0, 0.1)),
        Joint("lbr_A4", (0, 0, 0.1925), NONE, AGAINST_Y, -1.8, 1.8, 3.5, (0, 0, 0.1)),
        Joint("lbr_A5", (0, 0, 0.2075), NONE, Z, -2.6, 2.6, 3.5, (0, 0, 0.1)),
        Joint("lbr_A6", (0, 0, 0.1925), NONE, Y, -1.8, 1.8, 1.8),
        Joint("lbr_A7", (0, 0, 0.081), NONE, Z, -2.6, 2.6, 1.2, (0, 0, 0.02)),
    ),
    "rail": (Joint("rail_joint", (0, 0, 0.4), (0, 0, H), X, 0.0, 1.5, 30.0, slides=True), *UR5E),
    "scara": (
        Joint("scara_1", (0, 0, 0.35), NONE, Z, -2.0, 2.0, 5.0),
        Joint("scara_2", (0.3, 0, 0), NONE, Z, -2.3, 2.3, 4.0),
        Joint("scara_z", (0.25, 0, 0.05), NONE, (0, 0, -1), 0.0, 0.2, 1.0, slides=True),
        Joint("scara_4", (0, 0, -0.1), NONE, Z, -3.0, 3.0, 0.5),
    ),
}
ASIDE = (0.05, 0, 0.02)
SCARA = (
    Joint("shoulder", (0, 0, 0.35), NONE, Z, -2.2, 2.2, 5.3, ASIDE),
    Joint("elbow", (0.325, 0, 0), NONE, Z, -2.5, 2.5, 4.6, ASIDE),
    Joint("quill", (0.275, 0, 0), NONE, (0, 0, -1), 0.0, 0.2, 3.9, ASIDE, slides=True),
    Joint("wrist", (0, 0, -0.1), NONE, Z, -3.1, 3.1, 3.2, ASIDE),
)
GANTRY = (
    Joint("bridge", (0, 0, 1.2), NONE, X, 0.0, 2.5, 5.3, ASIDE, slides=True),
    Joint("trolley", (0, 0.1, 0), NONE, Y, 0.0, 1.5, 4.6, ASIDE, slides=True),
    Joint("column", (0.1, 0, 0), NONE, (0, 0, -1), 0.0, 0.8, 3.9, ASIDE, slides=True),
    Joint("swivel", (0, 0, -0.2), NONE, Z, -3.0, 3.0, 3.2, ASIDE),
    Joint("nod", (0.06, 0, -0.05), NONE, Y, -1.6, 1.6, 2.5, ASIDE),
)
DESCRIBED |= {
    "scara": (described(SCARA, 0.0, "0 0 0.08"), "tool0"),
    "gantry": (described(GANTRY, 0.0, "0 0 0.08"), "tool0"),
    "iiwa14": ((FOLDER / "iiwa14.urdf").read_text(encoding="utf-8"), "iiwa_link_ee"),
    # on a carriage that goes two metres
    "rail": standing(
        "ur10",
        lambda root: [
            link("rail", 40.0, "0.05 0 0.02"),
            joint("rail_joint", f"rail {root}", "prismatic", "0 0 0.3", axis="1 0 0 -1 1"),
        ],
    ),
}


class World(Cell):
    """An arm as built, its target and its tracker (``eye``: where it sees the base, and how turned)."""

    noise = 0.025, 0.03, 8e-6
    period, epoch, by_meant = EACH, EPOCH, True

    def __init__(self, robot: str, rng: np.random.Generator) -> None:
        self.robot, self.rng, self.joints = robot, rng, ARMS[robot]
        self.rebuild()
        self.turns = np.array([not j.slides for j in self.joints])
        self.tool = self.way(0.06) + np.array([0.02, 0.0, 0.08]), Rotation.random(rng=rng)
        self.eye = np.array([0.3, -0.4, 0.5]) + rng.normal(0, 1.0, 3), Rotation.random(rng=rng)

    def rebuild(self, size: float = 1.0) -> None:
        """Another arm of the series. size: of how far it is off."""
        scale = np.r_[np.full(3, 5e-4), np.full(3, 1e-3)]
        off = self.rng.normal(0, size * scale, (len(self.joints), 6))
        rows = iter([*off, np.zeros(6)])  # the flange is where it is drawn

        def place(xyz: Array, R: Rotation) -> tuple[Array, Rotation]:
            row = next(rows)
            return xyz + R.apply(row[:3]), R * Rotation.from_rotvec(row[3:])

        self.settle_in(Arm(described(self.joints), "tool0", place, bare=True))
        self.arm.range = np.array([[j.low for j in self.joints], [j.high for j in self.joints]])

    def any_joint(self, low: int = 0, high: int | None = None) -> int:
        """The number of a joint that turns, drawn."""
        return int(self.rng.choice([i for i in range(low, high or len(self.names)) if self.turns[i]]))

    def seen(self, p: Array, tip: Rotation, d: Deviation) -> Seen:
        """The target moves along the flange's axes, and the base where the tracker is said to move."""
        (at, turn), (stand, eye), base = self.tool, self.eye, Rotation.from_rotvec(d.tracker[:, 3:])
        p, tip = base.apply(p) + d.tracker[:, :3], base * tip
        p = p + tip.apply(at + d.tool[:, :3])
        return Seen(eye.apply(p) + stand, eye * (tip * Rotation.from_rotvec(d.tool[:, 3:]) * turn))

    def sees(self, q: Array) -> Seen:
        """Where the target truly is in the tracker's frame."""
        return self.poses(Stations(q, np.zeros(len(q)), np.zeros_like(q)))

    def torques(self, q: Array, payload: Array | float = 0.0) -> Array:
        """Of weight about each axis (N, n) [N m], with a mass [kg] where the target is."""
        pay, out = np.broadcast_to(payload, len(q)), np.zeros(q.shape)
        for kg in np.unique(pay):
            self.arm.carry(float(kg), self.tool[0])
            out[pay == kg] = np.where(self.turns, -self.arm.loads(q[pay == kg])[..., TURN], 0.0)
        return out

    def postures(self, count: int, returns: int = 6, low: float = 0.0, high: float = 1.0) -> tuple[Array, Array]:
        """Random postures (count, n), the last visits of which come back from other sides: and which those are."""
        least, most = self.arm.range
        q = least + (most - least) * self.rng.uniform(low, high, (count - returns, len(self.names)))
        order, again = list(range(len(q))), [False] * len(q)
        for i in self.rng.choice(len(q) // 2, returns, replace=False):
            here = order.index(i)
            came = np.sign(q[i] - (q[order[here - 1]] if here else 0.5 * (least + most)))
            best = max(range(here + 4, len(order)), key=lambda k: int(np.sum(came * (q[i] - q[order[k - 1]]) < 0)))
            order.insert(best, int(i))
            again.insert(best, True)
        return q[order], np.array(again)

    def begins(self, q: Array) -> Array:
        """The first posture: nobody knows how it was reached."""
        return q[:1]


def cell_of(robot: str, rng: np.random.Generator) -> Cell:
    """The cell of any arm: of these ones, or of those that other benches have."""
    return (World if robot in ARMS and robot != "rail" else Cell)(robot, rng)
