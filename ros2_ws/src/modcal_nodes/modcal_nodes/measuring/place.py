"""Everything that a measurement by an arm needs: its robot, what it may do, its session, and who advises."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadRobot, BadTable
from modcal_core.files import read_yaml
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POINT, POSE
from modcal_core.measuring.advice import Advice, Advisor
from modcal_core.measuring.goal import Goal
from modcal_core.measuring.motion import TimedMotion, free_way, from_side, timed
from modcal_core.measuring.pool import Pool, of_robot
from modcal_core.measuring.session import Session, Station
from modcal_core.planning.posture_pool import with_limits
from modcal_core.planning.site import Site, site_from_data
from modcal_core.planning.spheres import Spheres, clearance, spheres_of
from modcal_core.robot import Robot
from modcal_core.robots.mechanism import forward
from modcal_core.robots.urdf_drives import read_drives
from modcal_nodes.measuring.collision import CollisionModel, has_shapes
from modcal_nodes.measuring.folder import Folder, StoredSession

_SIDE = 0.05  # rad or m from which a station is come to where the side matters


@dataclass(frozen=True)
class StationWay:
    """How to go to a station: its number, and the motion, None where there is no free one."""

    number: int
    motion: TimedMotion | None


class Place:
    """One robot at one site. chosen: the parameters of ``station_runner``. urdf: text of the description."""

    def __init__(self, urdf: str, chosen: Mapping[str, Any]) -> None:
        """Raises ModcalError for what cannot be: another robot's session, a description without shapes, a bad site."""
        self.robot = Robot.from_urdf(urdf, chosen["base"] or None, chosen["tip"] or None)
        site_file = Path(chosen["site"]) if chosen["site"] else None
        self.site = Site() if site_file is None else site_from_data(read_yaml(site_file), str(site_file))
        limits = with_limits(self.robot.mechanism, self.site)
        self.lower, self.upper = np.asarray(self.robot.mechanism.lower), np.asarray(self.robot.mechanism.upper)
        self._narrow = np.asarray(limits.lower), np.asarray(limits.upper)
        self._fastest = read_drives(urdf, self.robot.chain).speed
        self._slack = float(chosen["tolerance_rad"])
        self.shapes: CollisionModel | None = None
        if has_shapes(urdf):
            folder = Path(chosen["meshes"]) if chosen["meshes"] else None
            self.shapes = CollisionModel(urdf, self.robot.names, self.site, folder)
        elif not chosen["no_self_collision"]:
            raise BadRobot(
                "robot_description",
                "has no collision shapes, so that the arm could not be kept from itself",
                "give one that has, or set no_self_collision: spheres along the links are then all that is checked",
            )
        self._spheres: Spheres = spheres_of(limits, self.site)
        kind = chosen["measurement"]
        if kind not in (POINT, POSE):
            raise BadTable(f"measurement '{kind}'", "is not read", "set pose or point")
        goal_mm, minutes = chosen["goal_mm"], chosen["minutes"]
        self.goal = Goal(
            1e-3 * goal_mm if goal_mm else None, chosen["statistic"], chosen["confidence"], chosen["stations"],
            60.0 * minutes if minutes else None,
        )  # fmt: skip
        if self.goal.statistic not in ("rms", "p95"):
            raise BadTable(f"statistic '{self.goal.statistic}'", "is not known", "set rms or p95")
        self.pool: Pool = of_robot(self.robot.mechanism, self.site, kind, np.random.default_rng(chosen["seed"]))
        if not chosen["out"]:
            raise BadTable("out", "names no folder", "set it: the session is kept there")
        self.folder = Folder(Path(chosen["out"]), self.robot)
        self.kept = self.folder.begin(
            StoredSession(
                Session(self.robot.names, kind, carried=self.site.carried), self.goal, chosen["seed"], time.time()
            )
        )
        self._advisor = Advisor(
            self.robot.mechanism, self.pool, self.goal, chosen["seed"], None, self.robot.inertias,
            effects=not chosen["geometry_only"],
        )  # fmt: skip

    @property
    def session(self) -> Session:
        """What has been measured so far."""
        return self.kept.session

    def advise(self) -> Advice:
        """What is next; the session with it is kept."""
        elapsed = time.time() - (self.kept.began or time.time())
        advice = self._advisor.advise(self.session, elapsed)
        self._keep(advice.session)
        return advice

    def note(self, number: int, station: Station) -> None:
        """Keep what became of a station."""
        self._keep(self.session.with_station(number, station))

    def finish(self, advice: Advice) -> None:
        """Write what came of it."""
        self.folder.write_tables(advice.session)
        self.folder.finish(advice, self.goal)

    def _keep(self, session: Session) -> None:
        self.kept = replace(self.kept, session=session)
        self.folder.save(self.kept)

    def free(self, q: Array) -> np.ndarray:
        """True for postures (N, n) that are within limits and touch nothing, (N,)."""
        inside = ((q >= self._narrow[0] - 1e-9) & (q <= self._narrow[1] + 1e-9)).all(axis=1)
        out = np.array(inside)
        if self.shapes is not None:
            out[inside] = self.shapes.free(q[inside])
        else:
            out[inside] = clearance(self._spheres, self.site, q[inside]) >= 0.0
        return out

    def way(self, number: int, start: Array, speed: float) -> StationWay:
        """How to go to a pending station from a posture (n,), no joint faster than the speed [rad/s, m/s], nor than the
        description allows. Raises BadRobot where the arm cannot begin: that is no fault of the station.
        """
        station = self.session.stations[number]
        goal, begin = station.asked, self._inside(start)
        self.require_free(begin)
        via = free_way(begin, goal, self.free, self.pool.where)
        if via is not None and station.approach is not None:
            beside = from_side(goal, station.approach, _SIDE)
            before = free_way(begin, beside, self.free, self.pool.where)
            last = None if before is None else free_way(beside, goal, self.free, self.pool.where[:0])
            via = None if before is None or last is None else [*before, goal]
        if via is None:
            return StationWay(number, None)
        return StationWay(number, timed([start, *via[1:]], np.minimum(speed, self._fastest)))

    def _inside(self, q: Array) -> Array:
        """The posture (n,), within limits where it is beyond them by no more than an arm stands beside a station."""
        inside = np.clip(q, *self._narrow)
        return inside if np.abs(inside - q).max() <= self._slack else q

    def require_free(self, q: Array) -> None:
        """Raises BadRobot where the arm cannot begin from a posture (n,)."""
        if self.free(q[None])[0]:
            return
        touching = [] if self.shapes is None else self.shapes.touches(q)
        said = (
            f"{touching[0].one} touches {touching[0].other}" if touching else "lies outside limits or touches something"
        )
        raise BadRobot("posture of the arm", said, "move it by hand to where it is free, or correct site and shapes")

    def dry_run(self, start: Array, speed: float) -> str:
        """What the arm would do first, in sentences; nothing is sent. Raises ModcalError where it could not begin."""
        self.require_free(self._inside(start))
        pending = self.session.pending
        ways, here = [], start
        for number in pending:
            way = self.way(number, here, speed)
            ways.append(way)
            if way.motion is not None:
                here = way.motion.end
        lasting = [float(w.motion.t[-1]) for w in ways if w.motion is not None]
        where = forward(self.robot.mechanism, self.pool.where)[:, :3, 3]
        low, high = where.min(axis=0), where.max(axis=0)
        checked = "the shapes of the description" if self.shapes is not None else "spheres along the links only"
        blocked = sum(w.motion is None for w in ways)
        box = ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", low, high, strict=True))
        return (
            f"{len(pending)} stations first, {sum(lasting):.0f} s of motion, {blocked} of them without a free way "
            f"(skipped). Joints move at {speed:g} rad/s at most, less where the description says so. The tip may go "
            f"anywhere in {box} m of {self.robot.base}. "
            f"Checked: limits, {checked}"
            + (", floor" if self.site.floor is not None else "")
            + (
                f", {len(self.site.boxes) + len(self.site.obstacles)} obstacles"
                if self.site.boxes or self.site.obstacles
                else ""
            )
            + ". Nothing has moved: call ~/start to accept."
        )
