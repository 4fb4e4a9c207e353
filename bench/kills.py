"""The recorder killed twenty times in a row at 1 kHz + 200 Hz: did each record, and what did a kill cost?

    make kills                     # BENCH_ARGS="--kills 5" for fewer

After a kill DDS holds on to the dead recorder, and the next one may be sent nothing for some seconds after it has
subscribed. That is no loss that anybody could undo; but it must be said within a second. Ends with exit code 1 when a
recorder held no message and did not say so in time, when one missed a message after its first, or lost more than the
last second.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from nodes.processes import Process, fresh_domain, listener, running  # noqa: E402
from nodes.talking import Talker, numbers_on_disk  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

RATES = {"joint_states": 1000.0, "wrench": 200.0}
RUNS = 2.0  # s that a recorder records before it is killed
HELD = 50_000  # bytes of a bag that holds messages
SAID_WITHIN, LAST = 1.0, 1.0  # s
STAMP = re.compile(r"\[(\d+\.\d+)\] \[[\w.]+\]: (.*)")
FIRST = re.compile(r"/joint_states: the first message came ([\d.]+)")


def main() -> int:
    """Run it; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    kills = parser.parse_args().kills
    table = Table("kill", "silent after subscribing", "said after", "recorded", "holes", "lost at the end", "")
    broken, domain = 0, fresh_domain()
    with (
        tempfile.TemporaryDirectory() as name,
        listener(domain) as (node, _),
        Talker(node, rate=RATES["joint_states"]) as joints,
        Talker(node, "wrench", RATES["wrench"]),
    ):
        for k in range(kills):
            row, good = _one(Path(name), k, domain, joints)
            broken += not good
            table.add_row(str(k + 1), *row, "ok" if good else "[red]broken")
    Console(width=120).print(table)
    return 1 if broken else 0


def _one(folder: Path, k: int, domain: int, joints: Talker) -> tuple[list[str], bool]:
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
    waits = [float(m[1]) for _, text in said if (m := FIRST.search(text))]
    silent = waits[0] if waits else 0.0
    # a reader that was matched late may be sent the earlier ones after the later ones: first and last by number
    holes = max(numbers) - min(numbers) + 1 - len(set(numbers)) if numbers else -1
    # what had been published a moment before the kill, and is not there
    lost = max(joints.before(killed) - 1 - max(numbers), 0) / RATES["joint_states"] if numbers else 30.0
    good = bool(numbers) and holes == 0 and lost <= LAST and (warned is None or warned <= SAID_WITHIN)
    told = "" if warned is None else f"{warned:.2f} s"
    return [f"{silent:.1f} s", told, str(len(numbers)), str(holes), f"{lost:.2f} s"], good


if __name__ == "__main__":
    sys.exit(main())
