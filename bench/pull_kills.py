"""Nodes killed, paused, stopped and deactivated at random moments of a pull: are limits kept, and is the hand let go?

    make bench NAME=pull_kills                     # ARGS="--pulls 20 --first 5" for fewer, others

Every pull is a random door or drawer in MuJoCo (modcal_nodes/simulation/furniture.py), in real time, with the real
nodes over DDS. At a random moment one of them is killed (SIGKILL), asked to end (SIGTERM) or paused (SIGSTOP, and
SIGCONT after `PAUSE` s), or the setpoint node is stopped by its service or deactivated. Then the world goes on for
some seconds. Asked of every pull:

* each joint reference is finite, within the joints' ranges and speed, and no more than two steps away from the last;
* the hand feels no more than 1.2 times `max_force_n` at any time;
* references end within `QUIET` s, and the object is let go: less than `LET_GO` N at the end. A setpoint node that was
  killed sends nothing any more, so there the force must only not grow; where the world was killed, there is none;
* an arm that is heard again after a pause is let go, and not led on.

A pull that does not begin is named and replaced by another scene's. Exit code 1 where one of them fails, or more than a
tenth do not begin.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from dataclasses import dataclass, field

import harness

# isort: split
import conftest  # noqa: F401 (finds the install tree)
import numpy as np
from lifecycle_msgs.msg import Transition
from nodes.polling import Polled
from nodes.processes import Process, fresh_domain, listener, running
from nodes.pulling import (
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
from nodes.talking import RELIABLE, Diagnostics
from rclpy.node import Node
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectoryPoint

from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.furniture import draw

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
    *(f"{how} {who}" for who in (ESTIMATOR, SETPOINT) for how in ("kill", "end")),
    *(f"kill {WORLD}", f"pause {WORLD}", "deactivate", "stop"),
)


@dataclass
class References:
    """The joint references that were sent, and when [s, this machine's clock]."""

    at: list[float] = field(default_factory=list)
    q: list[list[float]] = field(default_factory=list)
    v: list[list[float]] = field(default_factory=list)

    def take(self, message: JointTrajectoryPoint) -> None:
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


def _spin(wait: Wait, seconds: float) -> None:
    """Take messages for so long."""
    end = time.monotonic() + seconds
    wait(lambda: time.monotonic() >= end, seconds)


def _force(told: Told, last: float) -> float:
    """The median of the contact force [N] in the last so many seconds that the world told of."""
    newest = told.forces[-1][0]
    return float(np.median([f for t, f in told.forces if t >= newest - last]))


def pull(seed: int, event: str) -> harness.Result:
    """One pull in a scene of its own, and the event in it. Forces [N]: largest, before, last; times [s]."""
    scene = draw(CHAIN, np.random.default_rng(seed))
    moment = float(np.random.default_rng([seed, 77]).uniform(*MOMENTS))
    domain, paused = fresh_domain(), event.startswith("pause")
    sent, told = References(), Told()
    with contextlib.ExitStack() as until_over:
        folder = until_over.enter_context(harness.scratch())
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
        nodes = {ESTIMATOR: estimator, SETPOINT: setpoint, WORLD: world}
        _apply(event, nodes, node, wait)
        over = time.monotonic()
        _spin(wait, AFTER_PAUSE if paused else AFTER)
        ended = [name for name, process in nodes.items() if name not in event and process.popen.poll() is not None]
        for process in (world, estimator, setpoint):
            if process.popen.poll() is None:
                process.stop()
    force, last = max(f for _, f in told.forces), _force(told, 0.5)
    went_on = sent.at[-1] - over if sent.at else 0.0
    faults = sent.faults() + [f"{name} has ended" for name in ended]
    if force > MAX_FORCE:
        faults.append(f"the hand felt {force:.0f} N")
    if event == f"kill {SETPOINT}":
        if last > max(before, LET_GO) + 5.0:
            faults.append(f"the force grew from {before:.0f} to {last:.0f} N")
    elif went_on > (QUIET_PAUSE if paused else QUIET):
        faults.append(f"references went on for {went_on:.1f} s")
    elif last > LET_GO and event != f"kill {WORLD}":
        faults.append(f"{last:.0f} N are still held")
    elif pulling and went_on < 0.0 and paused:
        faults.append("nothing was sent after the pause")
    out = {"moment": moment, "pulling": pulling, "force": force, "before": before, "last": last, "faults": faults}
    return {**out, "references": len(sent.q), "went_on": went_on, "said": health.last[PULL].message}


def one(task: harness.Task) -> harness.Result:
    """One pull; of another scene where the first does not begin, as on a machine that gives a node no time."""
    try:
        return {**pull(task["seed"], task["event"]), "idle": ""}
    except AssertionError as error:
        return {**pull(task["other"], task["event"]), "idle": str(error).splitlines()[-1]}


def line(r: harness.Result) -> str:
    """A pull in words."""
    force = f"at most {r['force']:.0f} N, {r['before']:.0f} N before, {r['last']:.0f} N in the end"
    found = f"references for {r['went_on']:.2f} s, '{r['said']}'; {'; '.join(r['faults']) or 'as it should be'}"
    return f"at {r['moment']:.1f} s, {'' if r['pulling'] else 'not '}in motion: {force}, {found} {r['idle']}"


def main() -> int:
    made = harness.parser(__doc__, seeds=0, names=EVENTS, jobs=1)
    made.add_argument("--pulls", type=int, default=200)
    made.add_argument("--first", type=int, default=0, help="seed of the first scene")
    given = harness.parsed(made)
    events = [given.names[k % len(given.names)] for k in range(given.pulls)]
    tasks = [
        {"seed": given.first + k, "event": e, "other": given.first + k + given.pulls} for k, e in enumerate(events)
    ]
    results = harness.each(one, tasks, given, line)
    failed, runs = harness.failures(results), [r for r in results if r["failed"] is None]
    rows = []
    for event in given.names:
        if of := [r for r in runs if r["event"] == event]:
            good, moving = sum(not r["faults"] for r in of), sum(r["pulling"] for r in of)
            most = [max(r[key] for r in of) for key in ("force", "last", "went_on")]
            rows.append([event, len(of), moving, good, f"{most[0]:.0f}", f"{most[1]:.0f}", f"{most[2]:.1f}"])
    heads = ("event", "pulls", "in motion", "as it should be", "largest force, N", "held in the end, N", "went on, s")
    harness.table(f"{len(runs)} pulls, {sum(r['references'] for r in runs)} references", heads, rows)
    idle = failed + sum(bool(r["idle"]) for r in runs)
    return harness.met(
        (f"{idle} pulls did not begin", not failed and idle <= given.pulls // 10),
        ("every pull as it should be", not any(r["faults"] for r in runs)),
    )


if __name__ == "__main__":
    sys.exit(main())
