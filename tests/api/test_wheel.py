"""The wheel: `pip install .` gives one distribution that has all that the three packages need at run time."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

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


def modules() -> Iterator[tuple[Path, str]]:
    for package in ("modcal_core", "modcal_msgs_py", "modcal_nodes"):
        for file in (SRC / package).glob("modcal*/**/*"):
            if file.is_file() and file.suffix in SHIPPED and "egg-info" not in str(file):
                yield file, file.relative_to(SRC / package).as_posix()


def test_every_module_template_and_table_is_in_it(wheel: Path) -> None:
    there = set(zipfile.ZipFile(wheel).namelist())
    wanted = {name for _, name in modules()}
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
        for file, _ in modules()
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
