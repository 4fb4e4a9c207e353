"""Cells whose floor is known, and what each planted row hands over.

``Exact`` keeps, of each recording it makes, what no noise would have left of it. Two arms with bodies beside their
chain are added to those of the examples: a UR10 on a lifting column, and on a torso that carries another arm as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from arms import DESCRIBED, Array, joint, link, standing
from scipy.spatial.transform import Rotation
from sites import BEGIN, EXACT, Bend, Cell, Session

from modcal_core.measurements.recording import Recording
from modcal_core.measurements.samples import Samples

ARMS = ("ur10", "panda", "xarm7")
GRAVITY = 9.81
# Of the other arm: joints, their axes and origins, and the masses [kg] behind them
OTHER = (("right_1", "0 1 0", (0.05, -0.3, 0.3), 6.0), ("right_2", "1 0 0", (0.0, 0.0, 0.4), 7.0))


@dataclass(frozen=True)
class Planted:
    """One or several recordings, what the best model leaves of them [mm, RMS], and what must be among the effects.

    named: (families, places) that one of the effects must be of, or nothing. never: families that must not be there, or
    "*". down: unit vector (3,) in which weight pulls in the base. carried: payloads [kg], one a recording. stations:
    whether stations are what is recorded, so that the truth can stand beside the fit.
    """

    recordings: tuple[Recording, ...]
    floor_mm: float
    named: tuple[tuple[str, ...], tuple[str, ...]] | None = None
    never: tuple[str, ...] = ()
    down: Array | None = None
    carried: tuple[float, ...] = ()
    stations: bool = True


@dataclass(frozen=True)
class Row:
    """A kind of recording: how it is made of a cell, which arms it is drawn from, and what is drawn before the arm."""

    make: Callable[..., Planted]
    arms: tuple[str, ...] = ARMS
    before: Callable[[np.random.Generator], Any] | None = None

    def planted(self, name: str, seed: int) -> tuple[Exact, Planted]:
        """The cell of a seed, and what is recorded there."""
        rng = np.random.default_rng([seed, *name.encode()])
        drawn = () if self.before is None else (self.before(rng),)
        works = Exact(self.arms[rng.integers(len(self.arms))] if len(self.arms) > 1 else self.arms[0], rng)
        return works, self.make(works, rng, *drawn)


class Exact(Cell):
    """A cell that keeps its recordings without noise as well, of joints that repeat exactly."""

    def __init__(self, robot: str, rng: np.random.Generator) -> None:
        super().__init__(robot, rng)
        self.exact: list[Session] = []

    def observe(self, q: Array, again: Array | None = None, *bends: Bend, **options: Any) -> Session:
        """As of any cell; the same random numbers follow."""
        session = super().observe(q, again, *bends, **options)
        following = self.rng.bit_generator.state
        self.exact.append(super().observe(q, again, *bends, **options | EXACT))
        self.rng.bit_generator.state = following
        return session

    def exact_samples(self, samples: Samples) -> Samples:
        """These samples with the readings that the recordings without noise have at their stamps."""
        stamps = BEGIN + np.concatenate([session.t for session in self.exact])
        order = np.argsort(stamps, kind="stable")
        rows = order[np.searchsorted(stamps[order], samples.stamps - 1e-6)]
        assert np.abs(stamps[rows] - samples.stamps).max() < 1e-6, "not the same stations with and without noise"
        p = np.concatenate([session.p for session in self.exact])
        R = np.concatenate([session.R.as_matrix() for session in self.exact])
        return replace(samples, reading=p[rows], R=R[rows])


def _on_a_joint(name: str, kind: str, xyz: str, moves: str, mass: float) -> tuple[str, str]:
    """The UR10 on a link that moves by one joint more, of this mass [kg]."""
    moved, mount = f"{name}_link", f"{name}_mount"
    return standing(
        "ur10",
        lambda root: [
            *(link("foot"), link(moved, mass, "0.02 0 0.1"), joint(name, f"foot {moved}", kind, xyz, axis=moves)),
            joint(mount, f"{moved} {root}", xyz="0.1 0.1 0.2", rpy="0.3 0 0.2"),
        ],
    )


def with_other_arm(urdf: str) -> str:
    """The description with the other arm on the torso's link."""
    parts, parent = [], "torso_link"
    for name, axis, xyz, mass in OTHER:
        at = " ".join(str(v) for v in xyz)
        parts += [link(f"{name}_link", mass, "0.03 0 0.2")]
        parts += [joint(name, f"{parent} {name}_link", "revolute", at, axis=f"{axis} -2 2")]
        parent = f"{name}_link"
    return urdf.replace("</robot>", "\n".join([*parts, "</robot>"]))


def other_torque(torso: Array, turns: Array) -> Array:
    """Torque of the other arm's weight about the torso's axis (N,) [N m], by moments about it."""
    lean = Rotation.from_rotvec(np.outer(torso, [0.0, 1.0, 0.0]))
    first = Rotation.from_rotvec(np.outer(turns[:, 0], [0.0, 1.0, 0.0]))
    second = first * Rotation.from_rotvec(np.outer(turns[:, 1], [1.0, 0.0, 0.0]))
    centre = np.array([0.03, 0.0, 0.2])
    shoulder, elbow = (np.array(xyz) for _, _, xyz, _ in OTHER)
    at = [shoulder + first.apply(centre), shoulder + first.apply(elbow) + second.apply(centre)]
    weights = [mass * GRAVITY * np.array([0.0, 0.0, -1.0]) for *_, mass in OTHER]
    return np.sum([np.cross(lean.apply(p), w)[:, 1] for p, w in zip(at, weights, strict=True)], axis=0)


DESCRIBED["lifted"] = _on_a_joint("lift", "prismatic", "0.1 0 0.3", "0 0 1 0.0 0.6", 25.0)
DESCRIBED["torso"] = _on_a_joint("torso", "revolute", "0 0 0.8", "0 1 0 -0.6 0.6", 12.0)
