"""Arms of all benches: MuJoCo's kinematics and statics of a URDF whose every body sits a little beside its place.

Nothing here comes from modcal. Each moving joint has four coordinates, in this order from the parent outwards: growth
of the parent link along its length, two tilts across the axis, and the turn itself. The first three are zero in a good
arm. A prismatic joint's turn is its travel [m].
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

Array = np.ndarray
Place = Callable[[Array, Rotation], tuple[Array, Rotation]]  # of a body beside its nominal place
FOLDER = Path(__file__).resolve().parents[1] / "examples" / "robots"
ROBOTS = {"ur10": "tool0", "panda": "panda_hand_tcp", "xarm7": "link_eef"}
DESCRIBED: dict[str, tuple[str, str]] = {}  # other arms: URDF and tip, by name
GROW, TILT_X, TILT_Y, TURN = range(4)
SHIFT, TWIST = 5e-4, 1e-3  # displacement of every body, per axis [m, rad]
PAYLOAD = "payload"


def displaced(rng: np.random.Generator, shift: float = SHIFT, twist: float = TWIST) -> Place:
    """Random displacement of bodies."""
    return lambda xyz, R: (xyz + rng.normal(0, shift, 3), R * Rotation.from_rotvec(rng.normal(0, twist, 3)))


def urdf_of(robot: str) -> tuple[str, str]:
    """The URDF of an arm, and its tip."""
    text = DESCRIBED.get(robot)
    return text or ((FOLDER / f"{robot}.urdf").read_text(encoding="utf-8"), ROBOTS[robot])


def _numbers(element: Any, key: str, default: str) -> Array:
    return np.array([float(v) for v in (default if element is None else element.get(key) or default).split()])


def _text(values: Any) -> str:
    return " ".join(f"{v:.17g}" for v in np.atleast_1d(values))


def _origin(element: Any) -> tuple[Array, Rotation]:
    origin = element.find("origin")
    return _numbers(origin, "xyz", "0 0 0"), Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0"))


class Arm:
    """One arm: its joints by name, tip poses, gravity torques and what elastic parts do under them.

    place: of its bodies; None: as they are drawn. bare: no base that is not quite level, and the bodies of the chain
    alone. range: (2, n), the part of the joints' ranges that is used.
    """

    def __init__(self, urdf: str, tip: str, place: Place | None = None, bare: bool = False) -> None:
        self.urdf, self.tip = urdf, tip
        tree: Any = ET.fromstring(urdf)
        above = {e.find("child").get("link"): e for e in tree.findall("joint")}
        path, link = [], tip
        while link in above:
            path.insert(0, above[link])
            link = above[link].find("parent").get("link")
        self.root, moving = link, [e for e in path if e.get("type") in ("revolute", "continuous", "prismatic")]
        self.names, self.n = tuple(e.get("name", "") for e in moving), len(moving)
        self.links, self.parents = (tuple(e.find(end).get("link") for e in moving) for end in ("child", "parent"))
        self.hand = tuple(e.find("child").get("link") for e in path[path.index(moving[-1]) :])
        bounds = np.array([[_numbers(e.find("limit"), key, "0")[0] for key in ("lower", "upper")] for e in moving])
        half = np.minimum(1.8, 0.47 * np.ptp(bounds, axis=1))
        self.limits, self.range = bounds.T, bounds.mean(axis=1) + np.array([[-1.0], [1.0]]) * half
        # what a link's growth moves: the origin of the next joint, along the line to it
        self.lengths = np.array([np.linalg.norm(_origin(e)[0]) for e in moving])
        inertials = {e.get("name"): e.find("inertial") for e in tree.findall("link")}
        mjcf = self._mjcf(path if bare else list(above.values()), inertials, place or (lambda xyz, R: (xyz, R)), bare)
        self.model = mujoco.MjModel.from_xml_string(ET.tostring(mjcf, encoding="unicode"))
        self._data = mujoco.MjData(self.model)
        coordinates = [[f"{n}/grow", f"{n}/tilt_x", f"{n}/tilt_y", n] for n in self.names]
        self._at = np.array([[self.model.joint(c).qposadr[0] for c in row] for row in coordinates])
        self._bodies = [self.model.body(name).id for name in (*self.links, tip)]

    @classmethod
    def of(cls, robot: str, rng: np.random.Generator | None = None, shift: float = SHIFT, twist: float = TWIST) -> Arm:
        """An arm by its name; as it is drawn without rng."""
        return cls(*urdf_of(robot), None if rng is None else displaced(rng, shift, twist))

    def _mjcf(self, joints: list[Any], inertials: dict[Any, Any], place: Place, bare: bool) -> ET.Element:
        mjcf = ET.Element("mujoco")
        ET.SubElement(mjcf, "compiler", angle="radian", balanceinertia="true", inertiafromgeom="false")
        ET.SubElement(mjcf, "option", gravity="0 0 -9.81")
        bodies: dict[Any, ET.Element] = {}

        def add(name: str, parent: ET.Element, xyz: Array, R: Rotation) -> ET.Element:
            turn = _text(np.roll(R.as_quat(), 1))
            bodies[name] = ET.SubElement(parent, "body", name=name, pos=_text(xyz), quat=turn)
            return bodies[name]

        nowhere = np.zeros(3), Rotation.identity()
        level = Rotation.identity() if bare else place(*nowhere)[1]  # a base that is not quite level
        add(self.root, ET.SubElement(mjcf, "worldbody"), nowhere[0], level)
        while joints:
            joint, *joints = joints
            parent, child = joint.find("parent").get("link"), joint.find("child").get("link")
            if parent not in bodies:
                joints.append(joint)
                continue
            nominal, name = _origin(joint), joint.get("name")
            body = add(child, bodies[parent], *place(*nominal))
            if name in self.names:
                axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
                axis /= np.linalg.norm(axis)
                x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
                x /= np.linalg.norm(x)
                along = nominal[0] if np.linalg.norm(nominal[0]) else np.array([0.0, 0.0, 1.0])
                growth = nominal[1].inv().apply(along / np.linalg.norm(along))
                turn = "slide" if joint.get("type") == "prismatic" else "hinge"
                kinds = ("/grow", "slide", growth), ("/tilt_x", "hinge", x), ("/tilt_y", "hinge", np.cross(axis, x))
                for suffix, kind, way in (*kinds, ("", turn, axis)):
                    ET.SubElement(body, "joint", name=name + suffix, type=kind, axis=_text(way), limited="false")
        for name, body in bodies.items():
            if (inertial := inertials[name]) is not None:
                xyz, R = _origin(inertial)
                six = [float(inertial.find("inertia").get(k)) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")]
                tensor = R.as_matrix() @ np.array(six)[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]] @ R.as_matrix().T
                full = _text(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
                mass = inertial.find("mass").get("value", "0")
                ET.SubElement(body, "inertial", pos=_text(xyz), mass=mass, fullinertia=full)
        load = ET.SubElement(bodies[self.tip], "body", name=PAYLOAD, pos="0 0 0.06")
        ET.SubElement(load, "inertial", pos="0 0 0", mass="1e-9", diaginertia="1e-9 1e-9 1e-9")
        return mjcf

    def carry(self, mass: float, at: Array | None = None) -> None:
        """Hang a mass [kg] at the flange, as a ball of 10 cm diameter. at: where, from now on, in the tip (3,) [m]."""
        body = self.model.body(PAYLOAD).id
        self.model.body_mass[body], self.model.body_inertia[body] = mass + 1e-9, 1e-3 * mass + 1e-9
        if at is not None:
            self.model.body_pos[body] = at
        mujoco.mj_setConst(self.model, self._data)

    def coordinates(self, q: Array) -> Array:
        """Coordinates (m, n, 4) of a stiff and perfect arm at joint positions (m, n)."""
        x = np.zeros((*q.shape, 4))
        x[..., TURN] = q
        return x

    def _place(self, x: Array) -> None:
        self._data.qpos[self._at] = x
        mujoco.mj_kinematics(self.model, self._data)

    def frames(self, x: Array) -> tuple[Array, Array]:
        """Origins (m, n + 1, 3) and axes (m, n + 1, 3, 3) of the links behind the joints, and last of the tip."""
        k = self.n + 1
        p, R = np.empty((len(x), k, 3)), np.empty((len(x), k, 3, 3))
        for i, row in enumerate(x):
            self._place(row)
            p[i], R[i] = self._data.xpos[self._bodies], self._data.xmat[self._bodies].reshape(-1, 3, 3)
        return p, R

    def centres(self, q: Array) -> Array:
        """The arm's centre of mass in its base (m, 3)."""
        out = np.empty((len(q), 3))
        for i, row in enumerate(self.coordinates(q)):
            self._place(row)
            mujoco.mj_comPos(self.model, self._data)
            out[i] = self._data.subtree_com[1]
        return out

    def holding(self, x: Array) -> Array:
        """Force of each coordinate (m, n, 4) that holds the arm up at rest [N m; N for growth]."""
        force, out = np.empty(self.model.nv), np.empty_like(x)
        self._data.qvel[:] = 0.0
        for i, row in enumerate(x):
            self._place(row)
            mujoco.mj_comPos(self.model, self._data)
            mujoco.mj_comVel(self.model, self._data)
            mujoco.mj_rne(self.model, self._data, 0, force)
            out[i] = force[self._at]
        return out

    def loads(self, q: Array) -> Array:
        """Torque of each coordinate that holds the arm up at joint positions (m, n), (m, n, 4)."""
        return self.holding(self.coordinates(q))

    def driving(self, q: Array, v: Array, a: Array) -> Array:
        """Actuator torques (m, n) of a motion: gravity and inertia [N m]."""
        out, turn, data = np.empty_like(q), self._at[:, TURN], self._data
        data.qpos[:], data.qvel[:], data.qacc[:] = 0.0, 0.0, 0.0
        for i in range(len(q)):
            data.qpos[turn], data.qvel[turn], data.qacc[turn] = q[i], v[i], a[i]
            mujoco.mj_inverse(self.model, data)
            out[i] = data.qfrc_inverse[turn]
        data.qvel[:] = 0.0
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

    def tool(self, q: Array, point: Array) -> tuple[Array, Array]:
        """Where a point of the tip is at joints (m, n), (m, 3), and how the tip is turned (m, 3, 3)."""
        p, R = self.frames(self.coordinates(q))
        return p[:, -1] + R[:, -1] @ point, R[:, -1]

    def reaching(self, q: Array, point: Array, goals: Array, turned: Array | None = None) -> tuple[Array, Array]:
        """Joints (m, n) near q that bring a point of the tip to goals (m, 3), and which of them do so, (m,).

        turned: (m, 3, 3) of the tip, where that is asked.
        """
        apart, q = 1e-6 * np.eye(self.n), q.copy()
        done = np.zeros(len(q), bool)
        for _ in range(15):
            k = np.flatnonzero(~done)
            p, R = self.tool((q[k, None] + np.r_[0.0 * apart[:1], apart]).reshape(-1, self.n), point)
            p, R = p.reshape(len(k), -1, 3), R.reshape(len(k), -1, 3, 3)
            gap, J = goals[k] - p[:, 0], np.swapaxes(p[:, 1:] - p[:, :1], 1, 2) / 1e-6
            if turned is not None:
                back = np.swapaxes(R[:, 0], 1, 2)
                turns = [Rotation.from_matrix(M @ back).as_rotvec() for M in (turned[k], *np.swapaxes(R[:, 1:], 0, 1))]
                gap = np.concatenate([gap, turns[0]], axis=1)
                J = np.concatenate([J, np.stack(turns[1:], axis=2) / 1e-6], axis=1)
            near = np.abs(gap).max(axis=1) < 1e-9
            done[k[near]] = True
            if done.all():
                break
            back = np.swapaxes(J, 1, 2)
            step = (back @ np.linalg.solve(J @ back + 1e-8 * np.eye(J.shape[1]), gap[..., None]))[..., 0]
            step[near] = 0.0
            q[k] += step * np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
        return q, done


