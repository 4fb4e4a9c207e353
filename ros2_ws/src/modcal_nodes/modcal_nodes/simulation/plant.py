"""What the simulated cell does, at any time that is asked for, told by nobody's clock: arm, gear, springs, tracker.

The node ``simulated_cell`` says it aloud as time goes by; ``modcal simulate`` writes it into a bag at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadTable, about
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.delta import Delta
from modcal_core.robots.mechanism import Mechanism
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias
from modcal_nodes.io.inputs import read_delta
from modcal_nodes.simulation.delta_world import make_delta_world, require_drivable
from modcal_nodes.simulation.machine import Machine, tracker_and_tool
from modcal_nodes.simulation.program import Program, tour
from modcal_nodes.simulation.switches import Switches
from modcal_nodes.simulation.within_limits import within_limits
from modcal_nodes.simulation.world import World

TRACKER = "tracker"  # the frame that it reports in
TRACKER_PHASE = 2.0**0.5 - 1.0  # of a joint state's period: the same stamp would say that this is a finished station
_AWAY = 0.02  # rad or m; a nearer posture is the same arrival


class Plant:
    """An arm or a Delta with its tracker. chosen: the parameters of ``simulated_cell``. Times [s] must not go back.

    text: the URDF, empty for a Delta. chain: the nominal robot. world: the true one. switches: what may be changed.
    overloads: what the drives of the URDF cannot do however slowly, a sentence each.
    """

    def __init__(self, chosen: dict[str, Any]) -> None:
        """Raises ModcalError for choices that cannot be."""
        self.text, self.chain = _arm(chosen)
        rng = np.random.default_rng(chosen["seed"])
        compliance = _compliance(chosen["joint_compliance_rad_per_nm"], self.chain)
        off = chosen["length_std_m"], chosen["angle_std_rad"]
        self.world: Machine
        if isinstance(self.chain, Delta):
            self.world = make_delta_world(self.chain, rng, *off, compliance)
        else:
            assert isinstance(self.chain, Chain)
            self.world = make_world(self.chain, rng, *off, read_inertias(self.text, self.chain), compliance)
        self.switches = Switches(self.world, chosen)
        self._chosen, self._rng = chosen, rng
        self._noise = np.random.default_rng(chosen["seed"] + 1)
        self._arrivals = np.random.default_rng(chosen["seed"] + 2)
        if chosen["visit"]:  # what is random from here on belongs to the visit, not to the cell
            of_visit = np.random.SeedSequence((chosen["seed"], chosen["visit"])).spawn(3)
            self._rng, self._noise, self._arrivals = map(np.random.default_rng, of_visit)
        self._gear = self.chain.names.index(chosen["gear_joint"]) if chosen["gear_joint"] else None
        self._program = Program(np.clip(np.zeros(self.chain.n), self.chain.lower, self.chain.upper))
        self._miss = Program(np.zeros(self.chain.n))
        self._repeat = False
        self.overloads: tuple[str, ...] = ()
        self._own = self._tour() if chosen["stations"] else []
        if self._own:
            self.begin_own(0.0)

    @property
    def stops(self) -> int:
        """How many postures of its own it stands still at in a tour, returns included."""
        return len(self._own) // 2

    @property
    def end(self) -> float:
        """When the last posture is reached [s]."""
        return self._program.end

    # where it goes

    def begin_own(self, start: float) -> None:
        """Visit the postures of its own from this time on."""
        self._repeat = self._chosen["repeat"]
        self._go([(start + after, q) for after, q in self._own], start)

    def go(self, legs: list[tuple[float, Array]], start: float) -> None:
        """Reach each posture (n,) at its time after the start; the previous motion is dropped."""
        self._repeat, self._own = False, []
        self._go([(start + after, q) for after, q in legs], start)

    def keep_going(self, done: float, until: float) -> None:
        """Append tours of its own while it is to repeat them and they end before a time; before ``done`` none asks."""
        while self._repeat and until > self._program.end - self._chosen["travel_s"]:
            end, last = self._program.end, self._miss.at(self._program.end)
            legs = [(end + after, q) for after, q in self._tour()]
            self._miss.extend(self._missed(legs, self._program.at(end), last), done)
            self._program.extend(legs, done)

    def jump(self, before: float, now: float) -> None:
        """Go on at another time, the arm as it is; postures of its own restart when time moves backwards."""
        here, missed = self._program.at(before), self._miss.at(before)
        if now < before:
            self._program, self._miss = Program(here), Program(missed)
        self.switches.rebase(before, now)
        if now < before and self._own:
            self.begin_own(now)

    def _tour(self) -> list[tuple[float, Array]]:
        chosen = self._chosen
        legs = tour(self.chain, chosen["stations"], chosen["travel_s"], chosen["dwell_s"], self._rng, chosen["returns"])
        if not chosen["obey_limits"] or not isinstance(self.chain, Chain):
            return legs
        slowed = within_limits(legs, self._program.at(self._program.end), self.text, self.chain, chosen["payload_kg"])
        self.overloads = slowed.overloads
        return slowed.legs

    def _go(self, legs: list[tuple[float, Array]], start: float) -> None:
        self._miss.reset(start, self._missed(legs, self._program.at(start), self._miss.at(start)))
        self._program.reset(start, legs)

    def _missed(self, legs: list[tuple[float, Array]], q: Array, miss: Array) -> list[tuple[float, Array]]:
        """By how much each posture is missed (n,): again wherever the arm arrives."""
        out = []
        for at, goal in legs:
            if np.abs(goal - q).max() > _AWAY:
                q, miss = goal, self._chosen["repeatability_rad"] * self._arrivals.standard_normal(self.chain.n)
            out.append((at, miss))
        return out

    def _sent_to(self, t: float) -> Array:
        """Where motors and gears bring the joints (n,) at a time, before springs deflect."""
        reported = self._program.at(t)
        q = reported + self._miss.at(t)
        if (j := self._gear) is not None:
            q[j] += self._chosen["gear_amplitude_rad"] * np.sin(self._chosen["gear_cycles"] * reported[j])
        return q

    # what is seen of it

    def posture(self, t: float) -> Array:
        """What the joints report (n,)."""
        return self._program.at(t)

    def joints(self, t: float) -> tuple[Array, Array, Array | None]:
        """What the joints report: positions, velocities, and, if it is chosen, efforts, (n,)."""
        q, v = self._program.state(t)
        if not self._chosen["publish_effort"]:
            return q, v, None
        self.switches.pass_to(t)
        return q, v, self.world.holding(self._sent_to(t))

    def tool(self, t: float) -> Array:
        """The true pose of the tool in the base, T_base_tool (4, 4)."""
        self.switches.pass_to(t)
        return self.world.tool_in_base(self._sent_to(t))

    def read(self, T_base_tool: Array) -> Array:
        """What the tracker reads of a tool there, T_tracker_tool (4, 4), with its noise."""
        T = self.world.T_tracker_base @ T_base_tool
        T[:3, 3] += self._chosen["noise_m"] * self._noise.standard_normal(3)
        T[:3, :3] = T[:3, :3] @ so3.exp(self._chosen["noise_rad"] * self._noise.standard_normal(3))
        return T

    def temperature(self, t: float) -> tuple[str, float] | None:
        """The link that warms up and what its thermometer shows [°C]; None where none does."""
        if (felt := self.switches.temperature(t)) is None:
            return None
        return felt[0], felt[1] + self._chosen["temperature_noise_k"] * float(self._noise.standard_normal())


def make_world(
    chain: Chain,
    rng: np.random.Generator,
    length_std: float,
    angle_std: float,
    inertias: Inertias | None = None,
    compliance: ArrayLike = 0.0,
) -> World:
    """The true cell of a seed: tracker a few metres away, tool a hand's length from the tip, bodies displaced."""
    T_tracker_base, T_tip_tool = tracker_and_tool(rng)
    return World(chain, rng, length_std, angle_std, T_tracker_base, T_tip_tool, inertias, compliance)


