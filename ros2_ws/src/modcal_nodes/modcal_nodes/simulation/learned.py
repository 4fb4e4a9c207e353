"""What a pull has shown of an object: the way of the hand, how hard it was held, and how far it opened."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modcal_core.articulation.choice import choose
from modcal_core.articulation.track import FEWEST, Track
from modcal_core.files import to_json, write_folder
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.report.articulation import Articulation
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import forward
from modcal_core.robots.urdf import read_chain
from modcal_nodes.io.articulated import write_articulation

_PERIOD = 0.04  # s between two poses of the hand that are kept: some millimetres of the way
_STILL = 2e-4  # rad or m by which some joint must have gone since the last one: waiting says nothing of the way
_MAX = 2000  # of them; a minute has 1500


class PullRecord:
    """The hand's way during a pull, from joint states, and the largest force at the handle [N]."""

    def __init__(self) -> None:
        self.force = 0.0
        self._chain: Chain | None = None
        self._stamps: list[float] = []
        self._postures: list[Array] = []

    def describe(self, urdf_xml: str) -> None:
        """Take the arm from its description. Raises BadRobot."""
        self._chain = read_chain(urdf_xml)

    @property
    def begun(self) -> bool:
        """Whether the arm and a posture of it are known; of a pull that begins earlier the start would be missing."""
        return bool(self._postures)

    def take(self, names: list[str], positions: list[float], stamp: float) -> None:
        """One joint state [rad, m]. Other joints are left out, and what is too near the last one, in time or in way."""
        if self._chain is None or len(self._stamps) >= _MAX or not set(self._chain.names) <= set(names):
            return
        if self._stamps and stamp - self._stamps[-1] < _PERIOD:
            return
        at = dict(zip(names, positions, strict=False))
        q = np.array([at[name] for name in self._chain.names])
        if self._postures and np.abs(q - self._postures[-1]).max() < _STILL:
            return
        self._stamps.append(stamp)
        self._postures.append(q)

    def feel(self, force: Array) -> None:
        """A force at the handle (3,) [N]."""
        size = float(np.linalg.norm(force))
        if np.isfinite(size):
            self.force = max(self.force, size)

    def write(self, source: str, outcome: str, out: Path) -> tuple[str, ...]:
        """Write what was learned into a folder, with pull.json for programs; returns sentences.

        outcome: how the pull ended. Too short a way leaves pull.json alone.
        """
        sentences, names = self._articulation(source, out)
        data = {
            "modcal_pull": 1,
            "object": source,
            "sentences": [outcome, *sentences],
            "largest_force_n": self.force,
            "seconds": self._stamps[-1] - self._stamps[0] if self._stamps else 0.0,
            "files": list(names),
        }
        write_folder(out, {"pull.json": to_json(data)})
        return (outcome, *sentences)

    def _articulation(self, source: str, out: Path) -> tuple[list[str], tuple[str, ...]]:
        if self._chain is None or len(self._stamps) < FEWEST:
            return ["Too few joint states were received during the pull: nothing was learned."], ()
        poses = se3.to_pose(forward(self._chain, np.array(self._postures)))
        track = Track.of_poses(poses, np.array(self._stamps))
        choice = choose(track, np.random.default_rng(0))
        _, names, said = write_articulation(Articulation(source, self._chain.base, track, choice), out)
        return said, names
