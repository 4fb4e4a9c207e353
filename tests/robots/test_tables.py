"""DH, modified DH and CPC tables: the makers' own figures, round trips, and a refusal where DH cannot say it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from cells import ur10
from robots.test_kinematics import ARMS, urdf

from modcal_core.errors import BadTable, NotRepresentable
from modcal_core.geometry import se3
from modcal_core.robots.chain import Chain
from modcal_core.robots.dh import from_dh, from_mdh, to_dh, to_mdh
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.tables import from_cpc, from_table, to_cpc
from modcal_core.robots.urdf import read_chain

WRITERS = {"dh": to_dh, "mdh": to_mdh, "cpc": to_cpc}
H = np.pi / 2
# theta, d, a, alpha as the makers publish them. UR10 classical; the others modified (d of the last row is the flange),
# iiwa classical by its four lengths.
PUBLISHED: dict[str, tuple[str, list[tuple[float, float, float, float]]]] = {
    "ur10": (
        "dh",
        [(0, 0.1273, 0, H), (0, 0, -0.612, 0), (0, 0, -0.5723, 0), (0, 0.163941, 0, H), (0, 0.1157, 0, -H), (0, 0.0922, 0, 0)],
    ),
    "panda": (
        "mdh",
        [(0, 0.333, 0, 0), (0, 0, 0, -H), (0, 0.316, 0, H), (0, 0, 0.0825, H), (0, 0.384, -0.0825, -H), (0, 0, 0, H), (0, 0.107, 0.088, H)],
    ),
    "xarm7": (
        "mdh",
        [(0, 0.267, 0, 0), (0, 0, 0, -H), (0, 0.293, 0, H), (0, 0, 0.0525, H), (0, 0.3425, 0.0775, H), (0, 0, 0, H), (0, 0.097, 0.076, -H)],
    ),
    "iiwa14": (
        "dh",
        [(0, 0.36, 0, -H), (0, 0, 0, H), (0, 0.42, 0, H), (0, 0, 0, -H), (0, 0.4, 0, -H), (0, 0, 0, H), (0, 0.126, 0, 0)],
    ),
}  # fmt: skip
ENDS = {"ur10": ("base_link_inertia", "tool0"), "panda": ("panda_link0", "panda_link8"),
        "xarm7": ("link_base", "link_eef"), "iiwa14": ("iiwa_link_0", "iiwa_link_ee")}  # fmt: skip


def table_of(convention: str, rows: list[tuple[float, float, float, float]]) -> dict[str, Any]:
    keys = ("theta", "d", "a", "alpha")
    joints = [{"name": f"j{k}", **dict(zip(keys, row, strict=True))} for k, row in enumerate(rows)]
    return {"convention": convention, "joints": joints}


def assert_same(a: Chain, b: Chain, tolerance: float) -> None:
    assert a.revolute.tolist() == b.revolute.tolist()
    q = np.random.default_rng(0).uniform(-2.5, 2.5, (50, a.n))
    assert np.abs(chain_forward(a, q) - chain_forward(b, q)).max() < tolerance


def random_chain(rng: np.random.Generator, kind: str) -> Chain:
    """Up to eight joints, three in ten sliding: anyhow, along coordinate axes, or within 0.1 mrad of parallel."""
    n = int(rng.integers(1, 9))
    axes = np.eye(3)[rng.integers(0, 3, n)] * rng.choice([-1.0, 1.0], (n, 1))
    turns = rng.integers(-2, 3, (n + 1, 3)) * H
    if kind == "any":
        axes, turns = rng.normal(size=(n, 3)), rng.uniform(-2.0, 2.0, (n + 1, 3))
    if kind == "nearly parallel":
        axes, turns = np.tile(axes[0], (n, 1)), 1e-4 * rng.normal(size=(n + 1, 3))
    origins = se3.exp(np.c_[np.zeros((n + 1, 3)), turns])
    origins[:, :3, 3] = rng.uniform(-0.5, 0.5, (n + 1, 3))
    return Chain.build([f"j{k}" for k in range(n)], origins, axes, rng.random(n) < 0.7)


@pytest.mark.parametrize("arm", ARMS)
def test_exported_tables_are_the_published_ones(arm: str) -> None:
    convention, rows = PUBLISHED[arm]
    base, tip = ENDS[arm]
    table = WRITERS[convention](read_chain(urdf(arm), base, tip))
    exported = [[joint[key] for key in ("theta", "d", "a", "alpha")] for joint in table["joints"]]
    assert np.abs(np.array(exported) - rows).max() < 1e-12
    for pose in (table["base"], table["tool"]):
        assert np.abs([*pose["xyz"], *pose["rpy"]]).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["any", "coordinate axes", "nearly parallel"])
def test_round_trip_of_anything(kind: str, rng: np.random.Generator) -> None:
    refused = 0
    for _ in range(150):
        chain = random_chain(rng, kind)
        assert_same(from_cpc(to_cpc(chain)), chain, 1e-12)
        for write in (to_dh, to_mdh):
            try:
                table = write(chain)
            except NotRepresentable:
                refused += 1
                continue
            assert_same(from_table(table), chain, 1e-9)
    assert (refused > 0) == (kind == "nearly parallel")


def bend(angle: float) -> Chain:
    """The UR10 with its elbow's axis turned across the upper arm."""
    origins = np.array(ur10().origins)
    origins[2] = origins[2] @ se3.exp([0, 0, 0, 0, angle, 0])
    return ur10().with_origins(origins)


