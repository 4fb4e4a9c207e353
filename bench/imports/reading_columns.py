"""Columns of readings: poses, targets, ranges, bearings, angles, heights, in the forms that instruments write."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from sheet import ANGLE, LENGTH, Sheet, Written


def pose(rng: np.random.Generator, sheet: Sheet, written: Written) -> list[list[str]]:
    T = written.recorded.T
    unit = str(rng.choice(["mm", "m"]))
    digits = {"mm": 4, "m": 7}[unit]
    written.about["unit"] = unit
    stem = str(rng.choice(["", "tool ", "probe_", "SMR "]))
    cells = [sheet.add(f"{stem}{axis}", LENGTH[unit] * T[:, k, 3], digits) for k, axis in enumerate("xyz")]
    form = str(rng.choice(["quaternion", "matrix", "euler", "point"], p=[0.35, 0.3, 0.2, 0.15]))
    written.about["form"] = form
    R = Rotation.from_matrix(T[:, :3, :3])
    if form == "quaternion":
        cells += [sheet.add(f"{stem}q{axis}", R.as_quat()[:, k], 7) for k, axis in enumerate("xyzw")]
    elif form == "matrix":
        names = str(rng.choice(["{stem}r{i}{j}", "{stem}R{i}{j}", "{stem}rot_{i}_{j}"]))
        for i in range(3):
            for j in range(3):
                label = names.format(stem=stem, i=i + 1, j=j + 1)
                cells.append(sheet.add(label, T[:, i, j], 8))
    elif form == "euler":
        angles = R.as_euler("ZYX", degrees=True)
        cells += [sheet.add(f"{stem}{name}", angles[:, k], 5) for k, name in enumerate(("rz", "ry", "rx"))]
    written.readings["point" if form == "point" else "pose"] = [T]
    if written.about["scenario"] in ("tracker", "faults") or rng.random() < 0.2:
        _std(rng, sheet, written, unit, form)
    return cells


def _std(rng: np.random.Generator, sheet: Sheet, written: Written, unit: str, form: str) -> None:
    """Standard deviations of positions, or expanded uncertainties, in the readings' unit or in one that is told."""
    N = len(written.recorded.q)
    s = rng.uniform(0.8, 1.25, (N, 3)) * rng.uniform(1.2e-5, 8e-5)
    told = bool(rng.random() < 0.5)
    if told:
        unit = str(rng.choice(["mm", "m"]))
    name = f" [{unit}]" if told else ""
    expanded = bool(rng.random() < 0.3)
    ways = ["U{a} (95%)", "u95_{a}", "{a} 2 sigma"] if expanded else [
        "std_{a}", "sigma_{a}", "s{a}", "{A} std", "{a}_stddev", "SD {A}"]  # fmt: skip
    way = str(rng.choice(ways))
    if rng.random() < 0.2 and not expanded:
        s = np.tile(s[:, :1], (1, 3))
        way = str(rng.choice(["pos_std", "std position", "sigma"]))
        sheet.add(f"{way}{name}", LENGTH[unit] * s[:, 0], 9 if unit == "m" else 6)
    else:
        for k, axis in enumerate("xyz"):
            factor = 2.0 if expanded else 1.0
            label = way.format(a=axis, A=axis.upper())
            sheet.add(f"{label}{name}", LENGTH[unit] * factor * s[:, k], 9 if unit == "m" else 6)
    written.about |= {"std": way + name, "expanded": expanded}
    written.std = np.linalg.norm(s, axis=1)


def targets(rng: np.random.Generator, sheet: Sheet, written: Written) -> list[list[str]]:
    T = written.recorded.T
    count = int(rng.integers(3, 6))
    while True:
        places = rng.uniform(-0.12, 0.12, (count, 3))
        if np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] > 0.05:
            break
    unit = str(rng.choice(["mm", "m"]))
    way = str(rng.choice(["SMR{i} {a}", "P{i}_{a}", "target {i} {a}", "m{i}{a}", "Marker{i}:{A}"]))
    written.about |= {"targets": way, "count": count, "unit": unit}
    cells = []
    for i, place in enumerate(places):
        p = T[:, :3, :3] @ place + T[:, :3, 3] + 3e-5 * rng.standard_normal((len(T), 3))
        for k, axis in enumerate("xyz"):
            label = way.format(i=i + 1, a=axis, A=axis.upper())
            cells.append(sheet.add(label, LENGTH[unit] * p[:, k], {"mm": 4, "m": 7}[unit]))
    if rng.random() < 0.3:  # a nest that stands
        nest = rng.uniform(-1, 1, 3) + 2e-5 * rng.standard_normal((len(T), 3))
        for k, axis in enumerate("xyz"):
            sheet.add(f"reference {axis}", LENGTH[unit] * nest[:, k], {"mm": 4, "m": 7}[unit])
    written.readings["body"] = [T]
    return cells


def _seen(rng: np.random.Generator, written: Written) -> np.ndarray:
    """The tool's point (N, 3) in the tracker's frame, whose origin is some metres away."""
    return np.asarray(written.recorded.T[:, :3, 3])


