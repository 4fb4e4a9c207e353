"""What people remount beside what an arm does by itself: is the right one repaired where both move the readings alike?

A target or a tool that was taken off and put back, a tracker or an arm that was knocked, a joint's zero, a link that
grew: each cell is calibrated once and checked after each of them, of sizes that are usual for it. Every second remount
goes along what the arm could do by itself: a turn about the last axis, a shift along it, a turn about the first. A
repair is judged at fresh postures by MuJoCo's poses, orientation included.
"""

from __future__ import annotations

from collections import Counter

import harness
import numpy as np
from arm import GROW, TURN, Array
from cells import Change, Readings, Workplace, calibrated, distance, samples_of, workplace
from fault import Deviation, Fault, Stations
from scipy.spatial.transform import Rotation

import modcal_core as modcal
from modcal_core.errors import ModcalError

KINDS = ("target", "tool", "base", "tracker", "joint_zero", "link")
COUNTS = (8, 10, 20, 40)
MM, MRAD, ZERO_MRAD, GROWTH_MM = (0.3, 3.0), (0.5, 5.0), (0.2, 3.0), (0.1, 0.6)  # sizes are drawn between, in logarithm
OFF_AXIS_MM = (10.0, 60.0)  # the target stands so far beside the last axis
FRESH = 200
WORSE_MM, WORSE_MRAD = 0.01, 0.02  # by which a repair may err more than no repair: nobody would see it


def _drawn(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits)))) * 1e-3


def _way(rng: np.random.Generator) -> Array:
    x = rng.normal(size=3)
    return x / np.linalg.norm(x)


def planted(place: Workplace, kind: str, rng: np.random.Generator) -> Change:
    """A change of one kind. Its names: what would name it rightly."""
    arm, stand = place.cell.arm, place.cell.tracker[0]
    shift, turn = _drawn(rng, MM) * _way(rng), _drawn(rng, MRAD) * _way(rng)
    if rng.random() < 0.5:
        shift, turn = _along_the_arm(place, kind, shift, turn, rng)
    joint = int(rng.choice([0, arm.n - 1, rng.integers(arm.n)]))
    zero, growth = _drawn(rng, ZERO_MRAD) * rng.choice([-1.0, 1.0]), _drawn(rng, GROWTH_MM)
    right = {
        "joint_zero": (f"zero of {arm.names[joint]}",),
        "base": ("base", "tracker"),
        "tracker": ("base", "tracker"),
    }
    if kind == "link":
        joint = int(rng.choice([j for j in range(1, arm.n) if arm.lengths[j] > 0.0]))
        right["link"] = (f"length of the link before {arm.names[joint]}",)

    def bend(_arm: object, _stations: Stations, deviation: Deviation) -> None:
        if kind in ("target", "tool"):
            deviation.tool[:] += np.r_[shift, turn if kind == "tool" else np.zeros(3)]
        elif kind == "tracker":
            deviation.tracker[:] += np.r_[shift, turn]
        elif kind == "base":  # about the arm's own foot: the tracker moves the other way round
            moved = Rotation.from_rotvec(turn).inv()
            deviation.tracker[:, :3] += moved.apply(stand - shift) - stand
            deviation.tracker[:, 3:] += moved.as_rotvec()
        elif kind == "joint_zero":
            deviation.x[:, joint, TURN] += zero
        else:
            deviation.x[:, joint, GROW] += growth

    names = tuple(("", name) for name in right.get(kind, ("tool", "target")))
    return Change(names, Fault((), (), (), kind, bend))


