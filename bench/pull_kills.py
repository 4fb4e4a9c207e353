"""Nodes killed, stopped and deactivated at random moments of a pull: are limits kept, and does the hand let go?

    make pull-kills                # BENCH_ARGS="--pulls 20 --seed 5" for fewer, others

Every pull is a random door or drawer in MuJoCo (modcal_nodes/simulation/furniture.py), in real time, with the real
nodes over DDS. At a random moment one of them is killed (SIGKILL), asked to end (SIGTERM) or paused (SIGSTOP, and
SIGCONT after `PAUSE` s), or the setpoint node is stopped by its service or deactivated. Then the world goes on for
some seconds. Asked of every pull:

* each joint reference is finite, within the joints' ranges and speed, and no more than two steps away from the last;
* the hand feels no more than 1.2 times `max_force_n` at any time;
* references end within `QUIET` s, and the object is let go: less than `LET_GO` N at the end. A setpoint node that was
  killed sends nothing any more, so there the force must only not grow; where the world was killed, there is none;
* an arm that is heard again after a pause is let go, and not led on.

A pull that does not begin is named and replaced by another scene's. Ends with exit code 1 where one of them fails, or
more than a tenth do not begin. Writes a table, and with --out the runs as JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import numpy as np  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from nodes.polling import Polled  # noqa: E402
from nodes.processes import Process, fresh_domain, listener, running  # noqa: E402
from nodes.pulling import (  # noqa: E402
    ESTIMATOR,
    PANDA,
    PULL,
    SETPOINT,
    WORLD,
    Told,
    Wait,
    begin,
    call,
    change,
    followers,
    until_heard,
)
from nodes.talking import RELIABLE, Diagnostics  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectoryPoint  # noqa: E402

from modcal_core.robots.urdf import read_chain  # noqa: E402
from modcal_nodes.simulation.furniture import draw  # noqa: E402

CHAIN = read_chain(PANDA.read_text())
RATE, SPEED = 250.0, 1.5  # Hz and rad/s: the defaults of impedance_setpoint
MAX_FORCE = 60.0  # N, 1.2 times max_force_n
LET_GO = 10.0  # N; what a closing spring leaves in a hand that holds nothing back
MOMENTS = (0.5, 9.0)  # s after the pull was asked for
PAUSE = 1.3  # s, more than timeout_s and patience_s together
AFTER, AFTER_PAUSE = 5.0, 8.0  # s; a world that was paused has to catch up first
# s after the event by which references have ended: a silent estimator is noticed after 1 s, late inputs are waited for
# 1 s, letting go takes 0.6 s, and a busy machine adds to each; a world that was paused has to catch up as well
QUIET, QUIET_PAUSE = 4.0, 6.0
PULLING = 0.1  # s before the event in which a reference was sent, where it met a pull that was going on

EVENTS = (
    f"kill {ESTIMATOR}", f"end {ESTIMATOR}", f"kill {SETPOINT}", f"end {SETPOINT}", f"kill {WORLD}", f"pause {WORLD}",
    "deactivate", "stop",
)  # fmt: skip


@dataclass
class References:
    """The joint references that were sent, and when [s, this machine's clock]."""

    at: list[float] = field(default_factory=list)
    q: list[list[float]] = field(default_factory=list)
    v: list[list[float]] = field(default_factory=list)

    def take(self, message: JointTrajectoryPoint) -> None:
        """Remember one."""
        self.at.append(time.monotonic())
        self.q.append(list(message.positions))
        self.v.append(list(message.velocities))

    def faults(self) -> list[str]:
        """What is wrong with them, nothing where nothing is."""
        if not self.q:
            return []
        q, v = np.array(self.q), np.array(self.v) if all(self.v) else np.zeros((1, CHAIN.n))
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            return ["a reference is not finite"]
        out = []
        if ((q < CHAIN.lower - 1e-9) | (q > CHAIN.upper + 1e-9)).any():
            out.append("a reference is outside a joint's range")
        if (fastest := float(np.abs(v).max())) > SPEED * 1.001:
            out.append(f"a reference asks for {fastest:.2f} rad/s")
        # two periods: a reference may have been taken back because its inputs were late
        if len(q) > 1 and (step := float(np.abs(np.diff(q, axis=0)).max())) > 2.0 * SPEED / RATE:
            out.append(f"a reference is {step:.4f} rad from the one before")
        return out


@dataclass
class Outcome:
    """A pull and what became of it.

    pulling: whether references were being sent at the event. force: largest [N]. before, last: medians of 0.2 s before
    the event, and of the last half second [N]. went_on: how long references went on after the event, or after the pause
    [s]. said: the last message of the pull on /diagnostics.
    """

    seed: int
    event: str
    moment: float
    pulling: bool
    force: float
    last: float
    before: float
    references: int
    went_on: float
    said: str
    faults: list[str]


def _apply(event: str, nodes: dict[str, Process], node: Node, wait: Wait) -> None:
    how, _, who = event.partition(" ")
    if how in ("kill", "end"):
        nodes[who].popen.send_signal(signal.SIGKILL if how == "kill" else signal.SIGTERM)
    elif how == "pause":
        nodes[who].popen.send_signal(signal.SIGSTOP)
        _spin(wait, PAUSE)
        nodes[who].popen.send_signal(signal.SIGCONT)
    elif how == "deactivate":
        change(node, wait, SETPOINT, Transition.TRANSITION_DEACTIVATE)
    else:
        call(node, wait, Trigger, f"{SETPOINT}/stop", Trigger.Request())


def pull(seed: int, event: str) -> Outcome:
    """One pull in a scene of its own, and the event in it."""
    rng = np.random.default_rng([seed, 77])
    scene = draw(CHAIN, np.random.default_rng(seed))
    moment = float(rng.uniform(*MOMENTS))
    domain = fresh_domain()
    sent, told = References(), Told()
    with contextlib.ExitStack() as until_over:
        folder = Path(until_over.enter_context(tempfile.TemporaryDirectory()))
        estimator, setpoint = followers(folder, domain, scene, {}, {"goal": float(scene.goal)})
        until_over.enter_context(running(estimator, setpoint))
        node, wait = until_over.enter_context(listener(domain))
        told.listen(node)
        health = Diagnostics(node)
        Polled(node, 0.005).subscribe(JointTrajectoryPoint, "joint_references", sent.take, RELIABLE.depth)
        change(node, wait, SETPOINT, Transition.TRANSITION_CONFIGURE)
        change(node, wait, SETPOINT, Transition.TRANSITION_ACTIVATE)
        world = Process(WORLD, domain, folder, urdf=PANDA, seed=seed)
        until_over.enter_context(running(world))
        wait(lambda: told.forces and told.opened, 30.0)
        until_heard(node, wait)
        begin(node, wait)
        _spin(wait, moment)
        before, pulling = _force(told, 0.2), bool(sent.at) and time.monotonic() - sent.at[-1] < PULLING
        _apply(event, {ESTIMATOR: estimator, SETPOINT: setpoint, WORLD: world}, node, wait)
        over = time.monotonic()
        _spin(wait, AFTER_PAUSE if event.startswith("pause") else AFTER)
        alive = {p.log.name.split("-")[0]: p.popen.poll() is None for p in (estimator, setpoint, world)}
        for process in (world, estimator, setpoint):
            if process.popen.poll() is None:
                process.stop()
    force = max(f for _, f in told.forces)
    last = _force(told, 0.5)
    faults = sent.faults()
    if force > MAX_FORCE:
        faults.append(f"the hand felt {force:.0f} N")
    went_on = sent.at[-1] - over if sent.at else 0.0
    if event == f"kill {SETPOINT}":
        if last > max(before, LET_GO) + 5.0:
            faults.append(f"the force grew from {before:.0f} to {last:.0f} N")
    elif went_on > (QUIET_PAUSE if event.startswith("pause") else QUIET):
        faults.append(f"references went on for {went_on:.1f} s")
    elif last > LET_GO and event != f"kill {WORLD}":
        faults.append(f"{last:.0f} N are still held")
    elif pulling and went_on < 0.0 and event == f"pause {WORLD}":
        faults.append("nothing was sent after the pause")
    faults += [f"{name} has ended" for name in _others(event) if not alive[name]]
    said = health.last[PULL].message
    return Outcome(seed, event, moment, pulling, force, last, before, len(sent.q), went_on, said, faults)


def _others(event: str) -> list[str]:
    return [name for name in (ESTIMATOR, SETPOINT, WORLD) if name not in event]


def _spin(wait: Wait, seconds: float) -> None:
    """Take messages for so long."""
    end = time.monotonic() + seconds
    wait(lambda: time.monotonic() >= end, seconds)


def _force(told: Told, last: float) -> float:
    """The median of the contact force [N] in the last so many seconds that the world told of."""
    newest = told.forces[-1][0]
    return float(np.median([f for t, f in told.forces if t >= newest - last]))


def main() -> int:
    """Run it; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--pulls", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--only", default="", help="events that have one of these words in them, with commas between")
    parser.add_argument("--out", type=Path, default=None, help="a file for the runs, as JSON")
    chosen = parser.parse_args()
    events = [event for event in EVENTS if any(word in event for word in chosen.only.split(","))]
    console = Console(width=150)
    runs: list[Outcome] = []
    idle = 0  # pulls that did not begin, as on a machine that gives a node no processor for seconds
    while len(runs) < chosen.pulls and idle <= chosen.pulls // 10:
        seed = chosen.seed + len(runs) + idle
        try:
            one = pull(seed, events[len(runs) % len(events)])
        except AssertionError as error:
            idle += 1
            console.print(f"{seed} did not begin: {str(error).splitlines()[-1]}")
            continue
        runs.append(one)
        console.print(
            f"{one.seed} {one.event} at {one.moment:.1f} s, {'' if one.pulling else 'not '}in motion: "
            f"at most {one.force:.0f} N, "
            f"{one.before:.0f} N before, {one.last:.0f} N in the end, "
            f"references for {one.went_on:.2f} s, '{one.said}'; {'; '.join(one.faults) or 'as it should be'}"
        )
        if chosen.out is not None:
            chosen.out.write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n")
    console.print(_table(runs, events))
    console.print(f"{idle} pulls did not begin")
    return int(len(runs) < chosen.pulls or any(run.faults for run in runs))


def _table(runs: list[Outcome], events: list[str]) -> Table:
    table = Table(width=110, title=f"{len(runs)} pulls, {sum(run.references for run in runs)} references")
    for name in (
        "event",
        "pulls",
        "in motion",
        "as it should be",
        "largest force, N",
        "held in the end, N",
        "references went on, s",
    ):
        table.add_column(name, justify="left" if name == "event" else "right")
    for event in events:
        of = [run for run in runs if run.event == event]
        if of:
            moving, good = sum(run.pulling for run in of), sum(not run.faults for run in of)
            largest, held = max(run.force for run in of), max(run.last for run in of)
            on = max(run.went_on for run in of)
            row = (str(len(of)), str(moving), str(good), f"{largest:.0f}", f"{held:.0f}", f"{on:.1f}")
            table.add_row(event, *row)
    return table


if __name__ == "__main__":
    sys.exit(main())
