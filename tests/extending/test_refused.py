"""What cannot be added is refused in one line that names it; a family is one file, built in as in a package; the page runs."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np
import pytest

from modcal_core.articulation.models.parametric import ParametricModel
from modcal_core.effects.family import Family
from modcal_msgs_py.topics import AddedTopic, Joints

pytestmark = pytest.mark.slow

PACKAGE = """
from modcal_core.effects.family import Family
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape, ShapeKind
from modcal_msgs_py.topics import AddedTopic
import numpy as np

def candidates(at):
    yield Effect("{yields}", "elbow_joint", AXIS, "{driver}", Shape("{shape}"))

def bent(x, settings):
    return {basis}

ADDED = {added}
"""
SCANNED = """
from cells import record, ur10
from modcal_core.effects.drivers import NominalArm, Drivers
from modcal_core.effects.effect import columns
from modcal_core.effects.registry import candidates
at = Drivers(record(1, 20).samples, NominalArm(ur10()))
print([columns(e, at)[0][0].size.shape for e in candidates(at) if e.family == "bend"])
"""
GOOD = {
    "yields": "bend",
    "driver": "position:elbow_joint",
    "shape": "bent",
    "basis": "(x**2)[None]",
    "added": 'Family("bend", candidates, {"bent": ShapeKind(bent)})',
}
ROOT = Path(__file__).resolve().parents[2]


# Forks for each case, so that what all of them import is imported once.
FORKS = """
import importlib, json, os, sys, traceback
import numpy, scipy.optimize, modcal_core.measurements, modcal_core.robots, rosbags.typesys
for line in sys.stdin:
    folder, program = json.loads(line)
    here, there = os.pipe()
    if os.fork() == 0:
        os.dup2(there, 1), os.dup2(there, 2)
        sys.path.insert(0, folder)
        try:
            exec(program, {})
        except Exception:
            traceback.print_exc()
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(0)
    os.close(there)
    with os.fdopen(here) as said:
        print(json.dumps(said.read()), flush=True)
    os.wait()
"""
Said = Callable[..., str]


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Said]:
    """What a program says with such a package beside it."""
    path = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), *sys.path])}
    forking = subprocess.Popen(
        [sys.executable, "-c", FORKS], env=path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )

    def run(group: str, program: str, package: str = "", **changes: str) -> str:
        folder = tmp_path_factory.mktemp("package")
        (folder / "bend.py").write_text(package or PACKAGE.format(**{**GOOD, **changes}))
        info = folder / "bend-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bend\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{group}]\nbend = bend:ADDED\n")
        print(json.dumps([str(folder), program]), file=forking.stdin, flush=True)
        return str(json.loads(forking.stdout.readline()))

    with forking:
        yield run
        forking.stdin.close()


def test_one_that_can_be_is_scanned(said: Said) -> None:
    assert said("modcal.effects", SCANNED).strip() == "[(20,)]"


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"added": "3"}, "entry point bend of modcal.effects: names a int: name a Family"),
        ({"added": 'Family("drift", candidates)'}, "entry point bend of modcal.effects: family drift is already used"),
        (
            {"added": 'Family("bend", candidates, {"sine": ShapeKind(bent)})'},
            "entry point bend of modcal.effects: shape sine is already used",
        ),
        (
            {"added": 'Family("bend", candidates, drivers={"time": bent})'},
            "entry point bend of modcal.effects: driver time is already used",
        ),
        ({"yields": "other"}, "effect bend: yields one of family other"),
        ({"shape": "crooked"}, "effect bend at elbow_joint: no shape crooked"),
        ({"driver": "mood:elbow_joint"}, "effect bend at elbow_joint: no driver mood:elbow_joint"),
        ({"basis": "x**2"}, "shape bent at {}: is (20,), not (1, 20): fix the package that provides it"),
        ({"basis": "(x / 0.0)[None]"}, "shape bent at {}: is not finite: fix the package that provides it"),
    ],
)
def test_an_effect_that_cannot_be(said: Said, changes: dict[str, str], line: str) -> None:
    assert line in said("modcal.effects", SCANNED, **changes)


@pytest.mark.parametrize(
    ("added", "line"),
    [
        ("3", "entry point bend of modcal.topics: names a int: name an AddedTopic"),
        (
            'AddedTopic("/tracker/pose", "std_msgs/msg/String", print)',
            "topic tracker/pose of modcal.topics: is used by modcal itself",
        ),
    ],
)
def test_a_topic_that_cannot_be(said: Said, added: str, line: str) -> None:
    assert line in said("modcal.topics", "import modcal_msgs_py.topics", added=added)


@pytest.mark.parametrize("made", ["7", 'Reading("smell", "nose", [1.0])', 'Reading("point", "f", [1.0])'])
def test_a_message_that_its_package_makes_nothing_of(said: Said, made: str) -> None:
    program = """
