"""The tutorial and the how-to pages work: every block of commands runs, in order, as a reader would type it.

Blocks marked ``console`` need what is not here (the ``ros2`` command, a real arm): what they name must exist.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import pose_and_jacobian
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import VERBS
from modcal_nodes.ros import parameters
from modcal_nodes.ros.launch_files import LAUNCHES
from modcal_nodes.simulation.world import World

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]
FORKED = Path(__file__).with_name("forked.py")
BALL = [0.0, 0.0, 0.05]  # m, seen from the hand
RUNS, MUST_EXIST, SHOWN = "bash", "console", ("yaml", "python")
NODES = ROOT / "ros2_ws" / "src" / "modcal_nodes"


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def sockets(folder: Path) -> None:
    """An iiwa with a ball on its hand that sits in six sockets of three plates, in 12 postures each: MuJoCo's truth."""
    cell = yaml.safe_load((ROOT / "examples" / "import" / "mukca_kuka_14_cell.yaml").read_text())
    urdf = (ROOT / "examples" / "robots" / "iiwa14.urdf").read_text()
    chain, rng = read_chain(urdf), np.random.default_rng(4)
    world = World(chain, rng, T_tip_tool=se3.transform(p=BALL))
    plates = [np.array([0.5, 0.0, 0.2]), np.array([0.1, 0.5, 0.3]), np.array([0.3, -0.4, 0.5])]
    stamp, joints = 1.7e9, []
    readings: dict[str, list[float]] = {}
    for distance, plate in zip(cell["distances"], plates, strict=True):
        along = rng.normal(size=3)
        across = distance["distance_m"] * along / np.linalg.norm(along)
        for frame, p in zip(distance["between"], (plate, plate + across), strict=True):
            for _ in range(12):
                q = reach(world, p, chain, rng)
                joints.append((stamp, q + 2e-5 * rng.normal(size=chain.n)))
                readings.setdefault(frame, []).append(stamp)
                stamp += 10.0
    t, q = np.array([s for s, _ in joints]), np.array([p for _, p in joints])
    unknown = np.full_like(q, np.nan)
    tracks = tuple(
        ReadingTrack("point", frame, np.array(s), np.zeros((len(s), 3)), np.array(s)) for frame, s in readings.items()
    )
    write_recording(Recording((JointTrack(chain.names, t, q, unknown, unknown, t),), tracks, (), urdf), folder)


def reach(world: World, p: Array, chain: Chain, rng: np.random.Generator) -> Array:
    """A random posture (n,) in which the ball is at p: Newton's method, with slopes of the drawing."""
    while True:
        q = rng.uniform(chain.lower, chain.upper)
        for _ in range(60):
            missing = p - world.tool_in_base(q)[:3, 3]
            if np.abs(missing).max() < 1e-9:
                return q
            T, J = pose_and_jacobian(chain, q)
            slope = T[:3, :3] @ (J[:3] + np.cross(J[3:], BALL, axis=0))
            step = np.linalg.pinv(slope, rcond=1e-2) @ missing
            q = np.clip(q + step * min(1.0, 0.5 / np.abs(step).max()), chain.lower, chain.upper)


@pytest.fixture(scope="module")
def modcal(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """What a page's commands are to begin with, so that its verbs need no interpreter of their own each."""
    place = tmp_path_factory.mktemp("forked") / "socket"
    serve = f"source '{ROOT}/env.bash'; exec python '{FORKED}' '{place}'"
    with subprocess.Popen(["bash", "-c", serve]) as server:
        while not place.exists():
            assert server.poll() is None
            time.sleep(0.05)
        yield f"modcal() {{ '{sys.executable}' -I -S '{FORKED}' '{place}' \"$@\"; }}\n"
        server.terminate()


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_runs(page: Path, tmp_path: Path, modcal: str) -> None:
    """On the page that asks for least `modcal` is the executable itself."""
    for name in ("examples", "ros2_ws"):
        (tmp_path / name).symlink_to(ROOT / name)
    if page.stem == "ball_in_socket":
        sockets(tmp_path / "sockets")
    program = "\n".join(blocks(page, RUNS))
    assert program
    begin = "" if page.stem == "delta_printer" else modcal
    done = subprocess.run(
        ["bash", "-c", f"source '{ROOT}/env.bash'; set -euo pipefail\n{begin}{program}"],
        cwd=tmp_path, capture_output=True, text=True, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_no_block_is_of_a_kind_that_nobody_looks_at(page: Path) -> None:
    fences = re.findall(r"^```(\S*)$", page.read_text(), re.MULTILINE)
    assert len(fences) % 2 == 0
    assert set(fences[::2]) <= {RUNS, MUST_EXIST, *SHOWN}
    assert not any(fences[1::2])
    for text in blocks(page, "yaml"):
        yaml.safe_load(text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_commands_for_ros_name_exists(page: Path) -> None:
    makefile = (ROOT / "Makefile").read_text()
    for line in "\n".join(blocks(page, MUST_EXIST)).splitlines():
        command = line.partition("#")[0].replace("$ ", "").split()
        if not command or command[:2] in (["source", "env.bash"], ["ros2", "bag"]):
            continue
        if command[0] == "make":
            assert re.search(rf"^{command[1]}:", makefile, re.MULTILINE), line
        elif command[:3] == ["ros2", "run", "modcal_nodes"]:
            declared = getattr(parameters, command[3].upper())
            for name, _ in re.findall(r"-p (\w+):=(\S+)", line):
                assert name in declared, line
        elif command[:3] == ["ros2", "launch", "modcal_nodes"]:
            assert (NODES / "launch" / command[3]).is_file(), line
            known = {argument.name for argument in LAUNCHES[command[3].partition(".")[0]].arguments}
            assert set(re.findall(r"(\w+):=", line)) <= known, line
        elif command[0] == "modcal":
            assert command[1] in VERBS, line
        else:
            named = re.match(r"ros2 (service call|topic pub --once) (\S+) (\w+)/(srv|msg)/(\w+)", line)
            assert named, line
            leaf = named[2].rpartition("/")[2]
            said = [f'"~/{leaf}"', f'"{leaf}"']
            assert any(s in source.read_text() for source in NODES.rglob("*.py") for s in said), line
