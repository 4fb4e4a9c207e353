"""Nodes killed, paused, stopped and deactivated at random moments of a pull: are limits kept, and is the hand let go?

Every pull is a random door or drawer in MuJoCo, in real time, with the real nodes over DDS. At a random moment one of
them is killed (SIGKILL), asked to end (SIGTERM) or paused (SIGSTOP, and SIGCONT after `PAUSE` s), or the setpoint node
is stopped by its service or deactivated. Then the world goes on for some seconds. Asked of every pull:

* each joint reference is finite, within the joints' ranges and speed, and no more than two steps away from the last;
* the hand feels no more than 1.2 times `max_force_n` at any time;
* references end within `QUIET` s, and the object is let go: less than `LET_GO` N at the end. A setpoint node that was
  killed sends nothing any more, so there the force must only not grow; where the world was killed, there is none;
* an arm that is heard again after a pause is let go, and not led on.

A pull that does not begin is replaced by another scene's.
"""

from __future__ import annotations

import contextlib
import signal
import time
from dataclasses import dataclass, field

import harness
import numpy as np
from harness import over
from lifecycle_msgs.msg import Transition
from nodes.polling import Polled
from nodes.processes import Process, ask, fresh_domain, listener, running
from nodes.pulling import ESTIMATOR, PANDA, PULL, SETPOINT, WORLD, Told, begin, change, followers, until_heard
from nodes.talking import RELIABLE, Diagnostics
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
SIGNALS = {"kill": signal.SIGKILL, "end": signal.SIGTERM, "pause": signal.SIGSTOP}
OTHER = 10_000  # seeds to the scene that replaces one
EVENTS = (
    *(f"{how} {who}" for who in (ESTIMATOR, SETPOINT) for how in ("kill", "end")),
    *(f"kill {WORLD}", f"pause {WORLD}", "deactivate", "stop"),
)
COLUMNS = {
    "in motion": over("pulling", sum),
    "peak N, most": over("peak", max),
    "held in the end, N": over("last", max),
}
COLUMNS |= {"went on, s": over("went_on", max), "references": over("references", sum)}


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


def force(told: Told, last: float) -> float:
    """The median of the contact force [N] in the last so many seconds that the world told of."""
    newest = told.forces[-1][0]
    return float(np.median([f for t, f in told.forces if t >= newest - last]))


def pull(seed: int, event: str) -> harness.Result:
    """One pull in a scene of its own, and the event in it. Forces [N]: peak, before, last; times [s]."""
    scene = draw(CHAIN, np.random.default_rng(seed))
    moment = float(np.random.default_rng([seed, 77]).uniform(*MOMENTS))
    domain, (how, _, who), sent, told = fresh_domain(), event.partition(" "), References(), Told()
    paused = how == "pause"
    with contextlib.ExitStack() as until_over:
        folder = until_over.enter_context(harness.scratch())
        estimator, setpoint = followers(folder, domain, scene, {}, {"goal": float(scene.goal)})
        until_over.enter_context(running(estimator, setpoint))
        node, wait = until_over.enter_context(listener(domain))

        def spin(seconds: float) -> None:
            end = time.monotonic() + seconds
            wait(lambda: time.monotonic() >= end, seconds)

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
        spin(moment)
        before, pulling = force(told, 0.2), bool(sent.at) and time.monotonic() - sent.at[-1] < PULLING
        nodes = {ESTIMATOR: estimator, SETPOINT: setpoint, WORLD: world}
        if who:
            nodes[who].popen.send_signal(SIGNALS[how])
        elif how == "deactivate":
            change(node, wait, SETPOINT, Transition.TRANSITION_DEACTIVATE)
        else:
            ask(node, wait, Trigger, f"{SETPOINT}/stop", Trigger.Request())
        if paused:
            spin(PAUSE)
            nodes[who].popen.send_signal(signal.SIGCONT)
        over = time.monotonic()
        spin(AFTER_PAUSE if paused else AFTER)
        ended = [name for name, process in nodes.items() if name not in event and process.popen.poll() is not None]
        for process in (world, estimator, setpoint):
            if process.popen.poll() is None:
                process.stop()
    peak, last = max(f for _, f in told.forces), force(told, 0.5)
    went_on = sent.at[-1] - over if sent.at else 0.0
    faults = sent.faults() + [f"{name} has ended" for name in ended]
    if peak > MAX_FORCE:
        faults.append(f"the hand felt {peak:.0f} N")
    if event == f"kill {SETPOINT}":
        if last > max(before, LET_GO) + 5.0:
            faults.append(f"the force grew from {before:.0f} to {last:.0f} N")
    elif went_on > (QUIET_PAUSE if paused else QUIET):
        faults.append(f"references went on for {went_on:.1f} s")
    elif last > LET_GO and event != f"kill {WORLD}":
        faults.append(f"{last:.0f} N are still held")
    elif pulling and went_on < 0.0 and paused:
        faults.append("nothing was sent after the pause")
    out = {"moment": moment, "pulling": pulling, "peak": peak, "before": before, "last": last, "faults": faults}
    out |= {"kind": scene.kind, "held": scene.grasp, "references": len(sent.q), "went_on": went_on}
    return {**out, "said": health.last[PULL].message}


def one(task: harness.Task) -> harness.Result:
    """One pull; of another scene where the first does not begin, as on a machine that gives a node no time."""
    event = task["name"].partition(": ")[2]
    try:
        return {**pull(task["seed"], event), "idle": ""}
    except AssertionError as error:
        return {**pull(task["seed"] + OTHER, event), "idle": str(error).splitlines()[-1]}