from types import SimpleNamespace as N
from modcal_msgs_py.messages import RecordingBuilder
RecordingBuilder().add("/vendor", "std_msgs/msg/String", N(data=""), 5.0)
"""
    take = f'AddedTopic("vendor", "std_msgs/msg/String", lambda m: [__import__("modcal_msgs_py.topics").topics.{made}])'
    if made == "7":
        take = 'AddedTopic("vendor", "std_msgs/msg/String", lambda m: [7])'
    assert "topic /vendor: its package made " in said("modcal.topics", program, added=take)


MODEL = """
import numpy as np
from modcal_core.articulation.models.parametric import ParametricModel, ShapeParameter

class Model(ParametricModel):
    name, parameters, lower, upper = "bend", (ShapeParameter("size", 1.0, 0.1),), 0.0, 1.0
    def pose(self, values, a):
        return None

model = Model()
{change}
ADDED = model
"""
CHOSEN = """
import numpy as np
from modcal_core.articulation.choice import choose
from modcal_core.articulation.track import Track
choose(Track(np.linspace([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], 30)))
"""


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ("", "articulation model bend of package bend, pose at size = 1: has shape (), not (48, 4, 4)"),
        (
            "model.name = 'screw'",
            "entry point bend of modcal.articulation: kind screw is already used: choose another name",
        ),
        ("model.share = 0.9", "entry point bend of modcal.articulation: its share is 0.9, not between 0 and 0.5"),
        ("model = 3", "entry point bend of modcal.articulation: names a int: name an instance of an ArticulationModel"),
        ("model.upper = 0.0", "entry point bend of modcal.articulation: its configurations lie between 0 and 0"),
        ("import nothing_there", "entry point bend of modcal.articulation: package bend raises ModuleNotFoundError"),
    ],
)
def test_a_way_to_move_that_cannot_be(said: Said, change: str, line: str) -> None:
    assert line in said("modcal.articulation", CHOSEN, package=MODEL.format(change=change))


KIND = """
from modcal_core.measurements.kinds.distance import DistanceKind

class Sonar(DistanceKind):
    name, topic, message = "{name}", "sonar/range", "{message}"

ADDED = {made}
"""
HEARD = """
from types import SimpleNamespace as N
from modcal_core.measurements.kinds.registry import kinds
from modcal_msgs_py.messages import RecordingBuilder
builder, header = RecordingBuilder(), N(stamp=N(sec=5, nanosec=0), frame_id="reef")
builder.add("/sonar/range", "sensor_msgs/msg/Range", N(header=header, range=1.25), 5.0)
(track,) = builder.recording().readings
print(track.kind, track.frame, track.values.tolist(), kinds()[track.kind].dimensions)
"""


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({}, "sonar reef [[1.25]] 1"),
        ({"name": "range"}, "entry point bend of modcal.measurement_kinds: its name or topic is already used: choose"),
        ({"name": "a" * 33}, "entry point bend of modcal.measurement_kinds: name of 33 letters: use at most 32"),
        ({"made": "3"}, "entry point bend of modcal.measurement_kinds: names a int: name a Kind"),
        ({"message": "std_msgs/msg/Float64"}, "message std_msgs/msg/Float64: use geometry_msgs/msg/PoseStamped"),
    ],
)
def test_a_kind_is_read_or_refused(said: Said, changes: dict[str, str], line: str) -> None:
    good = {"name": "sonar", "message": "sensor_msgs/msg/Range", "made": "Sonar()"}
    assert line in said("modcal.measurement_kinds", HEARD, package=KIND.format(**{**good, **changes}))


TEXT = (ROOT / "docs" / "extending.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_examples_run() -> None:
    effect, topic, moving = ({}, {}, {})  # type: tuple[dict[str, object], dict[str, object], dict[str, object]]
    for program, names in zip(blocks("python"), (effect, topic, moving), strict=True):
        exec(compile(program, "docs/extending.md", "exec"), names)
    assert isinstance(effect["FAMILY"], Family)
    added = topic["TOPIC"]
    assert isinstance(added, AddedTopic)
    (said,) = added.take(Message(data=[0.1] * 6))
    assert isinstance(said, Joints)
    assert said.name[5] == "joint_6"
    model = moving["MODEL"]
    assert isinstance(model, ParametricModel)
    _, T = model.checked_path(model.prior[0], 9)
    assert np.allclose(np.hypot(T[:, 0, 3], T[:, 1, 3]), 0.25)  # in the middle of the bar it is a circle


def test_the_entry_points_are_those_of_the_example() -> None:
    (text,) = blocks("toml")
    written = tomllib.loads(text)["project"]["entry-points"]
    package = tomllib.loads((ROOT / "examples" / "extending" / "pyproject.toml").read_text())
    assert written == package["project"]["entry-points"]