def ranges(rng: np.random.Generator, sheet: Sheet, written: Written) -> list[list[str]]:
    p = _seen(rng, written)
    middle = p.mean(axis=0)
    count = int(rng.integers(1, 4))
    unit = str(rng.choice(["mm", "m", "in"], p=[0.5, 0.4, 0.1]))
    ways = ["range_{i}", "distance {i}", f"Dist {{i}} [{unit}]", f"wire_{{i}}_{unit}", "d{i}", "range to anchor {i}"]
    way = str(rng.choice(ways))
    written.about |= {"ranges": way, "count": count, "unit": unit}
    written.readings["range"] = []
    cells = []
    for i in range(count):
        away = rng.standard_normal(3)
        anchor = middle + rng.uniform(1.2, 3.0) * away / np.linalg.norm(away)
        d = np.linalg.norm(p - anchor, axis=1) + 5e-5 * rng.standard_normal(len(p))
        written.readings["range"].append(d)
        cells.append(sheet.add(way.format(i=i + 1), LENGTH[unit] * d, {"mm": 4, "m": 7, "in": 5}[unit]))
    return cells


def _station(rng: np.random.Generator, p: np.ndarray) -> np.ndarray:
    """The point in the frame of a station that stands upright some metres away, turned anyhow about its axis."""
    away = rng.standard_normal(3) * [1, 1, 0.3]
    place = p.mean(axis=0) + rng.uniform(1.5, 3.5) * away / np.linalg.norm(away)
    turn = Rotation.random(random_state=rng)
    return np.asarray(turn.apply(p - place))


def _angles(
    rng: np.random.Generator, sheet: Sheet, written: Written, u: np.ndarray, way: str
) -> tuple[list[list[str]], np.ndarray]:
    unit = str(rng.choice(["deg", "rad", "gon"], p=[0.45, 0.25, 0.3]))
    clockwise, zenith = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
    up = np.arcsin(u[:, 2]) + 4e-5 * rng.standard_normal(len(u))
    azimuth = np.arctan2(u[:, 1], u[:, 0]) + 4e-5 * rng.standard_normal(len(u))
    true = np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1)
    azimuth = (-azimuth if clockwise else azimuth) % (2 * np.pi) if rng.random() < 0.6 else (
        -azimuth if clockwise else azimuth)  # fmt: skip
    second = np.pi / 2 - up if zenith else up
    pairs = [("zenith" if zenith else "elevation"), ("Zen" if zenith else "El"), "V" if zenith else "vertical angle"]
    one, two = {"words": ("azimuth", pairs[0]), "short": ("az", pairs[1]), "survey": ("Hz", pairs[2])}[way]
    told = f" [{unit}]" if rng.random() < 0.5 else ""
    written.about |= {"angles": (one, two, told), "unit": unit, "clockwise": clockwise, "zenith": zenith}
    digits = {"deg": 6, "rad": 8, "gon": 6}[unit]
    cells = [sheet.add(f"{one}{told}", ANGLE[unit] * azimuth, digits)]
    cells.append(sheet.add(f"{two}{told}", ANGLE[unit] * second, digits))
    return cells, true


def bearings(rng: np.random.Generator, sheet: Sheet, written: Written) -> list[list[str]]:
    seen = _station(rng, _seen(rng, written))
    u = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    if rng.random() < 0.3:
        u = u + 4e-5 * rng.standard_normal(u.shape)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        names = str(rng.choice(["u{a}", "dir_{a}", "bearing.{a}"]))
        written.about["vector"] = names
        written.readings["bearing"] = [u]
        return [sheet.add(names.format(a=a), u[:, k], 8) for k, a in enumerate("xyz")]
    cells, true = _angles(rng, sheet, written, u, str(rng.choice(["words", "short", "survey"])))
    written.readings["bearing"] = [true]
    return cells


def polar(rng: np.random.Generator, sheet: Sheet, written: Written) -> list[list[str]]:
    seen = _station(rng, _seen(rng, written))
    d = np.linalg.norm(seen, axis=1)
    cells, true = _angles(rng, sheet, written, seen / d[:, None], str(rng.choice(["words", "short", "survey"])))
    unit = str(rng.choice(["mm", "m"]))
    d = d + 2e-5 * rng.standard_normal(len(d))
    cells.append(sheet.add(str(rng.choice(["distance", "D", "Slope distance"])), LENGTH[unit] * d, 6))
    written.readings |= {"bearing": [true], "range": [d]}
    return cells


def height(rng: np.random.Generator, sheet: Sheet, written: Written) -> list[list[str]]:
    p = _seen(rng, written)
    n = rng.standard_normal(3)
    n /= np.linalg.norm(n)
    h = (p - p.mean(axis=0)) @ n + 1.5 + 3e-5 * rng.standard_normal(len(p))
    unit = str(rng.choice(["mm", "m"]))
    label = str(rng.choice(["height", f"height [{unit}]", "dial indicator", "probe height", f"gap_{unit}"]))
    written.about |= {"height": label, "unit": unit}
    written.readings["plane"] = [h]
    return [sheet.add(label, LENGTH[unit] * h, {"mm": 4, "m": 7}[unit])]
