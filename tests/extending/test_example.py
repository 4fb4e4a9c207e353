"""The package in examples/extending, installed as a user would: what it adds is found, fitted, stored and reported.

Truth is MuJoCo's, with the cable put in by a formula of its own: no rounding where it becomes taut.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
Run = Callable[[str], str]

FITTED = """
import json, sys
import numpy as np
import yaml
from diagnosis.test_diagnosis import at_joint, nothing, recorded, report_of
from modcal_core.calibration.store import from_data, to_data
from modcal_core.effects.effect import columns
from modcal_core.loop import calibrate
from modcal_core.report.report import to_json_data
from cells import ur10

taut = at_joint(2, lambda q: 1.5e-3 * np.maximum(q[:, 2] - 0.4, 0.0))
samples = recorded(3, taut if {taut} else nothing)
result = calibrate(samples, ur10(), np.random.default_rng(0))
data = to_json_data(result.report)
stored = yaml.safe_dump(to_data(result.calibration))
again = from_data(yaml.safe_load(stored))
shape = again.calibrated.effects[0].shape if again.calibrated.effects else None
print(json.dumps(dict(effects=data["effects"], story=data["story"], basis=shape and shape.basis(np.array([-3.0, 2.0])).tolist())))
if {keep!r}:
    open({keep!r}, "w").write(stored)
"""

READ = """
import json
import numpy as np
from pathlib import Path
from rosbags.rosbag2 import Writer, StoragePlugin
from rosbags.typesys import Stores, get_typestore
from modcal_msgs_py import read_recording

