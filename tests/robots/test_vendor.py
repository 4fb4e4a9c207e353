"""The makers' own forms hold what their own descriptions need to rebuild the corrected arm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from robots.test_kinematics import chain_of, urdf
from robots.test_urdf_write import by_hand

from modcal_core.errors import BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.makers import (
    from_ur_kinematics,
    kinematics_yaml_data,
    lacks_hash,
)
from modcal_core.robots.tables import from_table, from_ur_conf
from modcal_core.robots.urdf import joint_origins, read_chain
from modcal_core.robots.urdf_write import calibrated_urdf, chain_urdf

# default_kinematics.yaml of UR's description, as published for the UR10
UR10 = {
    "shoulder": (0, 0, 0.1273, 0, 0, 0),
    "upper_arm": (0, 0, 0, 1.570796327, 0, 0),
    "forearm": (-0.612, 0, 0, 0, 0, 0),
    "wrist_1": (-0.5723, 0, 0.163941, 0, 0, 0),
    "wrist_2": (0, -0.1157, 0, 1.570796327, 0, 0),
    "wrist_3": (0, 0.0922, 0, 1.570796326589793, 3.141592653589793, 3.141592653589793),
}


def pose(values: dict[str, float]) -> Array:
    x, y, z, roll, pitch, yaw = (values[key] for key in ("x", "y", "z", "roll", "pitch", "yaw"))
    return se3.transform(so3.from_rpy([roll, pitch, yaw]), [x, y, z])


def corrected(arm: str) -> tuple[Chain, str]:
    chain = chain_of(arm)
    xi = 1e-3 * np.random.default_rng(0).normal(size=(chain.n + 1, 6))
    text = calibrated_urdf(urdf(arm), chain, chain.with_origins(chain.origins @ se3.exp(xi)))
    return read_chain(text), text


def test_ur_defaults_are_the_published_ones() -> None:
    data = kinematics_yaml_data(chain_of("ur10"), joint_origins(urdf("ur10")))["kinematics"]
    assert list(data) == [*UR10]
    for link, values in UR10.items():
        keys = ("x", "y", "z", "roll", "pitch", "yaw")
        published = dict(zip(keys, values, strict=True))
        assert np.abs(pose(data[link]) - pose(published)).max() < 1e-9


def test_a_hash_is_the_arms_own() -> None:
    """None is invented; that of the maker's file is kept, with whatever else stands in it."""
    chain, text = corrected("ur10")
    origins = joint_origins(text)
    found = kinematics_yaml_data(chain, origins)
    assert lacks_hash(found)
    own = {
        link: dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), map(float, v), strict=True)) for link, v in UR10.items()
    }
    factory = {"kinematics": {**own, "hash": "calib_12788084448423163542"}, "mine": [1]}
    filled = kinematics_yaml_data(chain, origins, factory)
    assert list(filled) == ["kinematics", "mine"]
    assert filled["kinematics"] == {**found["kinematics"], "hash": "calib_12788084448423163542"}
    assert not lacks_hash(filled)
    assert not lacks_hash(kinematics_yaml_data(chain_of("panda")))


@pytest.mark.parametrize("factory", [3, {}, {"kinematics": 3}, {"kinematics": {"shoulder": {}}}, {"joint1": {}},
                                     {"kinematics": {link: {"x": "a"} for link in UR10}}])  # fmt: skip
def test_a_factory_file_of_something_else_is_refused(factory: Any) -> None:
    chain, text = corrected("ur10")
    with pytest.raises(BadTable, match="factory kinematics"):
        kinematics_yaml_data(chain, joint_origins(text), factory)


def other_layout(chain: Chain, rng: np.random.Generator) -> Chain:
    """The same arm with its base turned by right angles, its joints about other axes of other frames along them."""
    turns = [so3.exp(0.5 * np.pi * rng.integers(-1, 2) * axis) for axis in np.eye(3)[rng.integers(0, 3, chain.n + 1)]]
    shifts = [*(T_axis * rng.uniform(-0.1, 0.1) for T_axis in chain.axes), np.zeros(3)]
    frames = [se3.transform(R, p) for R, p in zip(turns, shifts, strict=True)]
    before = [se3.transform(so3.exp([0.0, 0.0, 0.5 * np.pi])), *map(se3.inverse, frames[:-1])]
    origins = np.stack([A @ M @ B for A, M, B in zip(before, chain.origins, frames, strict=True)])
    axes = np.stack([R.T @ axis for R, axis in zip(turns, chain.axes, strict=False)])
    return Chain.build(chain.names, origins, axes, base="base_link", tip="tool0")


def test_another_layout_of_the_same_arm_is_written_as_its_factory_lays_it_out(rng: np.random.Generator) -> None:
    factory = kinematics_yaml_data(chain_of("ur10"), joint_origins(urdf("ur10")))
    factory["kinematics"]["hash"] = "calib_1"
    for _ in range(10):
        xi = 1e-3 * rng.normal(size=(7, 6))
        xi[-1] = 0.0
        chain = other_layout(chain_of("ur10").with_origins(chain_of("ur10").origins @ se3.exp(xi)), rng)
        written = kinematics_yaml_data(chain, None, factory)
        assert written["kinematics"]["hash"] == "calib_1"
        again = from_table(written)
        q = rng.uniform(-3.0, 3.0, (20, 6))
        moved = chain_forward(chain, q) @ se3.inverse(chain_forward(chain, q[:1]))
        as_written = chain_forward(again, q) @ se3.inverse(chain_forward(again, q[:1]))
        back = se3.transform(so3.exp([0.0, 0.0, -0.5 * np.pi]))
        np.testing.assert_allclose(as_written, back @ moved @ se3.inverse(back), atol=1e-9)
        nominal = chain_forward(chain_of("ur10"), q)[:, :3, 3]
        assert np.linalg.norm(chain_forward(again, q)[:, :3, 3] - nominal, axis=1).max() < 0.02


