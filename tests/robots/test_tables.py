"""DH, modified DH and CPC tables: the makers' figures, round trips, files, refusals where DH cannot say it; pages of robots."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cells import ur10
from robots.test_kinematics import ARMS, chain_of, urdf

from modcal_core.errors import BadTable, NotRepresentable
from modcal_core.geometry import se3, so3
from modcal_core.measurements.kinds import kinds
from modcal_core.planning import site_from_data, with_limits
from modcal_core.robots import delta_from_data, forward
from modcal_core.robots.chain import Chain
from modcal_core.robots.dh import from_dh, from_mdh, to_dh, to_mdh
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.tables import CONVENTIONS, EXACT, from_cpc, from_csv, from_table, loss, to_cpc, to_csv, to_table
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_write import chain_urdf
from modcal_nodes.io.inputs import read_cell

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
    for _ in range(60):
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
    "b: points straight back": (from_cpc, {"joints": [{"name": "a", "b": [0, 0, -1]}]}),
    "reversed: 1 is not true or false": (from_cpc, {"joints": [{"name": "a", "reversed": 1}]}),
}


@pytest.mark.parametrize("said", WRONG)
def test_wrong_tables_are_refused(said: str) -> None:
    read, table = WRONG[said]
    with pytest.raises(BadTable) as caught:
        read(table)
    assert said in str(caught.value)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("arm", [*ARMS, "sliders"])
def test_csv_holds_what_the_table_holds(arm: str, convention: str) -> None:
    """To the last digit, notes apart."""
    table = to_table(chain_of(arm), convention)
    again = from_csv(to_csv(table, ["left out: a gear", "and: more"]))
    assert json.loads(json.dumps(again)) == json.loads(json.dumps(table))
    made, chain = from_table(again), chain_of(arm)
    assert_same(made, chain, EXACT)
    assert (made.names, made.base, made.tip) == (chain.names, chain.base, chain.tip)
    assert np.array_equal([made.lower, made.upper], [chain.lower, chain.upper])


def test_dh_says_all_pairs_that_it_cannot_hold() -> None:
    """The UR's two pairs of parallel axes, each with its angle, and how wild the offset is."""
    origins = np.array(bend(3e-4).origins)
    origins[3] = origins[3] @ se3.exp([0, 0, 0, 0, 1e-3, 0])
    said = (
        "axes of joints shoulder_lift_joint and elbow_joint, 0.0003 rad; elbow_joint and wrist_1_joint, 0.001 rad "
        "from parallel: DH's offset would move by 6.8e.03 m with a mrad, and be 2.04e.03 m, 10 m is the limit: "
        "write a CPC table instead"
    )
    for convention in ("dh", "mdh"):
        with pytest.raises(NotRepresentable, match=said):
            to_table(ur10().with_origins(origins), convention)
        bent = bend(3e-4)  # with offsets of kilometres allowed it is still exact
        assert_same(from_table(to_table(bent, convention, 1e4)), bent, 1e-9)


def test_a_table_that_lost_something_is_not_written() -> None:
    """Axes so nearly parallel that DH takes them for it, and a tool so far away that this shows."""
    origins = np.stack([np.eye(4), se3.exp([0.3, 0, 0, 9e-12, 0, 0]), se3.transform(p=[0.0, 0.0, 50.0])])
    chain = Chain.build(["a", "b"], origins)
    with pytest.raises(NotRepresentable, match=r"dh table: read back, it is off by .* 1e-10 is the limit"):
        to_table(chain, "dh")
    assert loss(chain, to_table(chain, "cpc")) < EXACT


@pytest.mark.parametrize("arm", [*ARMS, "sliders"])
def test_a_urdf_of_a_bare_chain(arm: str) -> None:
    chain = chain_of(arm)
    again = read_chain(chain_urdf(chain), chain.base, chain.tip)
    assert_same(again, chain, 1e-12)
    assert (again.names, again.base, again.tip) == (chain.names, chain.base, chain.tip)
    assert np.array_equal(again.lower, chain.lower)
    assert np.array_equal(again.upper, chain.upper)


TABLE_FILE = "# convention: dh\nname,type,theta,d,a,alpha,lower,upper\nj1,revolute,0,1,0,0,,\n"
NO_TABLE_FILES = {
    "table: states no convention: begin with a line such as '# convention: dh'": "name,theta\nj1,0\n",
    "comment 'colour': is not a key of the table": "# colour: red\n" + TABLE_FILE,
    "joints: it has 0 entries": "# convention: dh\n",
    "joint 2: alpha: is 90, in the unit m rad: write the unit as": "# convention: dh\nd,alpha\n0.1,1.5\n0.1,90\n",
    "entry 1: unknown key b;": TABLE_FILE.replace("theta", "bx"),
    "joint 1: has 3 cells, the header 8": TABLE_FILE.replace("j1,revolute,0,1,0,0,,", "j1,revolute,0"),
    "entry 1: d: 'long' is not a finite number": TABLE_FILE.replace("0,1,0,0", "0,long,0,0"),
    "reversed: 'maybe' is not true or false": "# convention: cpc\nname,reversed\nj1,maybe\n",
}


