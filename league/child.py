"""One method, one task, one process: `python -m league.child METHOD TASK.npz ANSWER.npz`.

The process sees the task file alone, which holds no reading of a row that is scored. What it took is its own time and
memory, after its imports of this package.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from importlib import import_module, metadata
from pathlib import Path

import numpy as np

from league.methods import METHODS
from league.task import Task


def main(name: str, file: str, out: str) -> None:
    """Write the answer, or why there is none."""
    method = METHODS[name]
    begun = time.process_time()
    said: dict[str, object] = {"status": "ran"}
    arrays = {}
    try:
        module, function = method["call"].split(":")
        answer = getattr(import_module(f"league.methods.{module}"), function)(Task.read(Path(file)))
        arrays["T"] = answer.T
        if answer.radius95 is not None:
            arrays["radius95"] = answer.radius95
        said |= {"claim_p95_mm": None if answer.claim_p95 is None else 1e3 * answer.claim_p95, "open": answer.is_open}
        said |= {"named": answer.named, "parameters": answer.parameters, "remark": answer.remark[:400]}
        said["oriented"] = answer.oriented
    except Exception as error:  # a method that fails is a result
        said = {"status": "failed", "remark": f"{type(error).__name__}: {error}"[:400]}
    said["cpu_s"] = round(time.process_time() - begun, 2)
    said["memory_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
    ours = method["package"] == "modcal"  # which stands on the path and is not installed
    told = import_module("modcal_core.version").__version__ if ours else metadata.version(method["package"])
    said["version"] = str(told)
    np.savez(out, said=json.dumps(said), **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
