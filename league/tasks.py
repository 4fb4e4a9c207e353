"""The tasks: recordings, which rows a method gets, and which it is scored on.

A row is held out by the digest of its task's and its block's names, so that a split is the same on every machine and
nothing can be tuned by drawing it again.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from league import excerpts, scenes
from league.arm import Arm, Array, quaternion_rotation
from league.excerpts import ROBOTS, Table
from league.generator import World
from league.task import Task

HERE = Path(__file__).resolve().parent
HELD = 0.3  # share of the blocks
PERIOD = 12.0  # s between simulated stations
PLACED, LATE = 15, 3e4  # simulated stations for that, and when [s] the other postures are reached
FEW = 30  # rows that are known where few are
REFIT = 30  # rows of another day, or of a tracker that scores alone, that place base and tool
OPENED = 0.6  # share of a pull that is known; what comes after is scored


@dataclass(frozen=True)
class Problem:
    """A task and what only the scorer knows.

    scored: rows (S,). target: their positions (S, 3) [m], readings or, where ``truth``, what is true; of sockets NaN.
    unit: what is drawn again as a whole for intervals (S,). refit: rows, with positions, by which base and tool are put
    in place again before scoring. planted: joints of each fault that was put in, of tracks the objects of each kind;
    None: unknown. turns: rotations that are read, or true (S, 3, 3).
    """

    task: Task
    track: str
    about: str
    scored: Array
    target: Array
    unit: Array
    truth: bool = False
    refit: tuple[Array, Array] | None = None
    planted: dict[str, tuple[str, ...]] | None = None
    turns: Array | None = None


def held(task: str, block: object) -> bool:
    """Whether a block is held out."""
    digest = hashlib.sha256(f"{task}:{block}".encode()).digest()
    return int.from_bytes(digest[:4], "big") < HELD * 2**32


def _before(q: Array) -> Array:
    return np.concatenate([q[:1], q[:-1]])


def _problem(name: str, track: str, about: str, table: Table, train: Array, scored: Array) -> Problem:
    """A problem of a table, from which rows train and which are scored."""
    width = table.reading.shape[1]
    kind = {0: "socket", 3: "point", 7: "pose"}[width]
    reading = table.reading if width else np.full((len(table.q), 3), np.nan)
    pairs = np.arange(table.frame.max() + 1).reshape(-1, 2) if kind == "socket" else np.empty((0, 2), int)
    block = int(np.median(np.unique(table.block, return_counts=True)[1]))
    distance = 0.05 if kind == "socket" else 0.0
    what = (reading[train], table.frame, pairs, distance, block)
    task = Task(name, kind, table.urdf, table.tip, table.q, _before(table.q), train, *what)
    turns = quaternion_rotation(reading[scored, 3:]) if kind == "pose" else None
    return Problem(task, track, about, scored, reading[scored, :3], table.block[scored], turns=turns)


def blocks(name: str, track: str, about: str, table: Table) -> Problem:
    """Whole blocks are held out."""
    out = np.array([held(name, b) for b in table.block])
    return _problem(name, track, about, table, np.flatnonzero(~out), np.flatnonzero(out))


def few(name: str, track: str, about: str, table: Table) -> Problem:
    """FEW rows are known, one a block, and blocks without one are scored."""
    order = sorted(np.unique(table.block), key=lambda b: hashlib.sha256(f"{name}:{b}".encode()).digest())[:FEW]
    rows = (np.flatnonzero(table.block == b) for b in order)
    train = np.sort([r[zlib.crc32(f"{name}:{b}".encode()) % len(r)] for r, b in zip(rows, order, strict=True)])
    return _problem(name, track, about, table, train, np.flatnonzero(~np.isin(table.block, order)))


def next_day(name: str, track: str, about: str, first: Table, second: Table) -> Problem:
    """One recording is known; of the other, some rows place base and tool, and the others are scored."""
    q, n = np.concatenate([first.q, second.q]), len(first.q)
    rows = np.random.default_rng(0).permutation(len(second.q))
    known, rest = np.sort(rows[:REFIT]), np.sort(rows[REFIT:])
    both = replace(first, q=q, block=first.block, frame=np.zeros(len(q), int))
    made = _problem(name, track, about, both, np.arange(n), np.arange(n))
    placed = (n + known, second.reading[known, :3])
    target, unit = second.reading[rest, :3], second.block[rest]
    return replace(made, scored=n + rest, target=target, unit=unit, refit=placed, turns=None)


def opened(name: str, track: str, about: str, table: Table) -> Problem:
    """The first part of every pull is known, the rest scored."""
    pulls = [np.flatnonzero(table.frame == f) for f in range(table.frame.max() + 1)]
    train = np.concatenate([rows[: int(OPENED * len(rows))] for rows in pulls])
    scored = np.setdiff1d(np.arange(len(table.frame)), train)
    made = _problem(name, track, about, table, train, scored)
    task = replace(made.task, kind="track", frame=table.frame, pairs=np.empty((0, 2), int))
    kinds = {kind: tuple(f"{f}" for f, own in enumerate(table.kinds) if own == kind) for kind in set(table.kinds)}
    return replace(made, task=task, turns=None, planted=kinds or None)


@dataclass(frozen=True)
class Simulated:
    """A recording to be made: the arm, its stations, images or objects, the reading, faults by name with how many
    joints have each.
    """

    robot: str
    tip: str
    stations: int
    kind: str
    faults: dict[str, int] = field(default_factory=dict)
    wrong: float = 0.0
    second_day: bool = False


def _world(name: str, what: Simulated, draw: int, first: int) -> tuple[str, World]:
    """(The URDF as its maker has it, the arm as it is). first: the seed that all draws begin with."""
    rng = np.random.default_rng([first, zlib.crc32(name.split("#")[0].encode()), draw])
    urdf = (ROBOTS / f"{what.robot}.urdf").read_text()
    arm = Arm.from_urdf(urdf, what.tip)
    # links near the base carry gears and loads that show
    faults = {f: tuple(sorted(rng.choice(5, count, replace=False))) for f, count in what.faults.items()}
    return urdf, World(arm, rng, faults)


def simulated(name: str, track: str, about: str, what: Simulated, draw: int = 0) -> Problem:
    """A recording of an arm that exists nowhere, scored on what is true at 300 other postures in the same ranges."""
    urdf, world = _world(name, what, draw, seed())
    arm, rng, faults = world.arm, world.rng, world.faults
    q, t = world.postures(what.stations), PERIOD * np.arange(what.stations)
    reading = world.read(world.poses(q, _before(q), t))
    wrong = rng.permutation(len(q))[: round(what.wrong * len(q))]
    reading[wrong, :3] += 10.0 ** rng.uniform(-2.7, -1.3, (len(wrong), 1)) * rng.normal(size=(len(wrong), 3))
    first = PLACED if what.second_day else 0
    fresh, refit = world.postures(300 + first), None
    if what.second_day:
        world.place(moved=True)
    true = world.poses(fresh, _before(fresh), LATE + PERIOD * np.arange(len(fresh)))
    if what.second_day:
        refit = len(q) + np.arange(first), world.read(true[:first])[:, :3]
    turns = None if what.second_day or what.kind == "point" else true[first:, :3, :3]
    true = true[:, :3, 3]
    joints, zeros = np.concatenate([q, fresh]), np.zeros(len(q) + len(fresh), int)
    before = np.concatenate([_before(q), _before(fresh)])
    reading = reading[:, :3] if what.kind == "point" else reading
    task = Task(name, what.kind, urdf, what.tip, joints, before, np.arange(len(q)), reading, zeros)
    planted = {f: tuple(arm.names[k] for k in places) for f, places in faults.items()}
    planted |= {"wrong": ("tracker",)} if what.wrong else {}
    scored = len(q) + np.arange(first, len(fresh))
    known = None if "warm" in planted else planted
    return Problem(task, track, about, scored, true[first:], np.arange(len(scored)), True, refit, known, turns)


def seated(name: str, track: str, about: str, what: Simulated, draw: int = 0) -> Problem:
    """A ball in sockets, scored on what is true at other postures, where a tracker places base and tool."""
    urdf, world = _world(name, what, draw, seed("scenes"))
    q, frame, pairs = scenes.sockets(world)
    fresh = world.postures(300 + REFIT)
    true, n = scenes.tips(world, fresh)[:, :3, 3], len(q)
    joints, frame = np.concatenate([q, fresh]), np.concatenate([frame, np.zeros(len(fresh), int)])
    unknown = np.full((n, 3), np.nan)
    told = (joints, _before(joints), np.arange(n), unknown, frame, pairs, scenes.APART)
    task = Task(name, "socket", urdf, what.tip, *told)
    scored = n + np.arange(REFIT, len(fresh))
    placed = n + np.arange(REFIT), true[:REFIT]
    return Problem(task, track, about, scored, true[REFIT:], np.arange(len(scored)), True, placed, {})


def watched(name: str, track: str, about: str, what: Simulated, draw: int = 0) -> Problem:
    """A board and a camera, one of them on the tip, scored on where the camera truly is, as the board has it.

    How a camera is turned is a matter of words: a lens that leans looks like one that is turned and off centre.
    """
    urdf, world = _world(name, what, draw, seed("scenes"))
    on_tip = what.kind == "camera on tip"
    q, T, corners = scenes.views(world, scenes.camera(world, on_tip), on_tip, what.stations + 300)
    train, scored = np.split(np.arange(len(q)), [what.stations])
    told = (q, _before(q), train, corners[train].reshape(len(train), -1), np.zeros(len(q), int))
    task = Task(name, "corners", urdf, what.tip, *told, board=scenes.board(), size=scenes.SIZE, on_tip=on_tip)
    camera = T if on_tip else np.linalg.inv(T)
    return Problem(task, track, about, scored, camera[scored, :3, 3], scored, True, None, {})


def furniture(name: str, track: str, about: str, what: Simulated, draw: int = 0) -> Problem:
    """Doors and drawers that exist nowhere, scored on where their handles truly go."""
    rng = np.random.default_rng([seed("scenes"), zlib.crc32(name.split("#")[0].encode()), draw])
    pulls = [scenes.pull(rng) for _ in range(what.stations)]
    seen, true = (np.concatenate([scenes.read(getattr(p, key)) for p in pulls]) for key in ("seen", "true"))
    frame = np.repeat(np.arange(len(pulls)), [len(p.true) for p in pulls])
    seen = seen if what.kind == "pose" else seen[:, :3]
    table = Table(np.zeros((len(frame), 0)), seen, frame, frame, "", "", tuple(p.kind for p in pulls))
    made = opened(name, track, about, table)
    return replace(made, target=true[made.scored, :3], truth=True)


def digest(file: str = "generator") -> str:
    """Of a file that simulates, which no seed may have been seen with."""
    return hashlib.sha256((HERE / f"{file}.py").read_bytes()).hexdigest()


def seed(file: str = "generator") -> int:
    """The seed that was chosen after a file was frozen."""
    return int(json.loads((HERE / "seeds.json").read_text())[file]["seed"])


POINTS, POSES, NO_INSTRUMENT = "from points", "from poses", "no instrument"
UNDECLARED, NEXT_DAY, SPARSE = "undeclared effects", "next day", "few stations"
CAMERA, DOORS = "from a camera", "doors"
PANDA, XARM, IIWA, UR10 = ("panda", "panda_link8"), ("xarm7", "link_eef"), ("iiwa14", "iiwa_link_ee"), ("ur10", "tool0")
GEARS = {"gear": 2, "eccentric": 1}
# By name: track, about, what makes it, and of what.
SIMULATED: dict[str, tuple[str, str, Callable[..., Problem], Simulated]] = {
    "sim_few": (SPARSE, "Panda, 20 points, links alone wrong", simulated, Simulated(*PANDA, 20, "point")),
    "sim_clean": (POINTS, "xArm 7, 120 points, links alone wrong", simulated, Simulated(*XARM, 120, "point")),
    "sim_poses": (POSES, "iiwa, 60 poses, links alone wrong", simulated, Simulated(*IIWA, 60, "pose")),
    "sim_gear": (
        UNDECLARED,
        "UR10, 250 poses, two gears, an eccentric encoder",
        simulated,
        Simulated(*UR10, 250, "pose", GEARS),
    ),
    "sim_elastic": (
        UNDECLARED,
        "iiwa, 200 points, links that bend",
        simulated,
        Simulated(*IIWA, 200, "point", {"elastic": 4}),
    ),
    "sim_backlash": (
        UNDECLARED,
        "xArm 7, 200 poses, backlash",
        simulated,
        Simulated(*XARM, 200, "pose", {"backlash": 2}),
    ),
    "sim_wrong": (
        POINTS,
        "Panda, 120 points, 10 wrong by 2 to 50 mm",
        simulated,
        Simulated(*PANDA, 120, "point", wrong=1 / 12),
    ),
    "sim_next_day": (
        NEXT_DAY,
        "UR10, 200 poses, gears, bending, warm; base and tool moved",
        simulated,
        Simulated(*UR10, 200, "pose", GEARS | {"elastic": 3, "warm": 1}, second_day=True),
    ),
    "sim_sockets": (NO_INSTRUMENT, "Panda, ball in eight sockets", seated, Simulated(*PANDA, 0, "socket")),
    "sim_eye": (CAMERA, "Panda, camera on its tip, 30 images", watched, Simulated(*PANDA, 30, "camera on tip")),
    "sim_watched": (CAMERA, "xArm 7, board on its tip, 40 images", watched, Simulated(*XARM, 40, "board on tip")),
    "sim_door_points": (DOORS, "40 doors and drawers, positions", furniture, Simulated("", "", 40, "point")),
    "sim_door_poses": (DOORS, "30 doors and drawers, poses", furniture, Simulated("", "", 30, "pose")),
}
# By name: track, about, what makes it, and of which tables.
REAL: dict[str, tuple[str, str, Callable[..., Problem], tuple[str, ...]]] = {
    "ur10_cubes": (POSES, "UR10, 632 poses in cubes, blocks of 10 held out", blocks, ("ur10_cubes",)),
    "ur10_cubes_few": (SPARSE, "the same, 30 poses known", few, ("ur10_cubes",)),
    "ur5_grid": (POINTS, "UR5, 1 000 points of a grid, blocks of 20 held out", blocks, ("ur5_grid",)),
    "wam_grid": (POINTS, "cable-driven WAM, 216 points, blocks of 8 held out", blocks, ("wam_grid",)),
    "kuka_sockets": (NO_INSTRUMENT, "iiwa 14, ball in six sockets, joints only", blocks, ("kuka_sockets",)),
    "ur10_grid": (POSES, "UR10, a tenth of 11 911 poses of a grid", blocks, ("ur10_grid",)),
    "ur10_next_day": (
        NEXT_DAY,
        "UR10, the grid known, cubes of another day scored",
        next_day,
        ("ur10_grid", "ur10_cubes"),
    ),
    "panda_3_sockets": (NO_INSTRUMENT, "Panda 3, ball in twelve sockets", blocks, ("panda_3_sockets",)),
    "panda_4_sockets": (NO_INSTRUMENT, "Panda 4, ball in eight sockets", blocks, ("panda_4_sockets",)),
    "positioner": (POSES, "two-axis positioner, 205 poses by a camera, blocks of 10 held out", blocks, ("positioner",)),
    "door_points": (DOORS, "furniture in kitchens, 43 pulls, positions", opened, ("door_points",)),
    "door_poses": (DOORS, "furniture in kitchens, 9 pulls, poses", opened, ("door_poses",)),
}
SMALL = (*list(REAL)[:5], *SIMULATED)
FURTHER = tuple(name for name, told in REAL.items() if not set(told[3]) <= set(excerpts.COMMITTED))
FULL = (*SMALL, *(name for name in REAL if name not in SMALL), *(f"{name}#{k}" for name in SIMULATED for k in (1, 2)))


def problem(name: str, data: Path | None = None) -> Problem:
    """The problem of a name. data: folder with what is not in the repository; FileNotFoundError where it is needed."""
    if name in REAL:
        track, about, make, tables = REAL[name]
        return make(name, track, about, *(excerpts.table(key, data) for key in tables))
    first, _, draw = name.partition("#")
    track, about, make, what = SIMULATED[first]
    return make(name, track, about, what, int(draw or 0))
