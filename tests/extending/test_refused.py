"""What cannot be added is refused, in one line that names it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

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


def said(folder: Path, group: str, program: str, package: str = "", **changes: str) -> str:
    """What a program says with such a package beside it."""
    (folder / "bend.py").write_text(package or PACKAGE.format(**{**GOOD, **changes}))
    info = folder / "bend-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bend\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\nbend = bend:ADDED\n")
    path = os.pathsep.join([str(folder), str(ROOT / "tests"), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
    )
    return done.stdout + done.stderr


def test_one_that_can_be_is_scanned(tmp_path: Path) -> None:
    assert said(tmp_path, "modcal.effects", SCANNED).strip() == "[(20,)]"


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
def test_an_effect_that_cannot_be(tmp_path: Path, changes: dict[str, str], line: str) -> None:
    assert line in said(tmp_path, "modcal.effects", SCANNED, **changes)


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
def test_a_topic_that_cannot_be(tmp_path: Path, added: str, line: str) -> None:
    assert line in said(tmp_path, "modcal.topics", "import modcal_msgs_py.topics", added=added)


@pytest.mark.parametrize("made", ["7", 'Reading("smell", "nose", [1.0])', 'Reading("point", "f", [1.0])'])
def test_a_message_that_its_package_makes_nothing_of(tmp_path: Path, made: str) -> None:
    program = """
from types import SimpleNamespace as N
from modcal_msgs_py.messages import RecordingBuilder
RecordingBuilder().add("/vendor", "std_msgs/msg/String", N(data=""), 5.0)
"""
    take = f'AddedTopic("vendor", "std_msgs/msg/String", lambda m: [__import__("modcal_msgs_py.topics").topics.{made}])'
    if made == "7":
        take = 'AddedTopic("vendor", "std_msgs/msg/String", lambda m: [7])'
    assert "topic /vendor: its package made " in said(tmp_path, "modcal.topics", program, added=take)


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
def test_a_way_to_move_that_cannot_be(tmp_path: Path, change: str, line: str) -> None:
    assert line in said(tmp_path, "modcal.articulation", CHOSEN, package=MODEL.format(change=change))
