"""The ways in: which postures are taken, what each instrument reads there, and how that is written for ``modcal``.

A way makes tables, each with the joints (N, n) that were reported, columns of numbers, and what an import mapping says
of these; and what the cell file states.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from arm import Array, Delta, World, approaches, pose

PERIOD, START = 10.0, 1.7e9  # s: stations follow each other, the first at this stamp
TRACKER_FRAME = "tracker"


@dataclass(frozen=True)
class Table:
    """q (N, n): joints as they were reported. columns: name and numbers (N,). says: of the mapping. times (N,): from
    the start [s]; None: one station after the other. joints: whether the table has them.
    """

    q: Array
    columns: dict[str, Array]
    says: dict[str, Any]
    times: Array | None = None
    joints: bool = True


@dataclass(frozen=True)
class Recording:
    """tables: one after the other in time. cell: what is stated. direct: pose of the base in the tracker (4, 4); None
    where no instrument knows it. frame: that modcal is asked to predict in. shows_tool: whether the readings show where
    the tool's point is in the tip.
    """

    tables: list[Table]
    frame: str
    cell: dict[str, Any] = field(default_factory=dict)
    direct: Array | None = None
    shows_tool: bool = True

    @property
    def q(self) -> Array:
        """All joints that were reported."""
        return np.concatenate([t.q for t in self.tables if t.columns or t.times is None])

    def write(self, folder: Path, names: tuple[str, ...], urdf: Path | None) -> None:
        """Tables, their mapping ``m.yaml`` and the cell file ``cell.yaml`` in a folder."""
        mapping: dict[str, Any] = {"tables": []} if urdf is None else {"urdf": str(urdf), "tables": []}
        first = 0
        for i, table in enumerate(self.tables):
            t = START + (PERIOD * (first + np.arange(len(table.q))) if table.times is None else table.times)
            first += len(table.q)
            mine = names if table.joints else ()
            heads = ["t", *mine, *table.columns]
            rows = np.column_stack([*([table.q] if table.joints else []), *table.columns.values()])
            text = [",".join([f"{a:.6f}", *(f"{x:.9f}" for x in row)]) for a, row in zip(t, rows, strict=True)]
            (folder / f"t{i}.csv").write_text("\n".join([",".join(heads), *text]) + "\n")
            joints = {"joints": {"unit": "rad", "columns": {n: n for n in mine}}} if table.joints else {}
            mapping["tables"].append(
                {"files": f"t{i}.csv", "time": {"seconds": "t", "unit": "s"}, **joints, **table.says}
            )
        (folder / "m.yaml").write_text(yaml.safe_dump(mapping))
        (folder / "cell.yaml").write_text(yaml.safe_dump(self.cell or {"fixed": []}))


@dataclass(frozen=True)
class Site:
    """Where a way works: the world, its numbers, how many stations."""

    world: World
    rng: np.random.Generator
    count: int

    def postures(self, share: float = 1.0, moving: tuple[int, ...] | None = None, count: int | None = None) -> Array:
        """Random postures; share: of the joints' ranges, about somewhere in them; moving: the only joints that do."""
        arm, rng, count = self.world.drawn, self.rng, count or self.count
        half = 0.5 * (arm.high - arm.low)
        middle = arm.low + half + (1.0 - share) * half * rng.uniform(-1.0, 1.0, len(half))
        q = middle + share * half * rng.uniform(-1.0, 1.0, (40 * count if isinstance(arm, Delta) else count, len(half)))
        if moving is not None:
            q[:, [k for k in range(q.shape[1]) if k not in moving]] = middle[
                [k for k in range(q.shape[1]) if k not in moving]
            ]
        return np.asarray(q[np.isfinite(arm.tips(q)).all(axis=(1, 2))][:count])

    def at(self, q: Array, before: Array | None = None) -> Array:
        """Poses of the tool where the joints report q, with what they do not repeat."""
        noise = self.world.joint_noise * self.rng.normal(size=q.shape)
        return self.world.poses(q, approaches(q), noise)


