"""Readings out of /tf: how one frame moves in another, along the one way that leads from it to the other."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, se3
from modcal_core.measurements import POSE, ReadingTrack

_MAX_EDGES = 500
_SHOWN = 8


@dataclass
class _Edge:
    """One frame in another: stamps, times of reception [s], and x y z qx qy qz qw [m]."""

    static: bool
    stamps: list[Array] = field(default_factory=list)
    received: list[Array] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)

    def columns(self) -> tuple[Array, Array, Array]:
        """Stamps (n,), received (n,), values (n, 7), in order, each stamp once."""
        stamps, received = np.concatenate(self.stamps), np.concatenate(self.received)
        _, first = np.unique(stamps, return_index=True)
        return stamps[first], received[first], np.concatenate(self.values)[first]


@dataclass
class Transforms:
    """What /tf and /tf_static say; parent, child: frames that are asked for."""

    parent: str
    child: str
    _edges: dict[tuple[str, str], _Edge] = field(default_factory=dict)

    def add(self, parent: str, child: str, stamps: Array, received: Array, values: Array, static: bool) -> None:
        """Take transforms (n, 7) of one frame in another."""
        key = parent.strip("/"), child.strip("/")
        if key not in self._edges and len(self._edges) >= _MAX_EDGES:
            return
        edge = self._edges.setdefault(key, _Edge(static))
        edge.stamps.append(np.where(stamps == 0.0, received, stamps))
        edge.received.append(received)
        edge.values.append(values)

    def forget_before(self, received: float) -> None:
        """Forget what was received before this time [s], but for what is static."""
        for edge in self._edges.values():
            if not edge.static:
                keep = [late >= received for late in edge.received]
                for name in ("stamps", "values", "received"):
                    setattr(edge, name, [v[k] for v, k in zip(getattr(edge, name), keep, strict=True)])

    def track(self, description: str | None) -> ReadingTrack:
        """The child in the parent at every stamp of the one part of the way that moves.

        description: the robot's, whose links must not be on the way but for fixed ones. Raises BadRecording.
        """
        name = f"tf {self.parent}:{self.child}"
        way = self._way()
        if way is None:
            there = ", ".join(f"{a}:{b}" for a, b in list(self._edges)[:_SHOWN]) or "nothing"
            raise BadRecording(name, "are not connected", f"name two frames that are; there are {there}")
        moving = [(key, forward) for key, forward in way if self._moves(key)]
        links = set() if description is None else set(re.findall(r"<link[^>]*\bname\s*=\s*[\"']([^\"']+)", description))
        if any(parent in links and child in links for (parent, child), _ in moving):
            said = "follows the robot's own links: it was computed from the joints and is not a measurement"
            raise BadRecording(name, said, "name the frames between which the tracker measures")
        if len(moving) != 1:
            said = "does not move" if not moving else f"is composed of {len(moving)} transforms that move"
            raise BadRecording(name, said, "name the frame of the tracker and that of its target, as it publishes them")
        stamps, received, values = self._edges[moving[0][0]].columns()
        T = np.broadcast_to(np.eye(4), (len(stamps), 4, 4))
        for key, forward in way:
            own = values if key == moving[0][0] else self._edges[key].columns()[2][-1:]
            good = np.linalg.norm(own[:, 3:], axis=1) > 0.5
            step = se3.from_pose(np.where(good[:, None], own, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
            step = np.where(good[:, None, None], step, np.nan)
            T = T @ (step if forward else se3.inverse(step))
        poses = np.full((len(stamps), 7), np.nan)
        finite = np.isfinite(T).all(axis=(1, 2))
        poses[finite] = se3.to_pose(T[finite])
        return ReadingTrack(POSE, self.parent, stamps, poses, received, "/tf")

    def _moves(self, key: tuple[str, str]) -> bool:
        edge = self._edges[key]
        values = np.concatenate(edge.values)
        return not edge.static and len(values) > 1 and bool((values != values[0]).any())

    def _way(self) -> list[tuple[tuple[str, str], bool]] | None:
        """Pairs from parent to child, each with whether it is gone from its parent to its child."""
        ways: dict[str, list[tuple[tuple[str, str], bool]]] = {self.parent: []}
        front = [self.parent]
        while front and self.child not in ways:
            front = [there for here in front for there in self._next(here, ways)]
        return ways.get(self.child)

    def _next(self, here: str, ways: dict[str, list[tuple[tuple[str, str], bool]]]) -> Iterator[str]:
        for a, b in self._edges:
            there = b if a == here else a if b == here else None
            if there is not None and there not in ways:
                ways[there] = [*ways[here], ((a, b), a == here)]
                yield there
