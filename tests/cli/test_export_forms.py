"""``modcal export`` for other people's descriptions: a xacro property, a maker's file, a table in mm and degrees."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli.conftest import Refused
from robots.test_tables import assert_same
from scipy.spatial.transform import Rotation

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.tables import from_csv, from_table
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_write import calibrated_urdf
from modcal_nodes.cli.main import run

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
URDF = ROBOTS / "ur10.urdf"


def corrected(folder: Path, robot: str = "ur10") -> Path:
    """A URDF with every origin of the arm displaced and turned."""
    text = (ROBOTS / f"{robot}.urdf").read_text()
    nominal = read_chain(text)
    xi = 1e-3 * np.random.default_rng(1).normal(size=(nominal.n + 1, 6))
    out = folder / "calibrated.urdf"
    out.write_text(calibrated_urdf(text, nominal, nominal.with_origins(nominal.origins @ se3.exp(xi))))
    return out


def by_hand(urdf: str, tip: str, angles: dict[str, float]) -> Array:
    """The tip in the root by the elements of a URDF, without our reader."""
    above = {joint.find("child").get("link"): joint for joint in ET.fromstring(urdf).findall("joint")}  # type: ignore[union-attr]
    T = np.eye(4)
    while tip in above:
        joint = above[tip]
        origin, axis = joint.find("origin"), joint.find("axis")
        own = np.eye(4)
        if origin is not None:
            rpy = [float(v) for v in origin.get("rpy", "0 0 0").split()]
            own[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
            own[:3, 3] = [float(v) for v in origin.get("xyz", "0 0 0").split()]
        turn = np.eye(4)
        if joint.get("type") != "fixed":
            along = np.array([float(v) for v in (axis.get("xyz") if axis is not None else "1 0 0").split()])  # type: ignore[union-attr]
            turn[:3, :3] = Rotation.from_rotvec(angles[joint.get("name", "")] * along).as_matrix()
        T = own @ turn @ T
        tip = joint.find("parent").get("link")  # type: ignore[union-attr, assignment]
    return T


@pytest.mark.parametrize("robot", ["ur10", "panda"])
def test_a_description_that_includes_the_xacro_file_is_the_calibrated_arm(robot: str, tmp_path: Path) -> None:
    """xacro itself is not here: its property is evaluated as Python, which is what xacro does with ``${…}``."""
    urdf = corrected(tmp_path, robot)
    out = tmp_path / "origins.xacro"
    assert run(["export", str(urdf), "--to", "xacro", "--out", str(out)]) == 0
    (value,) = [e.get("value", "") for e in ET.parse(out).getroot() if e.tag.endswith("property")]
    assert value.count("}") == 1, "xacro ends an expression at its first brace"
    calibrated = eval(value.removeprefix("${").removesuffix("}"), {"__builtins__": {}, "dict": dict})
    # a description of one's own: the nominal one, whose origins come from the property
    nominal = (ROBOTS / f"{robot}.urdf").read_text()
    tree = ET.fromstring(nominal)
    for joint in tree.findall("joint"):
        if joint.get("name") in calibrated:
            for origin in joint.findall("origin"):
                joint.remove(origin)
            joint.append(ET.Element("origin", calibrated[joint.get("name")]))
    mine, chain = ET.tostring(tree, encoding="unicode"), read_chain(urdf.read_text())
    for q in np.random.default_rng(2).uniform(-2.0, 2.0, (20, chain.n)):
        angles = dict(zip(chain.names, q, strict=True))
        assert np.abs(by_hand(mine, chain.tip, angles) - by_hand(urdf.read_text(), chain.tip, angles)).max() < 1e-12
    far = max(np.abs(by_hand(nominal, chain.tip, angles) - by_hand(mine, chain.tip, angles)).max() for _ in [0])
    assert far > 1e-4


def test_urs_file_gives_the_calibrated_arm(tmp_path: Path) -> None:
    """Read as ur_description does: six poses behind the half turn of its base, each with its joint's angle."""
    urdf = corrected(tmp_path)
    drawn = str(ROBOTS / "ur10.urdf")
    assert run(["export", drawn, "--to", "kinematics", "--out", str(tmp_path / "own.yaml")]) == 0
    own = yaml.safe_load((tmp_path / "own.yaml").read_text())
    own["kinematics"]["hash"] = "calib_123"
    (tmp_path / "factory.yaml").write_text(yaml.safe_dump(own))
    out = tmp_path / "mine.yaml"
    arguments = ["export", str(urdf), "--to", "kinematics", "--factory-kinematics", str(tmp_path / "factory.yaml")]
    assert run([*arguments, "--out", str(out)]) == 0
    table = yaml.safe_load(out.read_text())["kinematics"]
    assert table["hash"] == "calib_123"
    chain = read_chain(urdf.read_text())
    for q in np.random.default_rng(2).uniform(-2.0, 2.0, (20, 6)):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", math.pi).as_matrix()
        for link, angle in zip(("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"), q, strict=True):
            v = table[link]
            own_pose, turn = np.eye(4), np.eye(4)
            own_pose[:3, :3] = Rotation.from_euler("xyz", [v["roll"], v["pitch"], v["yaw"]]).as_matrix()
            own_pose[:3, 3] = [v["x"], v["y"], v["z"]]
            turn[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
            T = T @ own_pose @ turn
        angles = dict(zip(chain.names, q, strict=True))
        assert np.abs(T - by_hand(urdf.read_text(), "wrist_3_link", angles)).max() < 1e-12


@pytest.mark.parametrize("convention", ["dh", "mdh", "cpc"])
def test_a_table_in_millimetres_and_degrees_is_the_same_arm(
    convention: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["export", str(URDF), "--to", convention, "--unit", "mm deg"]) == 0
    text = (tmp_path / f"ur10_{convention}.csv").read_text()
    if convention == "dh":
        row = text.splitlines()[-5].split(",")
        assert row[0] == "shoulder_lift_joint"
        assert float(row[4]) == pytest.approx(612.0, abs=1e-9) or float(row[4]) == pytest.approx(-612.0, abs=1e-9)
        assert abs(float(text.splitlines()[-6].split(",")[5])) == pytest.approx(90.0)
    assert_same(from_table(from_csv(text)), read_chain(URDF.read_text()), 1e-10)
    assert run(["import", f"ur10_{convention}.csv", "--out", "again.urdf"]) == 0
    assert_same(read_chain(Path("again.urdf").read_text(), "base_link", "tool0"), read_chain(URDF.read_text()), 1e-10)


def test_the_nearest_table_says_what_it_loses(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The figure on the terminal is what its poses are off, over other postures."""
    urdf, out = corrected(tmp_path), tmp_path / "near.csv"
    assert run(["export", str(urdf), "--to", "dh", "--nearest", "--unit", "mm deg", "--out", str(out)]) == 0
    said = capfd.readouterr().out
    found = re.search(r"tip is off by (\S+) mm RMS, (\S+) mm and \S+ at most", " ".join(said.split()))
    assert found
    assert "shoulder_lift_joint and elbow_joint" in said
    q = np.random.default_rng(9).uniform(-np.pi, np.pi, (400, 6))
    off = chain_forward(from_table(from_csv(out.read_text())), q) - chain_forward(read_chain(urdf.read_text()), q)
    assert 1e3 * np.sqrt(np.mean(np.sum(off[:, :3, 3] ** 2, axis=1))) == pytest.approx(float(found[1]), rel=0.1)
    assert float(found[1]) in [float(v) for v in re.findall(r"off by (\S+) mm RMS", out.read_text())]


def test_what_these_forms_refuse(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "arm.csv").write_text("# convention: dh\nname,theta\nj1,0\n")
    out = str(tmp_path / "out")
    refused(["export", str(tmp_path / "arm.csv"), "--to", "xacro", "--out", out], "arm.csv: is not a URDF, which xacro")
    refused(["export", str(tmp_path), "--to", "kinematics", "--out", out], "calibration.yaml")
    refused(
        ["export", str(URDF), "--to", "dh", "--unit", "mm deg", "--out", f"{out}.yaml"], "a YAML table is in m and rad"
    )
    named = tmp_path / "named.urdf"
    named.write_text(URDF.read_text().replace("elbow_joint", "elbow'joint"))
    refused(["export", str(named), "--to", "xacro", "--out", out], "has a name that no xacro expression holds")
    assert not Path(out).exists()
    (tmp_path / "inch.csv").write_text("# convention: dh\n# unit: inch\nname,theta\nj1,0\n")
    refused(["import", str(tmp_path / "inch.csv"), "--out", out], "unit: is 'inch': write one of m rad, mm deg")
