"""MJCF text: of a chain, the true arm as MuJoCo simulates it, and of an arm with joint servos that holds a handle.

What any simulated robot is to the cell around it: a tool that a tracker sees, a tracker, a payload, soft joints.

An arm in MuJoCo whose bodies are not where its drawing puts them, and that deflects where its joints are elastic.

The truth of a test must not come from the model under test: here it comes from another engine. Every body is displaced
and turned by a random amount in all six directions, which is not how modcal writes errors (four directions at a joint).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from html import escape

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots import STANDARD_GRAVITY, Chain, Inertias
from modcal_nodes.simulation.furniture import FOLDS_AT, Furniture

PAYLOAD = "payload"
NO_MASS = 1e-9  # kg and kg m²; MuJoCo moves no body without either


def quoted(value: str) -> str:
    """An attribute's value in XML. xml.sax.saxutils does the same and imports urllib, http and ssl for it."""
    return f'"{escape(value)}"'


def body_name(joint: str) -> str:
    """The MuJoCo body that moves with a joint."""
    return f"body_{joint}"


def mjcf(chain: Chain, origins: Array, T_tip_tool: Array, inertias: Inertias | None = None) -> str:
    """MJCF text of a chain with these constants: one body a joint, a payload at the tip, a site at the tool.

    Gravity is along −z of the base. inertias: masses of the bodies; a ball of 2 kg at every joint where none are known.
    """
    opening = [
        '<mujoco model="arm"><compiler angle="radian" autolimits="true" balanceinertia="true"/>'
        f'<option timestep="0.001" gravity="0 0 {-STANDARD_GRAVITY}"><flag contact="disable"/></option><worldbody>'
    ]
    for k, name in enumerate(chain.names):
        kind = "hinge" if chain.revolute[k] else "slide"
        opening.append(
            f"<body name={quoted(body_name(name))} {placed(origins[k])}>"
            f"<joint name={quoted(name)} type={quoted(kind)} axis={quoted(text(chain.axes[k]))}/>"
            + ('<geom type="sphere" size="0.03" mass="2"/>' if inertias is None else inertial(inertias, k))
        )
    mass = f'<inertial pos="0 0 0" mass="{NO_MASS}" diaginertia="{NO_MASS} {NO_MASS} {NO_MASS}"/>'
    payload = f"<body name={quoted(PAYLOAD)} {placed(origins[-1])}>{mass}</body>"
    site = f'<site name="tool" {placed(origins[-1] @ T_tip_tool)}/>'
    return "".join(opening) + payload + site + "</body>" * chain.n + "</worldbody></mujoco>"


