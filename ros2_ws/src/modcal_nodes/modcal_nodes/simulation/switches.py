"""Effects of the simulated cell that are switched on and off while it runs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, ModcalError
from modcal_nodes.simulation.machine import Machine

AMBIENT = 20.0  # °C
EXPANSION = 23e-6  # 1/K, aluminium
_VECTORS = {"tool_bump_m": 1.0, "tool_turn_rad": math.pi, "tracker_move_m": 10.0}  # longest that is taken
SWITCHES = (*_VECTORS, "payload_kg", "warm_up_link", "warm_up_m", "warm_up_s")


@dataclass(frozen=True)
class Growth:
    """A link that tends to a length: ``target + (first − target) exp(−(t − since) / tau)`` [m]."""

    since: float = 0.0
    first: float = 0.0
    target: float = 0.0
    tau: float = 60.0

    def at(self, t: float) -> float:
        """How much longer the link is at a time [m]."""
        return self.target + (self.first - self.target) * math.exp(-max(t - self.since, 0.0) / self.tau)


class Switches:
    """The present values of the switches, and what they do to a world."""

    def __init__(self, world: Machine, chosen: dict[str, Any]) -> None:
        """Begin with these values at time zero. Raises BadTable for one that cannot be."""
        self._world = world
        self._values = {name: chosen[name] for name in SWITCHES}
        self._growth: dict[str, Growth] = {}
        if (reason := self.refusal(self._values)) is not None:
            raise BadTable("simulated cell", reason, "set another value")
        for name, value in self._values.items():
            self.set(name, value, 0.0)

    def refusal(self, wanted: dict[str, Any]) -> str | None:
        """Why these values cannot be taken together with the others as they are, or None."""
        for name in _VECTORS.keys() & wanted.keys():
            v = np.asarray(wanted[name], dtype=float)
            if v.shape != (3,) or not np.isfinite(v).all():
                return f"{name} takes three finite numbers"
            if np.linalg.norm(v) > _VECTORS[name]:
                return f"{name} is longer than {_VECTORS[name]:.4g}"
        for name in ("payload_kg", "warm_up_m", "warm_up_s"):
            if not math.isfinite(wanted.get(name, 0.0)):
                return f"{name} takes a finite number"
        both = {**self._values, **wanted}
        if both["warm_up_m"] != 0.0 and not both["warm_up_link"]:
            return "warm_up_link must name the link that warms up before warm_up_m is set"
        if both["warm_up_link"]:
            try:
                self._world.length(both["warm_up_link"])
            except ModcalError as error:
                return f"warm_up_link: {error}"
        return None

    def value(self, name: str) -> Any:
        """The present value of a switch."""
        value = self._values[name]
        return list(value) if name in _VECTORS else value

    def set(self, name: str, value: Any, now: float) -> None:
        """Take a value that :meth:`refusal` does not refuse, from this time [s] on."""
        self._values[name] = value
        if name == "payload_kg":
            self._world.carry(value)
        elif name in ("tool_bump_m", "tool_turn_rad"):
            self._world.bump(self._values["tool_bump_m"], self._values["tool_turn_rad"])
        elif name == "tracker_move_m":
            self._world.move_tracker(value)
        else:
            self._warm(now)

    def rebase(self, before: float, after: float) -> None:
        """The time that was ``before`` is now called ``after``; nothing warms or cools by that."""
        self._growth = {
            link: Growth(after, growth.at(before), growth.target, growth.tau) for link, growth in self._growth.items()
        }

    def pass_to(self, now: float) -> None:
        """Let the warm links of the world be as long as they are at a time [s]."""
        for link, growth in self._growth.items():
            self._world.grow(link, growth.at(now))

    def temperature(self, now: float) -> tuple[str, float] | None:
        """The link that ``warm_up_link`` names and how warm it is [°C]; None where it names none."""
        link = self._values["warm_up_link"]
        if not link:
            return None
        return link, AMBIENT + self._growth[link].at(now) / (EXPANSION * self._world.length(link))

    def _warm(self, now: float) -> None:
        """The named link tends to its growth; any other one cools."""
        named, tau = self._values["warm_up_link"], self._values["warm_up_s"]
        if named:
            self._growth.setdefault(named, Growth())
        self._growth = {
            link: Growth(now, growth.at(now), self._values["warm_up_m"] if link == named else 0.0, tau)
            for link, growth in self._growth.items()
        }
