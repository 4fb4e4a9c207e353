"""What people remount beside what an arm does by itself: is the right one repaired where both move the readings alike?

A target or a tool that was taken off and put back, a tracker or an arm that was knocked, a joint's zero, a link that
grew: each cell is calibrated once and checked after each of them, of sizes that are usual for it. Every second remount
goes along what the arm could do by itself: a turn about the last axis, a shift along it, a turn about the first. A
repair is judged at fresh postures by MuJoCo's poses, orientation included.
"""

from __future__ import annotations

import harness
import numpy as np
from arms import GROW, Array
from harness import over
from scipy.spatial.transform import Rotation
from sites import Deviation, Stations, off, turned, twisted, unit
from workplace import Readings, Workplace, distance, drawn

import modcal_core as modcal
from modcal_core.errors import ModcalError

KINDS = ("target", "tool", "base", "tracker", "joint_zero", "link")
COUNTS, FRESH = (8, 10, 20, 40), 200
MM, MRAD, ZERO_MRAD, GROWTH_MM = (0.3, 3.0), (0.5, 5.0), (0.2, 3.0), (0.1, 0.6)  # sizes are drawn between, in logarithm
OFF_AXIS_MM = (10.0, 60.0)  # the target stands so far beside the last axis
WORSE_MM, WORSE_MRAD = 0.01, 0.02  # by which a repair may err more than no repair: nobody would see it
RESULTS = ("right", "one of", "none", "wrong")


def size(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits)))) * 1e-3


def remount(place: Workplace, kind: str, rng: np.random.Generator) -> tuple[set[str], Workplace]:
    """What names a change of one kind rightly, and the workplace after it."""
    arm, stand = place.cell.arm, place.cell.tracker[0]
    shift, turn = size(rng, MM) * unit(rng.normal(size=3)), size(rng, MRAD) * unit(rng.normal(size=3))
    if rng.random() < 0.5:
        shift, turn = along_the_arm(place, kind, shift, turn, rng)
    joint = int(rng.choice([0, arm.n - 1, rng.integers(arm.n)]))
    zero, growth = size(rng, ZERO_MRAD) * rng.choice([-1.0, 1.0]), size(rng, GROWTH_MM)
    right = {"joint_zero": {f"zero of {arm.names[joint]}"}, "base": {"base", "tracker"}, "tracker": {"base", "tracker"}}
    if kind == "link":
        joint = int(rng.choice([j for j in range(1, arm.n) if arm.lengths[j] > 0.0]))
        right["link"] = {f"length of the link before {arm.names[joint]}"}

    def knocked(s: Stations, d: Deviation) -> None:  # about the arm's own foot: the tracker moves the other way round
        moved = Rotation.from_rotvec(turn).inv()
        d.tracker[:] += np.r_[moved.apply(stand - shift) - stand, moved.as_rotvec()]

    always = lambda s: np.ones(len(s.t))  # noqa: E731
    bend = {
        "target": twisted("tool", np.r_[shift, np.zeros(3)], always),
        "tool": twisted("tool", np.r_[shift, turn], always),
        "tracker": twisted("tracker", np.r_[shift, turn], always),
        "base": knocked,
        "joint_zero": turned(joint, lambda s: zero),
        "link": off("x", np.s_[:, joint, GROW], lambda s: growth),
    }[kind]
    return right.get(kind, {"tool", "target"}), place.after(bend)


def along_the_arm(
    place: Workplace, kind: str, shift: Array, turn: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """A remount of the same size that the arm could make by itself; of a tracker and a base, about the first axis."""
    axis, much = np.array([0.0, 0.0, 1.0]), float(np.linalg.norm(shift))
    if kind in ("base", "tracker"):
        turn = float(np.linalg.norm(turn)) * axis
        return (np.zeros(3) if kind == "base" else np.cross(turn, place.cell.tracker[0])), turn
    at, hand = place.cell.tool  # in the frame of the tip, whose z is the last axis
    side = axis if rng.random() < 0.5 else np.cross(axis, at) / np.linalg.norm(np.cross(axis, at))
    return hand.inv().apply(much * side), turn


def missed(model: object, fresh: Readings, hand: Rotation) -> tuple[float, float]:
    """RMS of what is predicted at fresh postures against the truth [mm, mrad]; hand: what points do not show."""
    T = model.predict(fresh.q)  # type: ignore[attr-defined]
    turned = (Rotation.from_matrix(T[:, :3, :3]) * hand).inv() * fresh.exact_R
    return distance(T[:, :3, 3], fresh.exact), 1e3 * harness.rms(turned.magnitude())


def cell(task: harness.Task) -> harness.Result:
    """A cell, calibrated once and checked after each kind of change by each number of stations."""
    read, seed = task["read"], task["seed"]
    points = read == "points"
    place, rng = drawn(task["robot"], seed, read)
    across = np.array([*rng.normal(size=2), 0.0])
    at = size(rng, OFF_AXIS_MM) * across / np.linalg.norm(across) + [0.0, 0.0, rng.uniform(0.03, 0.15)]
    place.cell.tool = at, place.cell.tool[1]
    before = place.calibrated(place.measure(place.postures(rng), rng), points).calibration
    plain, hand = place.measure(place.postures(rng, FRESH), rng), Rotation.identity()
    if points:  # the target has no orientation: that of the hand is read off where nothing has changed
        hand = (Rotation.from_matrix(before.predict(plain.q)[:, :3, :3]).inv() * plain.exact_R).mean()
    rows = []
    for k, kind in enumerate(KINDS):
        for count in COUNTS:
            own = np.random.default_rng([seed, k, count, points, 47])
            right, after = remount(place, kind, own)
            seen = after.measure(place.postures(own, count), own)
            fresh = after.measure(place.postures(own, FRESH), own)
            row = {"kind": kind, "stations": count, "read": read, "was": missed(before, fresh, hand)}
            rows.append({**row, **checked(before, seen.samples(place.cell.arm.names, points, 1.71e9), right)})
            if repaired := rows[-1].pop("repaired", None):
                (p, r), (was_p, was_r) = missed(repaired, fresh, hand), row["was"]
                rows[-1] |= {"now": (p, r), "worse": bool(p > was_p + WORSE_MM or r > was_r + WORSE_MRAD)}
    return {"checks": rows}


def checked(before: modcal.Calibration, samples: modcal.Samples, right: set[str]) -> harness.Result:
    """What a check said, and its score: right, one of those that it cannot tell apart, none, or wrong."""
    try:
        found = modcal.check(before, samples)
    except ModcalError as error:
        return {"result": "none", "said": str(error)[:90]}
    out = {"said": " + ".join(" | ".join((c.label, *c.same_as)) for c in found.changes), "action": found.advice.action}
    named, silent = [{c.label, *c.same_as} for c in found.changes], not found.changes or found.status == "unexplained"
    certain = all(c.label in right and names <= right for c, names in zip(found.changes, named, strict=True))
    hit = "one of" if all(names & right for names in named) else "wrong"
    out |= {"result": "none" if silent else "right" if certain else hit, "alike": [c.alike for c in found.changes]}
    return {**out, "repaired": None if found.status == "unexplained" else found.repaired}


COLUMNS = {
    result: over("result", lambda said, result=result: sum(one == result for one in said)) for result in RESULTS
} | {"repair is worse": over("worse", harness.share)}