def moved(T: Array, p: Array) -> Array:
    """Points (N, 3) in another frame."""
    return np.asarray(p @ T[:3, :3].T + T[:3, 3])


def somewhere(rng: np.random.Generator, far: float = 2.5) -> Array:
    """Pose of the base in an instrument."""
    return np.asarray(pose(rng.normal(0.0, far / 2.0, 3), rng.normal(0.0, 1.0, 3)))


def _point(site: Site, T: Array, q: Array, sigma: float) -> Table:
    p = moved(T, site.at(q)[:, :3, 3]) + sigma * site.rng.normal(size=(len(q), 3))
    says = {"point": {"frame": TRACKER_FRAME, "unit": "m", "position": ["x", "y", "z"]}}
    return Table(q, dict(zip("xyz", p.T, strict=True)), says)


def tracker(share: float = 1.0, moving: int = 0) -> Callable[[Site], Recording]:
    """Points of a tracker; over a share of the ranges, or with so many joints moving."""

    def way(site: Site) -> Recording:
        n = len(site.world.drawn.names)
        some = tuple(site.rng.choice(n, moving, replace=False).tolist()) if moving else None
        T = somewhere(site.rng)
        return Recording([_point(site, T, site.postures(share, some), 3e-5)], TRACKER_FRAME, direct=T)

    return way


def motion(site: Site) -> Recording:
    """Points of a tracker, ten a second, of an arm that does not stop; joints fifty times a second."""
    rng, arm, T = site.rng, site.world.drawn, somewhere(site.rng)
    half, n = 0.5 * (arm.high - arm.low), len(arm.names)
    phase, pace = rng.uniform(0.0, 2.0 * np.pi, (2, n)), 2.0 * np.pi * rng.uniform(0.02, 0.07, (2, n))

    def path(t: Array) -> Array:
        waves = np.sin(pace[:, None] * t[:, None] + phase[:, None])
        return np.asarray(arm.low + half + half * (0.6 * waves[0] + 0.35 * waves[1]))

    last = max(0.4 * site.count, 20.0)
    fast, slow = np.arange(0.0, last, 0.02), np.arange(0.5, last - 0.5, 0.1) + 0.007
    q = path(slow)
    reading = _point(site, T, q, 3e-5)
    noise = site.world.joint_noise * rng.normal(size=(len(fast), n))
    tables = [Table(path(fast) + noise, {}, {}, fast), replace(reading, times=slow, joints=False)]
    return Recording(tables, TRACKER_FRAME, direct=T)


def poses(site: Site) -> Recording:
    """Poses of a camera system."""
    T, q, rng = somewhere(site.rng), site.postures(), site.rng
    seen = T @ site.at(q) @ pose(1e-4 * rng.normal(size=(len(q), 3)), 2e-4 * rng.normal(size=(len(q), 3)))
    columns = dict(zip("xyz", seen[:, :3, 3].T, strict=True))
    columns |= {f"r{i}{j}": seen[:, i, j] for i in range(3) for j in range(3)}
    says = {"frame": TRACKER_FRAME, "unit": "m", "position": ["x", "y", "z"]}
    matrix = {"columns": [f"r{i}{j}" for i in range(3) for j in range(3)]}
    return Recording([Table(q, columns, {"pose": {**says, "matrix": matrix}})], TRACKER_FRAME, direct=T)


def _heights(site: Site, frame: str, normal: Array, q: Array, T: Array, sigma: float) -> Table:
    h = T[:, :3, 3] @ normal
    h = h - np.median(h) + sigma * site.rng.normal(size=len(q))
    return Table(q, {"h": h}, {"plane": {"frame": frame, "unit": "m", "column": "h"}})


