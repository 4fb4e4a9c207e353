"""What hangs on an arm beside its chain weighs where its own joints hold it: against MuJoCo, which reads the URDF itself."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from cells import samples_of

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.store import from_data, to_data
from modcal_core.effects.drivers import Drivers, NominalArm
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import PART, SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.robots.bodies import STANDARD_GRAVITY, gravity_columns, gravity_efforts, payload_wrench
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias
from modcal_nodes.cli.camera_input import arm_between

OTHER = ("right_1", "right_2")
LEFT = ("torso", "left_1", "left_2", "left_3", "left_4", "left_5")


def _joint(
    name: str, parent: str, child: str, xyz: str, axis: str, mass: float, more: str = "", kind: str = "revolute"
) -> str:
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>
      <axis xyz="{axis}"/><limit lower="-3" upper="3" effort="9" velocity="9"/>{more}</joint>
      <link name="{child}"><inertial><origin xyz="0.02 0.01 0.15"/><mass value="{mass}"/>
      <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


HUMANOID = (
    '<robot name="two_arms"><link name="world"/>'
    '<joint name="stand" type="fixed"><parent link="world"/><child link="hips"/><origin xyz="0 0 1" rpy="0.2 0.1 0.3"/></joint>'
    '<link name="hips"/>'
    + _joint("torso", "hips", "chest", "0 0 0.1", "0 1 0", 8.0)
    + _joint("left_1", "chest", "l1", "0 0.2 0.4", "0 1 0", 2.0)
    + _joint("left_2", "l1", "l2", "0 0 0.1", "1 0 0", 2.0)
    + _joint("left_3", "l2", "l3", "0 0 0.3", "0 0 1", 1.0)
    + _joint("left_4", "l3", "l4", "0 0 0.1", "0 1 0", 1.0)
    + _joint("left_5", "l4", "l5", "0 0 0.3", "1 0 0", 0.5)
    + _joint("right_1", "chest", "r1", "0 -0.2 0.4", "0 1 0", 4.0)
    + _joint("right_2", "r1", "r2", "0 0 0.3", "1 0 0", 6.0)
    + _joint("finger", "r2", "f", "0.1 0 0.3", "1 0 0", 0.5, '<mimic joint="right_2" multiplier="0.5" offset="0.1"/>')
    + "</robot>"
)  # fmt: skip


def torques(q: Array, other: Array, urdf: str = HUMANOID, asked: tuple[str, ...] = LEFT) -> Array:
    """What gravity does to the joints that are asked for, (N, n) [N m], by MuJoCo, at positions of all joints."""
    model = mujoco.MjModel.from_xml_string(urdf)
    model.opt.gravity[:] = 0.0, 0.0, -STANDARD_GRAVITY
    data = mujoco.MjData(model)
    out = np.empty((len(q), len(asked)))
    at = {model.joint(k).name: model.joint(k).qposadr[0] for k in range(model.njnt)}
    for row, here, there in zip(out, q, other, strict=True):
        for name, x in zip((*LEFT, *OTHER), (*here, *there), strict=True):
            data.qpos[at[name]] = x
        if "finger" in at:
            data.qpos[at["finger"]] = 0.5 * there[1] + 0.1
        mujoco.mj_forward(model, data)
        row[:] = [-data.qfrc_bias[model.joint(name).dofadr[0]] for name in asked]
    return out


def arm() -> tuple[Chain, Inertias]:
    chain = read_chain(HUMANOID, base="hips", tip="l5")
    return chain, read_inertias(HUMANOID, chain)


def recorded(chain: Chain, q: Array, T: Array, other: Array) -> Samples:
    """Samples, the other arm's joints beside them as recordings have them."""
    samples = samples_of(chain, q, T)
    tracks = tuple(
        SignalTrack(f"signal:/joint_states{PART}joint {name}", samples.stamps, other[:, [i]], "/joint_states")
        for i, name in enumerate(OTHER)
    )
    return replace(samples, signals=tracks)


@pytest.fixture
def postures(rng: np.random.Generator) -> tuple[Array, Array]:
    return rng.uniform(-1.2, 1.2, (160, 6)), rng.uniform(-1.5, 1.5, (160, 2))


def test_the_other_arm_weighs_where_it_is_recorded(postures: tuple[Array, Array]) -> None:
    q, other = postures
    chain, inertias = arm()
    around = Drivers(recorded(chain, q, chain_forward(chain, q), other), NominalArm(chain, inertias))
    found = np.stack([around.values(f"load:{name}") for name in LEFT], axis=1)
    np.testing.assert_allclose(found, torques(q, other), atol=1e-9)
    still = Drivers(samples_of(chain, q, chain_forward(chain, q)), NominalArm(chain, inertias))
    np.testing.assert_allclose(still.values("load:torso"), torques(q, 0.0 * other)[:, 0], atol=1e-9)


def test_a_payload_pulls_along_the_worlds_down(postures: tuple[Array, Array]) -> None:
    """Its torques are minus the slope of its height in the root, which the base is tilted against."""
    chain, inertias = arm()
    q = postures[0][:20]
    found = payload_wrench(chain, q, inertias.down)[:, 5].T
    for j in range(chain.n):
        d = np.zeros(chain.n)
        d[j] = 1e-6
        ends = chain_forward(chain, q + d)[:, :3, 3] - chain_forward(chain, q - d)[:, :3, 3]
        assert np.abs(found[:, j] - STANDARD_GRAVITY * (ends @ inertias.down) / 2e-6).max() < 1e-7
    assert inertias.down == pytest.approx(-(_tilted().T @ [0.0, 0.0, 1.0]))


