"""What the command costs before it does anything: the processor's time of a fresh process, its system's included."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from timing import Row

ROOT = Path(__file__).resolve().parents[2]


def process_ms(*arguments: str, runs: int = 5) -> float:
    """Median of the processor's time of a process with these arguments [ms]."""
    times = []
    for _ in range(runs + 1):
        before = os.times()
        subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
        after = os.times()
        spent = after.children_user + after.children_system - before.children_user - before.children_system
        times.append(1e3 * spent)
    return float(np.median(times[1:]))


def rows() -> Iterator[Row]:
    """Beside an interpreter that does nothing, and NumPy alone."""
    command = str(Path(sys.executable).with_name("modcal"))
    bare = process_ms(sys.executable, "-c", "pass")
    numpy = process_ms(sys.executable, "-c", "import numpy")
    yield Row("start", "modcal --help", process_ms(command, "--help"), "python -c pass", bare, "0.1 s is the limit")
    info = process_ms(command, "info", str(ROOT / "bags" / "ur10_cell"))
    yield Row("start", "modcal info, a small bag", info, "import numpy", numpy, "0.3 s is the limit")
    with tempfile.TemporaryDirectory() as folder:
        asked = ("--stations", "26", "--candidates", "500", "--out", folder)
        plan = process_ms(command, "plan", str(ROOT / "examples" / "robots" / "ur10.urdf"), *asked)
    yield Row("start", "modcal plan, 26 of 500 candidates", plan, "import numpy", numpy, "1.5 s is the limit")
