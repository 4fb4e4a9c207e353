"""The scene of a page in three dimensions: an arm in its postures, or an object that moves, and what stands around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.effects import motion
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.measurements.kinds import indirect_rows
from modcal_core.outcome import Outcome
from modcal_core.report.blocks import Scene3D
from modcal_core.robots import ARMS, Mechanism, is_delta, tool_frames

MAX_POSTURES, MAX_POINTS = 60, 500  # that a page can show and a person look through


def arm_lines(chain: Mechanism, T_tip_tool: Array, q: Array, twists: Mapping[int, Array] | None = None) -> list[Array]:
    """The polylines of an arm over its joints at postures q (N, n), (N, k, 3) [m] each, in its base; the last ends at
    the tool. twists: of its places, as ``tool_frames`` takes them.
    """
    frames = tool_frames(chain, T_tip_tool, q, twists)
    T = chain.T_base_root
    p = np.moveaxis(frames.p, -1, 0) @ T[:3, :3].T + T[:3, 3]  # (N, places, 3)
    base = np.zeros((len(q), 1, 3))
    if not is_delta(chain):
        return [np.concatenate([base, p], axis=1)]
    tip = p[:, -2:-1] if chain.has_shaft else p[:, -1:]
    arms = []
    for i in range(1, 1 + ARMS):
        elbow = p[:, i] + frames.loops[i].lever.T @ T[:3, :3].T
        arms.append(np.concatenate([base, p[:, i : i + 1], elbow[:, None], tip], axis=1))
    return [*arms, np.concatenate([tip, p[:, -1:]], axis=1)]


def joints_in_words(chain: Mechanism, q: Array) -> str:
    """A posture (n,) in degrees, and millimetres of sliding joints."""
    turning = chain.revolute
    values = (f"{np.degrees(x):.1f}°" if turns else f"{1e3 * x:.1f} mm" for x, turns in zip(q, turning, strict=True))
    return ", ".join(f"{name} {value}" for name, value in zip(chain.names, values, strict=True))


@dataclass(frozen=True)
class ShownPostures:
    """Postures of an arm that a scene shows. what: Posture, Station or Image. q: (N, n). rows: those that are shown."""

    chain: Mechanism
    q: Array
    what: str = "Posture"
    T_tip_tool: Array | None = None

    @property
    def rows(self) -> np.ndarray:
        """Numbers of the postures that are shown."""
        return spread_rows(len(self.q), MAX_POSTURES)

    def said(self, row: int) -> str:
        """A posture in words."""
        return f"{self.what} {row + 1} of {len(self.q)}: {joints_in_words(self.chain, self.q[row])}."

    def scene(self, alt: str, more: Sequence[str] = (), **others: Any) -> Scene3D:
        """The scene of these postures. more: a sentence for each that is shown. others: fields of the scene."""
        paths = arm_lines(self.chain, np.eye(4) if self.T_tip_tool is None else self.T_tip_tool, self.q[self.rows])
        said = [self.said(int(row)) for row in self.rows]
        said = [f"{one} {also}" for one, also in zip(said, more, strict=True)] if more else said
        given: dict[str, Any] = {"points": paths[-1][:, -1], "shown": np.arange(len(said)), **others}
        arms = [[path[k] for path in paths] for k in range(len(said))]
        return Scene3D(arms=arms, said=said, base=self.chain.base, alt=alt, **given)


MAX_ARROWS = 300
_MAX_STAGES = 7


def scene(report: Outcome) -> Scene3D | None:
    """The arm and what each held-out sample misses by; None if no model or no sample is at hand."""
    model, scored = report.model, report.scored
    if model is None or not len(scored):
        return None
    rows = spread_rows(len(scored), MAX_ARROWS)
    samples = scored.select(rows)
    indirect = indirect_rows(samples)
    named = [("nominal model", report.errors["nominal"]), *((s.added, s.errors) for s in report.steps)]
    named = [*named[: _MAX_STAGES - 1], *named[-1:]] if len(named) > _MAX_STAGES else named
    # misses as the base sees them; those of readings that are no positions come from the first joint
    R_frame_base = model.T_frame_base[samples.frame][:, :3, :3]
    stages = []
    for name, errors in named:
        miss = errors.position[rows]
        of_root = miss @ model.chain.T_base_root[:3, :3].T
        stages.append((name, np.where(indirect[:, None], of_root, np.einsum("nji,nj->ni", R_frame_base, miss))))
    twists = motion(model.effects, model.drivers(samples))[0] if model.effects else None
    places = arm_lines(model.chain, model.T_tip_tool, samples.q, twists)
    shown = spread_rows(len(samples), MAX_POSTURES)
    return Scene3D(
        points=places[-1][:, -1],
        arms=tuple(tuple(path[k] for path in places) for k in shown),
        shown=shown,
        said=(),
        base=model.chain.base,
        alt="The arm and an arrow for the error of every held-out sample",
        stages=tuple(stages),
        names=tuple(f"station {int(s)}" for s in samples.station),
    )
