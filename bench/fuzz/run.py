"""Hostile and damaged input, made by the thousand and read in this process: every case must be read or refused.

    make fuzz                                             # every target for its share of five minutes
    make fuzz ARGS="--only mcap --cases 30000"
    make fuzz ARGS="--only mcap --seed 7 --from 1234 --cases 1"    # one case again, with its traceback

A fault is an exception that is no refusal, a case that takes longer than two seconds of processor twice, or a process that
grows beyond 1 GiB. Exit code 1 if there is any.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from targets import Target, targets

from modcal_core.errors import ModcalError, plain

SLOW, LARGEST = 2.0, 1 << 20  # s of processor; kB
SHARE = {"mcap": 6}  # times as much of the time as another
MIN_CASES = 40  # on a machine that is busy, seconds say little


@dataclass
class Result:
    """What became of the cases of a target; of each fault the number of the first case, and what was said."""

    cases: int = 0
    refused: int = 0
    slowest: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)
    examples: dict[str, tuple[int, str]] = field(default_factory=dict)


def fuzz(target: Target, seed: int, seconds: float, cases: int | None = None, first: int = 0) -> Result:
    """Run cases of one target for so much processor time [s], forty at least, or so many of them."""
    out, began, least = Result(), time.process_time(), MIN_CASES if cases is None else cases
    while out.cases < least or (cases is None and time.process_time() - began < seconds):
        number = first + out.cases
        case, found = target.make(np.random.default_rng([seed, number])), {}
        refused, took = _tried(target, case, found)
        if took > SLOW:  # the collector and what other threads leave behind also take time: what is slow is so twice
            took = min(took, _tried(target, case, found)[1])
        if took > SLOW:
            found["slower than two seconds"] = f"{took:.1f} s"
        out.refused += refused
        out.slowest = max(out.slowest, took)
        out.faults.update(found)
        out.examples = {key: (number, said) for key, said in found.items()} | out.examples
        out.cases += 1
    return out


def _tried(target: Target, case: object, found: dict[str, str]) -> tuple[bool, float]:
    """Run one case: whether it was refused, and the time of this thread [s]; what is a fault goes into `found`."""
    refused, start = False, time.thread_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's, of numbers that a file holds
            target.run(case)
    except ModcalError as error:
        refused = True
        if str(error) != plain(str(error)) or "\n" in str(error):
            found["a refusal with control characters"] = repr(str(error)[:300])
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        found[f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}"] = traceback.format_exc()
    return refused, time.thread_time() - start


def main() -> int:
    parser = argparse.ArgumentParser(description="Hostile input by the thousand.")
    parser.add_argument("--seconds", type=float, default=300.0, help="of processor time, in all")
    parser.add_argument("--cases", type=int, default=None, help="of each target, in place of a time")
    parser.add_argument("--from", dest="first", type=int, default=0, metavar="NUMBER", help="of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="targets, with commas between")
    asked = parser.parse_args()
    failed = total = 0
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        wanted = [t for t in targets(Path(folder)) if not asked.only or t.name in asked.only.split(",")]
        share = asked.seconds / sum(SHARE.get(t.name, 1) for t in wanted)
        print(f"{'target':12} {'cases':>8} {'refused':>8} {'slowest s':>10} {'faults':>7}")
        for target in wanted:
            out = fuzz(target, asked.seed, share * SHARE.get(target.name, 1), asked.cases, asked.first)
            total, failed = total + out.cases, failed + out.faults.total()
            row = f"{target.name:12} {out.cases:8} {out.refused:8} {out.slowest:10.3f} {out.faults.total():7}"
            print(row, flush=True)
            for key, count in out.faults.most_common():
                number, said = out.examples[key]
                print(f"\n{count} × {key}, first: --only {target.name} --seed {asked.seed} --from {number}\n{said}")
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"{total} cases, {failed} faults, at most {largest >> 10} MiB")
    return int(bool(failed) or largest > LARGEST)


if __name__ == "__main__":
    sys.exit(main())