def _tilted() -> Array:
    turns = (so3.exp([0.0, 0.0, 0.3]), so3.exp([0.0, 0.1, 0.0]), so3.exp([0.2, 0.0, 0.0]))
    return np.asarray(turns[0] @ turns[1] @ turns[2])


@pytest.mark.slow
def test_a_soft_torso_is_found_though_the_other_arm_moves(
    postures: tuple[Array, Array], rng: np.random.Generator
) -> None:
    q, other = postures
    chain, inertias = arm()
    bent = q.copy()
    bent[:, 0] += 1e-4 * torques(q, other)[:, 0]
    T = (
        se3.exp([1.0, 2.0, 0.3, 0.2, -0.4, 1.0])
        @ chain_forward(chain, bent)
        @ se3.exp([0.05, 0.03, 0.12, 0.2, 0.0, 0.3])
    )
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
    samples = recorded(chain, q, T, other)
    upright = replace(inertias, down=np.array([0.0, 0.0, -1.0]))  # and the cell file says what the description does not
    cell = Cell(gravity=tuple(9.81 * inertias.down))
    done = calibrate(samples, chain, np.random.default_rng(0), cell, inertias=upright)
    assert (
        done.report.size_mm("final").rms < 1.2 * np.sqrt(3.0) * 0.02
    )  # 80 poses were fitted with 36 values, which adds 7 %
    (found,) = done.scored.model.effects
    assert (found.family, found.place, found.driver) == ("compliance", "torso", "load:torso")
    assert found.values[0] == pytest.approx(1e-4, rel=0.02)
    kept = from_data(to_data(done.calibration))
    np.testing.assert_allclose(kept.predict(samples), done.calibration.predict(samples), atol=1e-12)
    assert np.linalg.norm(kept.predict(samples)[:, :3, 3] - T[:, :3, 3], axis=1).max() < 2e-4


COLUMN = (
    '<robot name="column"><link name="foot"/>'
    + _joint("lift", "foot", "carriage", "0 0 0.2", "0 0 1", 10.0, kind="prismatic")
    + _joint("shoulder", "carriage", "a1", "0.1 0 0.3", "0 0 1", 5.0)
    + _joint("upper", "a1", "a2", "0 0 0.2", "0 1 0", 5.0)
    + _joint("elbow", "a2", "a3", "0 0 0.5", "0 1 0", 4.0)
    + _joint("roll", "a3", "a4", "0 0 0.4", "0 0 1", 2.0)
    + _joint("pitch", "a4", "a5", "0 0 0.1", "0 1 0", 1.0)
    + "</robot>"
)


@pytest.mark.slow
def test_a_column_that_tilts_under_what_it_carries_is_named(rng: np.random.Generator) -> None:
    chain = read_chain(COLUMN, base="foot", tip="a5")
    q = np.column_stack([rng.uniform(-0.3, 0.3, 160), rng.uniform(-1.5, 1.5, (160, 5))])
    model = mujoco.MjModel.from_xml_string(COLUMN)
    data, moment = mujoco.MjData(model), np.zeros((160, 3))
    for row, posture in zip(moment, q, strict=True):
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        weights = -STANDARD_GRAVITY * model.body_mass[1:, None] * [0.0, 0.0, 1.0]
        row[:] = np.cross(data.xipos[1:] - [0.0, 0.0, 0.2], weights).sum(axis=0)  # about where the column stands
    tilt = se3.transform(so3.exp(5e-6 * moment * [1.0, 1.0, 0.0]))
    foot = se3.transform(p=np.array([0.0, 0.0, 0.2]))
    T = foot @ tilt @ se3.inverse(foot) @ chain_forward(chain, q)
    T = se3.exp([1.0, 2.0, 0.3, 0.2, -0.4, 1.0]) @ T @ se3.exp([0.05, 0.03, 0.12, 0.2, 0.0, 0.3])
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
    done = calibrate(
        samples_of(chain, q, T), chain, np.random.default_rng(0), Cell(), inertias=read_inertias(COLUMN, chain)
    )
    (found,) = done.scored.model.effects
    assert (found.family, found.place, found.driver) == ("compliance", "lift", "moment:lift")
    assert found.values[0] == pytest.approx(5e-6, rel=0.05)
    assert done.report.size_mm("final").rms < 1.2 * np.sqrt(3.0) * 0.02


def test_both_arms_as_one_chain_weigh_as_the_chest_between_them_holds_them() -> None:
    fingerless = HUMANOID[: HUMANOID.index('<joint name="finger"')] + "</robot>"
    robot, said = arm_between(fingerless, "r2", "l5", ())
    chain, inertias = robot.chain, robot.inertias
    assert said
    assert inertias is not None
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (20, chain.n))
    at = {name: q[:, chain.names.index(name)] for name in chain.names}
    still = np.zeros(len(q))
    here = np.stack([at.get(name, still) for name in LEFT], axis=1)
    there = np.stack([at[name] for name in OTHER], axis=1)
    wanted = -torques(here, there, fingerless, chain.names)
    assert np.abs(wanted).max() > 10.0
    efforts = gravity_efforts(chain, inertias, q)
    np.testing.assert_allclose(efforts, wanted, atol=1e-9)
    # by the masses and centres of the bodies, but for the base's, which hangs on the first joint as on a wall
    own, columns = gravity_columns(chain, inertias, q)
    bodies = np.concatenate([inertias.mass[:, None], inertias.mass[:, None] * inertias.com], axis=1)
    hung = replace(inertias, held=replace(inertias.held, mass=0.0) if inertias.held else None)
    np.testing.assert_allclose(own, efforts, atol=1e-12)
    np.testing.assert_allclose(columns @ bodies.ravel(), gravity_efforts(chain, hung, q), atol=1e-9)
