"""The workspace is what ROS expects: three ament packages with their markers, and all they ship installed."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ament_index_python.packages import get_package_share_directory
from setuptools import find_namespace_packages, find_packages

import modcal_core

SRC = Path(__file__).resolve().parents[2] / "ros2_ws" / "src"
PACKAGES = ("modcal_core", "modcal_msgs_py", "modcal_nodes")
INTERFACES = "modcal_interfaces"
EXECUTABLES = sorted(e for e in entry_points(group="console_scripts") if e.value.startswith("modcal_nodes."))


@pytest.mark.slow
def test_colcon_sees_ament_packages() -> None:
    """An invalid package.xml does not fail: the package is then built as plain Python, and ROS does not find it."""
    command = [sys.executable, "-m", "colcon", "--log-base", os.devnull, "list", "--base-paths", SRC]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    kinds = {line.split()[0]: line.split()[-1] for line in listed.splitlines()}
    assert kinds == {**dict.fromkeys(PACKAGES, "(ros.ament_python)"), INTERFACES: "(ros.ament_cmake)"}


@pytest.mark.parametrize("package", PACKAGES)
def test_marker_and_manifest_are_installed(install: Path, package: str) -> None:
    share = install / package / "share"
    assert (share / "ament_index/resource_index/packages" / package).is_file()
    assert (share / package / "package.xml").read_text() == (SRC / package / "package.xml").read_text()
    assert Path(get_package_share_directory(package)).samefile(share / package)


@pytest.mark.parametrize("folder", ["config", "launch"])
def test_configs_and_launch_files_are_installed(install: Path, folder: str) -> None:
    written = {p.name for p in (SRC / "modcal_nodes" / folder).glob("*") if p.is_file()}
    installed = {p.name for p in (install / "modcal_nodes/share/modcal_nodes" / folder).glob("*")}
    assert installed == written


@pytest.mark.slow
@pytest.mark.parametrize("executable", EXECUTABLES, ids=lambda e: e.name)
def test_executables_are_installed_and_start_somewhere(install: Path, executable: EntryPoint) -> None:
    script = install / "modcal_nodes/lib/modcal_nodes" / executable.name
    assert os.access(script, os.X_OK)
    assert callable(executable.load())


def test_there_are_executables(install: Path) -> None:
    installed = {p.name for p in (install / "modcal_nodes/lib/modcal_nodes").iterdir()}
    assert installed == {e.name for e in EXECUTABLES}
    assert {"modcal", "recorder", "calibrator", "simulated_cell"} <= installed


@pytest.mark.slow
def test_modcal_is_on_the_path_of_a_sourced_shell(install: Path, tmp_path: Path) -> None:
    clean = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    shell = f"source {install}/setup.bash && command -v modcal && modcal --version"
    done = subprocess.run(["bash", "-c", shell], env=clean, cwd=tmp_path, capture_output=True, text=True, check=True)
    where, version = done.stdout.splitlines()
    assert Path(where) == install / "modcal_nodes/bin/modcal"
    assert version == f"modcal, version {modcal_core.__version__}"


def test_one_version_everywhere() -> None:
    assert f"\nversion: {modcal_core.__version__}\n" in (SRC.parents[1] / "CITATION.cff").read_text()
    for package in (*PACKAGES, INTERFACES):
        manifest = ElementTree.parse(SRC / package / "package.xml").getroot()
        assert manifest.findtext("version") == modcal_core.__version__
        assert manifest.findtext("author") == manifest.findtext("maintainer")
        if package != INTERFACES:
            setup = (SRC / package / "setup.py").read_text()
            assert f'version="{modcal_core.__version__}"' in setup
            assert manifest.findtext("description") in setup


@pytest.mark.parametrize("package", PACKAGES)
def test_every_folder_of_modules_is_a_package(package: str) -> None:
    """A folder without __init__.py works from the sources and is left out of an ordinary install."""
    include = [package, f"{package}.*"]
    with_modules = {
        name
        for name in find_namespace_packages(str(SRC / package), include=include)
        if list((SRC / package / name.replace(".", "/")).glob("*.py"))
    }
    assert with_modules == set(find_packages(str(SRC / package), include=include))
    assert (SRC / package / package / "py.typed").is_file()


@pytest.mark.slow
def test_in_the_shell_of_env_bash_the_nodes_are_commands(root: Path, tmp_path: Path) -> None:
    """Which stands in for `ros2 run`; `modcal` is the one that ignores another ROS, and a closed pipe is no fault."""
    clean = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    shell = f"source {root}/env.bash && command -v modcal && (calibrator --help | head -1)"
    done = subprocess.run(["bash", "-c", shell], env=clean, cwd=tmp_path, capture_output=True, text=True, check=True)
    where, usage = done.stdout.splitlines()
    assert Path(where) == root / ".venv/bin/modcal"
    assert usage.startswith("usage: ros2 run modcal_nodes calibrator")
    assert done.stderr == ""
