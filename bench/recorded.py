"""Real recordings beside the checkout (../shared/data), as arrays and samples: what several benches read."""

from __future__ import annotations

import csv
from pathlib import Path

import harness
import numpy as np
from scipy.spatial.transform import Rotation

from modcal_core.measurements.samples import Samples
from modcal_core.robot import Robot

Array = np.ndarray
GRIDS = {"ur5": "ur5_grid.csv", "wam7": "wam_grid.csv"}
UR10_JOINTS = tuple(f"{j}_joint" for j in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))


class Table:
    """Rows of a CSV file; decimal commas are read as points."""

    def __init__(self, *path: str, delimiter: str = ",", every: int = 1) -> None:
        with harness.data(*path).open(encoding="utf-8-sig") as stream:
            self.rows = list(csv.DictReader(stream, delimiter=delimiter))[::every]

    def columns(self, *names: str) -> Array:
        """Numbers (N, len(names))."""
        return np.array([[float(row[name].replace(",", ".")) for name in names] for row in self.rows])


def grid(name: str) -> tuple[Array, Array]:
    """Commanded joints (N, n) [rad] and measured positions (N, 3) [m]: what was aimed at less the difference to it."""
    table = Table("serial_robots", GRIDS[name])
    q = np.deg2rad(table.columns(*(key for key in table.rows[0] if key.startswith("joint_"))))
    return q, 1e-3 * (table.columns("x_t", "y_t", "z_t") - table.columns("x_dif", "y_dif", "z_dif"))


def ur10(file: str, every: int = 1) -> tuple[Table, Array, Array]:
    """The table, joints (N, 6) [rad] and poses (N, 7) [m, quaternion] of a file of the IPA's UR10."""
    table = Table("ipa_ur10", file, delimiter=";", every=every)
    p, turns = (table.columns(*(f"measurement_{r}{a}" for a in "xyz")) for r in ("", "r"))
    poses = np.concatenate([1e-3 * p, Rotation.from_euler("XYZ", turns, degrees=True).as_quat()], axis=1)
    return table, table.columns(*UR10_JOINTS), poses


def imported(name: str, folder: Path) -> Path:
    """The bag that ``modcal import`` makes of a recording, by the name of its mapping among the examples."""
    bag = folder / name
    if not bag.exists():
        mapping = harness.ROOT / "examples" / "import" / f"{name}.yaml"
        harness.succeeded("import", mapping, "--data", harness.data(), "--out", bag)
    return bag


def series(letter: str, folder: Path) -> tuple[Robot, Samples]:
    """The UR10 and the stations of its series a or d, one reading each."""
    from modcal_nodes.cli.inputs import described
    from modcal_nodes.io.inputs import opened
    from modcal_nodes.measuring.folder import one_a_station

    recorded = opened(imported(f"ipa_ur10_series_{letter}", folder))
    robot = described(recorded.recording, None, None, None, None)
    return robot, one_a_station(recorded.samples(robot, 0.5))
