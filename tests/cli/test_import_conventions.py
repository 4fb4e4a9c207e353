"""A mapping that states another convention than the table was written in is refused on import, and names the right one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from cells import record, ur10
from cli.recordings import URDF
from scipy.spatial.transform import Rotation

from modcal_msgs_py.mcap_read import read_recording
from modcal_nodes.cli.main import run

NAMES = ur10().names


def table(folder: Path, sequence: str = "xyz") -> None:
    """60 postures of an arm with the pose of its tool, Euler angles in degrees."""
    samples = record(1, 60).samples
    angles = Rotation.from_matrix(samples.R).as_euler(sequence, degrees=True)
    header = ",".join((*NAMES, *"xyzabc"))
    rows = np.c_[samples.q, 1e3 * samples.reading, angles]
    np.savetxt(folder / "table.csv", rows, delimiter=",", header=header, comments="")


def imported(folder: Path, **euler: str) -> int:
    stated = {"columns": ["a", "b", "c"], "sequence": "xyz", "unit": "deg", **euler}
    mapping = {
        "tables": [
            {
                "files": "table.csv",
                "time": {"order": {"period_s": 10}},
                "joints": {"unit": "rad", "columns": {name: name for name in NAMES}},
                "pose": {"frame": "t", "unit": "mm", "position": ["x", "y", "z"], "euler": stated},
            }
        ]
    }
    (folder / "mapping.yaml").write_text(yaml.safe_dump(mapping))
    return run(["import", str(folder / "mapping.yaml"), "--urdf", str(URDF), "--out", str(folder / "bag")])


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"sequence": "XYZ"}, "composed as XYZ about moving axes .* look like xyz about fixed axes"),
        ({"sequence": "ZYX"}, ""),  # turning about moving axes in the reverse order: other angles, another rotation
        ({"unit": "rad"}, "they look like degrees"),
    ],
)
def test_a_wrong_statement_is_refused(
    stated: dict[str, str], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    import re

    table(tmp_path)
    assert imported(tmp_path, **stated) == 2
    line = capfd.readouterr().err
    assert re.search(said, line), line
    assert not (tmp_path / "bag").exists()


def test_a_right_one_is_written_and_keeps_that_it_has_no_clock(tmp_path: Path) -> None:
    table(tmp_path)
    assert imported(tmp_path) == 0
    assert not read_recording(tmp_path / "bag").has_clock
