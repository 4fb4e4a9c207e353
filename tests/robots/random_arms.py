"""URDF texts of arms drawn by chance, which three parsers read each by itself: ours, Pinocchio's and MuJoCo's."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain

GRAVITY = 9.80665


def random_urdf(rng: np.random.Generator, joints: int = 6, sliding: float = 0.3, friction: bool = False) -> str:
    """A chain of links with any masses, fixed joints between some of them, axes anyhow."""

    out, parent = ['<robot name="anyhow"><link name="base_link"/>'], "base_link"
    for k in range(joints):
        if rng.random() < 0.3:
            out.append(_link(f"part_{k}", rng))
            out.append(
                f'<joint name="bolted_{k}" type="fixed"><origin xyz="{_text(rng.uniform(-0.2, 0.2, 3))}" '
                f'rpy="{_text(rng.uniform(-1.5, 1.5, 3))}"/><parent link="{parent}"/><child link="part_{k}"/></joint>'
            )
            parent = f"part_{k}"
        kind = "prismatic" if rng.random() < sliding else "revolute"
        dynamics = f'<dynamics damping="{rng.uniform(0, 3)!r}" friction="{rng.uniform(0, 4)!r}"/>' if friction else ""
        axis = rng.normal(size=3)
        out.append(_link(f"link_{k}", rng))
        out.append(
            f'<joint name="joint_{k}" type="{kind}"><origin xyz="{_text(rng.uniform(-0.4, 0.4, 3))}" '
            f'rpy="{_text(rng.uniform(-1.5, 1.5, 3))}"/><parent link="{parent}"/><child link="link_{k}"/>'
            f'<axis xyz="{_text(axis / np.linalg.norm(axis))}"/>'
            f'<limit lower="-2" upper="2" effort="{rng.uniform(300, 900)!r}" velocity="3"/>{dynamics}</joint>'
        )
        parent = f"link_{k}"
    return "".join(out) + "</robot>"


def _link(name: str, rng: np.random.Generator) -> str:
    mass, centre, six = random_body(rng)
    return inertial_link(name, mass, centre, rng.uniform(-1.0, 1.0, 3), six)


def random_body(rng: np.random.Generator) -> tuple[float, Array, list[float]]:
    """Mass, centre, and ixx iyy izz ixy ixz iyz of a few point masses: of something that can be."""
    points, masses = rng.uniform(-0.25, 0.25, (5, 3)), rng.uniform(0.2, 1.5, 5)
    centre = masses @ points / masses.sum()
    i = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points - centre, strict=True))
    return float(masses.sum()), centre, [float(i[at]) for at in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]


def inertial_link(name: str, mass: float, centre: Array, rpy: ArrayLike, six: list[float]) -> str:
    """URDF text of a link with such a body, described in axes turned by rpy."""
    values = " ".join(f'{key}="{v!r}"' for key, v in zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), six, strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="{_text(centre)}" rpy="{_text(rpy)}"/><mass value="{mass!r}"/>'
        f"<inertia {values}/></inertial></link>"
    )


def _text(values: ArrayLike) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values))


class Pinocchio:
    """Pinocchio's model of a chain's joints, all others locked at zero; arrays in the chain's order."""

    def __init__(self, text: str, chain: Chain) -> None:
        model = pin.buildModelFromXML(text)
        others = [i for i, name in enumerate(model.names) if i > 0 and name not in chain.names]
        self.model = pin.buildReducedModel(model, others, np.zeros(model.nq)) if others else model
        self.model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
        self.data = self.model.createData()
        assert [self.model.joints[self.model.getJointId(name)].idx_v for name in chain.names] == list(range(chain.n))

    def matrix(self, q: Array) -> Array:
        upper = np.triu(pin.crba(self.model, self.data, q))
        return upper + np.triu(upper, 1).T

    def torque(self, q: Array, v: Array, a: Array) -> Array:
        return np.array(pin.rnea(self.model, self.data, q, v, a))


class Mujoco:
    """MuJoCo's model of a URDF; arrays in the chain's order. Joints that are not the chain's stand at zero."""

    def __init__(self, text: str, chain: Chain) -> None:
        compiler = '<mujoco><compiler balanceinertia="false" discardvisual="false"/></mujoco>'
        self.model = mujoco.MjModel.from_xml_string(text.replace("</robot>", compiler + "</robot>"))
        self.model.opt.gravity = [0.0, 0.0, -GRAVITY]
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.data = mujoco.MjData(self.model)
        ids = [mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in chain.names]
        self.at = self.model.jnt_dofadr[ids]

    def matrix(self, q: Array) -> Array:
        self._place(q, 0.0 * q)
        full = np.empty((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, full)
        return full[np.ix_(self.at, self.at)]

    def torque(self, q: Array, v: Array, a: Array) -> Array:
        """M q̈ + C q̇ + g, friction left out."""
        self._place(q, v)
        acceleration = np.zeros(self.model.nv)
        acceleration[self.at] = a
        out = np.zeros(self.model.nv)
        mujoco.mj_mulM(self.model, self.data, out, acceleration)
        return (out + self.data.qfrc_bias)[self.at]

    def _place(self, q: Array, v: Array) -> None:
        self.data.qpos[:], self.data.qvel[:] = 0.0, 0.0
        self.data.qpos[self.at], self.data.qvel[self.at] = q, v
        mujoco.mj_forward(self.model, self.data)
