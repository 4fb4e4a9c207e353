"""DH, modified DH and CPC tables: round trips, and a refusal where DH cannot say it."""

from __future__ import annotations

import numpy as np
import pytest
from cells import slider_arm, ur10
from robots.test_kinematics import ARMS, chain_of

from modcal_core.errors import BadTable, NotRepresentable
from modcal_core.geometry import se3
from modcal_core.robots.chain import Chain
from modcal_core.robots.cpc import CpcTable, from_cpc, to_cpc
from modcal_core.robots.dh import from_dh, to_chain, to_dh
from modcal_core.robots.kinematics import forward

EVERY = [*ARMS, "sliders"]


def same_motion(a: Chain, b: Chain, tolerance: float) -> None:
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (50, a.n))
    assert np.abs(forward(a, q) - forward(b, q)).max() < tolerance


@pytest.mark.parametrize("arm", EVERY)
@pytest.mark.parametrize("modified", [False, True])
def test_dh_round_trip(arm: str, modified: bool) -> None:
    chain = chain_of(arm)
    same_motion(to_chain(to_dh(chain, modified)), chain, 1e-9)


def test_published_tables_are_read() -> None:
    """The UR10 by its classical table, the Panda by its modified one, against their URDFs."""
    half = np.pi / 2
    rows = [[0, 0.1273, 0, half], [0, 0, -0.612, 0], [0, 0, -0.5723, 0], [0, 0.163941, 0, half], [0, 0.1157, 0, -half],
            [0, 0.0922, 0, 0]]  # fmt: skip
    same_motion(from_dh(ur10().names, rows), ur10(), 1e-12)
    panda = [[0, 0.333, 0, 0], [0, 0, 0, -half], [0, 0.316, 0, half], [0, 0, 0.0825, half], [0, 0.384, -0.0825, -half],
             [0, 0, 0, half], [0, 0, 0.088, half]]  # fmt: skip
    chain = chain_of("panda")
    T_tool = chain.origins[-1]
    same_motion(from_dh(chain.names, panda, T_tool=T_tool, modified=True), chain, 1e-12)


def test_exported_tables_are_the_published_ones() -> None:
    rows = to_dh(ur10()).rows
    assert np.abs(np.abs(rows[:5, 2]) - [0, 0.612, 0.5723, 0, 0]).max() < 1e-12
    assert np.abs(np.cos(rows[:5, 3]) - [0, 1, 1, 0, 0]).max() < 1e-12


@pytest.mark.parametrize("modified", [False, True])
def test_nearly_parallel_axes_are_refused_by_dh_and_taken_by_cpc(modified: bool) -> None:
    origins = np.array(ur10().origins)
    origins[2] = origins[2] @ se3.exp([0, 0.002, 0, 0.0, 1e-5, 0])
    bent = ur10().with_origins(origins)
    with pytest.raises(NotRepresentable, match="shoulder_lift_joint and elbow_joint: axes are 0.0006° from parallel"):
        to_dh(bent, modified)
    same_motion(from_cpc(to_cpc(bent)), bent, 1e-12)


@pytest.mark.parametrize("arm", EVERY)
def test_cpc_round_trip(arm: str) -> None:
    chain = chain_of(arm)
    table = to_cpc(chain)
    same_motion(from_cpc(table), chain, 1e-12)
    inner = table.links[:-1]
    assert not inner[:, 2].any()
    assert not inner[table.revolute, 5].any()


def test_cpc_is_continuous_where_dh_jumps() -> None:
    """Bending an axis by 1e-6 changes the table by about that, through parallel."""
    tables = []
    for angle in (-1e-6, 0.0, 1e-6):
        origins = np.array(ur10().origins)
        origins[2] = origins[2] @ se3.exp([0, 0, 0, angle, 0, 0])
        tables.append(to_cpc(ur10().with_origins(origins)).links)
    assert np.abs(tables[1] - tables[0]).max() < 2e-6
    assert np.abs(tables[2] - tables[1]).max() < 2e-6


def test_wrong_tables_are_refused() -> None:
    with pytest.raises(BadTable, match="needs 2 rows"):
        from_dh(["a", "b"], [[0, 0, 0, 0]])
    with pytest.raises(BadTable, match="finite"):
        from_dh(["a"], [[0, np.nan, 0, 0]])
    good = to_cpc(slider_arm())
    with pytest.raises(BadTable, match="above 1"):
        from_cpc(CpcTable(good.names, good.links + 1.0, good.direction, good.revolute))
