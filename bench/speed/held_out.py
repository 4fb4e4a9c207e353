"""The same points calibrated by FIGAROH, and both judged at postures that neither has seen.

FIGAROH chooses its parameters itself, and not always as many as the points can tell, so that residuals would compare
little: what counts is how well postures are predicted that were not measured, against MuJoCo's own positions.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from cells import record
from peers import ROOT, ask
from timing import Row

from modcal_core.calibration.identify import Fit
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

URDF = ROOT / "examples" / "robots" / "ur10.urdf"
HELD = 500
SAME = 0.05  # of our error; two that differ by less are called equal
# How FIGAROH chooses parameters, what the table calls it, and the most samples it is asked for
METHODS = (("excitation", "FIGAROH, excitation", 10_000), ("structural", "FIGAROH, its default set", 1_000))


def mean_error_mm(positions: Array, truth: Array) -> float:
    """Mean distance [mm] of positions (n, 3) [m]."""
    return 1e3 * float(np.linalg.norm(positions - truth, axis=1).mean())


def against_figaroh(fit: Fit, samples: Samples, work: str, ms: float, seed: int = 1) -> Iterator[Row]:
    """Rows of FIGAROH with the parameters it can be told to choose, and with those it chooses untold.

    seed: of the recording that the samples are of.
    """
    count = len(samples)
    world = record(seed, 1, "point").world  # the arm is drawn before the postures: it is the same at any count
    q = np.random.default_rng([seed, HELD]).uniform(-np.pi, np.pi, (HELD, samples.q.shape[1]))
    truth = world.tool_in_tracker(q)[:, :3, 3]
    ours = mean_error_mm(fit.model.predict(q)[:, :3, 3], truth)
    for method, name, most in METHODS:
        if count > most:
            continue
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "samples.npz"
            np.savez(file, names=np.array(samples.names), q=samples.q, position=samples.reading, held=q)
            answer = ask("figaroh", "figaroh_fit", str(file), str(URDF), method, seconds=120.0)
        remark = answer.remark
        if answer.found:
            theirs = mean_error_mm(np.reshape(answer.found, (-1, 3)), truth)
            remark += f"; held out {theirs:.4f} mm, ours {ours:.4f} mm"
            if theirs > (1.0 + SAME) * ours:
                remark += ": a worse optimum"
        yield Row("calibration", work, ms, name, answer.ms, remark, count)