def deflection(force: Array, linear: Array, cubic: Array) -> Array:
    """The d at which linear·d + cubic·d³ is the force."""
    soft, out = np.isfinite(linear), np.zeros_like(force)
    k, c = linear[soft], cubic[soft]
    straight = force[..., soft] / k
    ratio = np.sqrt(3.0 * np.maximum(c, 1e-12) / k)
    bent = 2.0 / ratio * np.sinh(np.arcsinh(1.5 * straight * ratio) / 3.0)
    out[..., soft] = np.where(c > 0.0, bent, straight)
    return out


@dataclass(frozen=True)
class Joint:
    """A joint as a drawing has it. xyz, rpy: of its frame in the one before; mass: of the link that it moves [kg].

    low, high: the part of its range that is used.
    """

    name: str
    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    axis: tuple[float, float, float]
    low: float
    high: float
    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slides: bool = False


def link(name: str, mass: float = 0.0, com: str = "0 0 0") -> str:
    """A link, with a mass [kg] at a point [m] if it has any, as URDF."""
    i = f'<inertia ixx="{0.01 * mass}" ixy="0" ixz="0" iyy="{0.01 * mass}" iyz="0" izz="{0.01 * mass}"/>'
    inside = f'<inertial><origin xyz="{com}" rpy="0 0 0"/><mass value="{mass}"/>{i}</inertial>' if mass else ""
    return f'<link name="{name}">{inside}</link>'


