"""Doors and drawers pulled open: random ones, what must not be forced, what is hard to open, broken sensors and nodes.

    make bench NAME=doors                             # all; hours, for time is simulated at the pace of the real one
    make bench NAME=doors ARGS="--one-process"        # without nodes between modcal and the physics: some minutes
    make bench NAME=doors ARGS="--only modcal stiff --seeds 10"
    make bench NAME=doors ARGS="--only closer magnet --grasp ball"
    make bench NAME=doors ARGS="--only sensor --first 100"
    make bench NAME=doors ARGS="--only event --seeds 3"

Random scenes (modcal_nodes/simulation/furniture.py) are pulled by modcal, which knows the tool's weight and that one
pulls along the hand, and in plain ways for comparison. Stubborn ones are locked, jam, or are no joint. Time is
simulated and waits for the next setpoint, so that the physics does not depend on what else runs.

hard: pulled with both grasps, and it is stated how hard one may pull. What needs less than that, pulled slowly in
MuJoCo, is to be opened by no more than it; the others are to be let go below 1.2 times as much, for a true reason.

sensor: scenes that jam on the way or are locked, in this process, while the force sensor departs from the truth, with
its noise going on: frozen from 2 mm or 2 mrad before the jam, as soon as so many N are felt; repeats: to the last
digit; stuck: wherever that is; deaf, half: a fifth, or half, of what has been added since the first reading;
unconnected: what it said at first. What is free with a sound one must open. The hand may feel 60 N, and 10 N when it
has been let go. Scenes of seeds below 100 may be looked at to improve the core. --efforts: what joint states report;
--servo: stiffness of the joints [N m/rad]; --stated, --lead: arm_stiffness_n_m and max_joint_lead_rad, of which 0.022
is true of these servos; --late: mean delay of messages [s]; --integral: time of the servos' integral part [s], with
--cascaded in a loop of speed.

efforts: random scenes pulled by the joints' efforts alone, and with a sound force sensor. Joints have dry friction of
1 to 4 % of their full effort and torque constants that are off by 5 %; the hand came freely to the handle before.

matrix: sensors that tell all, a part or nothing of a force, or freeze before a jam, on servos and fingers of every
stiffness, in this process. The hand came freely to the handle before (--blind: it did not, so that nothing is known of
the sensor). At most 1.2 times what is stated may be felt, or the pull is refused before it begins.

event: nodes killed, paused, stopped and deactivated at random moments of a pull; see events.py.

Exit code 1 where a target is missed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import conftest  # noqa: F401 (finds the install tree)
import events
import mujoco
import numpy as np
from harness import median, over, share
from nodes import own_pull
from nodes.plain_pulls import Pull, Way, learnt_wrong, pull, straight
from nodes.pulling import PANDA, open_it
from nodes.reported_efforts import KINDS, ReportedEfforts

from modcal_core.geometry import Array
from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.furniture import FREE, Furniture, draw
from modcal_nodes.simulation.mjcf import Servo
from modcal_nodes.simulation.pulling import Pulling, effort_limits

URDF = PANDA.read_text()
CHAIN = read_chain(URDF)
OWN, STIFF, HARD_SEED = "modcal", "stiff, straight", 1000
PLAIN: dict[str, tuple[Callable[[Furniture], Way], bool]] = {
    STIFF: (straight, False),
    "admittance, straight": (straight, True),
    "stiff, learnt wrong": (learnt_wrong, False),
    "admittance, learnt wrong": (learnt_wrong, True),
}
MIN_OPENED, MAX_PEAK, MAX_MEAN, MIN_RATIO, MAX_STUBBORN = 0.95, 40.0, 12.0, 8.0, 60.0
STUBBORN: dict[str, dict[str, Any]] = {
    "locked door": {"kind": "door", "stop": 0.0},
    "locked drawer": {"kind": "drawer", "stop": 0.0},
    "door that jams at 25°": {"kind": "door", "stop": 0.436},
    "drawer that jams at 12 cm": {"kind": "drawer", "stop": 0.12},
    "folding door": {"kind": "folding"},
}
USUAL, SEALED, MAX_REFUSED = 50.0, 80.0, 1.2  # N that are stated; times that
GRASPS = ("weld", "ball")
REFUSED = ("tool_mass weighs",)
REASONS = ("does not move", "stopped moving", "beyond the limit", "jammed")
DOOR, DRAWER = {"kind": "door", "spring": 0.0, "friction": 0.5}, {"kind": "drawer", "spring": 0.0, "friction": 2.0}
HEAVY, TRUCK = {**DOOR, "mass_kg": 40.0}, {**DRAWER, "mass_kg": 40.0}
# name; sizes [N] and what resists by that much; the rest of the scene; how hard one may pull [N]. The order draws the
# scenes, so that new ones stand at the end.
RESISTING: tuple[tuple[str, str, tuple[int, ...], dict[str, Any], float], ...] = (
    ("hard: door, closer {} N", "closer", (10, 18, 25, 32, 40), HEAVY, USUAL),
    ("hard: drawer, preload {} N", "closer", (15, 30, 42), DRAWER, USUAL),
    ("hard: cupboard, magnet {} N", "magnet", (20, 40, 65), DOOR, SEALED),
    ("hard: drawer, magnet {} N", "magnet", (30, 60), DRAWER, SEALED),
    ("hard: fridge, gasket {} N", "gasket", (30, 50, 68), HEAVY, SEALED),
    ("hard: freezer drawer, gasket {} N", "gasket", (35, 65), TRUCK, SEALED),
    ("hard: drawer that sticks, {} N", "stick_slip", (10, 20, 35), DRAWER, USUAL),
    ("hard: door that sticks, {} N", "stick_slip", (12, 25), DOOR, USUAL),
    ("hard: drawer with notches, {} N", "detents", (8, 20), DRAWER, USUAL),
    ("hard: door with notches, {} N", "detents", (6, 15), DOOR, USUAL),
    ("hard: oven lid over centre, {} N", "over_centre", (12, 25, 38), DOOR, USUAL),
    ("hard: drawer over centre, {} N", "over_centre", (15, 35), DRAWER, USUAL),
    ("hard: drawer, soft end {} N", "soft_end", (20, 38), DRAWER, USUAL),
    ("hard: door of {} kg", "", (60,), {**DOOR, "mass_kg": 60.0}, USUAL),
    ("hard: drawer of {} kg", "", (60,), {**DRAWER, "mass_kg": 60.0}, USUAL),
    ("hard: door that ends at {}°", "", (35,), {**DOOR, "stop": 0.61}, USUAL),
    ("hard: closer {} N and an end at 45°", "closer", (20,), {**HEAVY, "stop": 0.785}, USUAL),
    ("hard: drawer that ends at {} cm", "", (18,), {**DRAWER, "stop": 0.18}, USUAL),
    ("hard: drawer that sticks by {} N and ends at 15 cm", "stick_slip", (15,), {**DRAWER, "stop": 0.15}, USUAL),
    ("hard: door, closer {} N", "closer", (70,), HEAVY, USUAL),
    ("hard: cupboard, magnet {} N", "magnet", (90,), DOOR, USUAL),
    ("hard: fridge, gasket {} N", "gasket", (120,), HEAVY, SEALED),
    ("hard: drawer, preload {} N", "closer", (90,), DRAWER, USUAL),
)
HARD: dict[str, tuple[dict[str, Any], float]] = {
    name.format(n): ({**what, "resistance": f"{by} {n}"} if by else what, stated)
    for name, by, sizes, what, stated in RESISTING
    for n in sizes
}
LIMIT, LET_GO = 60.0, 10.0  # N
NEAR = 2e-3  # m or rad before the jam
NOISE = np.array([0.2] * 3 + [0.01] * 3)  # N, N m: that of the simulated sensor
SHARES = {"deaf": 0.2, "half": 0.5, "unconnected": 0.0}
SENSORS = (*(f"frozen {n}" for n in (0, 3, 12, 25)), "repeats 12", "stuck 3", "stuck 12", *SHARES, "sound")
BY_EFFORTS, SOUND, MIN_SHARE = "efforts: alone", "efforts: sensor", 0.9
SERVOS, FINGERS = (1500.0, 4000.0, 12e3, 30e3), (3e3, 20e3, 700e3)  # N m/rad, N/m
PARTS = {"whole": 1.0, "half": 0.5, "third": 1.0 / 3.0, "fifth": 0.2, "frozen 3": 1.0, "stuck 12": 1.0}
MATRIX = {f"matrix: {part}, {servo:.0f} N m/rad, {grasp / 1e3:.0f} kN/m": (part, servo, grasp)
          for part in PARTS for servo in SERVOS for grasp in FINGERS}  # fmt: skip
GROUPS: dict[str, tuple[tuple[str, ...], int]] = {  # names, and seeds of each
    "random": ((*PLAIN, OWN), 50),
    "stubborn": (tuple(STUBBORN), 2),
    "hard": (tuple(HARD), 1),
    "sensor": (tuple(f"sensor: {fault}" for fault in SENSORS), 12),
    "efforts": ((BY_EFFORTS, SOUND), 30),
    "matrix": (tuple(MATRIX), 1),
    "event": (tuple(f"event: {event}" for event in events.EVENTS), 25),
}


def needed(scene: Furniture) -> float:
    """The largest force along the handle's way [N] that takes it to the goal slowly, by MuJoCo's inverse dynamics; inf
    where it ends before.
    """
    if 0.0 <= scene.stop < scene.goal:
        return float("inf")
    world, slowly, most = Pulling.of(URDF, CHAIN, scene, np.random.default_rng(0)), 0.005, 0.0
    model, data = world.model, world.data
    joint = model.joint(world.object_joints[0])
    at, moved = int(joint.qposadr[0]), int(joint.dofadr[0])
    lever = scene.radius if scene.turns else 1.0
    data.eq_active[:] = 0  # nobody holds the handle
    for way in np.concatenate([np.linspace(1e-4, 0.02, 60), np.linspace(0.02, lever * scene.goal, 60)]):
        data.qpos[at] = way / lever
        data.qvel[:], data.qacc[:] = 0.0, 0.0
        data.qvel[moved] = slowly / lever
        mujoco.mj_inverse(model, data)
        # by inverse dynamics, friction of a joint that moves steadily is a force that its constraint has to give
        held = scene.resistance.force(float(way), slowly) if scene.resistance is not None else 0.0
        most = max(most, data.qfrc_inverse[moved] / lever + held)
    return float(most)


def faults(drawn: Furniture, made: Pull, need: float, stated: float) -> list[str]:
    """What is wrong with a pull at what is hard to open, nothing where nothing is."""
    out = []
    if made.peak > (stated if need < stated else MAX_REFUSED * stated):
        out.append(f"{made.peak:.0f} N")
    if need < stated and not made.done:
        out.append("not opened")
    if need >= stated and not any(words in made.said for words in REASONS):
        out.append("another reason")
    if "open to " in made.said:
        said = made.said.split("open to ")[1]
        value, turn = float(said.split("°")[0].split(" cm")[0]), "°" in said
        truth = np.degrees(made.opened) if drawn.turns else 100.0 * made.opened
        if turn != drawn.turns or abs(value - truth) > (3.0 if turn else 2.0):
            out.append(f"said {said[:8]}, is {truth:.0f}")
    return out


def scene_of(task: harness.Task) -> harness.Result:
    """A pull at a random, stubborn or hard scene: peak and mean force [N], opened and goal [rad or m], what it said."""
    name, seed, times = task["name"], task["seed"], {}
    what, stated = HARD.get(name, (STUBBORN.get(name, {}), None))
    what = {**what, "grasp": task["grasp"]} if task["grasp"] else what
    asked = {"max_force_n": stated} if stated else {}
    drawn = draw(CHAIN, np.random.default_rng(seed), what)
    world = Pulling.of(URDF, CHAIN, drawn, np.random.default_rng(seed))
    if name in PLAIN:
        way, compliant = PLAIN[name]
        made = pull(world, way(drawn), compliant)
    elif task["one_process"]:
        made = own_pull.pull(world, URDF, **asked)
    else:
        factor = task["time_factor"]
        paced = {"publish_clock": True, "keep_step": True, "time_factor": factor} if factor else {}
        with harness.scratch() as folder:
            opening = open_it(folder, drawn, {"seed": seed, **what, **paced}, 300.0, **asked)
        made, times = opening.pull, {"took": opening.seconds, "gap": opening.gap}
    out = {**asdict(made), "done": made.done, "kind": drawn.kind, "held": drawn.grasp, **times}
    if stated:
        need = needed(drawn)
        out |= {"stated": stated, "needed": need, "faults": faults(drawn, made, need, stated)}
    return out


class Sensor:
    """What the force sensor says of the wrench (6,) at its place, with one of the faults."""

    def __init__(self, fault: str, world: Pulling, rng: np.random.Generator) -> None:
        self.kind, _, newtons = fault.partition(" ")
        self.force, self._world, self._rng = float(newtons or 0.0), world, rng
        self._first: Array | None = None
        self._held: Array | None = None

    def __call__(self, w: Array) -> Array:
        if self._first is None:
            self._first = w
        if self.kind == "sound":
            return w
        if self.kind in SHARES:
            return self._first + SHARES[self.kind] * (w - self._first) + NOISE * self._rng.standard_normal(6)
        near = self.kind == "stuck" or self._world.opened > self._world.scene.stop - NEAR
        if self._held is None and near and np.linalg.norm(w[:3] - self._first[:3]) > self.force:
            self._held = w
        if self._held is None:
            return w
        return self._held if self.kind == "repeats" else self._held + NOISE * self._rng.standard_normal(6)


def sensed(task: harness.Task) -> harness.Result:
    """A pull with a force sensor. last: the force in the end [N]."""
    seed, fault, efforts = task["seed"], task["name"].partition(": ")[2], task["efforts"]
    rng = np.random.default_rng([seed, 24])
    kind, grasp = ("door", "drawer")[seed % 2], GRASPS[seed // 2 % 2]
    if fault == "sound" and seed % 4 < 2:
        stop = FREE
    elif seed % 5 == 4 and not fault.startswith(("frozen", "repeats")):
        stop = 0.0
    else:
        stop = float(rng.uniform(0.1, 0.8) if kind == "door" else rng.uniform(0.05, 0.25))
    scene = draw(CHAIN, np.random.default_rng(seed), {"kind": kind, "grasp": grasp, "stop": stop})
    limits = effort_limits(URDF, CHAIN.names)
    drives = Servo(limits, task["servo"], integral_s=task["integral"], cascaded=task["cascaded"])
    world = Pulling.of(URDF, CHAIN, scene, rng, drives)
    reports = None if efforts == "none" else ReportedEfforts(efforts, URDF, world, np.random.default_rng([seed, 25]))
    stiffness: dict[str, object] = {"arm_stiffness_n_m": task["stated"], "max_joint_lead_rad": task["lead"]}
    made = own_pull.pull(world, URDF, Sensor(fault, world, rng), task["late"], reports, **stiffness)
    for _ in range(50):  # as the arm stands where it was sent last
        world.forget()
        world.advance(0.004)
    last = float(np.linalg.norm(world.peak()[:3]))
    wrong = {f"the hand felt {made.peak:.0f} N": made.peak >= LIMIT, f"{last:.0f} N are still held": last >= LET_GO}
    wrong["not opened"] = stop == FREE and not made.said.startswith("open to")
    return {**asdict(made), "kind": kind, "held": grasp, "last": last, "faults": [w for w, so in wrong.items() if so]}


def by_efforts(task: harness.Task) -> harness.Result:
    """A pull by efforts, or with a sound sensor."""
    seed, rng, full = task["seed"], np.random.default_rng([task["seed"], 7]), effort_limits(URDF, CHAIN.names)
    scene = draw(CHAIN, np.random.default_rng(seed))
    world = Pulling.of(URDF, CHAIN, scene, rng, Servo(full, friction=full * rng.uniform(0.01, 0.04, len(full))))
    world.approach()
    reports = ReportedEfforts("motors", URDF, world, rng)
    made = own_pull.pull(world, URDF, efforts=reports, wrench="efforts" if task["name"] == BY_EFFORTS else "sensor")
    faults = [f"{made.peak:.0f} N"] if made.peak > USUAL else []
    return {**asdict(made), "done": made.done, "kind": scene.kind, "held": scene.grasp, "faults": faults}


class Part(Sensor):
    """Tells a part of everything, its weight and zero included, or is as a Sensor of another fault."""

    def __init__(self, part: str, world: Pulling, rng: np.random.Generator) -> None:
        super().__init__(part, world, rng)
        self._part = PARTS[part]

    def __call__(self, w: Array) -> Array:
        whole = self.kind not in ("frozen", "stuck") or self._world.moves_freely
        return self._part * w if whole else super().__call__(w)


def of_matrix(task: harness.Task) -> harness.Result:
    """A pull at what jams on its way; refused: whether before it began."""
    (part, servo, grasp), seed = MATRIX[task["name"]], task["seed"]
    rng, kind = np.random.default_rng([seed, 31]), ("door", "drawer")[seed % 2]
    stop = float(rng.uniform(0.15, 0.5) if kind == "door" else rng.uniform(0.05, 0.2))
    scene = draw(CHAIN, np.random.default_rng(seed), {"kind": kind, "grasp": GRASPS[seed // 2 % 2], "stop": stop})
    drives = Servo(effort_limits(URDF, CHAIN.names), servo)
    world = Pulling.of(URDF, CHAIN, replace(scene, fingers=grasp), rng, drives)
    if not task["blind"]:
        world.approach(10.0)  # slowly, so that the tool shows its weight and not its inertia
    made = own_pull.pull(world, URDF, Part(part, world, rng))
    refused = made.opened < 1e-3 and any(words in made.said for words in REFUSED)
    faults = [f"{made.peak:.0f} N"] if made.peak > MAX_REFUSED * USUAL and not refused else []
    if not task["blind"] and part == "whole" and made.opened < 0.9 * stop:
        faults.append("let go before the stop")
    return {**asdict(made), "part": part, "servo": servo, "fingers": grasp, "kind": kind, "held": scene.grasp,
            "refused": refused, "faults": faults}  # fmt: skip


def line(r: harness.Result) -> str:
    wrong = f" ({'; '.join(r['faults'])})" if r.get("faults") else ""
    return f"{r['kind']}, {r['held']}: {r['peak']:.0f} N, '{r['said']}'{wrong}"


def tasks_of(given: Any) -> list[harness.Task]:
    paced = harness.told(given, "one_process", "time_factor")
    sensors = harness.told(given, "servo", "stated", "lead", "late", "integral", "efforts", "cascaded")
    out = []
    for group, (names, count) in GROUPS.items():
        for k in range(count if given.seeds is None or group == "hard" else given.seeds):
            for i, name in ((i, name) for i, name in enumerate(names) if name in given.names):
                task = {"group": group, "name": name, "seed": given.first + k}
                if group == "hard":
                    grasps = GRASPS if given.grasp == "both" else [given.grasp]
                    out += [{**task, "seed": HARD_SEED + i, "grasp": grasp, **paced} for grasp in grasps]
                elif group == "matrix":
                    out.append({**task, "blind": given.blind})
                elif group == "event":
                    out.append({**task, "seed": given.first + k * len(names) + i})
                else:
                    out.append({**task, **(sensors if group == "sensor" else {**paced, "grasp": None})})
    return out


def main() -> int:
    given = harness.options(
        __doc__,
        **{"seeds": None, "jobs": 1, "names": [name for names, _ in GROUPS.values() for name in names]},
        **{"one_process": False, "time_factor": 1.0, "grasp": ("both", *GRASPS), "efforts": ("none", *KINDS)},
        **{"servo": 4000.0, "stated": 100e3, "lead": 0.04, "late": 0.0, "integral": 0.0},
        **{"cascaded": False, "blind": False},
    )
    results = harness.each(
        dict.fromkeys(GROUPS, scene_of)
        | {"sensor": sensed, "efforts": by_efforts, "matrix": of_matrix, "event": events.one},
        tasks_of(given),
        given,
        line,
    )
    of = harness.grouped(results, "group")
    newtons = {
        f"{key} N, {how}": over(key, f) for key in ("peak", "mean") for how, f in (("median", median), ("most", max))
    }
    opened = over(lambda r: r["opened"] / r["goal"], lambda shares: f"{100.0 * np.median(shares):.0f} %")
    good = {"as it should be": over(lambda r: not r["faults"], share)}
    moving = {"opened, median": opened, "to the goal": over("done", share)}
    for group in ("random", "stubborn", "efforts"):
        harness.summary(group, of.get(group, []), "name", newtons | moving)
    harness.summary("sensor", of.get("sensor", []), "name", newtons | {"left N, most": over("last", max)} | good)
    harness.summary("event", of.get("event", []), "name", events.COLUMNS | good)
    own, stiff = ([r for r in of.get("random", []) if r["name"] == name] for name in (OWN, STIFF))
    targets = []
    if own:
        targets += [
            (f"opened at least {MIN_OPENED:.0%}", np.mean([r["done"] for r in own]) >= MIN_OPENED),
            (f"largest peak at most {MAX_PEAK:g} N", max(r["peak"] for r in own) <= MAX_PEAK),
            (f"largest mean at most {MAX_MEAN:g} N", max(r["mean"] for r in own) <= MAX_MEAN),
        ]
    if own and stiff:  # over all scenes together: where a drawer happens to be pulled straight, stiffness does no harm
        ratio = sum(r["peak"] for r in stiff) / sum(r["peak"] for r in own)
        harness.say(f"peaks below the stiff, straight pull's by {ratio:.1f}")
        targets.append((f"peaks below the stiff, straight pull's by {MIN_RATIO:g}", ratio >= MIN_RATIO))
    for r in of.get("stubborn", []):
        targets.append((f"{r['name']}: below {MAX_STUBBORN:g} N", r["peak"] < MAX_STUBBORN))
    if hard := of.get("hard"):
        harness.rows("hard to open", hard, ("name", "grasp", "stated", "needed", "peak", "opened", "goal", "faults"))
        can, rest = ([r for r in hard if (r["needed"] < r["stated"]) == openable] for openable in (True, False))
        done, gentle = [r["done"] for r in can], [r["peak"] <= r["stated"] for r in can]
        harness.say(f"opened {share(done)}, by no more than is stated {share(gentle)}")
        harness.say(f"the others let go gently and for a true reason: {share(not r['faults'] for r in rest)}")
        targets.append((f"hard ones opened: at least {MIN_OPENED:.0%}", sum(done) >= MIN_OPENED * len(can)))
        targets.append(("by no more than is stated", all(gentle)))
        targets.append(("the others let go", not any(r["faults"] for r in rest)))
    done = {(r["name"], r["seed"]) for r in of.get("efforts", []) if r["done"]}
    if sound := [seed for name, seed in done if name == SOUND]:
        opened_too = np.mean([(BY_EFFORTS, seed) in done for seed in sound])
        targets.append((f"opened by efforts at least {MIN_SHARE:.0%} of what a sensor opens", opened_too >= MIN_SHARE))
    for part in PARTS:  # rows of servos, columns of fingers
        cells = {(r["servo"], r["fingers"]): "refused" if r["refused"] else f"{r['peak']:.0f} N"
                 for r in of.get("matrix", []) if r["part"] == part}  # fmt: skip
        for servo in SERVOS if cells else ():
            harness.say(
                f"{part:>9} {servo:6.0f} N m/rad " + "".join(f"{cells.get((servo, f), '–'):>9}" for f in FINGERS)
            )
    for group in ("sensor", "efforts", "matrix", "event"):
        targets.append((f"every pull of {group} as it should be", not any(r["faults"] for r in of.get(group, []))))
    idle = sum(bool(r["idle"]) for r in of.get("event", []))
    targets.append((f"{idle} pulls did not begin", idle <= len(of.get("event", [])) // 10))
    return harness.ended(results, *targets)


if __name__ == "__main__":
    sys.exit(main())