@pytest.mark.parametrize("said", NO_TABLE_FILES)
def test_files_that_are_no_tables(said: str) -> None:
    assert from_table(from_csv(TABLE_FILE)).names == ("j1",)
    with pytest.raises(BadTable) as caught:
        from_table(from_csv(NO_TABLE_FILES[said]))
    assert said in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "theta,d,a,alpha\n0,0.4,0.1,1.5\n0.2,0,0.3,0\n",
        "joint;d;a;alpha;offset\n1;0.4;0.1;1.5;0\n2;0;0.3;0;0.2\n",
        "name,theta,d,a,alpha\njoint_1,0,0.4,0.1,1.5\njoint_2,0.2,0,0.3,0\n",
    ],
)
def test_tables_as_others_write_them(text: str) -> None:
    """Without names, with numbers for names, with offset for theta, with semicolons."""
    chain = from_table(from_csv("# convention: dh\n" + text))
    assert chain.names == ("joint_1", "joint_2")
    rows = [{"d": 0.4, "a": 0.1, "alpha": 1.5}, {"theta": 0.2, "a": 0.3}]
    assert chain.origins == pytest.approx(from_table({"convention": "dh", "joints": rows}).origins)


@pytest.mark.parametrize("angle", [1e-3, 1e-5])
def test_offsets_that_cancel_are_no_millimetres(angle: float) -> None:
    """A UR as its controller states it: the second and third axis meet hundreds of metres away."""
    table = to_dh(bent_elbow(angle), largest_offset=1e6)
    assert max(abs(joint["d"]) for joint in table["joints"]) > 100.0
    chain = from_table(from_csv(to_csv(table)))
    assert np.linalg.norm(chain.origins[:, :3, 3], axis=1).max() < 1.5
    assert_same(chain, bent_elbow(angle), 1e-8)
    table["joints"][1]["d"] += 30.0
    with pytest.raises(BadTable, match="joint 2: d: is .* in the unit m rad: write the unit"):
        from_csv(to_csv(table))


def bent_elbow(angle: float) -> Chain:
    """A UR10 with its elbow's axis tilted by so much [rad] towards the shoulder's."""
    origins = np.array(ur10().origins)
    origins[2] = origins[2] @ se3.transform(so3.exp([0.0, angle, 0.0]))
    return ur10().with_origins(origins)


@pytest.mark.parametrize(("row", "said"), [({"alpha": 90.0}, "alpha: is 90"), ({"d": 300.0, "a": 250.0}, "d: is 300")])
def test_a_table_in_other_units_is_refused_in_whatever_file(row: dict[str, float], said: str) -> None:
    table = {"convention": "dh", "joints": [{"theta": 0.0, "d": 0.0, "a": 0.0, "alpha": 0.0, **row}] * 2}
    with pytest.raises(BadTable, match=f"{said}, in the unit m rad"):
        from_table(table)


PROGRAMS = {"robots": 3, "acceleration_limits": 2, "delta": 2, "instruments": 1, "sensitivity": 2, "planning": 1}


def page(name: str) -> str:
    return (Path(__file__).resolve().parents[2] / "docs" / f"{name}.md").read_text()


def blocks(name: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page(name), re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_examples_run(name: str, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs = blocks(name, "python")
    assert len(programs) == PROGRAMS[name]
    monkeypatch.chdir(root)
    exec(compile("\n".join(programs), name, "exec"), {})


def test_files_are_read(tmp_path: Path) -> None:
    (text,) = blocks("delta", "yaml")
    assert forward(delta_from_data(yaml.safe_load(text), "docs"), [0.1, 0.2, 0.3, 0.4])[2, 3] < -0.5
    assert with_limits(ur10(), site_from_data(yaml.safe_load(blocks("planning", "yaml")[0]), "docs")).upper[5] == 2.0
    (text,) = blocks("instruments", "yaml")
    (tmp_path / "cell.yaml").write_text(text)
    cell = read_cell(tmp_path / "cell.yaml")
    assert [k.frame for k in cell.known] == [k["frame"] for k in yaml.safe_load(text)["known"]]
    assert len(cell.distances) == 2


def test_the_table_of_kinds_is_the_registry() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `([\w/]+)` (\w+) \| .* \| (\d) \|$", page("instruments"), re.MULTILINE)
    assert {(name, topic, message, int(seen)) for name, topic, message, seen in rows} == {
        (k.name, k.topic, k.message.rpartition("/")[2], k.dimensions) for k in kinds().values()
    }
