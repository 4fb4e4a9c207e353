"""The nearest DH table: exact where DH holds the arm, and honest about what it loses where it does not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from robots.test_kinematics import urdf
from robots.test_tables import PUBLISHED, table_of
from scipy.spatial.transform import Rotation

from modcal_core.errors import NotRepresentable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.dh import from_dh, to_dh
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.tables import nearest_dh
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_write import calibrated_urdf

HERE = {"xyz": [0.0] * 3, "rpy": [0.0] * 3}


def step(axis: str, angle: float, length: float) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    T["xyz".index(axis), 3] = length
    return T


def end(values: dict[str, list[float]]) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", values["rpy"]).as_matrix(), values["xyz"]
    return T


def by_hand(table: dict[str, Any], q: Array) -> Array:
    """The tip's pose by a table, multiplied out as textbooks do, without our chain."""
    T = end(table.get("base", HERE))
    for row, angle in zip(table["joints"], q, strict=True):
        z, x = step("z", row["theta"] + angle, row["d"]), step("x", row["alpha"], row["a"])
        T = T @ (z @ x if table["convention"] == "dh" else x @ z)
    return T @ end(table.get("tool", HERE))


def bent_ur10(angle: float) -> tuple[Chain, str]:
    """A UR10 whose links are displaced and turned in every direction, as a chain and as its URDF."""
    text = urdf("ur10")
    nominal = read_chain(text)
    rng = np.random.default_rng(2)
    xi = rng.normal(size=(nominal.n + 1, 6)) * ([3e-4] * 3 + [angle] * 3)
    bent = calibrated_urdf(text, nominal, nominal.with_origins(nominal.origins @ se3.exp(xi)))
    return read_chain(bent), bent


def test_an_arm_that_dh_holds_is_met() -> None:
    """Lengths, twists and zeros other than drawn, the parallel axes exactly parallel."""
    table = table_of("dh", PUBLISHED["ur10"][1])
    rng = np.random.default_rng(1)
    for row in table["joints"]:
        for key in ("theta", "d", "a"):
            row[key] += 1e-3 * rng.normal()
    for row in (table["joints"][0], *table["joints"][3:]):
        row["alpha"] += 1e-3 * rng.normal()
    found = nearest_dh(from_dh(table))
    assert found.largest < 1e-9
    assert found.angle < 1e-9
    assert found.parallel == (("j1", "j2"), ("j2", "j3"))


@pytest.mark.slow
@pytest.mark.parametrize("convention", ["dh", "mdh"])
def test_what_it_says_of_a_bent_arm_is_what_pinocchio_sees(convention: str) -> None:
    chain, text = bent_ur10(5e-4)
    with pytest.raises(NotRepresentable):
        to_dh(chain)
    found = nearest_dh(chain, convention)
    assert max(abs(row[key]) for row in found.table["joints"] for key in ("d", "a")) < 1.0
    model = pin.buildModelFromXML(text)
    data, tip = model.createData(), model.getFrameId("tool0")
    missed, nominal = [], []
    published = {"convention": "dh", "joints": table_of("dh", PUBLISHED["ur10"][1])["joints"]}
    drawn = {**to_dh(read_chain(urdf("ur10"))), "joints": published["joints"]}
    for q in np.random.default_rng(3).uniform(-np.pi, np.pi, (300, 6)):
        pin.framesForwardKinematics(model, data, q)
        true = data.oMf[tip].translation
        missed.append(np.linalg.norm(by_hand(found.table, q)[:3, 3] - true))
        nominal.append(np.linalg.norm(by_hand(drawn, q)[:3, 3] - true))
    rms = np.sqrt(np.mean(np.square(missed)))
    assert abs(rms - found.rms) < 0.1 * found.rms
    assert max(missed) < 1.1 * found.largest
    assert rms < 0.6 * np.sqrt(np.mean(np.square(nominal)))


@pytest.mark.slow
def test_it_is_nearest() -> None:
    """No small change of any length or angle of the table brings tip and tool nearer."""
    chain, _ = bent_ur10(5e-4)
    found = nearest_dh(chain)
    q = np.random.default_rng(4).uniform(-np.pi, np.pi, (150, 6))
    true = chain_forward(chain, q)

    def missed(table: dict[str, Any]) -> float:
        """RMS of the tip's distance and of what its turn moves at 0.2 m, the length of a tool."""
        off = np.array([by_hand(table, row) for row in q]) - true
        return float(
            np.mean(np.sum(off[:, :3, 3] ** 2, axis=1) + 0.5 * 0.2**2 * np.sum(off[:, :3, :3] ** 2, axis=(1, 2)))
        )

    best = missed(found.table)
    for k in range(6):
        for key in ("theta", "a", "alpha"):
            for sign in (-1.0, 1.0):
                other = {**found.table, "joints": [dict(row) for row in found.table["joints"]]}
                other["joints"][k][key] += sign * 5e-4
                assert missed(other) > best, (k, key)