def test_cpc_passes_smoothly_through_parallel() -> None:
    """Bending an axis by an angle changes the table by that much, where DH needs another table altogether."""

    def numbers(angle: float) -> np.ndarray:
        return np.array([[*joint["b"], *joint["l"]] for joint in to_cpc(bend(angle))["joints"]])

    for angle in (-1e-3, -1e-9, 1e-12, 1e-9, 1e-6, 1e-3):
        assert np.abs(numbers(angle) - numbers(0.0)).max() <= 1.0001 * abs(angle) + 1e-15


def test_cpc_with_an_axis_pointing_back() -> None:
    origins = np.array(ur10().origins)
    origins[2] = origins[2] @ se3.exp([0, 0, 0, np.pi - 1e-7, 0, 0])
    chain = ur10().with_origins(origins)
    table = to_cpc(chain)
    assert [bool(joint.get("reversed")) for joint in table["joints"]] == [False, False, True, True, False, False]
    assert_same(from_cpc(table), chain, 1e-12)


def test_what_is_left_out_is_zero() -> None:
    chain = from_dh({"joints": [{"name": "a", "d": 0.5}, {"name": "b", "type": "prismatic", "lower": -0.1}]})
    assert chain_forward(chain, [[0.3, 0.2]])[0, 2, 3] == pytest.approx(0.7)
    assert chain.lower.tolist() == [-np.inf, -0.1]
    assert not chain.revolute[1]


GOOD = {"joints": [{"name": "a", "b": [0, 0, 1]}]}
WRONG: dict[str, tuple[Callable[[Any], Chain], Any]] = {
    "row 1: needs a name of its own": (from_dh, {"joints": [{"d": 1.0}, {"name": "b"}]}),
    "row 2: needs a name of its own": (from_mdh, {"joints": [{"name": "a"}, {"name": "a"}]}),
    "entry 1: unknown key aplha; known are a, alpha, d": (from_dh, {"joints": [{"name": "a", "aplha": 1.0}]}),
    "entry 1: theta: '90°' is not a finite number": (from_dh, {"joints": [{"name": "a", "theta": "90°"}]}),
    "its convention is 'mdh': read it as mdh": (from_dh, {"convention": "mdh", **GOOD}),
    "base: xyz: it has 2 entries, 3 are allowed": (from_cpc, {"base": {"xyz": [1, 2]}, **GOOD}),
    "convention 'dhh' is unknown: write convention: dh, mdh, cpc": (from_table, {"convention": "dhh", **GOOD}),
    "b: has length 1.41421, not 1": (from_cpc, {"joints": [{"name": "a", "b": [1, 0, 1]}]}),
    "b: is longer than 1": (from_cpc, {"joints": [{"name": "a", "b": [1, 1]}]}),
    "b: points straight back": (from_cpc, {"joints": [{"name": "a", "b": [0, 0, -1]}]}),
    "reversed: 1 is not true or false": (from_cpc, {"joints": [{"name": "a", "reversed": 1}]}),
}


@pytest.mark.parametrize("said", WRONG)
def test_wrong_tables_are_refused(said: str) -> None:
    read, table = WRONG[said]
    with pytest.raises(BadTable) as caught:
        read(table)
    assert said in str(caught.value)
