"""All nodes while everything goes wrong: does any end by itself, and what is lost?

A simulated cell speaks on /raw. One calibrator hears it undisturbed. A relay passes everything on to all other nodes,
and drops, delays, doubles and corrupts messages, changes the order of joints, restarts its publishers and moves the
clock of the stamps. In every node callbacks raise exceptions; each node is killed and started again in turn. At the end
both calibrators solve, and are compared with each other and with MuJoCo's truth; every message that the relay has
published is looked for in the recorder's bags.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import harness
import numpy as np
from nodes.cell import call
from nodes.processes import Process, fresh_domain, listener, running
from nodes.talking import Diagnostics
from parts import RECORD, digest
from run import CELL, PARTS, TOPICS

from modcal_core import BadRecording
from modcal_core.calibration.store import Calibration
from modcal_core.correction import ArmState, Correction
from modcal_msgs_py.mcap_walk import McapFile
from modcal_nodes.ros.parameters import SIMULATED_CELL
from modcal_nodes.simulation import Plant

UNWRITTEN = 1.0  # s of messages that a kill may take with it
UNSENT, UNMATCHED = 0.05, 0.5  # s of messages about a restart of the publishers that they may take with them
NEAR = 0.5  # s, within which an exception in a callback costs one message
MAX_DEVIATIONS = 3.0  # combined standard deviations between the two calibrations
CALM_DOWN = 0.25  # share of the time at the end in which the calibrator and the recorder are not killed any more
UNEXCUSED = "without an excuse"
# every node but the cell, all within hearing of the relay; the furniture in a namespace of its own
NODES = {
    "recorder": ["-p", "out:=BAG"],
    "calibrator": ["-p", "state:=state", "-p", "out:=disturbed", "-p", "buffer_s:=20.0"],
    "corrector": ["-r", "calibration:=calibrator/calibration"],
    "viewer": [],
    "articulation_estimator": [],
    "acceleration_limits": [],
    "impedance_setpoint": ["-p", "autostart:=true"],
    "simulated_furniture": ["-r", "__ns:=/door", "-p", f"urdf:={harness.ROBOTS / 'panda.urdf'}"],
}
Pairs = Counter[tuple[int, bytes]]  # topic and digest of messages


@dataclass
class Subject:
    """A node that is disturbed; moments of its starts, kills, and when it was seen to be down for either reason."""

    name: str
    start_one: Callable[[str, int], Process]
    process: Process = field(init=False)
    kills: int = 0
    downs: list[float] = field(default_factory=list)
    starts: list[float] = field(default_factory=list)
    ended: list[int] = field(default_factory=list)  # by itself, with these codes

    def start(self) -> None:
        self.process = self.start_one(self.name, len(self.starts))
        self.starts.append(time.monotonic())

    def look(self) -> None:
        """Notice that it has ended by itself, and start it again."""
        if (code := self.process.popen.poll()) is not None:
            self.ended.append(code)
            self.downs.append(time.monotonic())
            self.start()

    def kill(self) -> None:
        """As an operator or the system would, without a word; and start it again."""
        self.kills += 1
        self.downs.append(time.monotonic())
        self.process.popen.kill()
        self.process.popen.wait()
        self.start()

    def stop(self) -> int:
        """End it as it should be ended; -9 where it does not."""
        try:
            return self.process.stop(signal.SIGINT)
        except AssertionError:
            return -9


def run(folder: Path, seconds: float) -> int:
    domain = fresh_domain()

    def start(name: str, count: int) -> Process:
        words = [word.replace("BAG", f"bag{count}") for word in NODES[name]]  # a recorder into another bag
        command = [sys.executable, str(PARTS), "node", name, str(folder / "injected.txt"), str(count)]
        return Process(name, domain, folder, *words, command=command)

    every = [Subject(name, start) for name in NODES]
    calm = Process("calibrator", domain, folder, "-r", "__ns:=/raw", out=folder / "calm")
    relay = Process(
        "relay", domain, folder, command=[sys.executable, str(PARTS), "relay", str(folder / "relay.bin"), "5"]
    )
    with running(calm, relay), listener(domain) as (node, wait):
        said = Diagnostics(node)
        try:
            for subject in every:
                subject.start()
            wait(lambda: said.level("/raw/calibrator: samples") >= 0 and said.level("/calibrator: samples") >= 0, 60.0)
            about = {**CELL, "stations": 200, "start_delay_s": 4.0}
            cell = Process("simulated_cell", domain, folder, "-r", "__ns:=/raw", **about)
            with running(cell):
                disturb(every, wait, seconds)
                asked = ("calibrator", "raw/calibrator")
                answers = {name: call(node, wait, f"{name}/solve", 300.0).message for name in asked}
                cell.stop()
            with contextlib.suppress(AssertionError):  # the table says it
                relay.stop()
            due = time.monotonic() + 2.0
            wait(lambda: time.monotonic() > due, 10.0)
        finally:
            codes = {subject.name: subject.stop() for subject in every}
        calm.stop(patience=60.0)
    return report(folder, every, codes, answers)


def disturb(every: list[Subject], wait: Any, seconds: float) -> None:
    """Kill one after the other, evenly over the time, and check that none ends otherwise."""
    begun, round_, turn = time.monotonic(), seconds / (2.0 * len(every)), 0
    while (since := time.monotonic() - begun) < seconds:
        due = time.monotonic() + 0.2
        wait(lambda due=due: time.monotonic() > due, 10.0)
        for subject in every:
            subject.look()
        if since > (turn + 1) * round_:
            subject = every[turn % len(every)]
            turn += 1
            late = since > (1.0 - CALM_DOWN) * seconds
            if not (late and subject.name in ("calibrator", "recorder")):
                subject.kill()


def losses(folder: Path, recorder: Subject) -> tuple[int, Counter[str], float]:
    """How many messages were published; how many are in no bag, and why: what the recorder could not have written is
    told apart from the rest; the longest silence from a start to the first message heard [s].
    """
    data = (folder / "relay.bin").read_bytes()
    published = [RECORD.unpack_from(data, at) for at in range(0, len(data) - RECORD.size + 1, RECORD.size)]
    bags = [in_bag(folder / f"bag{k}") for k in range(len(recorder.starts))]
    # a recorder hears a topic from the first message of its bag on, until it is killed
    kills, silent = [*recorder.downs, np.inf], 0.0
    heard_from: list[dict[int, float]] = []
    for start, kill, bag in zip(recorder.starts, kills, bags, strict=True):
        first: dict[int, float] = {}
        sent: dict[int, float] = {}
        for when, topic, key in published:
            if start <= when < kill:
                sent.setdefault(topic, when)
                if topic not in first and (topic, key) in bag:
                    first[topic] = when
        heard_from.append(first)
        silent = max([silent, *(min(first.get(topic, kill), kill) - when for topic, when in sent.items())])
    injected = [line.split() for line in (folder / "injected.txt").read_text().splitlines()]
    # an exception while a message is taken costs that message, and no other
    faults = [float(t) for t, name, *place in injected if name == "recorder" and any("/" in p for p in place)]
    # a publisher takes along what it has not sent yet, and the next one is not matched at once
    anew = [float(line) for line in (folder / "restarts.txt").read_text().split()]
    why, left = Counter[str](), sum(bags, Pairs())
    for when, topic, key in published:
        if left[topic, key] > 0:
            left[topic, key] -= 1
            continue
        k = int(np.searchsorted(recorder.starts, when, side="right")) - 1
        near = min(faults, key=lambda fault, when=when: abs(fault - when), default=np.inf)
        if k < 0 or when >= kills[k]:
            why["while the recorder was down"] += 1
        elif when < heard_from[k].get(topic, np.inf):
            why["while the recorder started, or was not matched yet"] += 1
        elif when >= kills[k] - UNWRITTEN:
            why["in the last second before a kill, not written yet"] += 1
        elif any(-UNSENT <= when - moment < UNMATCHED for moment in anew):
            why["next to a restart of the publishers"] += 1
        elif abs(near - when) < NEAR:
            faults.remove(near)
            why["one each by exceptions in the recorder's callbacks"] += 1
        else:
            why[UNEXCUSED] += 1
    return len(published), why, silent


def in_bag(folder: Path) -> Pairs:
    found = Pairs()
    for path in sorted(folder.glob("*.mcap")):
        try:
            for raw in McapFile(path).messages():
                if raw.topic in TOPICS:
                    found[TOPICS.index(raw.topic), digest(bytes(raw.cdr))] += 1
        except BadRecording as error:  # what a kill has cut off; whole chunks have been read
            harness.say(f"{path.name}: {error}")
    return found


def deviations(one: Calibration, other: Calibration) -> float:
    """How far the tip of one lies from that of the other at random postures, at most, in combined deviations.

    In the base link, where what base and first link, or tool and last link, share is not seen: the parameters
    themselves differ in that from fit to fit.
    """
    both = Correction(one), Correction(other)
    n, worst = both[0].chain.n, 0.0
    for q in np.random.default_rng(0).uniform(-2.0, 2.0, (100, n)):
        at = ArmState(0.0, q, np.zeros(n), np.zeros(n), np.full(n, np.nan), ())
        apart = both[0].pose(q, at)[:3, 3] - both[1].pose(q, at)[:3, 3]
        # without the scatter of the arm, which is no error of the calibration
        var = [np.diag(c.covariance(q, at))[:3] - c.calibration.noise.position**2 for c in both]
        worst = max(worst, float(np.abs(apart / np.sqrt(var[0] + var[1])).max()))
    return worst


def off(calibration: Calibration, truth: Plant) -> float:
    """RMS of the tool's true position, by MuJoCo, about that of a calibration, at random postures [mm]."""
    chain = truth.chain
    low, high = np.maximum(chain.lower, -2.0), np.minimum(chain.upper, 2.0)
    q = np.random.default_rng(0).uniform(low, high, (100, chain.n))
    missed = calibration.calibrated.predict(q)[:, :3, 3] - truth.world.tool_in_tracker(q)[:, :3, 3]
    return 1e3 * harness.rms(np.linalg.norm(missed, axis=1))


