"""Columns of readings: poses, targets, ranges, bearings, angles, heights, in the forms that instruments write.

Each function adds its columns and the truth, and returns the cells.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from sheet import ANGLE, DIGITS, LENGTH, Array, Rng, Sheet, Written

Cells = list[list[str]]


def unit_of(rng: Rng, written: Written, units: tuple[str, ...] = ("mm", "m"), p: list[float] | None = None) -> str:
    written.about["unit"] = unit = str(rng.choice(units, p=p))
    return unit


def pose(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    T = written.recorded.T
    unit = unit_of(rng, written)
    stem = str(rng.choice(["", "tool ", "probe_", "SMR "]))
    cells = sheet.add_all([f"{stem}{axis}" for axis in "xyz"], LENGTH[unit] * T[:, :3, 3], DIGITS[unit])
    form = str(rng.choice(["quaternion", "matrix", "euler", "point"], p=[0.35, 0.3, 0.2, 0.15]))
    written.about["form"] = form
    R = Rotation.from_matrix(T[:, :3, :3])
    if form == "quaternion":
        cells += sheet.add_all([f"{stem}q{axis}" for axis in "xyzw"], R.as_quat(), 7)
    elif form == "matrix":
        names = str(rng.choice(["{stem}r{i}{j}", "{stem}R{i}{j}", "{stem}rot_{i}_{j}"]))
        labels = [names.format(stem=stem, i=i, j=j) for i in (1, 2, 3) for j in (1, 2, 3)]
        cells += sheet.add_all(labels, T[:, :3, :3].reshape(-1, 9), 8)
    elif form == "euler":
        cells += sheet.add_all([f"{stem}{name}" for name in ("rz", "ry", "rx")], R.as_euler("ZYX", degrees=True), 5)
    written.readings["point" if form == "point" else "pose"] = [T]
    if written.about["scenario"] in ("tracker", "faults") or rng.random() < 0.2:
        _std(rng, sheet, written, unit, form)
    return cells


def _std(rng: Rng, sheet: Sheet, written: Written, unit: str, form: str) -> None:
    """Standard deviations of positions, or expanded uncertainties, in the readings' unit or in one that is told."""
    s = rng.uniform(0.8, 1.25, (len(written.recorded.q), 3)) * rng.uniform(1.2e-5, 8e-5)
    told = bool(rng.random() < 0.5)
    unit = str(rng.choice(["mm", "m"])) if told else unit
    name, expanded = f" [{unit}]" if told else "", bool(rng.random() < 0.3)
    single = ["std_{a}", "sigma_{a}", "s{a}", "{A} std", "{a}_stddev", "SD {A}"]
    way = str(rng.choice(["U{a} (95%)", "u95_{a}", "{a} 2 sigma"] if expanded else single))
    digits, labels = 9 if unit == "m" else 6, [f"{way.format(a=a, A=a.upper())}{name}" for a in "xyz"]
    if rng.random() < 0.2 and not expanded:
        s = np.tile(s[:, :1], (1, 3))
        way = str(rng.choice(["pos_std", "std position", "sigma"]))
        labels = [f"{way}{name}"]
    sheet.add_all(labels, (2.0 if expanded else 1.0) * LENGTH[unit] * s[:, : len(labels)], digits)
    written.about |= {"std": way + name, "expanded": expanded}
    written.std = np.linalg.norm(s, axis=1)


def targets(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    T, count = written.recorded.T, int(rng.integers(3, 6))
    while True:
        places = rng.uniform(-0.12, 0.12, (count, 3))
        if np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] > 0.05:
            break
    unit = unit_of(rng, written)
    way = str(rng.choice(["SMR{i} {a}", "P{i}_{a}", "target {i} {a}", "m{i}{a}", "Marker{i}:{A}"]))
    written.about |= {"targets": way, "count": count}
    cells = []
    for i, place in enumerate(places):
        p = T[:, :3, :3] @ place + T[:, :3, 3] + 3e-5 * rng.standard_normal((len(T), 3))
        labels = [way.format(i=i + 1, a=axis, A=axis.upper()) for axis in "xyz"]
        cells += sheet.add_all(labels, LENGTH[unit] * p, DIGITS[unit])
    if rng.random() < 0.3:  # a nest that stands
        nest = rng.uniform(-1, 1, 3) + 2e-5 * rng.standard_normal((len(T), 3))
        sheet.add_all([f"reference {axis}" for axis in "xyz"], LENGTH[unit] * nest, DIGITS[unit])
    written.readings["body"] = [T]
    return cells


