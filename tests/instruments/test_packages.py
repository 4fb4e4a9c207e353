"""A kind of reading that an installed package brings is read from bags and fitted like any other."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

KIND = """
from modcal_core.measurements.kinds.distance import DistanceKind

class Sonar(DistanceKind):
    name, topic = "{name}", "sonar/range"
    message = "{message}"

KIND = {made}
"""
USE = """
from types import SimpleNamespace as N
from modcal_core.measurements.kinds.registry import kinds
from modcal_msgs_py.messages import RecordingBuilder
builder = RecordingBuilder()
stamp = N(sec=5, nanosec=0)
builder.add("/sonar/range", "sensor_msgs/msg/Range", N(header=N(stamp=stamp, frame_id="reef"), range=1.25), 5.0)
(track,) = builder.recording().readings
print(track.kind, track.frame, track.values.tolist(), kinds()[track.kind].dimensions)
"""


def installed(folder: Path, name: str = "sonar", made: str = "Sonar()", message: str = "sensor_msgs/msg/Range") -> str:
    """What a program says that uses a kind of a package in this folder."""
    (folder / "reef_kind.py").write_text(KIND.format(name=name, made=made, message=message))
    info = folder / "reef-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: reef\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[modcal.measurement_kinds]\nsonar = reef_kind:KIND\n")
    path = os.pathsep.join([str(folder), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", USE], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    return done.stdout + done.stderr


@pytest.mark.slow
def test_a_kind_of_a_package_is_known(tmp_path: Path) -> None:
    assert installed(tmp_path).strip() == "sonar reef [[1.25]] 1"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"name": "range"}, "its name or topic is already used: choose others"),
        ({"name": "a" * 33}, "name of 33 letters: use at most 32"),
        ({"made": "3"}, "names a int: name a Kind"),
        ({"message": "std_msgs/msg/Float64"}, "message std_msgs/msg/Float64: use geometry_msgs/msg/PoseStamped"),
    ],
)
def test_a_kind_that_cannot_be_is_refused(tmp_path: Path, changes: dict[str, str], said: str) -> None:
    assert f"entry point sonar of modcal.measurement_kinds: {said}" in installed(tmp_path, **changes)
