"""What is shipped: numbered examples that find what they planted, and one wheel with all that is needed at run time."""

from __future__ import annotations

import ast
import json
import os
import re
import runpy
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable, Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import modcal
import modcal_core

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SRC = ROOT / "ros2_ws" / "src"
SHIPPED = (".py", ".typed", ".css", ".html", ".j2", ".js", ".yaml", ".xml")
STATED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built by the pinned setuptools, without a network."""
    folder = tmp_path_factory.mktemp("dist")
    done = subprocess.run([ROOT / "scripts" / "wheel.sh", folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


def shipped() -> Iterator[tuple[Path, str]]:
    for package in ("modcal_core", "modcal_msgs_py", "modcal_nodes"):
        for file in (SRC / package).glob("modcal*/**/*"):
            if file.is_file() and file.suffix in SHIPPED and "egg-info" not in str(file):
                yield file, file.relative_to(SRC / package).as_posix()


def test_every_module_template_and_table_is_in_it(wheel: Path) -> None:
    there = set(zipfile.ZipFile(wheel).namelist())
    wanted = {name for _, name in shipped()}
    assert len(wanted) > 300
    assert not wanted - there
    assert {name for name in there if name.endswith(".py") and "/share/" not in name} <= wanted
    assert any(name.endswith("config/calibrator.yaml") for name in there)


def test_the_examples_are_in_it(wheel: Path) -> None:
    """All but what runs in a checkout only; without git, what a clone has."""
    listed = subprocess.run(["git", "ls-files", "examples", "bags"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no clone")
    wanted = {name for name in listed.stdout.splitlines() if not name.endswith(".sh")}
    there = {name.partition("share/modcal/")[2] for name in zipfile.ZipFile(wheel).namelist()} - {""}
    assert there == wanted


def test_it_states_version_command_and_dependencies(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    read = {name.rpartition("/")[2]: archive.read(name).decode() for name in archive.namelist() if "dist-info/" in name}
    assert f"\nVersion: {modcal_core.__version__}\n" in read["METADATA"]
    assert "modcal = modcal_nodes.cli.main:main" in read["entry_points.txt"]
    assert "==" not in "".join(STATED["dependencies"])
    assert "ros-" not in read["METADATA"].partition("\n\n")[0]


def test_every_module_that_is_imported_is_a_dependency() -> None:
    """Of a distribution that is stated, or of ROS, which verbs ask for."""
    stated = [*STATED["dependencies"], *(one for extra in STATED["optional-dependencies"].values() for one in extra)]
    names = {re.split(r"[<>=!~\[; ]", one)[0].lower().replace("_", "-") for one in stated}
    owners = packages_distributions()
    imported = {
        found[1]
        for file, _ in shipped()
        if file.suffix == ".py"
        for found in re.finditer(r"^\s*(?:from|import) (\w+)", file.read_text(), re.MULTILINE)
    } - set(sys.stdlib_module_names)
    foreign = {
        module: {name.lower().replace("_", "-") for name in owners[module]}
        for module in imported
        if module in owners and not module.startswith("modcal")
    }
    assert {"numpy", "yaml", "click", "lz4", "zstandard"} <= set(foreign)
    ros = "ros-"
    missing = {
        module: of for module, of in foreign.items() if not of & names and not any(o.startswith(ros) for o in of)
    }
    assert not missing


def test_the_command_runs_from_it_without_ros(site: Path, tmp_path: Path) -> None:
    """In a process that sees neither the workspace nor ROS: the README's first way in, on the examples of the wheel."""
    readme = (ROOT / "README.md").read_text()
    blocks = "".join(re.findall(r"^```bash\n(.*?)^```", readme, re.DOTALL | re.MULTILINE))
    ways = [line.split()[1:] for line in re.findall(r"^modcal .*", blocks, re.MULTILINE) if " my_arm" in line]
    assert [words[0] for words in ways] == ["import", "calibrate"]
    program = f"""
import sys
sys.path[:] = [p for p in sys.path if "ros2_ws" not in p]
for name in ("rclpy", "rcl_interfaces", "std_msgs", "sensor_msgs", "ament_index_python", "launch", "rosidl_parser"):
    sys.modules[name] = None
sys.path.insert(0, {str(site)!r})
import modcal, modcal_nodes
assert modcal.__file__.startswith({str(site)!r}) and modcal_nodes.__file__.startswith({str(site)!r})
from modcal_nodes.cli.main import run
assert run(["--help"]) == 0
assert run(["examples"]) == 0
assert run(["info", "bags/ur10_cell"]) == 0
for words in {ways!r}:
    assert run(words) == 0
assert run(["calibrate", "bags/ur10_cell", "--geometry-only", "--out", "out"]) == 0
sys.exit(run(["watch"]))
"""
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "AMENT_PREFIX_PATH")}
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=clean, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert "modcal: watch: needs rclpy" in done.stderr
    assert "Calibrate" in done.stdout or "calibrate" in done.stdout
    assert {"report.html", "report.json", "calibrated.urdf"} <= {p.name for p in (tmp_path / "out").iterdir()}
    assert "PASS" in done.stdout
    assert (
        subprocess.run(
            ["diff", "-r", "examples/tables/sockets", ROOT / "examples/tables/sockets"], cwd=tmp_path
        ).returncode
        == 0
    )