def ranges(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    p, count = written.recorded.T[:, :3, 3], int(rng.integers(1, 4))
    unit = unit_of(rng, written, ("mm", "m", "in"), [0.5, 0.4, 0.1])
    ways = ["range_{i}", "distance {i}", f"Dist {{i}} [{unit}]", f"wire_{{i}}_{unit}", "d{i}", "range to anchor {i}"]
    way = str(rng.choice(ways))
    written.about |= {"ranges": way, "count": count}
    written.readings["range"], cells = [], []
    for i in range(count):
        away = rng.standard_normal(3)
        anchor = p.mean(axis=0) + rng.uniform(1.2, 3.0) * away / np.linalg.norm(away)
        d = np.linalg.norm(p - anchor, axis=1) + 5e-5 * rng.standard_normal(len(p))
        written.readings["range"].append(d)
        cells.append(sheet.add(way.format(i=i + 1), LENGTH[unit] * d, DIGITS[unit]))
    return cells


def _station(rng: Rng, written: Written) -> Array:
    """The tool's point in the frame of a station that stands upright some metres away, turned anyhow about its axis."""
    p, away = written.recorded.T[:, :3, 3], rng.standard_normal(3) * [1, 1, 0.3]
    place = p.mean(axis=0) + rng.uniform(1.5, 3.5) * away / np.linalg.norm(away)
    return Rotation.random(random_state=rng).apply(p - place)


def _angles(rng: Rng, sheet: Sheet, written: Written, u: Array) -> tuple[Cells, Array]:
    """Two angles of unit vectors u, and the vectors that they say."""
    way = str(rng.choice(["words", "short", "survey"]))
    unit = unit_of(rng, written, ("deg", "rad", "gon"), [0.45, 0.25, 0.3])
    clockwise, zenith = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
    up = np.arcsin(u[:, 2]) + 4e-5 * rng.standard_normal(len(u))
    azimuth = np.arctan2(u[:, 1], u[:, 0]) + 4e-5 * rng.standard_normal(len(u))
    true = np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1)
    azimuth = -azimuth if clockwise else azimuth
    azimuth = azimuth % (2 * np.pi) if rng.random() < 0.6 else azimuth
    names = {"words": ("azimuth", "zenith", "elevation"), "short": ("az", "Zen", "El")}
    one, *two = names.get(way, ("Hz", "V", "vertical angle"))
    told = f" [{unit}]" if rng.random() < 0.5 else ""
    written.about |= {"angles": (one, two[not zenith], told), "clockwise": clockwise, "zenith": zenith}
    both = ANGLE[unit] * np.stack([azimuth, np.pi / 2 - up if zenith else up], axis=1)
    return sheet.add_all([f"{one}{told}", f"{two[not zenith]}{told}"], both, 8 if unit == "rad" else 6), true


def bearings(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    seen = _station(rng, written)
    u = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    if rng.random() < 0.3:
        u = u + 4e-5 * rng.standard_normal(u.shape)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        names = str(rng.choice(["u{a}", "dir_{a}", "bearing.{a}"]))
        written.about["vector"], written.readings["bearing"] = names, [u]
        return sheet.add_all([names.format(a=a) for a in "xyz"], u, 8)
    cells, true = _angles(rng, sheet, written, u)
    written.readings["bearing"] = [true]
    return cells


def polar(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    seen = _station(rng, written)
    d = np.linalg.norm(seen, axis=1)
    cells, true = _angles(rng, sheet, written, seen / d[:, None])
    unit, noisy = str(rng.choice(["mm", "m"])), d + 2e-5 * rng.standard_normal(len(d))
    cells.append(sheet.add(str(rng.choice(["distance", "D", "Slope distance"])), LENGTH[unit] * noisy, 6))
    written.readings |= {"bearing": [true], "range": [noisy]}
    return cells


def height(rng: Rng, sheet: Sheet, written: Written) -> Cells:
    p, n = written.recorded.T[:, :3, 3], rng.standard_normal(3)
    n /= np.linalg.norm(n)
    h = (p - p.mean(axis=0)) @ n + 1.5 + 3e-5 * rng.standard_normal(len(p))
    unit = unit_of(rng, written)
    label = str(rng.choice(["height", f"height [{unit}]", "dial indicator", "probe height", f"gap_{unit}"]))
    written.about["height"], written.readings["plane"] = label, [h]
    return [sheet.add(label, LENGTH[unit] * h, DIGITS[unit])]