def _arm(chosen: dict[str, Any]) -> tuple[str, Mechanism]:
    """The URDF's text, empty for a Delta, and the robot."""
    if chosen["measurement"] not in ("pose", "point"):
        raise BadTable(f"measurement '{chosen['measurement']}'", "pose and point are simulated", "set one of them")
    kind = "delta" if chosen["delta"] else "urdf"
    file = Path(chosen[kind])
    if not file.is_file():
        raise BadTable(f"{kind} '{file}'", "is not a file", f"set the parameter {kind}")
    chain: Mechanism
    if chosen["delta"]:
        text, chain = "", read_delta(file)
        require_drivable(chain)
    else:
        text = file.read_text(encoding="utf-8", errors="replace")
        with about(str(file)):
            chain = read_chain(text, chosen["base"] or None, chosen["tip"] or None)
    if chosen["gear_joint"] and chosen["gear_joint"] not in chain.names:
        said = f"joints are {', '.join(chain.names)}"
        raise BadTable(f"gear_joint '{chosen['gear_joint']}'", said, "name one of them")
    return text, chain


def _compliance(given: ArrayLike, chain: Mechanism) -> Array:
    """Compliance of every joint (n,) from one number for all, or one per joint."""
    compliance = np.asarray(given, dtype=float)
    if len(compliance) not in (1, chain.n) or not ((compliance >= 0.0) & (compliance <= 1e-3)).all():
        said = f"1 or {chain.n} numbers from 0 to 0.001 are understood"
        raise BadTable(f"joint_compliance_rad_per_nm {compliance.tolist()}", said, "set as many")
    return np.broadcast_to(compliance, (chain.n,))