store = get_typestore(Stores.ROS2_JAZZY)
Array, Layout = store.types["std_msgs/msg/Float64MultiArray"], store.types["std_msgs/msg/MultiArrayLayout"]
with Writer(Path({bag!r}), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    at = writer.add_connection("/arm_1/motor_temperatures", Array.__msgtype__, typestore=store)
    for i in range(5):
        data = np.array([20.0, 21.0, 22.0, 23.0, 24.0, 25.0][:{count}]) + i
        message = Array(layout=Layout(dim=[], data_offset=0), data=data)
        writer.write(at, i * 10**9, store.serialize_cdr(message, Array.__msgtype__))
signals = read_recording(Path({bag!r})).signals
print(json.dumps({{s.name: s.values[:, 0].tolist() for s in signals}}))
"""

WIRE = """
import json
import numpy as np
from cells import ur10
from instruments.worlds import postures, samples_of, tracker, wire, world, together
from modcal_core.geometry import se3
from modcal_core.loop import calibrate

w, rng = world(1), np.random.default_rng(1)
q = postures(ur10(), 120, rng)
T = w.tool_in_base(q)
parts = [samples_of(ur10(), q, T, "hall", "point", tracker(se3.exp([1.0, 0.5, 0.2, 0.1, 0.2, 0.3])), 3e-5, rng)]
once = wire(np.array([1.8, -0.4, 0.9]), 0.0)
parts.append(samples_of(ur10(), q, T, "box", "doubled_wire", lambda P: 2.0 * once(P) + 0.07, 1e-4, rng))
result = calibrate(together(parts), ur10(), np.random.default_rng(0))
(instrument,) = result.calibration.calibrated.instruments
print(json.dumps(dict(
    kind=instrument.kind, zero=instrument.values.tolist(),
    std=[std for name, _, std, _ in result.calibration.parameters if "zero" in name], effects=len(result.report.effects),
    final=result.report.errors["final"].position_norm.mean())))
"""

DOOR = """
import json
from pathlib import Path
import numpy as np
from scipy.spatial.transform import Rotation
from articulation.folding import folding
from articulation.objects import ideal, noisy
from modcal_nodes.cli.main import run

folder = Path({folder!r})
rng = np.random.default_rng(1)
p, R = folding(rng, 0.45, 0.15)
hinge = noisy(ideal("revolute", np.linspace(0.0, 1.2, 60), rng, 0.4), rng, 1e-3, 5e-3)
for name, (x, rotations) in dict(hinge=(hinge.positions, hinge.rotations), door=(p, R)).items():
    np.savetxt(folder / (name + ".txt"), np.c_[x, Rotation.from_matrix(rotations).as_quat()])
    assert run(["articulate", str(folder / (name + ".txt")), "--out", str(folder / "out")]) == 0
    print("files", sorted(f.name for f in (folder / "out").iterdir()))
    print("json", (folder / "out" / "articulation.json").read_text().replace("\\n", ""))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a program with the package installed; what it prints."""
    folder = tmp_path_factory.mktemp("installed")
    copy = tmp_path_factory.mktemp("source") / "extending"
    subprocess.run(["cp", "-r", str(ROOT / "examples" / "extending"), str(copy)], check=True)  # building leaves traces
    how = "--no-deps --no-build-isolation --no-index --no-input --disable-pip-version-check --target"
    subprocess.run([*f"{sys.executable} -m pip install -qq {how}".split(), str(folder), str(copy)], check=True)
    path = os.pathsep.join([str(folder), str(ROOT / "tests"), *sys.path])

    def run(program: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_an_effect_of_a_package_is_found_within_three_sigma(installed: Run, tmp_path: Path) -> None:
    stored = tmp_path / "calibration.yaml"
    said = json.loads(installed(FITTED.format(taut=True, keep=str(stored))))
    (effect,) = said["effects"]
    assert (effect["family"], effect["place"], effect["driver"]) == (
        "taut_cable",
        "elbow_joint",
        "position:elbow_joint",
    )
    for name, planted in (("axis", 1.5e-3), ("slack", 0.4)):
        found = effect["parameters"][name]
        assert abs(found["value"] - planted) < 3.0 * found["std"], (name, found)
        assert found["std"] < 0.2 * planted
    assert effect["parameters"]["slack"]["unit"] == "rad"
    assert effect["rms_mm_after"] < 0.5 * effect["rms_mm_before"]
    assert said["story"][0].startswith("elbow_joint is pulled at by a cable that becomes taut; ")
    ((loose, pulled),) = said["basis"]  # as read again from the file
    assert loose < 1e-3 < 1.5 < pulled

    # without the package the file is refused: it would predict without the effect, and say nothing
    read = "import sys, yaml; from modcal_core.calibration.store import from_data; from_data(yaml.safe_load(open(sys.argv[1])))"
    done = subprocess.run([sys.executable, "-c", read, str(stored)], capture_output=True, text=True)
    assert "effect taut_cable at elbow_joint: no shape taut: install the package that provides it" in done.stderr


def test_a_clean_arm_stays_clean(installed: Run) -> None:
    assert json.loads(installed(FITTED.format(taut=False, keep="")))["effects"] == []


def test_a_topic_of_a_package_is_read(installed: Run, tmp_path: Path) -> None:
    said = json.loads(installed(READ.format(bag=str(tmp_path / "bag"), count=6)))
    assert said["temperature:elbow_joint"] == [22.0, 23.0, 24.0, 25.0, 26.0]
    assert len(said) == 6


def test_a_kind_of_a_package_is_fitted(installed: Run) -> None:
    said = json.loads(installed(WIRE))
    assert said["kind"] == "doubled_wire"
    assert said["effects"] == 0
    (std,) = said["std"]
    assert std < 3e-4
    assert said["zero"] == pytest.approx([0.035], abs=3.0 * std)
    assert said["final"] < 1.2e-4


def test_a_way_to_move_of_a_package_is_told(installed: Run, tmp_path: Path) -> None:
    said = installed(DOOR.format(folder=str(tmp_path)))
    hinge, door = (json.loads(line[5:]) for line in said.splitlines() if line.startswith("json "))
    files = [line for line in said.splitlines() if line.startswith("files ")]
    assert hinge["kind"] == "revolute"
    assert hinge["probabilities"]["folding_door"] < 0.05
    assert "object.urdf" in files[0]
    assert (door["kind"], door["enough"]) == ("folding_door", True)
    assert door["probabilities"]["folding_door"] > 0.95
    handle = door["joint"]["parameters"]["handle_m"]
    assert abs(handle["value"] - 0.15) < 3.0 * handle["std"]
    assert handle["unit"] == "m"
    assert door["joint"]["axis"] is None
    assert door["configuration"]["unit"] == "rad"
    assert door["residual_mm"]["rms"] < 3.0
    # what it is no URDF can say, and the hinge's, which lay there, would be wrong
    assert "object.urdf" not in files[1]
    assert "No object.urdf: a URDF has no joint like a folding_door" in " ".join(said.split())
    assert "folding_door" in (tmp_path / "out" / "report.html").read_text()