def test_colcon_does_not_take_the_root_for_a_package() -> None:
    command = [
        *f"{sys.executable} -m colcon --log-base {os.devnull} list --names-only --base-paths".split(),
        ROOT / "ros2_ws",
    ]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert sorted(listed) == ["modcal_core", "modcal_interfaces", "modcal_msgs_py", "modcal_nodes"]
    command[-1] = ROOT
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert "modcal" not in listed


EXAMPLES = sorted((ROOT / "examples").glob("[0-9][0-9]_*.py"))
TOUR = ROOT / "examples" / "tour.ipynb"
ALLOWED = {"modcal", "numpy", "scipy"} | set(sys.stdlib_module_names)


def rms(result: modcal.Result, stage: str = "final") -> float:
    size = result.report.size_mm(stage)
    return size.rms


def arrays(ran: dict[str, Any], folder: Path) -> None:
    assert np.sqrt(np.mean(ran["missed"] ** 2)) < 1e-4
    assert rms(ran["result"], "nominal") > 1.0
    assert (folder / "out" / "calibrated.urdf").is_file()


def bag(ran: dict[str, Any], folder: Path) -> None:
    assert ran["result"].report.status == "at_floor"
    assert ran["result"].report.tolerance.result == "PASS"
    assert (folder / "out" / "report.json").is_file()


def evaluate(ran: dict[str, Any], folder: Path) -> None:
    # the tool is 5 cm longer than the frozen one; noise alone is 0.09 mm
    assert ran["as_it_was"].size_mm("final").rms == pytest.approx(50.0, abs=1.0)
    assert ran["refitted"].size_mm("final").rms < 0.15


def effects(ran: dict[str, Any], folder: Path) -> None:
    (found,) = ran["report"].effects
    assert (found.family, found.place) == ("gear_harmonic", "elbow_joint")
    cycles, std, _ = found.parameters["cycles_per_turn"]
    assert abs(cycles - ran["TEETH"]) < 4.0 * std + 1e-3
    amplitude, std, _ = found.parameters["amplitude"]
    assert abs(amplitude - ran["AMPLITUDE"]) < 4.0 * std


def door(ran: dict[str, Any], folder: Path) -> None:
    assert ran["choice"].kind == "revolute"
    assert ran["model"].radius == pytest.approx(ran["RADIUS"], rel=0.02)
    assert abs(ran["model"].axis[2]) > 0.999


def plan(ran: dict[str, Any], folder: Path) -> None:
    assert ran["left"] < ran["at_random"]
    assert np.loadtxt(folder / "stations.csv", delimiter=",").shape == ran["plan"].q.shape


def modules(ran: dict[str, Any], folder: Path) -> None:
    assert np.sqrt(np.mean(np.sum(ran["missed"] ** 2, axis=1))) < 5e-5
    assert rms(ran["result"], "nominal") > 0.3


def delta(ran: dict[str, Any], folder: Path) -> None:
    assert rms(ran["result"]) < 0.06
    assert rms(ran["result"], "nominal") > 0.3


FOUND: dict[str, Callable[[dict[str, Any], Path], None]] = {
    "01_arrays": arrays, "02_bag": bag, "03_evaluate": evaluate, "04_effects": effects, "05_door": door,
    "06_plan": plan, "07_modules": modules, "08_delta": delta,
}  # fmt: skip


def test_there_is_a_check_for_each() -> None:
    assert [path.stem for path in EXAMPLES] == list(FOUND)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_finds_what_it_planted(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = runpy.run_path(str(path))
    assert capsys.readouterr().out.strip()
    FOUND[path.stem](ran, tmp_path)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_needs_public_names_only(path: Path) -> None:
    source = path.read_text()
    assert len(source.splitlines()) <= 60
    assert ast.get_docstring(ast.parse(source))
    modules = [
        module
        for node in ast.walk(ast.parse(source))
        for module in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    ]
    assert "modcal" in modules
    assert {module.partition(".")[0] for module in modules} <= ALLOWED
    assert not [module for module in modules if module.startswith("modcal.")]


def test_the_notebook_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = json.loads(TOUR.read_text())
    assert data["nbformat"] == 4
    cells = [cell for cell in data["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 4
    assert not [cell for cell in cells if cell["outputs"] or cell["execution_count"] is not None]
    monkeypatch.chdir(ROOT / "examples")
    scope: dict[str, Any] = {"__name__": "__main__", "OUT": tmp_path}
    for i, cell in enumerate(cells):
        exec(compile("".join(cell["source"]), f"{TOUR.name}, cell {i}", "exec"), scope)
    assert scope["result"].report.effects
    assert os.listdir(tmp_path)
