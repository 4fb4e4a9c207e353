"""``modcal export`` and the tables that ``modcal import`` takes: files in, files out, the same arm."""

from __future__ import annotations

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

from modcal_core.calibration.store import Calibration, to_data
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.outcome import offsets_of
from modcal_core.robots.tables import from_csv, from_table
from modcal_core.robots.urdf import joint_origins, read_chain
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
    assert known is not None
    root = ET.fromstring(out.read_text())
    written = {j.get("name"): float(j.findtext("offset", "")) for j in root.iter("joint")}
    assert written == {one.joint: one.value for one in known.found}
    assert {t.findtext("plugin") for t in root} == {"transmission_interface/SimpleTransmission"}
    assert f"which leave {known.left_mm:.3g} mm RMS of the {known.nominal_mm:.3g} mm corrected" in " ".join(
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
    "neither calibration, URDF nor table": (nothing_of_ours, ["--to", "cpc"], "is neither a calibration, a URDF, nor a table"),
    "an offset that is no distance": (lambda _: URDF, ["--to", "dh", "--largest-offset", "-1"], "--largest-offset: -1 m is not a valid distance"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_exported(case: str, tmp_path: Path, refused: Refused) -> None:
    make, arguments, said = CASES[case]
    source = make(tmp_path)
    before = sorted(tmp_path.iterdir())
    refused(["export", str(source), *arguments, "--out", str(tmp_path / "out.yaml")], said)
    assert sorted(tmp_path.iterdir()) == before