def test_the_factory_file_of_another_arm_is_refused() -> None:
    other = {link: dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), v, strict=True)) for link, v in UR10.items()}
    other["wrist_1"]["x"] += 0.05
    chain, text = corrected("ur10")
    with pytest.raises(BadTable, match="factory kinematics: puts wrist_1_joint 5. mm and .* give the file of this arm"):
        kinematics_yaml_data(chain, joint_origins(text), {"kinematics": other})


@pytest.mark.slow
@pytest.mark.parametrize("prefix", ["panda_", "left_fer_", "fr3v2_"])
def test_franka(prefix: str) -> None:
    chain, text = corrected("panda")
    renamed = text.replace('joint name="panda_', f'joint name="{prefix}').replace('joint="panda_', f'joint="{prefix}')
    data = kinematics_yaml_data(read_chain(renamed), joint_origins(renamed))
    assert list(data) == [f"joint{k}" for k in range(1, 9)]  # joint 8 is fixed and leads to the flange
    for k in range(1, 9):
        assert list(data[f"joint{k}"]) == ["kinematic"]
        assert np.abs(pose(data[f"joint{k}"]["kinematic"]) - joint_origins(text)[f"panda_joint{k}"]).max() < 1e-15 * 4
    assert list(kinematics_yaml_data(chain)) == [f"joint{k}" for k in range(1, 8)]


@pytest.mark.parametrize("arm", ["xarm7", "iiwa14"])
def test_any_other_arm_by_joint_name(arm: str) -> None:
    chain, text = corrected(arm)
    data = kinematics_yaml_data(chain, joint_origins(text))
    assert tuple(data) == chain.names
    for name, values in data.items():
        assert np.abs(pose(values) - joint_origins(text)[name]).max() < 1e-15 * 4
    assert all(type(value) is float for values in data.values() for value in values.values())


# -- a controller's differences from its model ------------------------------------------------------------------------

DH_OF_UR10 = {
    "theta": [0.0] * 6,
    "d": [0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922],
    "a": [0.0, -0.612, -0.5723, 0.0, 0.0, 0.0],
    "alpha": [np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0],
}


def differences() -> dict[str, np.ndarray]:
    """A UR10 whose elbow and first wrist are tilted by 1.1 and 5.2 mrad: common normals hundreds of metres away."""
    turn, bent = np.array([1.6, 0.05]), np.array([1.1e-3, 5.2e-3])
    along = np.array([0.612, 0.5723]) * np.sin(turn) / np.sin(bent)
    out = {key: np.array([1e-5, 0.0, 0.0, 2e-5, -3e-5, 0.0]) for key in DH_OF_UR10}
    out["theta"][1:4] = turn[0], turn[1] - turn[0], -turn[1]
    out["a"][1:3] = np.array([0.612, 0.5723]) * (1.0 - np.cos(turn))
    out["d"][1:4] = along[0], along[1] - along[0], -along[1]
    out["alpha"][1:3] = bent
    return out


def test_a_controllers_file_is_the_arm_in_the_descriptions_frames() -> None:
    nominal = read_chain(urdf("ur10"))
    delta = differences()
    assert np.abs(delta["d"]).max() > 300.0
    conf = "".join(f"delta_{key} = [ {', '.join(map(str, row.tolist()))}]\n" for key, row in delta.items())
    conf = f"[mounting]\ncalibration_status = 2   # 2 == linearised\n{conf}joint_checksum = [ 0x1, 0x2]\n"
    chain = from_ur_conf(conf, nominal)
    values = {k: np.array(v) + delta[k] for k, v in DH_OF_UR10.items()}
    for q in np.random.default_rng(8).uniform(-2.0, 2.0, (5, 6)):
        rows = [dict(zip(values, row, strict=True)) for row in np.stack([*values.values()]).T]
        expected = np.diag([-1.0, -1.0, 1.0, 1.0]) @ by_hand({"convention": "dh", "joints": rows}, q)
        assert np.abs(chain_forward(chain, q) - expected).max() < 1e-9
    assert np.abs(chain.origins[:, :3, 3] - nominal.origins[:, :3, 3]).max() < 5e-3  # not hundreds of metres
    again = read_chain(chain_urdf(chain))
    table = kinematics_yaml_data(again)["kinematics"]
    assert abs(table["shoulder"]["yaw"]) < 1e-9, "the half turn is in the description's own joint"
    assert np.abs(from_ur_kinematics({"kinematics": table}).origins - chain.origins).max() < 1e-9
    with pytest.raises(BadTable, match="delta_d"):
        from_ur_conf(conf.replace("delta_d", "d"), nominal)
    with pytest.raises(BadTable, match="is of a UR; this arm has panda_joint1"):
        from_ur_conf(conf, read_chain(urdf("panda")))