def _along_the_arm(
    place: Workplace, kind: str, shift: Array, turn: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """A remount of the same size that the arm could make by itself; of a tracker and a base, about the first axis."""
    axis, size = np.array([0.0, 0.0, 1.0]), float(np.linalg.norm(shift))
    if kind in ("base", "tracker"):
        turn = float(np.linalg.norm(turn)) * axis
        return (np.zeros(3) if kind == "base" else np.cross(turn, place.cell.tracker[0])), turn
    at, hand = place.cell.tool  # in the frame of the tip, whose z is the last axis
    way = axis if rng.random() < 0.5 else np.cross(axis, at) / np.linalg.norm(np.cross(axis, at))
    return hand.inv().apply(size * way), turn


def _errors(calibration: object, fresh: Readings, hand: Rotation) -> tuple[float, float]:
    """RMS of what is predicted at fresh postures against the truth [mm, mrad]; hand: what points do not show."""
    T = calibration.predict(fresh.q)  # type: ignore[attr-defined]
    turned = (Rotation.from_matrix(T[:, :3, :3]) * hand).inv() * fresh.exact_R
    return distance(T[:, :3, 3], fresh.exact_p), 1e3 * harness.rms(turned.magnitude())


def cell(task: harness.Task) -> harness.Result:
    """A cell, calibrated once and checked after each kind of change by each number of stations."""
    points, seed = task["setup"] == "points", task["seed"]
    place, rng = workplace(task["robot"], seed, points=points)
    across = np.array([*rng.normal(size=2), 0.0])
    at = _drawn(rng, OFF_AXIS_MM) * across / np.linalg.norm(across) + [0.0, 0.0, rng.uniform(0.03, 0.15)]
    place.cell.tool = at, place.cell.tool[1]
    before = calibrated(place, place.postures(rng), rng, ()).calibration
    plain = place.measure(place.postures(rng, FRESH), rng, ())
    hand = Rotation.identity()
    if points:  # the target has no orientation: that of the hand is read off where nothing has changed
        hand = (Rotation.from_matrix(before.predict(plain.q)[:, :3, :3]).inv() * plain.exact_R).mean()
    rows = []
    for k, kind in enumerate(KINDS):
        for count in COUNTS:
            own = np.random.default_rng([seed, k, count, points, 47])
            change = planted(place, kind, own)
            seen = place.measure(place.postures(own, count), own, (change,))
            fresh = place.measure(place.postures(own, FRESH), own, (change,))
            row = {"kind": kind, "count": count, "points": points, "said": "", "was": _errors(before, fresh, hand)}
            rows.append(row)
            try:
                found = modcal.check(before, samples_of(place, seen, 1.71e9))
            except ModcalError as error:
                row |= {"result": "none", "said": str(error)[:90]}
                continue
            right = {name for _, name in change.names}
            listed = [({c.label}, {c.label, *c.same_as}) for c in found.changes]
            row["said"] = " + ".join(" | ".join((c.label, *c.same_as)) for c in found.changes)
            row["action"], row["alike"] = found.advice.action, [c.alike for c in found.changes]
            hit = [bool(every & right) for _, every in listed]
            certain = [bool(own & right) and not every - right for own, every in listed]
            if not listed or found.status == "unexplained":
                row["result"] = "none"
            elif all(certain):
                row["result"] = "right"
            else:
                row["result"] = "one of" if any(hit) and sum(hit) == len(hit) else "wrong"
            if found.repaired is not None and found.status != "unexplained":
                row["now"] = _errors(found.repaired, fresh, hand)
    return {"checks": rows}


def is_worse(row: harness.Result) -> bool:
    """Whether a repair errs more than no repair at fresh postures, in position or orientation."""
    if "now" not in row:
        return False
    (p, r), (was_p, was_r) = row["now"], row["was"]
    return bool(p > was_p + WORSE_MM or r > was_r + WORSE_MRAD)


def show(checks: list[harness.Result]) -> None:
    """The score by kind and by number of stations, points and poses apart."""
    rows = []
    for points in (True, False):
        for kind in KINDS:
            for count in COUNTS:
                part = [c for c in checks if (c["points"], c["kind"], c["count"]) == (points, kind, count)]
                if not part:
                    continue
                of = Counter(c["result"] for c in part)
                repaired = [c for c in part if "now" in c]
                rows.append(
                    [
                        kind,
                        "points" if points else "poses",
                        count,
                        *(of[k] for k in ("right", "one of", "none", "wrong")),
                    ]
                    + [f"{sum(map(is_worse, part))} of {len(repaired)}"]
                )
    harness.table(
        "remounted", ["what", "read", "stations", "right", "one of", "none", "wrong", "repair is worse"], rows
    )
    of = Counter(c["result"] for c in checks)
    worse = sum(map(is_worse, checks))
    harness.say(f"{dict(of)}; repairs that are worse: {worse} of {sum('now' in c for c in checks)}")
