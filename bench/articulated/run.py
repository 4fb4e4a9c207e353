"""Joints of furniture told, fitted and followed: real tracks in ten variants, what is no joint, accuracy, time.

    make bench NAME=articulated                                           # all of it
    make bench NAME=articulated ARGS="--only real --variants 'first 50 %' --every 3"
    make bench NAME=articulated ARGS="--only beyond --sets design --online"
    make bench NAME=articulated ARGS="--online --trust-after 0.4"         # trust waits for so many metres of path

Asked: is what is said with certainty right, and does a trusted model hold for 5 cm or 10° further along the track
(``ahead``, by other means than the tracker's own)? ``--online`` adds the shares of poses at which a model was trusted,
of those at which it was although the path leaves it by more than twice the tolerance, of tracks at whose end it was,
how many were trusted at any time, and the median of the path that they had come by then.

Real tracks are read from ../shared/data/articulation, and left out where that is absent. Exit code 1 where a target is
missed; real tracks are judged as they were recorded.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
import zlib
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import conftest  # noqa: F401 (finds the install tree)
import numpy as np
import tracks
from articulation.furniture_tracks import recorded
from articulation.objects import ideal, noisy
from harness import over, share
from tracks import DEGREE

from modcal_core.articulation.choice import choose
from modcal_core.articulation.fit import fit
from modcal_core.articulation.online import Tracker, TrackerSettings, TrackerState
from modcal_core.articulation.track import Track, travelled

FOLDER = harness.DATA / "articulation"
PERIOD = 0.05  # s
UPDATE_MS, AHEAD_MM, RIGHT, SCREWS = 2.0, 6.0, {"position": 0.96, "pose": 1.0}, 0.02
# hinges with 60 samples: whether poses are seen, opening [deg], noise [m, deg], and limits of the 95 % quantiles of
# centre [mm] and axis [deg]
HINGES = {
    "poses over 30°, 1 mm": (True, 30.0, 1e-3, 0.2, 8.0, 1.2),
    "poses over 30°, 2 mm": (True, 30.0, 2e-3, 0.5, np.inf, np.inf),
    "poses over 60°, 1 mm": (True, 60.0, 1e-3, 0.2, np.inf, np.inf),
    "points over 30°, 1 mm": (False, 30.0, 1e-3, 0.0, np.inf, np.inf),
    "points over 60°, 1 mm": (False, 60.0, 1e-3, 0.0, np.inf, np.inf),
    "points over 60°, 3 mm": (False, 60.0, 3e-3, 0.0, 21.0, 2.8),
}
PACES = ("200 poses", "200 points", "2000 poses", "2000 points")

real_tracks = functools.cache(lambda: recorded(FOLDER))


def followed(track: Track, period: float, after: float = 0.0) -> tuple[list[TrackerState], list[float]]:
    """What the tracker believed after every pose, and the processor's time it took [ms]."""
    tracker, states, spent = Tracker(TrackerSettings(trust_after_m=after)), [], []
    for i, p in enumerate(track.positions):
        begun = time.thread_time()
        states.append(tracker.update(p, None if track.rotations is None else track.rotations[i], period * i))
        spent.append(1e3 * (time.thread_time() - begun))
    return states, spent


def ahead_mm(track: Track, states: list[TrackerState]) -> float | None:
    """Median error 5 cm or 10° ahead, wherever the model was trusted and the handle did go on that far."""
    out = []
    for i in range(0, len(track), 3):
        model = states[i].model
        if not states[i].trusted or model is None:
            continue
        ahead = min(0.05, 10.0 * DEGREE * model.length_per_unit if model.turns else np.inf)
        path = model.configuration(track.positions[i:]) * model.length_per_unit
        path = path - path[0]
        for side in (1.0, -1.0):
            beyond = np.flatnonzero(side * path >= ahead)
            if len(beyond) and (side * path[: beyond[0]]).min(initial=0.0) > -0.01:
                p = track.positions[i + beyond[0]]
                out.append(float(np.linalg.norm(model.position(model.configuration(p)) - p)))
                break
    return 1e3 * float(np.median(out)) if out else None


def trust(track: Track, states: list[TrackerState]) -> harness.Result:
    """Shares [%] trusted, and trusted although it fails; whether at the end; path [cm] at which it was first."""
    settings, way = TrackerSettings(), travelled(track)
    smooth = np.array([np.median(track.positions[max(0, i - 2) : i + 3], axis=0) for i in range(len(track))])
    sure, wrong = np.array([s.trusted for s in states]), np.zeros(len(track), dtype=bool)
    for i in np.flatnonzero(sure):
        if (model := states[i].model) is not None:
            far = settings.ahead_m
            far = min(far, settings.ahead_rad * model.length_per_unit) if model.turns else far
            coming = smooth[(way > way[i]) & (way <= way[i] + far)]
            off = np.linalg.norm(model.position(model.configuration(coming)) - coming, axis=1)
            wrong[i] = off.max(initial=0.0) > 2.0 * settings.tolerance_m
    first = next((100.0 * s.path_m for s in states if s.trusted), None)
    shares = {"trusted %": sure.mean(), "and wrong %": wrong.mean(), "at end %": sure[-1]}
    return {**{key: 100.0 * float(value) for key, value in shares.items()}, "after, cm": first}


def pace(task: harness.Task) -> harness.Result:
    """Time of an update [ms]."""
    rng = np.random.default_rng(1)
    made = noisy(
        ideal("revolute", np.linspace(0.0, 1.2, int(task["name"].split()[0])), rng, 0.4), rng, 5e-4, 0.2 * DEGREE
    )
    _, spent = followed(Track(made.positions, made.rotations if "poses" in task["name"] else None), 0.01)
    return dict(zip(("median", "p99"), map(float, np.quantile(spent, (0.5, 0.99))), strict=True))


