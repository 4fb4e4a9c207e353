"""A real arm: MuJoCo's kinematics and statics of a URDF whose every body sits a little beside its nominal place.

Nothing here comes from modcal. Each moving joint has four coordinates, in this order from the parent outwards: growth
of the parent link along its length, two tilts across the axis, and the turn itself. The first three are zero in a good
arm. A prismatic joint's turn is its travel [m].
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray
ROBOTS = {"ur10": "tool0", "panda": "panda_hand_tcp", "xarm7": "link_eef"}
FOLDER = Path(__file__).resolve().parents[2] / "examples" / "robots"
DESCRIBED: dict[str, tuple[str, str]] = {}  # arms that other benches add: URDF and tip, by name
GROW, TILT_X, TILT_Y, TURN = range(4)
SHIFT, TWIST = 5e-4, 1e-3  # displacement of every body, per axis [m, rad]
PAYLOAD = "payload"


def _numbers(element: ET.Element | None, key: str, default: str) -> Array:
    return np.array([float(v) for v in (default if element is None else element.get(key, default)).split()])


def _text(values: Array) -> str:
    return " ".join(f"{v:.17g}" for v in np.atleast_1d(values))


def _quaternion(rotation: Rotation) -> str:
    return _text(np.roll(rotation.as_quat(), 1))


def _origin(element: ET.Element) -> tuple[Array, Rotation]:
    origin = element.find("origin")
    return _numbers(origin, "xyz", "0 0 0"), Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0"))


@dataclass(frozen=True)
class Displaced:
    """Random displacement of bodies; ``None`` for rng leaves every body in its nominal place."""

    rng: np.random.Generator | None = None

    def __call__(self, xyz: Array, rotation: Rotation) -> tuple[Array, Rotation]:
        if self.rng is None:
            return xyz, rotation
        return xyz + self.rng.normal(0, SHIFT, 3), rotation * Rotation.from_rotvec(self.rng.normal(0, TWIST, 3))


class Arm:
    """One arm: its joints by name, tip poses, gravity torques and what elastic parts do under them."""

    def __init__(self, robot: str, rng: np.random.Generator | None = None) -> None:
        if robot in DESCRIBED:
            self.urdf, self.tip = DESCRIBED[robot]
        else:
            self.urdf, self.tip = (FOLDER / f"{robot}.urdf").read_text(encoding="utf-8"), ROBOTS[robot]
        tree = ET.fromstring(self.urdf)
        links = {e.get("name", ""): e for e in tree.findall("link")}
        above = {e.find("child").get("link"): e for e in tree.findall("joint")}  # type: ignore[union-attr]
        path, link = [], self.tip
        while link in above:
            path.append(above[link])
            link = above[link].find("parent").get("link")  # type: ignore[union-attr]
        self.root, path = link, path[::-1]
        moving = [e for e in path if e.get("type") in ("revolute", "continuous", "prismatic")]
        self.names = tuple(e.get("name", "") for e in moving)
        self.links = tuple(e.find("child").get("link", "") for e in moving)  # type: ignore[union-attr]
        self.parents = tuple(e.find("parent").get("link", "") for e in moving)  # type: ignore[union-attr]
        self.hand = tuple(e.find("child").get("link", "") for e in path[path.index(moving[-1]) :])  # type: ignore[union-attr]
        bounds = np.array([[float(e.find("limit").get(k, 0)) for k in ("lower", "upper")] for e in moving])  # type: ignore[union-attr]
        half = np.minimum(1.8, 0.47 * np.ptp(bounds, axis=1))
        self.range = bounds.mean(axis=1) + np.array([[-1.0], [1.0]]) * half
        # what a link's growth moves: the origin of the next joint, along the line to it
        self.lengths = np.array([np.linalg.norm(_origin(e)[0]) for e in moving])
        self._model = self._compile(links, above, Displaced(rng))
        self._data = mujoco.MjData(self._model)
        coordinates = [[f"{n}/grow", f"{n}/tilt_x", f"{n}/tilt_y", n] for n in self.names]
        self._at = np.array([[self._model.joint(c).qposadr[0] for c in row] for row in coordinates])
        self._bodies = [self._model.body(name).id for name in self.links]
        self._hand = self._model.body(self.tip).id

    @property
    def n(self) -> int:
        return len(self.names)

    def _compile(self, links: dict[str, ET.Element], above: dict[str | None, ET.Element], moved: Displaced) -> object:
        mjcf = ET.Element("mujoco")
        ET.SubElement(mjcf, "compiler", angle="radian", balanceinertia="true", inertiafromgeom="false")
        ET.SubElement(mjcf, "option", gravity="0 0 -9.81")
        bodies: dict[str, ET.Element] = {}
        level = moved(np.zeros(3), Rotation.identity())[1]  # a base that is not quite level
        bodies[self.root] = ET.SubElement(
            ET.SubElement(mjcf, "worldbody"), "body", name=self.root, quat=_quaternion(level)
        )
        waiting = list(above.values())
        while waiting:
            joint = waiting.pop(0)
            parent, child = joint.find("parent").get("link"), joint.find("child").get("link", "")  # type: ignore[union-attr]
            if parent not in bodies:
                waiting.append(joint)
                continue
            nominal = _origin(joint)
            xyz, rotation = moved(*nominal)
            bodies[child] = body = ET.SubElement(
                bodies[parent], "body", name=child, pos=_text(xyz), quat=_quaternion(rotation)
            )
            if (name := joint.get("name", "")) in self.names:
                axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
                axis /= np.linalg.norm(axis)
                x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
                along = nominal[0] if np.linalg.norm(nominal[0]) else np.array([0.0, 0.0, 1.0])
                growth = nominal[1].inv().apply(along / np.linalg.norm(along))
                kinds = (("/grow", "slide", growth), ("/tilt_x", "hinge", x / np.linalg.norm(x)))
                kinds += (("/tilt_y", "hinge", np.cross(axis, x / np.linalg.norm(x))),)  # type: ignore[assignment]
                kinds += (("", "slide" if joint.get("type") == "prismatic" else "hinge", axis),)  # type: ignore[assignment]
                for suffix, kind, direction in kinds:
                    ET.SubElement(body, "joint", name=name + suffix, type=kind, axis=_text(direction), limited="false")
        for name, body in bodies.items():
            if (inertial := links[name].find("inertial")) is not None:
                xyz, rotation = _origin(inertial)
                i = {k: float(v) for k, v in inertial.find("inertia").attrib.items()}  # type: ignore[union-attr]
                tensor = np.array(
                    [[i["ixx"], i["ixy"], i["ixz"]], [i["ixy"], i["iyy"], i["iyz"]], [i["ixz"], i["iyz"], i["izz"]]]
                )
                tensor = rotation.as_matrix() @ tensor @ rotation.as_matrix().T
                full = _text(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
                mass = inertial.find("mass").get("value", "0")  # type: ignore[union-attr]
                ET.SubElement(body, "inertial", pos=_text(xyz), mass=mass, fullinertia=full)
        load = ET.SubElement(bodies[self.tip], "body", name=PAYLOAD, pos="0 0 0.06")
        ET.SubElement(load, "inertial", pos="0 0 0", mass="1e-9", diaginertia="1e-9 1e-9 1e-9")
        return mujoco.MjModel.from_xml_string(ET.tostring(mjcf, encoding="unicode"))

    def carry(self, mass: float) -> None:
        """Hang a mass [kg] at the flange, as a ball of 10 cm diameter."""
        body = self._model.body(PAYLOAD).id
        self._model.body_mass[body], self._model.body_inertia[body] = mass + 1e-9, 1e-3 * mass + 1e-9
        mujoco.mj_setConst(self._model, self._data)

    def coordinates(self, q: Array) -> Array:
        """Coordinates (m, n, 4) of a stiff and perfect arm at joint positions (m, n)."""
        x = np.zeros((*q.shape, 4))
        x[..., TURN] = q
        return x

    def _place(self, x: Array) -> None:
        self._data.qpos[self._at] = x
        mujoco.mj_kinematics(self._model, self._data)

    def frames(self, x: Array) -> tuple[Array, Array]:
        """Origins (m, n + 1, 3) and axes (m, n + 1, 3, 3) of the links behind the joints, and last of the tip."""
        which = [*self._bodies, self._hand]
        p, R = np.empty((len(x), len(which), 3)), np.empty((len(x), len(which), 3, 3))
        for i, row in enumerate(x):
            self._place(row)
            p[i], R[i] = self._data.xpos[which], self._data.xmat[which].reshape(-1, 3, 3)
        return p, R

    def holding(self, x: Array) -> Array:
        """Force of each coordinate (m, n, 4) that holds the arm up at rest [N m; N for growth]."""
        force, out = np.empty(self._model.nv), np.empty_like(x)
        self._data.qvel[:] = 0.0
        for i, row in enumerate(x):
            self._place(row)
            mujoco.mj_comPos(self._model, self._data)
            mujoco.mj_comVel(self._model, self._data)
            mujoco.mj_rne(self._model, self._data, 0, force)
            out[i] = force[self._at]
        return out

    def driving(self, q: Array, v: Array, a: Array) -> Array:
        """Actuator torques (m, n) of a motion: gravity and inertia [N m]."""
        out, turn = np.empty_like(q), self._at[:, TURN]
        self._data.qpos[:], self._data.qvel[:], self._data.qacc[:] = 0.0, 0.0, 0.0
        for i in range(len(q)):
            self._data.qpos[turn], self._data.qvel[turn], self._data.qacc[turn] = q[i], v[i], a[i]
            mujoco.mj_inverse(self._model, self._data)
            out[i] = self._data.qfrc_inverse[turn]
        self._data.qvel[:] = 0.0
        return out

    def settle(self, x: Array, linear: Array, cubic: Array) -> Array:
        """Coordinates after springs of (n, 4) linear and cubic stiffness gave way; infinite stiffness gives nothing.

        The spring's torque equals gravity's at the posture that is reached, not at the one that was meant.
        """
        if not np.isfinite(linear).any():
            return x
        reached = x
        for _ in range(20):
            moved = x + deflection(-self.holding(reached), linear, cubic)
            change = np.abs(moved - reached).max()
            reached = moved
            if change < 1e-12:
                return reached
        raise ArithmeticError("springs too soft to hold the arm")


def deflection(force: Array, linear: Array, cubic: Array) -> Array:
    """The d at which linear·d + cubic·d³ is the force."""
    soft, out = np.isfinite(linear), np.zeros_like(force)
    k, c = linear[soft], cubic[soft]
    straight = force[..., soft] / k
    ratio = np.sqrt(3.0 * np.maximum(c, 1e-12) / k)
    bent = 2.0 / ratio * np.sinh(np.arcsinh(1.5 * straight * ratio) / 3.0)
    out[..., soft] = np.where(c > 0.0, bent, straight)
    return out
