"""The recorder killed twenty times in a row at 1 kHz + 200 Hz: did each record, and what did a kill cost?

    make bench NAME=kills                          # ARGS="--kills 5" for fewer

After a kill DDS holds on to the dead recorder, and the next one may be sent nothing for some seconds after it has
subscribed. That is no loss that anybody could undo; but it must be said within a second. Exit code 1 when a recorder
held no message and did not say so in time, missed a message after its first, or lost more than the last second.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from pathlib import Path

import harness

# isort: split
from nodes.processes import Process, fresh_domain, listener, running
from nodes.talking import Talker, numbers_on_disk

RATES = {"joint_states": 1000.0, "wrench": 200.0}
RUNS = 2.0  # s that a recorder records before it is killed
HELD = 50_000  # bytes of a bag that holds messages
SAID_WITHIN, LAST = 1.0, 1.0  # s
STAMP = re.compile(r"\[(\d+\.\d+)\] \[[\w.]+\]: (.*)")
FIRST = re.compile(r"/joint_states: the first message came ([\d.]+)")


def one(folder: Path, k: int, domain: int, joints: Talker) -> tuple[list[object], bool]:
    """A row of the table, and whether nothing is wrong with it."""
    bag = folder / f"bag{k}"
    recorder = Process("recorder", domain, folder, out=bag, topics="[joint_states, wrench]", optional="[wrench]")
    with running(recorder):
        end = time.monotonic() + 30.0
        while sum(f.stat().st_size for f in bag.glob("*.mcap")) < HELD and time.monotonic() < end:
            time.sleep(0.2)
        time.sleep(RUNS)
        killed = time.monotonic()
        recorder.popen.kill()
        recorder.popen.wait()
    numbers = numbers_on_disk(bag)
    said = [(float(m[1]), m[2]) for line in recorder.output.splitlines() if (m := STAMP.search(line))]
    subscribed = next((t for t, text in said if text.startswith("recording /joint_states")), 0.0)
    warned = next((t - subscribed for t, text in said if "/joint_states: subscribed for" in text), None)
    silent = next((float(m[1]) for _, text in said if (m := FIRST.search(text))), 0.0)
    # a reader that was matched late may be sent the earlier ones after the later ones: first and last by number
    holes = max(numbers) - min(numbers) + 1 - len(set(numbers)) if numbers else -1
    # what had been published a moment before the kill, and is not there
    lost = max(joints.before(killed) - 1 - max(numbers), 0) / RATES["joint_states"] if numbers else 30.0
    good = bool(numbers) and holes == 0 and lost <= LAST and (warned is None or warned <= SAID_WITHIN)
    return [k + 1, silent, warned, len(numbers), holes, lost, "ok" if good else "broken"], good


def main() -> int:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--kills", type=int, default=20)
    kills, domain = made.parse_args().kills, fresh_domain()
    with (
        harness.scratch() as folder,
        listener(domain) as (node, _),
        Talker(node, rate=RATES["joint_states"]) as joints,
        Talker(node, "wrench", RATES["wrench"]),
    ):
        rows = [one(folder, k, domain, joints) for k in range(kills)]
    heads = ("kill", "silent after subscribing, s", "said after, s", "recorded", "holes", "lost at the end, s", "")
    harness.table("", heads, [row for row, _ in rows])
    return harness.met(("no recorder lost more than it may", all(good for _, good in rows)))


if __name__ == "__main__":
    sys.exit(main())
