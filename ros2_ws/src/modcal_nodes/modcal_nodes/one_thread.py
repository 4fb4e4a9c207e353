"""BLAS on one thread, whatever the environment says: for the command and every node.

Matrices here are small. Threads of BLAS gain little on them, and where the cores are busy with something else they wait
for each other: the same calibration took three times the processor beside other work. What runs in parallel does so in
processes. Programs that import modcal decide for themselves.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress

# Read by OpenBLAS, OpenMP, MKL, BLIS and Accelerate once, when they are loaded
VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def limit_blas() -> None:
    """Limit BLAS to one thread in this process and those that it starts, be NumPy loaded or not."""
    before = {os.environ.get(name) for name in VARIABLES}
    os.environ.update(dict.fromkeys(VARIABLES, "1"))  # for what is loaded from here on, such as SciPy's own BLAS
    if "numpy" in sys.modules and before != {"1"}:
        with suppress(ModuleNotFoundError):  # beside ROS from apt, where it costs time only
            from threadpoolctl import threadpool_limits

            threadpool_limits(limits=1, user_api="blas")
