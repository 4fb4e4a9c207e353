"""From an answer to a result: errors on every scored row, none left out, with intervals, and what was claimed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from league.arm import Array, align, rotation_vector
from league.tasks import Problem

DRAWS = 2000
SHOWN = 40  # scored rows whose errors are kept, for the picture of the arm
SCHEMA = json.loads((Path(__file__).resolve().parent / "schema.json").read_text())
_KINDS: dict[str, tuple[type, ...]] = {
    "string": (str,), "number": (int, float), "integer": (int,), "boolean": (bool,), "null": (type(None),),
    "array": (list,), "object": (dict,),
}  # fmt: skip


def errors(problem: Problem, T: Array) -> Array:
    """Distances (S,) [m] between what is predicted and what was read, or is true, at every scored row."""
    task, p = problem.task, T[..., :3, 3]
    if task.kind == "track":
        parts = zip(task.frame[problem.scored], problem.target, strict=True)
        return np.array([_from_path(p[int(f)], seen) for f, seen in parts])
    if problem.refit is not None:
        rows, seen = problem.refit
        base, tool = align(T[rows], seen)
        p = (p + T[:, :3, :3] @ tool) @ base[:3, :3].T + base[:3, 3]
    elif task.kind == "socket":
        centre = {f: p[task.train][task.frame[task.train] == f].mean(axis=0) for f in np.unique(task.frame)}
        return np.linalg.norm(p[problem.scored] - np.array([centre[f] for f in task.frame[problem.scored]]), axis=1)
    return np.linalg.norm(p[problem.scored] - problem.target, axis=1)


def _from_path(path: Array, p: Array) -> float:
    """Distance of a point (3,) from a polyline (K, 3) [m]."""
    step, off = np.diff(path, axis=0), p - path[:-1]
    along = np.sum(off * step, axis=1) / np.maximum(np.sum(step**2, axis=1), 1e-30)
    return float(np.linalg.norm(off - np.clip(along, 0.0, 1.0)[:, None] * step, axis=1).min())


def turned(problem: Problem, T: Array) -> Array:
    """Angles (S,) [deg] between the rotations that are predicted and those that were read, or are true."""
    assert problem.turns is not None
    off = np.swapaxes(T[problem.scored, :3, :3], 1, 2) @ problem.turns
    return np.degrees(np.linalg.norm(rotation_vector(off), axis=1))


def interval(values: Array, unit: Array, of: Any) -> list[float]:
    """The 95 % interval of a statistic (of: values → number), units drawn again as wholes."""
    rng = np.random.default_rng(0)
    units = [values[unit == u] for u in np.unique(unit)]
    drawn = [of(np.concatenate([units[k] for k in rng.integers(len(units), size=len(units))])) for _ in range(DRAWS)]
    return [round(float(x), 5) for x in np.quantile(drawn, [0.025, 0.975])]


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def p95(values: Array) -> float:
    """The 95th percentile."""
    return float(np.quantile(values, 0.95))


def result(problem: Problem, method: str, said: dict[str, Any], arrays: dict[str, Array]) -> dict[str, Any]:
    """The result as the schema has it."""
    out = {"schema": 1, "task": problem.task.name, "digest": problem.task.digest, "method": method, "published": False}
    out |= {key: said[key] for key in ("status", "version", "cpu_s", "memory_mb", "remark")}
    out |= {"track": problem.track, "about": problem.about, "truth": problem.truth}
    if said["status"] != "ran":
        return out
    missed = 1e3 * errors(problem, arrays["T"])
    if not np.isfinite(missed).all():
        return {**out, "status": "failed", "remark": f"{int((~np.isfinite(missed)).sum())} predictions are not finite"}
    units = problem.unit
    sizes = {"rms": rms, "p95": p95, "mean": np.mean, "median": np.median, "max": np.max}
    out |= {"scored": len(missed), **{f"{name}_mm": round(float(of(missed)), 5) for name, of in sizes.items()}}
    out |= {"rms_ci95": interval(missed, units, rms), "p95_ci95": interval(missed, units, p95)}
    out |= {"parameters": said["parameters"], "open": said["open"]}
    if problem.turns is not None and said.get("oriented", True):
        out["rms_deg"] = round(rms(turned(problem, arrays["T"])), 5)
    if problem.task.kind in ("point", "pose") and problem.refit is None:
        rows = np.linspace(0, len(missed) - 1, min(SHOWN, len(missed))).astype(int)
        off = 1e3 * (arrays["T"][problem.scored[rows], :3, 3] - problem.target[rows])
        out["shown_mm"] = np.round(off, 3).tolist()
    radius = arrays.get("radius95")
    radius = np.full(len(units), said["claim_p95_mm"] or np.nan) if radius is None else 1e3 * radius[problem.scored]
    out |= {"claim_p95_mm": None, "coverage": None, "calm_and_wrong": None}
    if np.isfinite(radius).all():
        claim = p95(radius)
        wrong = not said["open"] and out["p95_ci95"][0] > claim
        out |= {"claim_p95_mm": round(claim, 5), "coverage": round(float(np.mean(missed <= radius)), 4)}
        out |= {"calm_and_wrong": bool(wrong)}
    if said["named"] is not None:
        out["named"] = [list(name) for name in said["named"]]
    if said["named"] is not None and problem.planted is not None:
        bent = [place for places in problem.planted.values() for place in places]
        by_kind = problem.task.kind == "track"
        right = ((place in (problem.planted.get(what, ()) if by_kind else bent)) for what, place in said["named"])
        out["false_causes"] = len(said["named"]) - sum(right)
    return out


def problems_of(data: Any, schema: dict[str, Any] = SCHEMA, at: str = "result") -> list[str]:
    """What is wrong with a result by the schema: the part of JSON Schema that it uses. Empty where all is well."""
    kinds = schema.get("type", list(_KINDS))
    names = [kinds] if isinstance(kinds, str) else kinds
    if type(data) not in [kind for name in names for kind in _KINDS[name]]:
        return [f"{at}: {type(data).__name__} is not {' or '.join(names)}"]
    found = [] if data in schema.get("enum", [data]) else [f"{at}: {data!r} is none of {schema['enum']}"]
    if isinstance(data, int | float) and data < schema.get("minimum", -np.inf):
        found.append(f"{at}: {data} is below {schema['minimum']}")
    if isinstance(data, dict):
        known = schema.get("properties", {})
        found += [f"{at}: {name} is missing" for name in schema.get("required", ()) if name not in data]
        open_ended = schema.get("additionalProperties", True)
        found += [f"{at}: {name} is unknown" for name in ([] if open_ended else data.keys() - known.keys())]
        for name in known.keys() & data.keys():
            found += problems_of(data[name], known[name], f"{at}.{name}")
        if "if" in schema and not problems_of(data, schema["if"], at):
            found += problems_of(data, schema["then"], at)
    if isinstance(data, list):
        found += [line for item in data for line in problems_of(item, schema.get("items", {}), at)]
    return found