def gauges(planes: int, beside: bool = False) -> Callable[[Site], Recording]:
    """Heights over the whole workspace above one or three planes; beside: with points at half of the stations."""

    def way(site: Site) -> Recording:
        tables = []
        for i, normal in enumerate(np.eye(3)[[2, 0, 1]][:planes]):
            q = site.postures(count=max(site.count // (planes + beside), 4))
            tables.append(_heights(site, f"plane_{i}", normal, q, site.at(q), 2e-5))
        if not beside:  # a platform that stays level shows no tool
            return Recording(tables, "plane_0", shows_tool=not isinstance(site.world.drawn, Delta))
        T = somewhere(site.rng)
        q = site.postures(count=max(site.count // 2, 4))
        return Recording([_point(site, T, q, 3e-5), *tables], TRACKER_FRAME, direct=T)

    return way


def _solved(site: Site, miss: Callable[[Array], Array], many: int, width: int) -> Array:
    """Postures (many, n) at which a miss (N, width) of the poses (N, 4, 4) is nothing, by Newton's method."""
    found: list[Array] = []
    world = site.world

    def at(q: Array) -> Array:
        return miss(world.poses(q, np.ones(q.shape)))

    for _ in range(20):
        q = site.postures(count=4 * many)
        for _ in range(15):
            e, n = at(q), q.shape[1]
            J = np.stack([(at(q + 1e-6 * np.eye(n)[k]) - e) / 1e-6 for k in range(n)], axis=2)
            step = -np.swapaxes(J, 1, 2) @ np.linalg.solve(
                J @ np.swapaxes(J, 1, 2) + 1e-6 * np.eye(width), e[..., None]
            )
            q = q + np.clip(step[..., 0], -0.3, 0.3)
        inside = ((q > world.drawn.low - 0.3) & (q < world.drawn.high + 0.3)).all(axis=1)
        found += list(q[inside & (np.abs(at(q)).max(axis=1) < 1e-8)])
        if len(found) >= many:
            break
    q = np.array(found[:many])
    return np.asarray(q + world.joint_noise * site.rng.normal(size=q.shape))


def contacts(planes: int) -> Callable[[Site], Recording]:
    """A probe that touches one, two or three planes."""

    def way(site: Site) -> Recording:
        tables = []
        middle = np.median(site.world.poses(q := site.postures(count=200), approaches(q))[:, :3, 3], axis=0)
        for i, normal in enumerate(np.eye(3)[[2, 0, 1]][:planes]):
            level = float(normal @ middle) + site.rng.normal(0.0, 0.1)
            q = _solved(
                site, lambda T, u=normal, c=level: T[:, :3, 3] @ u[:, None] - c, max(site.count // planes, 4), 1
            )
            zero = {"h": np.zeros(len(q))}
            tables.append(Table(q, zero, {"plane": {"frame": f"plane_{i}", "unit": "m", "column": "h"}}))
        return Recording(tables, "plane_0")

    return way


def sockets(distances: bool, wire: bool = False) -> Callable[[Site], Recording]:
    """The tool's ball in four sockets, with their distances or not; or with a draw wire besides."""

    def way(site: Site) -> Recording:
        rng, tables, at = site.rng, [], []
        centre = site.world.poses(q := site.postures(count=200), approaches(q))[:, :3, 3]
        for i in range(4):
            p = centre[np.argsort(np.linalg.norm(centre - np.median(centre, axis=0), axis=1))[i * 12]]
            q = _solved(site, lambda T, p=p: T[:, :3, 3] - p, max(site.count // (4 + wire), 4), 3)
            if len(q) < 4:
                continue
            at.append((f"socket_{i}", p))
            tables.append(Table(q, {}, {"same_point": {"frame": f"socket_{i}"}}))
        cell: dict[str, Any] = {"sockets": [name for name, _ in at]}
        if distances:
            apart = [(a, b, float(np.linalg.norm(p - r))) for a, p in at for b, r in at if a < b]
            far = [{"between": [a, b], "distance_m": d + 2e-5 * rng.normal(), "std_m": 2e-5} for a, b, d in apart[:4]]
            cell = {"distances": far}
        if wire:
            q = site.postures(count=max(site.count // 5, 6))
            tables.append(_wires(site, q, 1))
        return Recording(tables, at[0][0], cell)

    return way


def _wires(site: Site, q: Array, many: int) -> Table:
    rng, p = site.rng, site.at(q)[:, :3, 3]
    columns, says = {}, []
    for i in range(many):
        anchor = 1.8 * np.array([np.cos(2.1 * i), np.sin(2.1 * i), 0.2 * i]) + 0.1 * rng.normal(size=3)
        d = np.linalg.norm(p - anchor, axis=1) + rng.normal(0.0, 0.05)
        columns[f"d{i}"] = d + 1e-4 * rng.normal(size=len(q))
        says.append({"frame": f"wire_{i}", "unit": "m", "column": f"d{i}"})
    return Table(q, columns, {"range": says})


def wires(site: Site) -> Recording:
    """Three draw wires."""
    return Recording([_wires(site, site.postures(), 3)], "wire_0")


def bearings(bar: bool) -> Callable[[Site], Recording]:
    """Two theodolites; bar: whose distance between the tool's places is known for six pairs of stations."""

    def way(site: Site) -> Recording:
        rng, q = site.rng, site.postures()
        p = site.at(q)[:, :3, 3]
        columns, says = {}, []
        for i, place in enumerate(([2.5, -0.8, 0.6], [1.8, 2.0, 0.4])):
            T = np.linalg.inv(pose(np.array(place) + 0.2 * rng.normal(size=3), rng.normal(0.0, 0.6, 3)))
            u = moved(T, p)
            u = u / np.linalg.norm(u, axis=1, keepdims=True) + 2e-5 * rng.normal(size=u.shape)
            names = [f"u{i}{axis}" for axis in "xyz"]
            columns |= dict(zip(names, (u / np.linalg.norm(u, axis=1, keepdims=True)).T, strict=True))
            says.append({"frame": f"station_{i}", "vector": names})
        cell: dict[str, Any] = {}
        if bar:
            known = []
            for a, b in rng.permutation(len(q))[:12].reshape(-1, 2).tolist():
                d = float(np.linalg.norm(p[a] - p[b])) + 2e-5 * rng.normal()
                stamps = [START + PERIOD * a, START + PERIOD * b]
                known.append({"stamps": stamps, "distance_m": d, "std_m": 3e-5})
            cell = {"distances": known}
        return Recording([Table(q, columns, {"bearing": says})], "station_0", cell)

    return way


CAMERA = "camera"  # has images instead of tables: :mod:`camera`
# name: (way, fewest stations, what the readings leave open)
WAYS: dict[str, tuple[Callable[[Site], Recording], int, str]] = {
    "points": (tracker(), 26, "shown"),
    "motion": (motion, 50, "shown"),
    "poses": (poses, 10, "shown"),
    "corner": (tracker(0.2), 25, "shown"),
    "three joints": (tracker(moving=3), 25, "shown"),
    "points and plane": (gauges(1, beside=True), 25, "shown"),
    "bearings and bar": (bearings(True), 25, "shown"),
    "wires": (wires, 25, "shown"),
    "sockets and distances": (sockets(True), 40, "shown"),
    "sockets and wire": (sockets(False, wire=True), 60, "shown"),
    "gauge, 1 plane": (gauges(1), 90, "open"),
    "gauge, 3 planes": (gauges(3), 90, "open"),
    "sockets": (sockets(False), 40, "open"),
    "bearings": (bearings(False), 25, "open"),
    "contacts, 1 plane": (contacts(1), 90, "open"),
    "contacts, 2 planes": (contacts(2), 90, "open"),
    "contacts, 3 planes": (contacts(3), 90, "open"),
    "delta, points": (tracker(), 15, "shown"),
    "delta, bed": (gauges(1), 60, "open"),
    CAMERA: (tracker(), 15, "shown"),
}
MOST = 200