def joint(name: str, between: str, kind: str = "fixed", xyz: str = "0 0 0", rpy: str = "0 0 0", axis: str = "") -> str:
    """A joint as URDF. between: its two links; axis: and its limits behind it, of one that moves."""
    parent, child = between.split()
    *way, low, high = axis.split() or ("", "")
    limit = f'<axis xyz="{" ".join(way)}"/><limit lower="{low}" upper="{high}" effort="200" velocity="3"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit if axis else ""}</joint>'


def described(joints: tuple[Joint, ...], room: float = 4.0, flange: str = "0 0 0") -> str:
    """A URDF of these joints: link_0, link_1, ... and tool0 at the end. room: of limits beyond what is used."""
    lines = ['<robot name="arm">', link("link_0")]
    for i, j in enumerate(joints, 1):
        kind = "prismatic" if j.slides else "revolute"
        lines.append(link(f"link_{i}", j.mass, _text(j.com)))
        way = f"{_text(j.axis)} {j.low - room} {j.high + room}"
        lines.append(joint(j.name, f"link_{i - 1} link_{i}", kind, _text(j.xyz), _text(j.rpy), way))
    last = joint("flange", f"link_{len(joints)} tool0", xyz=flange)
    return "\n".join([*lines, link("tool0"), last, "</robot>"])


def standing(robot: str, parts: Callable[[str], list[str]]) -> tuple[str, str]:
    """The URDF of an arm that stands on other parts, made by the name of its root, and its tip."""
    text, tip = urdf_of(robot)
    children = set(re.findall(r'<child link="([^"]*)"', text))
    root = next(name for name in re.findall(r'<link name="([^"]*)"', text) if name not in children)
    return text.replace("</robot>", "\n".join([*parts(root), "</robot>"])), tip
