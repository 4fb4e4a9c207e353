"""What one tick of the setpoint node's core costs, and what hostile input makes it send.

    make bench NAME=control_tick                   # ARGS="--attempts 1000 --messages 0 --requests 10 --seed 7"

1. A door and a drawer are pulled open in the small world of the tests, with a model revised five times a second; every
   tick is timed, as the processor's time and by the clock.
2. The guard is tried with hostile setpoints and inputs (--attempts), each answer looked at by a witness.
3. The node is sent hostile messages over DDS while it pulls (--messages; 0: left out).
4. While it pulls it is asked for illegal transitions, limits that are lowered and parameters that make no sense
   (--requests; 0: left out). What is held is looked at as well: below 1.2 times `max_force_n`, and let go at the end.

Exit code 1 where a tick's 99th percentile of the processor's time is above 2 ms, or where a witness objects.
"""

from __future__ import annotations

import argparse
import sys
import time

import harness

# isort: split
import conftest  # noqa: F401 (finds the install tree)
import numpy as np
from impedance.gentle import LIMITS, TASK
from impedance.test_safety_monitor import fuzz as fuzz_guard
from impedance.toy import PANDA, Toy, door, drawer, pull
from nodes.processes import Process, fresh_domain, listener, running
from nodes.pulled_arm import PulledArm, fuzz
from nodes.random_requests import RandomRequests

from modcal_core.impedance.operation import Operation

LIMIT_MS = 2.0
COUNTS = {"attempts": 100_000, "messages": 100_000, "requests": 300, "seed": 7}


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


def ticks(rng: np.random.Generator) -> float:
    """Print the table; the 99th percentile of all ticks [ms of the processor]."""
    took, rows = [], []
    for toy in (Toy(door()), Toy(drawer(), friction=6.0, spring=10.0, inertia=4.0)):
        operation = Timed(PANDA, TASK, LIMITS)
        pull(toy, operation, 0.1, revise=0.003, rng=rng)
        took += operation.took
    for phase in ("tare", "explore", "check", "follow", "all"):
        of = np.array([row[1:] for row in took if row[0] == phase or phase == "all"])
        rows.append([phase, len(of), *(float(x) for k in (0, 1) for x in np.percentile(of[:, k], [50.0, 99.0]))])
    harness.table("", ("phase", "ticks", "processor ms, median", "99 %", "clock ms, median", "99 %"), rows)
    return rows[-1][3]


def over_dds(rng: np.random.Generator, messages: int, requests: int) -> None:
    """Hostile messages among those of an honest arm, then requests; raises AssertionError where a witness objects."""
    with harness.scratch() as folder:
        domain = fresh_domain()
        about = {"direction": "[-1.0, 0.0, 0.0]", "tip": PANDA.tip, "use_sim_time": True}
        process = Process("impedance_setpoint", domain, folder, **about)
        with running(process), listener(domain) as (node, wait):
            arm = PulledArm(node)
            arm.ready(wait)
            if messages:
                arm.pull(wait)
                seen, pulls = fuzz(arm, wait, rng, messages, burst=max(200, messages // 50))
                harness.say(
                    f"{messages} hostile messages in {pulls} pulls: {seen} setpoints, all of them within limits"
                )
            asked = RandomRequests(arm, wait, rng)
            asked.run(requests)
            harness.say(f"{dict(asked.count)}: {asked.witness.count} setpoints, all of them within limits, all let go")
            assert process.popen.poll() is None, process.output
            process.stop()


def main() -> int:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, count in COUNTS.items():
        made.add_argument(f"--{name}", type=int, default=count)
    given = made.parse_args()
    rng = np.random.default_rng(given.seed)
    p99 = ticks(rng)
    passed = fuzz_guard(given.attempts, rng)
    harness.say(f"{given.attempts} hostile attempts at the guard: {passed} got through, all of them within limits")
    if given.messages or given.requests:
        over_dds(rng, given.messages, given.requests)
    return harness.met((f"{LIMIT_MS:g} ms of the processor a tick", p99 <= LIMIT_MS))


if __name__ == "__main__":
    sys.exit(main())