def inertial(inertias: Inertias, k: int) -> str:
    """MJCF of what joint k carries by itself."""
    tensor = inertias.inertia[k] + NO_MASS * np.eye(3)
    full = text(tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    mass = max(float(inertias.mass[k]), NO_MASS)
    return f'<inertial pos="{text(inertias.com[k])}" mass="{mass:.17g}" fullinertia="{full}"/>'


def placed(T: Array) -> str:
    """MJCF attributes that put a body or a site at T (4, 4) [m]."""
    x, y, z, w = so3.to_quaternion(T[:3, :3])
    return f'pos="{text(T[:3, 3])}" quat="{text(np.array([w, x, y, z]))}"'


def text(values: Array) -> str:
    """Numbers as MJCF writes them, no digit lost."""
    return " ".join(f"{v:.17g}" for v in values)


OBJECT = "object_joint"
SECOND = "object_joint_2"  # the slide of a screw, the second hinge of a folding door
TIMESTEP = 1e-3  # s

_WIDEST = (np.radians(110.0), 0.6)  # where doors and drawers end [rad, m]
_HANDLE_MASS = 1e-3  # kg, so that the sensor behind it feels the grasp and nothing else
_SECOND_FRICTION = 4.0  # of a folding door, times that of the first hinge
_STIFF = 'solref="0.004 1" solimp="0.95 0.99 0.001"'  # of grasp, stops, couplings; 4 ms is as hard as 1 kHz allows
_GRASP_TURNING = 200.0  # N m/rad
_FINER, _SOFT = 4, 50e3  # times as many steps, and as hard a stop, where fingers are stiffer than that [N/m]
_FINGERS, _FINGERS_GYRATION, _GRASP_DAMPING = 0.15, 0.08, 0.3  # kg, m, share of critical

_STIFF_LIMIT = _STIFF.replace("solref", "solreflimit").replace("solimp", "solimplimit")


@dataclass(frozen=True)
class Servo:
    """Position servos of the joints: torque = stiffness (reference − position) − stiffness lag · velocity.

    stiffness: of the stronger joints [N m/rad]; those whose torque is limited below 20 N m have a quarter of it. lag_s:
    how far a steadily moving reference is ahead [s]. effort: limits of the torque (n,) [N m]; inf where there is none.
    integral_s: time in which an integral part adds as much again to a lead that stays [s]; 0 where there is none.
    cascaded: whether it sums up errors of speed, in a loop within that of position: no steady motion leaves any there.
    friction: dry, of each joint, as a number or (n,) [N m; N].
    """

    effort: Array
    stiffness: float = 4000.0
    lag_s: float = 0.03
    integral_s: float = 0.0
    cascaded: bool = False
    friction: ArrayLike = 0.1

    @property
    def gains(self) -> Array:
        """Stiffness of every joint (n,) [N m/rad]."""
        return np.where(self.effort < 20.0, 0.25, 1.0) * self.stiffness


def furniture_mjcf(chain: Chain, inertias: Inertias, servo: Servo, scene: Furniture) -> str:
    """MJCF text of the whole scene: gravity along −z of the arm's base, whose weight the servos need not carry.

    The grasp couples *sites*: that of the fingers, which sit on springs at the tool's origin, and the handle's. It, the
    stops and the coupling of a screw are as stiff as the time step allows. Sensors: ``force`` and ``torque`` of the
    wrist, at the tool; ``grasp_force`` and ``grasp_torque`` behind the handle.
    """
    bodies = _arm(chain, inertias, scene, servo) + _object(scene)
    step = TIMESTEP / (_FINER if scene.fingers > _SOFT else 1)
    text = (
        '<mujoco model="furniture"><compiler angle="radian" autolimits="true" balanceinertia="true"/>'
        f'<option timestep="{step}" gravity="0 0 {-STANDARD_GRAVITY}" integrator="implicitfast">'
        f'<flag contact="disable"/></option><worldbody>{bodies}</worldbody>'
        f"<actuator>{_servos(chain, servo)}</actuator><equality>{_couplings(scene)}</equality><sensor>"
        '<force name="force" site="tool"/><torque name="torque" site="tool"/>'
        '<force name="grasp_force" site="handle"/><torque name="grasp_torque" site="handle"/></sensor></mujoco>'
    )
    return text.replace('"0.004 1"', f'"{4.0 * step:g} 1"')


def _arm(chain: Chain, inertias: Inertias, scene: Furniture, servo: Servo) -> str:
    """Bodies of the arm, then of the tool, which hangs on the wrist by nothing but the sensor."""
    out, dry = [], [f'frictionloss="{f:.17g}"' for f in np.broadcast_to(servo.friction, chain.n)]
    for k, name in enumerate(chain.names):
        kind = "hinge" if chain.revolute[k] else "slide"
        limits = f'range="{chain.lower[k]:.17g} {chain.upper[k]:.17g}"' if np.isfinite(chain.lower[k]) else ""
        # what a motor's rotor adds through its gear, and the friction of bearings
        out.append(
            f'<body gravcomp="1" {placed(chain.origins[k])}><joint name={quoted(name)} type="{kind}" '
            f'axis="{text(chain.axes[k])}" armature="0.1" damping="0.5" {dry[k]} {limits}/>' + inertial(inertias, k)
        )
    rest = scene.tool_mass - _FINGERS
    tool = _inertial(rest, scene.tool_mass / rest * scene.tool_com, 0.03) + '<site name="tool"/>'
    out.append(f'<body gravcomp="1" {placed(chain.origins[-1])}>{tool}{_fingers(scene.fingers)}</body>')
    return "".join(out) + "</body>" * chain.n


def _fingers(grasp: float) -> str:
    joints = []
    for kind, stiffness, inertia in (
        ("slide", grasp, _FINGERS),
        ("hinge", _GRASP_TURNING, _FINGERS * _FINGERS_GYRATION**2),
    ):
        damping = 2.0 * _GRASP_DAMPING * np.sqrt(stiffness * inertia)
        joints += [
            f'<joint name="fingers_{kind}_{axis}" type="{kind}" axis="{text(direction)}" stiffness="{stiffness:.17g}" '
            f'damping="{damping:.17g}"/>'
            for axis, direction in zip("xyz", np.eye(3), strict=True)
        ]
    mass = _inertial(_FINGERS, np.zeros(3), _FINGERS_GYRATION)
    return f'<body gravcomp="1">{"".join(joints)}{mass}<site name="fingers"/></body>'


def _object(scene: Furniture) -> str:
    """The moving part, whose weight is balanced, and its handle."""
    at, reach = scene.point, scene.T_base_handle[:3, 3] - scene.point
    T_object_handle = se3.transform(scene.T_base_handle[:3, :3], reach)
    size = scene.radius if scene.turns else 0.3
    body = _inertial(scene.mass, 0.5 * reach if scene.turns else reach, size / np.sqrt(12.0))
    widest = FOLDS_AT if scene.kind == "folding" else _WIDEST[0 if scene.turns else 1]
    stop = widest if scene.stop < 0.0 else min(scene.stop, widest)
    first = _joint(OBJECT, scene, "hinge" if scene.turns else "slide", f"-0.0001 {max(stop, 1e-4):.17g}")
    handle = f'<body {placed(T_object_handle)}>{_inertial(_HANDLE_MASS, np.zeros(3), 0.02)}<site name="handle"/></body>'
    if scene.kind == "screw":
        first += f'<joint name="{SECOND}" type="slide" axis="{text(scene.axis)}"/>'
    if scene.kind == "folding":
        second = _joint(SECOND, scene, "hinge", f"-0.0001 {_WIDEST[0]:.17g}", _SECOND_FRICTION)
        T_half = se3.transform(np.eye(3), 0.5 * reach)
        light = _inertial(0.3 * scene.mass, 0.25 * reach, 0.5 * size / np.sqrt(12.0))
        T_half_handle = se3.transform(scene.T_base_handle[:3, :3], 0.5 * reach)
        handle = handle.replace(placed(T_object_handle), placed(T_half_handle))
        handle = f'<body gravcomp="1" {placed(T_half)}>{second}{light}{handle}</body>'
    return f'<body gravcomp="1" {placed(se3.transform(np.eye(3), at))}>{first}{body}{handle}</body>'


def _joint(name: str, scene: Furniture, kind: str, limits: str, resists: float = 1.0) -> str:
    return (
        f'<joint name="{name}" type="{kind}" axis="{text(scene.axis)}" frictionloss="{resists * scene.friction:.17g}" '
        f'damping="{scene.damping:.17g}" stiffness="{scene.spring:.17g}" range="{limits}" '
        f"{_STIFF_LIMIT}/>"
    )


def _servos(chain: Chain, servo: Servo) -> str:
    return "".join(
        f'<position joint={quoted(name)} kp="{gain:.17g}" kv="{servo.lag_s * gain:.17g}"'
        + (f' forcerange="{-limit:.17g} {limit:.17g}"/>' if np.isfinite(limit) else "/>")
        for name, gain, limit in zip(chain.names, servo.gains, servo.effort, strict=True)
    )


def _couplings(scene: Furniture) -> str:
    kind = "weld" if scene.grasp == "weld" else "connect"
    grasp = f'<{kind} name="grasp" site1="fingers" site2="handle" {_STIFF}/>'
    if scene.kind != "screw":
        return grasp
    return grasp + f'<joint joint1="{SECOND}" joint2="{OBJECT}" polycoef="0 {scene.pitch:.17g} 0 0 0" {_STIFF}/>'


def _inertial(mass: float, com: Array, gyration: float) -> str:
    about = mass * gyration**2
    return f'<inertial pos="{text(com)}" mass="{mass:.17g}" diaginertia="{about:.17g} {about:.17g} {about:.17g}"/>'


_SETTLED = 1e-12  # rad or m, the last step of a spring that has found its balance
_MAX_STEPS = 60


def tracker_and_tool(rng: np.random.Generator) -> tuple[Array, Array]:
    """(T_tracker_base, T_tip_tool), (4, 4): a tracker a few metres away, a tool a hand's length from the tip."""
    T_tracker_base = se3.transform(so3.exp(rng.normal(size=3)), rng.uniform(-3.0, 3.0, 3))
    return T_tracker_base, se3.transform(so3.exp(0.5 * rng.normal(size=3)), [0.06, -0.04, 0.15])


class Machine(ABC):
    """A MuJoCo robot with its tool, seen from a tracker.

    T_tracker_base: true pose [m]. compliance: of each joint [rad/(N m), or m/N where it slides], (n,). The true robot
    is private; :meth:`tool_in_tracker` is all a tracker shows.
    """

    def __init__(self, names: tuple[str, ...], xml: str, T_tracker_base: Array | None, compliance: ArrayLike) -> None:
        """names: of the joints. xml: MJCF text with a site "tool" and a body for the payload."""
        self.T_tracker_base = np.eye(4) if T_tracker_base is None else T_tracker_base
        self._T_tracker_base = self.T_tracker_base  # where the tracker stood at first
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self._names = names
        self._site = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, "tool")
        self._payload = self.model.body(PAYLOAD).id
        self._bump = np.eye(4)
        self.compliance = np.broadcast_to(np.asarray(compliance, dtype=float), (len(names),)).copy()
        self._elastic = bool(self.compliance.any())

    def tool_in_tracker(self, q: ArrayLike) -> Array:
        """True poses (..., 4, 4) of the tool in the tracker at joint positions q (..., n) [rad, m]."""
        return self.T_tracker_base @ self.tool_in_base(q)

    def tool_in_base(self, q: ArrayLike) -> Array:
        """True poses (..., 4, 4) of the tool in the base link, the joints at q (..., n) before springs deflect."""
        q = np.asarray(q, dtype=float)
        flat = q.reshape(-1, q.shape[-1])
        T = np.zeros((len(flat), 4, 4))
        T[:, 3, 3] = 1.0
        for i, posture in enumerate(flat):
            self._place(self._settled(posture) if self._elastic else posture)
            T[i, :3, :3] = self.data.site_xmat[self._site].reshape(3, 3)
            T[i, :3, 3] = self.data.site_xpos[self._site]
        return (T @ self._bump).reshape((*q.shape[:-1], 4, 4))

    def settle(self, q: ArrayLike) -> Array:
        """Where the joints come to rest (..., n) when they are sent to q (..., n): gravity and springs in balance.

        Raises BadRobot when the joints are too soft to hold the arm.
        """
        q = np.asarray(q, dtype=float)
        flat = q.reshape(-1, q.shape[-1])
        return np.array([self._settled(posture) for posture in flat]).reshape(q.shape)

    def holding(self, q: ArrayLike) -> Array:
        """Torques (..., n) that hold the arm up when it is sent to q (..., n) [N m; N where a joint slides]."""
        q = np.asarray(q, dtype=float)
        flat = q.reshape(-1, q.shape[-1])
        return np.array([self._held(self._settled(posture)).copy() for posture in flat]).reshape(q.shape)

    def carry(self, mass: float) -> None:
        """Hang a mass [kg] at the tip, a point at its origin."""
        here = self.data.qpos.copy()
        self.model.body_mass[self._payload] = mass + NO_MASS
        mujoco.mj_setConst(self.model, self.data)  # leaves every joint at zero, where closed chains are open
        self.data.qpos[:] = here

    def bump(self, move: ArrayLike, turn: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Displace the tool by move (3,) [m] and the rotation vector turn (3,) [rad], along the axes that it had.

        Always from where the tool was at first, so that zeros put it back.
        """
        self._bump = se3.transform(so3.exp(np.asarray(turn, dtype=float)), np.asarray(move, dtype=float))

    def move_tracker(self, move: ArrayLike) -> None:
        """Displace the tracker along its own axes (3,) [m] from where it stood at first."""
        back = se3.transform(np.eye(3), -np.asarray(move, dtype=float))
        self.T_tracker_base = back @ self._T_tracker_base

    def length(self, link: str) -> float:
        """How long a link is, from its joint to the next one [m]. Raises BadRobot for one that cannot grow."""
        raise BadRobot(f"link '{link}'", "belongs to a Delta, whose links do not grow", "leave warm_up_link empty")

    def grow(self, link: str, metres: float) -> None:
        """Make a link this much longer than it was at first [m], along the line from its joint to the next."""
        self.length(link)

    @abstractmethod
    def _place(self, q: Array) -> None:
        """Bring MuJoCo's robot to a posture (n,)."""

    @abstractmethod
    def _held(self, q: Array) -> Array:
        """What holds it there at rest, (n,); the array may be used again by the next call."""

    def _settled(self, q: Array) -> Array:
        """A spring's torque equals gravity's at the posture that is reached, not at the one that was meant."""
        if not self._elastic:
            return q
        reached = q
        for _ in range(_MAX_STEPS):
            moved = q - self.compliance * self._held(reached)
            step = np.abs(moved - reached).max()
            reached = moved
            if step < _SETTLED:
                return reached
        softest = self._names[int(np.argmax(self.compliance))]
        raise BadRobot(f"joint {softest}", "is too soft to hold the arm", "lower joint_compliance or the payload")


SHORTEST_LINK = 1e-3  # m; a shorter one has no direction to grow in


class World(Machine):
    """A serial arm. T_tracker_base, T_tip_tool: true poses [m]."""

    def __init__(
        self,
        nominal: Chain,
        rng: np.random.Generator,
        length_std: float = 5e-4,
        angle_std: float = 1e-3,
        T_tracker_base: Array | None = None,
        T_tip_tool: Array | None = None,
        inertias: Inertias | None = None,
        compliance: ArrayLike = 0.0,
    ) -> None:
        """Displace every body of the nominal arm by these standard deviations per axis [m, rad].

        inertias: of the bodies; where none are known, each is a ball of 2 kg. compliance: one number, or one a joint.
        """
        scale = np.array([length_std] * 3 + [angle_std] * 3)
        self.nominal = nominal
        tool = np.eye(4) if T_tip_tool is None else T_tip_tool
        origins = nominal.origins @ se3.exp(scale * rng.standard_normal((nominal.n + 1, 6)))
        known = inertias if inertias is not None and inertias.known else None
        super().__init__(nominal.names, mjcf(nominal, origins, tool, known), T_tracker_base, compliance)
        self._bodies = {
            link: self.model.body(body_name(j)).id for link, j in zip(nominal.links, nominal.names, strict=False)
        }
        self._at_rest = self.model.body_pos.copy()
        self._force = np.empty(nominal.n)

    def length(self, link: str) -> float:
        """How long a link is, from its joint to the next one [m]. Raises BadRobot for one that cannot grow."""
        if link not in self._bodies:
            raise BadRobot(f"link '{link}'", "does not belong to a joint", f"name one of {', '.join(self._bodies)}")
        length = float(np.linalg.norm(self._at_rest[self._bodies[link]]))
        if length < SHORTEST_LINK:
            raise BadRobot(f"link '{link}'", "has no length that can grow", "name a longer link")
        return length

    def grow(self, link: str, metres: float) -> None:
        """Make a link this much longer than it was at first [m], along the line from its joint to the next."""
        rest = self._at_rest[self._bodies[link]]
        self.model.body_pos[self._bodies[link]] = rest * (1.0 + metres / self.length(link))

    def _place(self, q: Array) -> None:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)

    def _held(self, q: Array) -> Array:
        """What MuJoCo's inverse dynamics asks for at rest; the array is used again by the next call."""
        self._place(q)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)
        mujoco.mj_rne(self.model, self.data, 0, self._force)
        return self._force
