"""What the simulated cell does, at any time that is asked for, told by nobody's clock: arm, gear, springs, tracker.

The node ``simulated_cell`` says it aloud as time goes by; ``modcal simulate`` writes it into a bag at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadTable, ModcalError, about
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import POINT, POSE, JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_core.robots import Chain, Delta, Inertias, Mechanism, read_chain, read_inertias
from modcal_nodes.io import Watch, read_delta, silent
from modcal_nodes.simulation.delta_world import make_delta_world, require_drivable
from modcal_nodes.simulation.mjcf import Machine, World, tracker_and_tool
from modcal_nodes.simulation.program import Program, tour, within_limits

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
    compliance = np.asarray(given, dtype=float)
    if len(compliance) not in (1, chain.n) or not ((compliance >= 0.0) & (compliance <= 1e-3)).all():
        said = f"1 or {chain.n} numbers from 0 to 0.001 are understood"
        raise BadTable(f"joint_compliance_rad_per_nm {compliance.tolist()}", said, "set as many")
    return np.broadcast_to(compliance, (chain.n,))


class Grid:
    """Times ``start + (k + phase) / rate`` [s], each of them handed out once. rate: [Hz]."""

    def __init__(self, rate: float, phase: float = 0.0) -> None:
        self.rate, self._phase = rate, phase
        self.count = 0
        self.start(0.0)

    def start(self, at: float) -> None:
        """Start over at a time."""
        self._start, self._k = at, 0

    def take(self, until: float) -> Iterator[float]:
        """The times up to ``until`` that have not been handed out yet."""
        while (due := self._start + (self._k + self._phase) / self.rate) <= until:
            self._k += 1
            yield due
            self.count += 1  # once it has been dealt with


_TEMPERATURE_RATE = 1.0  # Hz
_MANY = 100  # moments between two words of how far it is


def recorded(
    plant: Plant, chosen: dict[str, Any], changes: list[tuple[float, str, Any]], watch: Watch = silent
) -> Recording:
    """Everything the cell says until its last posture. changes: (seconds, switch, value), in order.

    Raises BadTable for a change that cannot be.
    """
    fast, slow = chosen["joint_rate_hz"], chosen["tracker_rate_hz"]
    grids = (Grid(fast), Grid(slow, TRACKER_PHASE * slow / fast), Grid(_TEMPERATURE_RATE))
    joints: list[tuple[float, Array]] = []
    readings: list[tuple[float, Array]] = []
    felt: dict[str, list[tuple[float, float]]] = {}

    def moments(grid: Grid, stop: float, doing: str) -> Iterator[float]:
        for i, t in enumerate(grid.take(stop)):
            if i % _MANY == 0:
                watch(doing, t / plant.end)
            yield t

    for until, change in [*((when, (when, name, value)) for when, name, value in changes), (math.inf, None)]:
        stop = min(until, plant.end)
        for t in moments(grids[0], stop, "moving the arm"):
            q, v, effort = plant.joints(t)
            joints.append((t, np.r_[q, v, np.full_like(q, np.nan) if effort is None else effort]))
        readings += [(t, plant.read(plant.tool(t))) for t in moments(grids[1], stop, "reading the tracker")]
        for t in grids[2].take(stop):
            if (warm := plant.temperature(t)) is not None:
                felt.setdefault(warm[0], []).append((t, warm[1]))
        if change is not None:
            _switch(plant, *change)
    first = chosen["clock_start_s"]
    t, columns = first + np.array([x for x, _ in joints]), np.array([c for _, c in joints])
    position, velocity, effort = np.split(columns, 3, axis=1)
    s = first + np.array([x for x, _ in readings])
    poses = se3.to_pose(np.array([T for _, T in readings]))
    points = chosen["measurement"] == POINT
    return Recording(
        (JointTrack(plant.chain.names, t, position, velocity, effort, t),),
        (ReadingTrack(POINT if points else POSE, TRACKER, s, poses[:, :3] if points else poses, s),),
        tuple(
            SignalTrack(f"temperature:{link}", first + np.array(rows)[:, 0], np.array(rows)[:, 1:])
            for link, rows in felt.items()
        ),
        plant.text or None,
    )


def _switch(plant: Plant, when: float, name: str, value: Any) -> None:
    at = f"--at {when:g} {name}"
    if name not in SWITCHES:
        raise BadTable(at, "cannot change in time", f"use one of {', '.join(SWITCHES)}, or -p")
    if when >= plant.end:
        raise BadTable(at, f"the last posture is reached at {plant.end:.0f} s", "change it earlier")
    if (reason := plant.switches.refusal({name: value})) is not None:
        raise BadTable(at, reason, "set another value")
    plant.switches.set(name, value, when)