def accuracy(task: harness.Task) -> harness.Result:
    """Errors of a hinge: centre [mm], axis [deg]."""
    oriented, degrees, position, rotation, *_ = HINGES[task["name"]]
    rng = np.random.default_rng(task["seed"])
    made = noisy(ideal("revolute", np.linspace(0.0, degrees * DEGREE, 60), rng, 0.5), rng, position, rotation * DEGREE)
    model = fit(Track(made.positions, made.rotations if oriented else None), "revolute").model
    away = model.point - made.point
    off = float(np.linalg.norm(away - made.axis * (made.axis @ away)))
    return {"centre": 1e3 * off, "axis": float(np.degrees(np.arccos(min(1.0, abs(model.axis @ made.axis)))))}


def track(task: harness.Task) -> harness.Result:
    """What was told of a track with what certainty, and how the tracker followed it."""
    name, part = task["name"], task["part"]
    if part == "beyond":
        truth, seen = "none", tracks.seen(name, task["seed"])
    else:
        truth, whole = real_tracks()[task["track"]]
        seen = tracks.VARIANTS[name](whole, np.random.default_rng(zlib.crc32(f"{name} {task['track']}".encode())))
    if len(seen) < 8:
        return {"short": True}
    choice = choose(seen)
    certain = bool(choice.enough and (part == "real" or choice.kind != "none"))
    out = {"kind": choice.kind, "certain": certain, "right": choice.kind == truth, "why": choice.why}
    out["false"] = certain and not out["right"]
    if task["online"] or name == "as recorded":
        states, _ = followed(seen, PERIOD, task["trust_after"])
        out["ahead"] = ahead_mm(seen, states) if part == "real" else None
        out |= trust(seen, states) if task["online"] else {}
    return out


PARTS = {"pace": pace, "accuracy": accuracy, "real": track, "beyond": track}


def main() -> int:
    given = harness.options(
        __doc__,
        **{"seeds": 5, "names": PARTS, "every": 1, "hinges": 100, "online": False},
        **{"trust_after": 0.0, "sets": list(tracks.SETS), "variants": list(tracks.VARIANTS)},
    )
    about, seeds = harness.told(given, "online", "trust_after"), range(given.first, given.first + given.seeds)
    listed = list(real_tracks())[:: given.every] if FOLDER.is_dir() else []
    made = {
        "pace": [{"name": name} for name in PACES],
        "accuracy": [{"name": name, "seed": seed} for name in HINGES for seed in range(given.hinges)],
        "real": [{"name": name, "track": track, **about} for name in given.variants for track in listed],
        "beyond": [{"name": n, "seed": k, **about} for some in given.sets for n in tracks.SETS[some] for k in seeds],
    }
    tasks = [{"part": part, **task} for part in given.names for task in made[part]]
    paced, others = ([task for task in tasks if (task["part"] == "pace") == first] for first in (True, False))
    alone = argparse.Namespace(**{**vars(given), "jobs": 1})  # what is timed has the machine for itself
    results = harness.each(PARTS, paced, alone) + harness.each(PARTS, others, given, lambda r: str(r.get("why", "")))
    of, targets = harness.grouped(results, "part"), []
    if paces := of.get("pace"):
        harness.rows("update, ms of the processor", paces, ("name", "median", "p99"))
        targets.append((f"update p99 below {UPDATE_MS:g} ms", max(r["p99"] for r in paces) <= UPDATE_MS))
    quantile = lambda values: float(np.quantile(values, 0.95))  # noqa: E731
    columns = {"centre, mm": over("centre", quantile), "axis, deg": over("axis", quantile)}
    harness.summary("95 % quantiles of errors", of.get("accuracy", []), "name", columns)
    for name, some in harness.grouped(of.get("accuracy", []), "name").items():
        errors = [column(some) for column in columns.values()]
        targets.append((f"accuracy of {name}", errors[0] <= HINGES[name][4] and errors[1] <= HINGES[name][5]))
    columns = {
        what: over(key, sum) for what, key in (("right", "right"), ("certain", "certain"), ("and wrong", "false"))
    }
    if given.online:
        columns |= {key: over(key, np.mean) for key in ("trusted %", "and wrong %", "at end %")}
        columns |= {"ever": over("after, cm", len), "after, cm": over("after, cm", harness.median)}
    for part in ("beyond", "real"):
        harness.summary(part, of.get(part, []), "name", columns, sums=part == "beyond")
        for r in (r for r in of.get(part, []) if r.get("false")):
            harness.say(f"certain and wrong: {r['name']} {r.get('track', r.get('seed'))}: {r['why']}")
    judged = [r for r in of.get("real", []) if r["name"] == "as recorded" and "kind" in r]
    for kind, least in RIGHT.items() if judged else ():
        some = [r for r in judged if r["track"].startswith("pose/") == (kind == "pose")]
        right, sure = (share(r["right"] for r in which) for which in (some, [r for r in some if r["certain"]]))
        harness.say(f"{kind}: {right} right; of those said with certainty, {sure}")
        targets.append((f"kinds of {kind} tracks", sum(r["right"] for r in some) >= least * len(some)))
    if judged:
        ahead, screws = over("ahead", harness.median)(judged), sum(r["kind"] == "screw" for r in judged)
        count = over("ahead", len)(judged)
        harness.say(f"false screws: {screws}; ahead after trust: {ahead:.1f} mm median of {count} tracks")
        targets += [("false screws", screws <= SCREWS * len(judged)), ("prediction", ahead <= AHEAD_MM)]
    return harness.ended(results, *targets)


if __name__ == "__main__":
    sys.exit(main())
