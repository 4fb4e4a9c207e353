"""``modcal export`` and what ``modcal import`` takes: files in, files out, the same arm; for other people's descriptions, too."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli.conftest import Refused
from correction.test_compensation import calibration_of, true_model
from robots.test_tables import assert_same
from scipy.spatial.transform import Rotation

from modcal_core.calibration.store import Calibration, to_data
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.outcome import offsets_of
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.tables import from_csv, from_table
from modcal_core.robots.urdf import joint_origins, read_chain
from modcal_core.robots.urdf_write import calibrated_urdf
from modcal_nodes.cli.main import run

URDF = Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf"
GEAR = Effect("gear_harmonic", "elbow_joint", AXIS, "position:elbow_joint", Shape("sine", {"cycles": 101.0}))


def calibrated(folder: Path) -> Calibration:
    """A calibration of the UR10, displaced in all directions, with a gear error, written as a verb leaves it."""
    made = calibration_of(true_model(GEAR.started(np.array([2e-4, 1e-4])), seed=1))
    folder.mkdir()
    (folder / "calibration.yaml").write_text(to_yaml(to_data(made)))
    return made


def test_a_calibration_as_cpc(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """To 1e-10 with its ends, by YAML and by CSV; what a table cannot hold is said and noted."""
    made = calibrated(tmp_path / "cal")
    for name in ("arm.yaml", "arm.csv"):
        out = tmp_path / name
        assert run(["export", str(tmp_path / "cal"), "--to", "cpc", "--out", str(out)]) == 0
        said = capfd.readouterr().out
        assert "left out: gear_harmonic of elbow_joint axis by position:elbow_joint" in said
        text = out.read_text()
        assert "left out: gear_harmonic of elbow_joint" in text
        table = from_csv(text) if name.endswith("csv") else yaml.safe_load(text)
        assert_same(from_table(table), made.calibrated.chain, 1e-10)
    for which in ("nominal", "geometric"):
        assert (
            run(["export", str(tmp_path / "cal"), "--to", "cpc", "--which", which, "--out", str(tmp_path / which)]) == 0
        )
        assert "left out" not in capfd.readouterr().out
        assert_same(from_table(yaml.safe_load((tmp_path / which).read_text())), getattr(made, which).chain, 1e-10)


CAMERA = """<link name="cam"/><link name="optical"/>
<joint name="holder" type="fixed"><origin xyz="9 9 9"/><parent link="{0}"/><child link="cam"/></joint>
<joint name="turn" type="fixed"><origin xyz="0.01 0.02 0.03" rpy="-1.5708 0.2 -1.6"/><parent link="cam"/><child link="optical"/></joint>"""


@pytest.mark.parametrize("carrier", ["tool0", "base_link"])
def test_the_joint_by_which_a_camera_is_mounted(carrier: str, tmp_path: Path, refused: Refused) -> None:
    made = calibrated(tmp_path / "cal")
    urdf = URDF.read_text().replace("</robot>", CAMERA.format(carrier) + "</robot>")
    (tmp_path / "cal" / "calibrated.urdf").write_text(urdf)
    out = tmp_path / "mount.xacro"
    verb = ["export", str(tmp_path / "cal"), "--to", "mount", "--out", str(out)]
    assert run([*verb, "--link", "optical"]) == 0
    xyz, rpy = re.findall(r"(?:xyz|rpy)='([^']*)'", out.read_text())
    assert "('holder', dict(" in out.read_text()
    written = read_chain(
        urdf.replace('xyz="9 9 9"', f'xyz="{xyz}" rpy="{rpy}"'), tip="optical" if carrier == "tool0" else None
    )
    if carrier == "tool0":
        found, expected = written.origins[-1], read_chain(urdf, tip="tool0").origins[-1] @ made.calibrated.T_tip_tool
    else:
        origins = joint_origins(urdf.replace('xyz="9 9 9"', f'xyz="{xyz}" rpy="{rpy}"'))
        found, expected = origins["holder"] @ origins["turn"], se3.inverse(made.calibrated.T_frame_base[0])
    assert np.abs(found - expected).max() < 1e-9
    refused([*verb, "--link", "wrist_1_link"], "link wrist_1_link: hangs by fixed joints on neither tool0 nor base")
    refused(verb, "give --link LINK")


def test_joint_offsets_for_ros2_control(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    made = calibrated(tmp_path / "cal")
    made = replace(made, postures=np.random.default_rng(2).uniform(-2.0, 2.0, (40, 6)), kind="pose")
    (tmp_path / "cal" / "calibration.yaml").write_text(to_yaml(to_data(made)))
    out = tmp_path / "offsets.xml"
    assert run(["export", str(tmp_path / "cal"), "--to", "ros2_control", "--out", str(out)]) == 0
    known = offsets_of(made)
    root = ET.fromstring(out.read_text())
    written = {j.get("name"): float(j.findtext("offset", "")) for j in root.iter("joint")}
    assert written == {one.joint: one.value for one in known.found}
    assert {t.findtext("plugin") for t in root} == {"transmission_interface/SimpleTransmission"}
    assert f"which leave {known.left_mm:.3g} mm RMS of {known.nominal_mm:.3g} mm corrected" in " ".join(
        capfd.readouterr().out.split()
    )


def test_with_the_measured_tool(tmp_path: Path) -> None:
    made = calibrated(tmp_path / "cal")
    out = tmp_path / "arm.yaml"
    assert run(["export", str(tmp_path / "cal" / "calibration.yaml"), "--to", "cpc", "--tool", "--out", str(out)]) == 0
    chain = from_table(yaml.safe_load(out.read_text()))
    model = made.calibrated
    origins = np.array(model.chain.origins)
    origins[-1] = origins[-1] @ model.T_tip_tool
    assert_same(chain, model.chain.with_origins(origins), 1e-10)
    assert chain.tip == "tool"


def test_a_calibrated_ur10_has_no_dh_table(tmp_path: Path, refused: Refused) -> None:
    """Its parallel axes are so no more: both pairs are named, and nothing is written."""
    calibrated(tmp_path / "cal")
    out = tmp_path / "arm.yaml"
    for form in ("dh", "mdh"):
        said = (
            r"axes of joints shoulder_lift_joint and elbow_joint, \S+ rad; elbow_joint and wrist_1_joint, \S+ rad from "
            r"parallel: DH's offset would move by \S+ m with a mrad, and be \S+ m, 10 m is the limit: write a CPC table"
        )
        refused(["export", str(tmp_path / "cal"), "--to", form, "--out", str(out)], said)
    # allowed to be as wild as it needs, it is still the same arm
    assert run(["export", str(tmp_path / "cal"), "--to", "dh", "--largest-offset", "1e5", "--out", str(out)]) == 0


def test_from_a_urdf_and_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """URDF → DH as CSV → URDF → modified DH → CPC → URDF: the same arm, which other verbs take."""
    monkeypatch.chdir(tmp_path)
    assert run(["export", str(URDF), "--to", "dh", "--out", "arm.csv"]) == 0
    assert run(["import", "arm.csv"]) == 0
    assert run(["export", "arm.urdf", "--to", "mdh"]) == 0
    assert run(["export", "arm_mdh.yaml", "--to", "cpc"]) == 0
    assert run(["import", "arm_mdh_cpc.yaml", "--out", "again.urdf"]) == 0
    original, again = read_chain(URDF.read_text()), read_chain(Path("again.urdf").read_text(), "base_link", "tool0")
    assert_same(again, original, 1e-10)
    assert again.names == original.names
    assert np.allclose(again.lower, original.lower)
    assert run(["export", "again.urdf", "--to", "urdf"]) == 0
    assert_same(read_chain(Path("again_chain.urdf").read_text()), original, 1e-10)


def damaged(folder: Path) -> Path:
    (folder / "arm.csv").write_text("# convention: dh\nname,theta\nj1,ninety\n")
    return folder / "arm.csv"


def nothing_of_ours(folder: Path) -> Path:
    (folder / "notes.yaml").write_text("colour: red\n")
    return folder / "notes.yaml"


CASES = {
    "a table with a word for a number": (damaged, ["--to", "cpc"], "arm.csv: joints, entry 1: theta: 'ninety' is not a finite number"),
    "neither calibration, URDF nor table": (nothing_of_ours, ["--to", "cpc"], "notes.yaml: kinematic table: has no key 'convention'"),
    "an offset that is no distance": (lambda _: URDF, ["--to", "dh", "--largest-offset", "-1"], "--largest-offset: -1 m is not a valid distance"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_exported(case: str, tmp_path: Path, refused: Refused) -> None:
    make, arguments, said = CASES[case]
    source = make(tmp_path)
    before = sorted(tmp_path.iterdir())
    refused(["export", str(source), *arguments, "--out", str(tmp_path / "out.yaml")], said)
    assert sorted(tmp_path.iterdir()) == before


ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"


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
