"""The tables here, of arms in MuJoCo that differ from their nominal models: ``python examples/tables/make.py``.

tracker.csv: a UR10 with elastic joints, and a laser tracker that sees a reflector on its flange; joints in degrees,
points in mm. sockets/*.csv: joint angles in degrees of an iiwa whose ball sits in two sockets of a plate, at three
placements of the plate. iso_9283.csv: five poses of the UR10, thirty times each. door.txt: a point of a door of 0.4 m,
with a millimetre of noise.
"""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import numpy as np

import modcal
from modcal_core.geometry import se3
from modcal_core.robots import Chain, pose_and_jacobian, read_chain
from modcal_nodes.cli import run
from modcal_nodes.simulation import World

HERE = Path(__file__).resolve().parent
ROBOTS = HERE.parent / "robots"
BALL = [0.0, 0.0, 0.05]  # m, seen from the hand
SPAN = 0.05  # m, between the sockets of a plate
PLATES = {"front": [0.5, 0.0, 0.2], "left": [0.1, 0.5, 0.3], "raised": [0.3, -0.4, 0.5]}
POSTURES = 12  # in each socket
NOISE, REPEATABILITY = 2e-5, 1e-5  # m of the tracker, rad of a joint
POSES, CYCLES = 5, 30  # of ISO 9283


def cell(folder: Path, **more: float) -> modcal.Samples:
    """Stations of the simulated cell; the same arm each time."""
    words = ["simulate", str(ROBOTS / "ur10.urdf"), "--out", str(folder / "cell")]
    for name, value in {
        "measurement": "point", "noise_m": NOISE, "repeatability_rad": REPEATABILITY,
        "joint_compliance_rad_per_nm": 4e-6, "joint_rate_hz": 50.0, "tracker_rate_hz": 20.0, **more,
    }.items():  # fmt: skip
        words += ["-p", f"{name}={value}"]
    if run(words):
        raise SystemExit(1)
    read = modcal.read_bag(folder / "cell")
    return read.samples(read.robot(tip="tool0"))


def written(name: str, q: np.ndarray, p: np.ndarray) -> None:
    """A table of joints (N, 6) [rad] in degrees and points (N, 3) [m] in millimetres."""
    with (HERE / name).open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["Point", *(f"J{k} [deg]" for k in range(1, 7)), "X [mm]", "Y [mm]", "Z [mm]"])
        for i, (joints, point) in enumerate(zip(np.degrees(q), 1e3 * p, strict=True)):
            table.writerow([f"P{i + 1}", *(f"{v:.5f}" for v in joints), *(f"{v:.4f}" for v in point)])


def tracker() -> None:
    """Ninety stations, six of them twice."""
    with tempfile.TemporaryDirectory() as folder:
        samples = cell(Path(folder), stations=90)
    written("tracker.csv", samples.q, samples.reading)


def iso() -> None:
    """Five other stations of that cell in turn, as often as the standard asks; the joints stop a little elsewhere."""
    rng, chain = np.random.default_rng(5), read_chain((ROBOTS / "ur10.urdf").read_text())
    with tempfile.TemporaryDirectory() as folder:
        samples = cell(Path(folder), stations=POSES, visit=2)
    # it comes from the last pose to the first, also the first time: each pose is always reached from the same side
    order = np.r_[POSES - 1, np.tile(np.arange(POSES), CYCLES)]
    q, p = samples.q[order], samples.reading[order].copy()
    for i, posture in enumerate(q):
        T, J = pose_and_jacobian(chain, posture)
        # how the flange moves has the same size in the base and in the tracker, whose axes it is not seen along
        p[i] += T[:3, :3] @ J[:3] @ (REPEATABILITY * rng.normal(size=6)) + NOISE * rng.normal(size=3)
    written("iso_9283.csv", q, p)


def sockets() -> None:
    """A file for each socket."""
    chain, rng = read_chain((ROBOTS / "iiwa14.urdf").read_text()), np.random.default_rng(4)
    world = World(chain, rng, T_tip_tool=se3.transform(p=BALL))
    (HERE / "sockets").mkdir(exist_ok=True)
    for plate, place in PLATES.items():
        along = rng.normal(size=3)
        for hole, p in enumerate((np.array(place), np.array(place) + SPAN * along / np.linalg.norm(along))):
            with (HERE / "sockets" / f"{plate}_{hole}.csv").open("w", newline="") as file:
                table = csv.writer(file, lineterminator="\n")
                table.writerow([f"A{k}" for k in range(1, 8)])
                for _ in range(POSTURES):
                    q = reach(world, p, chain, rng) + 2e-5 * rng.normal(size=chain.n)
                    table.writerow([f"{v:.5f}" for v in np.degrees(q)])


def reach(world: World, p: np.ndarray, chain: Chain, rng: np.random.Generator) -> np.ndarray:
    """A random posture (n,) in which the true ball is at p: Newton's method, with slopes of the nominal arm."""
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


def door() -> None:
    """Positions along an arc of a radian."""
    angle, rng = np.linspace(0.0, 1.0, 60), np.random.default_rng(1)
    path = np.c_[0.6 - 0.4 * np.cos(angle), 0.4 * np.sin(angle), np.full(60, 0.9)]
    np.savetxt(HERE / "door.txt", path + 1e-3 * rng.normal(size=path.shape), fmt="%.5f")


if __name__ == "__main__":
    tracker()
    iso()
    sockets()
    door()
