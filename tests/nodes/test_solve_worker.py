"""The process that a calibrator solves in leaves the processor to what must be on time."""

from __future__ import annotations

import os
import time
from typing import Any

from modcal_nodes.calibrating.worker import SolveWorker


def test_a_solve_yields_to_the_nodes_beside_it() -> None:
    brought, said = list[Any](), list[str]()
    worker = SolveWorker(said.append)
    try:
        worker.give("asking", os.nice, 0, finish=brought.append, fail=said.append)
        end = time.monotonic() + 60.0
        while worker.poll():
            assert time.monotonic() < end
            time.sleep(0.01)
    finally:
        worker.close()
    assert not said
    assert brought[0] > os.nice(0)
