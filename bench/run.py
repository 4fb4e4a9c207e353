"""Timings, as ratios against others doing the same work in the same run, on one thread.

    make bench

Absolute times belong to the machine; the ratios and the growth with N are what to compare. Each figure is the median of
several runs after a warm-up, and each pair is checked to arrive at the same result.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
import pinocchio as pin  # noqa: E402
from cells import record, ur10  # noqa: E402
from cli.recordings import streams  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from rosbags.rosbag2 import Reader  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402

from modcal_core.calibration.cell import Cell, fit_cell  # noqa: E402
from modcal_core.calibration.identify import identify  # noqa: E402
from modcal_core.calibration.linearise import linearise  # noqa: E402
from modcal_core.calibration.structure import choose_parameters, views_of  # noqa: E402
from modcal_core.robots.kinematics import forward  # noqa: E402
from modcal_core.robots.urdf import read_chain  # noqa: E402
from modcal_msgs_py.mcap_read import read_bag  # noqa: E402
from modcal_msgs_py.recording_write import write_recording  # noqa: E402


def median_ms(work: Callable[[], Any], runs: int = 5) -> float:
    """Median time of several runs after one that is not counted [ms]."""
    work()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def calibration(table: Table) -> None:
    """The fit of all parameters from a located cell, against SciPy's least squares with numeric derivatives."""
    for kind in ("point", "pose"):
        for count in (100, 1_000, 10_000):
            samples = record(1, count, kind).samples
            start = fit_cell(ur10(), samples, Cell()).model
            parameters = choose_parameters(start, views_of(samples)).parameters
            ours = identify(start, samples, parameters, robust=False)
            whole = median_ms(lambda s=samples, p=parameters: identify(fit_cell(ur10(), s, Cell()).model, s, p))
            fit = median_ms(lambda m=start, s=samples, p=parameters: identify(m, s, p, robust=False))
            other = float("nan")
            if count <= 1_000:
                scale = np.full(len(parameters), 1e-3)

                def residual(x: Any, m: Any = start, s: Any = samples, p: Any = parameters) -> Any:
                    return linearise(m, p, x, s, jacobian=False).residual

                def peer(r: Any = residual, p: Any = parameters, k: Any = scale) -> Any:
                    return least_squares(r, np.zeros(len(p)), x_scale=k, method="trf")

                x = peer().x
                assert np.abs(x - ours.values).max() < 1e-4, np.abs(x - ours.values).max()
                other = median_ms(peer, 1)
            row = f"fit, {kind}, N = {count}"
            compared = (f"{other:.0f}", f"{other / fit:.0f} x") if np.isfinite(other) else ("", "")
            table.add_row(row, f"{fit:.1f}", *compared, f"{whole:.0f} with locating")


def kinematics(table: Table) -> None:
    """Forward kinematics of many postures, against Pinocchio called posture by posture."""
    urdf = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()
    model = pin.buildModelFromXML(urdf)
    data, frame = model.createData(), model.getFrameId("tool0")
    chain = read_chain(urdf)
    q = np.random.default_rng(0).uniform(-3, 3, (10_000, 6))

    def peer() -> Any:
        out = np.empty((len(q), 4, 4))
        for i, posture in enumerate(q):
            pin.framesForwardKinematics(model, data, posture)
            out[i] = data.oMf[frame].homogeneous
        return out

    assert np.abs(peer() - forward(chain, q)).max() < 1e-12
    ours, other = median_ms(lambda: forward(chain, q)), median_ms(peer, 3)
    table.add_row("FK, 10 000 postures", f"{ours:.1f}", f"{other:.0f}", f"{other / ours:.0f} x", "Pinocchio in a loop")


def bags(table: Table) -> None:
    """Reading and decoding a bag, against rosbags."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        recording = streams(40)
        write_recording(recording, bag)
        store = get_typestore(Stores.ROS2_JAZZY)

        def peer() -> Any:
            with Reader(bag) as reader:
                return [store.deserialize_cdr(raw, c.msgtype) for c, _, raw in reader.messages()]

        count = len(peer())
        ours, other = median_ms(lambda: read_bag(bag)), median_ms(peer)
        rate = f"{count / ours:.0f} k messages/s into arrays"
        table.add_row(f"bag, {count} messages", f"{ours:.0f}", f"{other:.0f}", f"{other / ours:.1f} x", rate)


def main() -> None:
    """Run everything and print one table."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("work", "modcal, ms", "peer, ms", "ratio", "remark"):
        table.add_column(name, justify="left" if name in ("work", "remark") else "right")
    calibration(table)
    kinematics(table)
    bags(table)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
