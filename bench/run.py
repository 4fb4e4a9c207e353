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
from modcal_core.geometry import se3  # noqa: E402
from modcal_core.online.estimator import Estimator  # noqa: E402
from modcal_core.online.watch import Watch  # noqa: E402
from modcal_core.robots.inverse import inverse  # noqa: E402
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


def online(table: Table) -> None:
    """One sample more: the running estimate against a batch fit of all, and the watch; inverse kinematics."""
    samples = record(1, 1_000, "pose").samples
    start = fit_cell(ur10(), samples, Cell()).model
    parameters = choose_parameters(start, views_of(samples)).parameters
    fit = identify(start, samples, parameters)
    estimator = Estimator(fit.model, fit.parameters, fit.spread, fit.covariance)
    watch = Watch(fit.model, fit.parameters, fit.covariance, fit.spread)
    rows = [samples.select(np.array([i])) for i in range(500)]
    update = median_ms(lambda: [estimator.update(row) for row in rows]) / len(rows)
    look = median_ms(lambda: [watch.add(row) for row in rows]) / len(rows)
    batch = median_ms(lambda: identify(fit.model, samples, parameters), 3)
    table.add_row("one more sample", f"{update:.2f}", f"{batch:.0f}", f"{batch / update:.0f} x", "batch fit of 1 000")
    table.add_row("watch, one sample", f"{look:.2f}", "", "", "48 postures, 42 directions")

    chain, q = ur10(), np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.2])
    T = forward(chain, q)

    def gap(x: Any) -> Any:
        return se3.log(se3.inverse(forward(chain, x)) @ T)

    def peer() -> Any:
        return least_squares(gap, q + 0.01, xtol=1e-15, ftol=1e-15, gtol=1e-15).x

    assert np.abs(peer() - inverse(chain, T, q + 0.01)).max() < 1e-7
    ours, other = median_ms(lambda: inverse(chain, T, q + 0.01), 50), median_ms(peer, 20)
    table.add_row("IK, from nearby", f"{ours:.2f}", f"{other:.1f}", f"{other / ours:.0f} x", "SciPy least squares")


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
    online(table)
    bags(table)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
