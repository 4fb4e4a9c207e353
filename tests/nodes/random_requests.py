"""Requests at random in the middle of pulls: illegal transitions, parameters of every kind, `~/pull` and `~/stop`."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from impedance.toy import Toy, door, drawer
from lifecycle_msgs.msg import Transition
from nodes.processes import Wait, put
from nodes.pulled_arm import NASTY, PulledArm, Witness

from modcal_nodes.ros.parameters import IMPEDANCE_SETPOINT
from modcal_nodes.setpoint import WHILE_PULLING

_BY_ITSELF = 6.0  # s
LIMIT, LET_GO = 60.0, 10.0  # N: 1.2 times max_force_n; what friction and a soft spring leave in a hand
_ILLEGAL = (
    Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_CREATE, 99,
)  # fmt: skip
_DEFAULTS = {name: float(IMPEDANCE_SETPOINT[name].default) for name in WHILE_PULLING}
# limits that a witness of the defaults can judge are only lowered; a smaller one of these lets more happen
_NOT_LOWERED = ("min_gain", "contact_stiffness_n_m", "arm_stiffness_n_m")


class RandomRequests:
    """Asks an active node; ``count`` says of what how many. Raises AssertionError where a witness objects."""

    def __init__(self, arm: PulledArm, wait: Wait, rng: np.random.Generator) -> None:
        self.arm, self.wait, self.rng, self.witness = arm, wait, rng, Witness(arm)
        self.count: Counter[str] = Counter()

    def run(self, requests: int) -> None:
        """So many requests, in pulls at what turns, slides or is locked, each let go at its end."""
        while self.count.total() - self.count["pulls"] < requests:
            self._one_pull()

    def _one_pull(self) -> None:
        arm, rng = self.arm, self.rng
        toy = (Toy(door(), locked=True), Toy(door()), Toy(drawer(), friction=6.0, inertia=4.0))[rng.integers(3)]
        self.parameters(_DEFAULTS)
        arm.again(self.wait, toy)
        arm.pull(self.wait)
        self.count["pulls"] += 1
        self._pass(float(rng.uniform(0.3, 4.0)))
        for _ in range(int(rng.integers(1, 8))):
            self._ask()
            self._pass(float(rng.uniform(0.0, 0.4)))
            self.witness.look()
        if rng.random() < 0.5:  # what is locked ends by itself
            until = arm.now() + _BY_ITSELF
            self.wait(lambda: not self._phase() or arm.now() > until, 120.0)
        arm.ask(self.wait, "stop")
        self._pass(0.2)
        self.witness.look()
        left = float(np.linalg.norm(toy.contact[:3]))
        assert toy.peak < LIMIT, f"{toy.peak:.0f} N were felt: {arm.said()}"
        assert left < LET_GO, f"{left:.0f} N are still held: {arm.said()}"

    def _ask(self) -> None:
        arm, rng = self.arm, self.rng
        kind = str(rng.choice(["transition", "limit", "limit", "hostile", "fixed", "pull"]))
        self.count[kind] += 1
        if kind == "transition":
            assert not arm.change(self.wait, int(rng.choice(_ILLEGAL)))
        elif kind == "pull":
            self.count["pulls"] += int(arm.ask(self.wait, "pull").success)
        elif kind == "fixed":  # what cannot change while it pulls; where nothing is pulled any more, it may
            default = float(IMPEDANCE_SETPOINT["blend_s"].default)
            if self.parameters({"blend_s": 0.5 * default}):
                self.parameters({"blend_s": default})
        else:
            names = sorted(WHILE_PULLING)
            name = names[rng.integers(len(names))]
            if kind == "limit":
                share = 1.0 / rng.uniform(0.1, 1.0) if name in _NOT_LOWERED else rng.uniform(0.1, 1.0)
                self.parameters({name: _DEFAULTS[name] * float(share)})
            else:
                value = float(NASTY[rng.integers(len(NASTY))])
                taken = self.parameters({name: value})
                if taken:
                    assert math.isfinite(value), f"{name}: {value} was taken"
                    self.parameters({name: _DEFAULTS[name]})

    def _phase(self) -> str:
        """What the pull is doing, as the node last said; empty where nothing is pulled."""
        return next((pair.value for pair in self.arm.health["pull"].values if pair.key == "phase"), "")

    def parameters(self, new: dict[str, float]) -> bool:
        """Set these together; whether all of them were taken."""
        return not put(self.arm.node, self.wait, "impedance_setpoint", **new)

    def _pass(self, seconds: float) -> None:
        """Let so much of the arm's time pass."""
        until = self.arm.now() + seconds
        self.wait(lambda: self.arm.now() >= until, 120.0)