def report(folder: Path, every: list[Subject], codes: dict[str, int], answers: dict[str, str]) -> int:
    told = folder / "relay.txt"
    rows: list[tuple[str, object, str, bool]] = [("relay: ended when told to", told.exists(), "True", told.exists())]
    for line in told.read_text().splitlines() if told.exists() else ():
        count, _, what = line.partition(" ")
        rows.append((f"relay: {what}", count, "", True))
    injected = Counter(line.split()[1] for line in (folder / "injected.txt").read_text().splitlines())
    for subject in every:
        name, code, own = subject.name, codes[subject.name], ", ".join(map(str, subject.ended)) or "never"
        rows.append((f"{name}: exceptions, kills", f"{injected[name]}, {subject.kills}", "", True))
        rows.append((f"{name}: ended by itself", own, "never", not subject.ended))
        rows.append((f"{name}: exit code when told to end", code, "0", code == 0))
    published, lost, silent = losses(folder, every[0])
    unexcused = lost.pop(UNEXCUSED, 0)
    rows.append(("recorder: lost of published", f"{lost.total() + unexcused} of {published}", "", True))
    rows += [(f"recorder: lost {reason}", count, "", True) for reason, count in sorted(lost.items())]
    rows.append((f"recorder: lost {UNEXCUSED}", unexcused, "0", unexcused == 0))
    rows.append(("recorder: longest silence after a start, s", silent, "", True))
    rows += [(f"{name}: solve", answer, "", True) for name, answer in answers.items()]
    try:
        disturbed, calm = (Calibration.load(folder / name) for name in ("disturbed", "calm"))
        defaults = {name: parameter.default for name, parameter in SIMULATED_CELL.items()}
        truth = Plant({**defaults, "urdf": CELL["urdf"], "seed": CELL["seed"], "stations": 10})
        apart, best, wrong = deviations(disturbed, calm), off(calm, truth), off(disturbed, truth)
        what = "disturbed against calm, the tip at 100 postures, in deviations"
        rows.append((what, apart, f"{MAX_DEVIATIONS:g}", apart <= MAX_DEVIATIONS))
        what, limit = "disturbed against the truth, RMS, mm", max(0.1, 2.0 * best)
        rows.append((what, wrong, f"{limit:.3f}, of calm {best:.3f}", wrong <= limit))
    except Exception as error:  # the table says so, and is still printed
        rows.append(("the two calibrations", repr(error), "both there", False))
    return harness.judged(rows)
