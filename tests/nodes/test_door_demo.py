"""One command opens a simulated door, and tells what was learned of it."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
from nodes.processes import fresh_domain

pytestmark = pytest.mark.dds

MODCAL = Path(__file__).resolve().parents[2] / ".venv" / "bin" / "modcal"


@pytest.mark.slow
def test_one_command_opens_a_simulated_door(tmp_path: Path) -> None:
    """Some 20 s, most of which the arm takes to pull; nothing else runs the four as their user does."""
    asked = ["door", "--seed", "0", "--patience", "200", "--domain", str(fresh_domain()), "--out", "door"]
    done = subprocess.run([MODCAL, *asked], cwd=tmp_path, capture_output=True, text=True, timeout=240)
    log = (tmp_path / "door" / "nodes.log").read_text()
    assert done.returncode == 0, done.stderr + log
    opened = re.search(r"in truth it is open by ([0-9.]+) rad, the handle was held with (\d+) N", done.stdout)
    assert opened
    assert float(opened[1]) > 1.0
    assert 0 < int(opened[2]) <= 40
    assert "Traceback" not in log
    # what was learned, by joint states alone, is what the simulation says of its door
    learned = json.loads((tmp_path / "door" / "articulation.json").read_text())
    assert learned["kind"] == "revolute"
    assert learned["configuration"]["upper"] - learned["configuration"]["lower"] == pytest.approx(
        float(opened[1]), abs=0.05
    )
    files = json.loads((tmp_path / "door" / "pull.json").read_text())["files"]
    assert sorted(path.name for path in (tmp_path / "door").iterdir()) == sorted([*files, "nodes.log", "pull.json"])
    assert done.stdout.endswith("Also in door: articulation.json, nodes.log, object.urdf, pull.json\n")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("from modcal_nodes.nodes.impedance_setpoint import ImpedanceSetpoint as node; node.main()", []),
        ("from modcal_nodes.cli.main import main; main()", ["door"]),
    ],
)
def test_without_the_interfaces_one_line_says_what_to_do(code: str, words: list[str], tmp_path: Path) -> None:
    (tmp_path / "hidden" / "modcal_interfaces").mkdir(parents=True)
    (tmp_path / "hidden" / "modcal_interfaces" / "__init__.py").touch()
    around = {**os.environ, "PYTHONPATH": str(tmp_path / "hidden")}
    words = [str(MODCAL.with_name("python")), "-c", code, *words]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, env=around, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("modcal: package modcal_interfaces: is not built: run make build")
    assert done.stderr.count("\n") == 1


def test_a_door_that_cannot_be_opened_is_refused_in_one_line(tmp_path: Path) -> None:
    """The nodes are not where ROS looks for them."""
    around = {name: value for name, value in os.environ.items() if name != "AMENT_PREFIX_PATH"}
    ask = "from modcal_nodes.cli.main import main; main()"
    python = MODCAL.with_name("python")
    done = subprocess.run(
        [python, "-c", ask, "door"], cwd=tmp_path, capture_output=True, text=True, env=around, timeout=60
    )
    assert done.returncode == 2
    assert done.stderr == "modcal: package modcal_nodes: is not installed for ROS: source install/setup.bash\n"
    assert not list(tmp_path.iterdir())
