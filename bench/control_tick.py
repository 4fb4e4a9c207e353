"""What one tick of the setpoint node's core costs, and what hostile input makes it send.

    python bench/control_tick.py [--attempts 100000] [--messages 100000] [--requests 300] [--seed 7]

1. A door and a drawer are pulled open in the small world of the tests, with a model revised five times a second; every
   tick is timed, as the processor's time and by the clock.
2. The guard is tried with hostile setpoints and inputs (--attempts), each answer looked at by a witness.
3. The node is sent hostile messages over DDS while it pulls (--messages; 0: left out).
4. While it pulls it is asked for illegal transitions, limits that are lowered and parameters that make no sense
   (--requests; 0: left out). What is held is looked at as well: below 1.2 times `max_force_n`, and let go at the end.

Exits with 1 where a tick's 99th percentile of the processor's time is above 2 ms, or where a witness objects.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import numpy as np  # noqa: E402
from impedance.gentle import LIMITS, TASK  # noqa: E402
from impedance.test_safety_monitor import fuzz as fuzz_guard  # noqa: E402
from impedance.toy import PANDA, Toy, door, drawer, pull  # noqa: E402
from nodes.processes import Process, fresh_domain, listener, running  # noqa: E402
from nodes.pulled_arm import PulledArm, fuzz  # noqa: E402
from nodes.random_requests import RandomRequests  # noqa: E402

from modcal_core.impedance.operation import Operation  # noqa: E402

LIMIT_MS = 2.0


class Timed(Operation):
    """An operation whose ticks are timed: (phase, processor's ms, ms by the clock)."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self.took: list[tuple[str, float, float]] = []

    def tick(self, *arguments: object) -> object:  # type: ignore[override]
        begun, used = time.perf_counter(), time.process_time()
        answer = super().tick(*arguments)  # type: ignore[arg-type]
        self.took.append((self.phase, 1e3 * (time.process_time() - used), 1e3 * (time.perf_counter() - begun)))
        return answer


def ticks(rng: np.random.Generator) -> bool:
    """Print the table; whether the limit is kept."""
    took = []
    for toy in (Toy(door()), Toy(drawer(), friction=6.0, spring=10.0, inertia=4.0)):
        operation = Timed(PANDA, TASK, LIMITS)
        pull(toy, operation, 0.1, revise=0.003, rng=rng)
        took += operation.took
    print("| phase | ticks | processor ms, median | 99 % | clock ms, median | 99 % |\n" + 6 * "| --- " + "|")
    for phase in ("tare", "explore", "check", "follow", "all"):
        rows = np.array([row[1:] for row in took if row[0] == phase or phase == "all"])
        (a, b), (c, d) = (np.percentile(rows[:, k], [50.0, 99.0]) for k in (0, 1))
        print(f"| {phase} | {len(rows)} | {a:.2f} | {b:.2f} | {c:.2f} | {d:.2f} |")
    return bool(b <= LIMIT_MS)


def over_dds(rng: np.random.Generator, messages: int, requests: int) -> None:
    """Hostile messages among those of an honest arm, then requests; raises AssertionError where a witness objects."""
    with tempfile.TemporaryDirectory() as folder:
        domain = fresh_domain()
        process = Process(
            "impedance_setpoint", domain, Path(folder), direction="[-1.0, 0.0, 0.0]", tip=PANDA.tip, use_sim_time=True
        )
        with running(process), listener(domain) as (node, wait):
            arm = PulledArm(node)
            arm.ready(wait)
            if messages:
                arm.pull(wait)
                seen, pulls = fuzz(arm, wait, rng, messages, burst=max(200, messages // 50))
                print(f"{messages} hostile messages in {pulls} pulls: {seen} setpoints, all of them within limits")
            asked = RandomRequests(arm, wait, rng)
            asked.run(requests)
            if requests:
                print(f"{dict(asked.count)}: {asked.witness.count} setpoints, all of them within limits, all let go")
            assert process.popen.poll() is None, process.output
            process.stop()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attempts", type=int, default=100_000)
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--requests", type=int, default=300)
    parser.add_argument("--seed", type=int, default=7)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    quick = ticks(rng)
    passed = fuzz_guard(chosen.attempts, rng)
    print(f"{chosen.attempts} hostile attempts at the guard: {passed} got through, all of them within limits")
    if chosen.messages or chosen.requests:
        over_dds(rng, chosen.messages, chosen.requests)
    return int(not quick)


if __name__ == "__main__":
    sys.exit(main())
