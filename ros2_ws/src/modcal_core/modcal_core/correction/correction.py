"""Where an arm truly is, given what its joints report: the calibrated geometry with the effects put in.

*In the base link* means that of the calibrated arm written with the least change to its drawing (see
:mod:`modcal_core.calibration.parameters`): where the base stands in the tracker, and what turns or slides the first
joint as a whole, belongs to the cell and is not in it, neither in the pose nor in its covariance. *In a tracker frame*
has no such freedom: it is what that instrument would show.

Of the effects, those of the arm move the tip; a tool that was bumped moves the tool only; a base or tracker that
drifts, and a tracker's scale, show in tracker frames only; a tracker's delay shows in no true pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration import (
    PRIOR_ANGLE_RAD,
    PRIOR_LENGTH_M,
    Calibration,
    Model,
    RowView,
    between,
    passing_directions,
)
from modcal_core.effects import (
    JOINTS,
    PAIRS,
    READING,
    AxisCurves,
    Drivers,
    Effect,
    NominalArm,
    Term,
    columns,
    motion,
    shape_columns,
)
from modcal_core.errors import BadTable, MissingDriver, NotReachable
from modcal_core.geometry import Array, error_transform, se3, so3
from modcal_core.measurements import TRAVEL, Samples, SignalTrack, went_on
from modcal_core.robots import Frames, Mechanism, frames, gravity_wrench, is_serial_arm, tool_frames


@dataclass(frozen=True)
class ArmState:
    """One moment of an arm.

    stamp: [s]. q: where the joints were reported (n,), which efforts belong to. velocity: (n,) [rad/s, m/s]. approach:
    direction each joint last moved in, −1, 0 (unknown) or 1, (n,). effort: (n,) [N m, N], NaN where unknown. signals:
    what was received of everything else, up to now. path: how far joints are ahead of followers with play, at least
    and at most, (n, 2, widths); empty where unknown.
    """

    stamp: float
    q: Array
    velocity: Array
    approach: Array
    effort: Array
    signals: tuple[SignalTrack, ...] = ()
    path: Array = field(default_factory=lambda: np.empty((0, 0, 0)))

    @classmethod
    def at_rest(
        cls, q: ArrayLike, stamp: float, approach: ArrayLike | None = None, signals: tuple[SignalTrack, ...] = ()
    ) -> ArmState:
        """An arm that stands still at q (n,), with nothing known of its efforts."""
        q = np.array(q, dtype=float)
        came = np.zeros(len(q)) if approach is None else np.array(approach, dtype=float)
        return cls(stamp, q, np.zeros(len(q)), came, np.full(len(q), np.nan), signals)

    def arriving(self, q: Array) -> ArmState:
        """The moment of arrival at q (n,), straight from here: at rest, each joint from the side it comes from."""
        way = q - self.q
        approach = np.where(np.abs(way) > TRAVEL, np.sign(way), self.approach)
        return replace(self, velocity=np.zeros_like(self.velocity), approach=approach)

    def samples(self, chain: Mechanism, postures: Array, arm: NominalArm) -> Samples:
        """Samples of postures (N, n) under these conditions, for a model to predict.

        What the actuators would have to exert there is what they exert now, but for the difference in weight.
        """
        N = len(postures)

        def same(row: Array) -> Array:
            return np.broadcast_to(row, postures.shape)

        effort = same(self.effort)
        if arm.inertias is not None and arm.weighed and np.isfinite(self.effort).any():
            both = gravity_wrench(arm.chain, arm.inertias, np.concatenate([self.q[None], postures]))
            weight = np.where(chain.revolute[:, None], both[:, 5], both[:, 2]).T
            effort = effort - (weight[1:] - weight[:1])
        return Samples(
            names=chain.names,
            frames=("",),
            q=postures,
            stamps=np.full(N, self.stamp),
            station=np.zeros(N, int),
            reading=np.zeros((N, 3)),
            velocity=same(self.velocity),
            approach=same(self.approach),
            path=went_on(self.path, postures - self.q) if len(self.path) else self.path,
            effort=effort,
            signals=self.signals,
        )


Target = Literal["tip", "tool"]
_HEARD = ("temperature:", "signal:")
_MARGIN = 0.02  # of the range that was seen


class Correction:
    """A calibration made ready to correct one posture after another. Nothing in it changes."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.model = calibration.calibrated
        self.chain = self.model.chain
        self._arm = replace(self.model.arm or NominalArm(calibration.nominal.chain), limits=calibration.driver_limits)
        self._full = _Parts.of(self.model)
        self._fallback = calibration.fallback(self.model, calibration.geometric)
        self._outside = _Parts.of(calibration.geometric.with_effects(()))
        self._covariance = _deviations_covariance(calibration)
        # columns of the covariance of an arm at which the values of each effect begin
        self._first = (6 * self.chain.n + np.cumsum([0, *(len(e.values) for e in self.model.effects)])[:-1]).tolist()

    @cached_property
    def needs(self) -> tuple[str, ...]:
        """Names of the temperatures and signals that the effects depend on."""
        parts = (part for e in self.model.effects for part in e.driver.split(","))
        return tuple(dict.fromkeys(part for part in parts if part.startswith(_HEARD)))

    @cached_property
    def needs_effort(self) -> bool:
        """Whether the effects depend on what the actuators exert."""
        return any(part.startswith("effort:") for e in self.model.effects for part in e.driver.split(","))

    def require(self, at: ArmState) -> None:
        """Raises MissingDriver unless everything is known that the effects depend on."""
        heard = {track.name for track in at.signals if len(track.stamps)}
        missing = [(name, "it was not received") for name in self.needs if name not in heard]
        if self.needs_effort and not np.isfinite(at.effort).all():
            missing.append(("effort of the joints", "joint_states contain none"))
        for name, why in missing:
            raise MissingDriver(name, f"the calibration depends on it and {why}", "publish it, or calibrate without it")

    def pose(self, q: Array, at: ArmState, target: Target = "tip", frame: str = "") -> Array:
        """True pose (4, 4) of tip or tool at reported positions q (n,); in the base link, or in a tracker frame."""
        return self.poses(q[None], at, target, frame)[0]

    def poses(self, postures: Array, at: ArmState, target: Target = "tip", frame: str = "") -> Array:
        """The same for many postures (N, n) under the same conditions, (N, 4, 4). Raises BadTable: unknown frame.

        Outside the joint ranges that were seen they are those of the calibration's other model, as far as it counts.
        """
        around = self._around(postures, at)
        T = self._full.poses(postures, around, target, self.base_in(frame) if frame else None)
        if self._fallback is None:
            return T
        share = self._fallback.share(around.samples, around)
        rows = np.flatnonzero(share > 0.0)
        if not len(rows):
            return T
        other = self._poses_outside(postures[rows], self._around(postures[rows], at), target, frame)
        return between(T, rows, share[rows], other)

    def _poses_outside(self, postures: Array, around: Drivers, target: Target, frame: str = "") -> Array:
        bases = self._outside.model.T_frame_base
        base = bases[self.model.frames.index(frame)] if frame else None
        other = self._outside.poses(postures, around, "tool", base)
        if base is None:  # both bases are where the first frame sees them
            other = se3.inverse(self.model.T_frame_base[0]) @ bases[0] @ other
        if target == "tip":  # what is measured is the tool; the tip is where the full model has it on the tool
            other = other @ se3.inverse(self.model.T_tip_tool)
        return other

    def controlled(self, desired: Array) -> Array:
        """What of an error (6,), seen from the target at a pose (4, 4), the robot's joints can do away with, (k, 6).

        All of it for an arm; of a Delta the position, and the turn about the base's z where it has a shaft.
        """
        if is_serial_arm(self.chain):
            return np.eye(6)
        out = np.zeros((self.chain.n, 6))
        out[:3, :3] = np.eye(3)
        out[3:, 3:] = desired[2, :3]
        return out

    def base_in(self, frame: str) -> Array:
        """Pose (4, 4) of the base link in a tracker frame; raises BadTable for one that was not calibrated."""
        if frame not in self.model.frames:
            known = ", ".join((self.chain.base, *self.model.frames))
            raise BadTable(f"frame '{frame}'", f"the calibration knows {known}", "give a pose in one of these")
        return self.model.T_frame_base[self.model.frames.index(frame)]

    def joints(self, q: Array, at: ArmState) -> Array:
        """Where the joints truly stand when they report q (n,): with what effects turn them about their own axes."""
        around = self._around(q[None], at)
        out = self._full.joints(q, around)
        if self._fallback is not None and (share := float(self._fallback.share(around.samples, around)[0])) > 0.0:
            out += share * (self._outside.joints(q, around) - out)
        return out

    def corrected(self, at: ArmState, target: Target = "tip") -> tuple[Array, Array, Array]:
        """Where the arm truly is now: pose (4, 4), its covariance (6, 6) and the joints (n,), as pose, covariance and
        joints give them, with what the three have in common computed once.
        """
        if not is_serial_arm(self.chain):
            return self.pose(at.q, at, target), self.covariance(at.q, at, target), self.joints(at.q, at)
        around = self._around(at.q[None], at)
        twists = self._full.twists(around)
        f = frames(self.chain, at.q[None], twists)
        T = self._full.behind(f.transform(-1), around, target)
        C, q = self._of_serial(f, around, T[0], target), self._full.turned(at.q, twists)
        share = np.zeros(1) if self._fallback is None else self._fallback.share(around.samples, around)
        if share[0] > 0.0:
            T = between(T, np.arange(1), share, self._poses_outside(at.q[None], around, target))
            q += share[0] * (self._outside.joints(at.q, around) - q)
        return T[0], C, q

    def covariance(self, q: Array, at: ArmState, target: Target = "tip") -> Array:
        """Covariance (6, 6) of a pose in the base link: x y z [m], turns about its x y z [rad].

        The calibration's, through the Jacobian, and on top of it how the arm scattered about the model when it was
        calibrated; the latter alone where the calibration does not say how well it is known.
        """
        if self._covariance is None:
            return self._scatter()
        around = self._around(q[None], at)
        chain = self.chain
        if not is_serial_arm(chain):
            return np.asarray(self._scatter() + self._of_closed(around, target))
        f = frames(chain, q[None], self._full.twists(around))
        return self._of_serial(f, around, self._full.behind(f.transform(-1), around, target)[0], target)

    def _scatter(self) -> Array:
        noise = self.calibration.noise
        return np.diag([noise.position**2] * 3 + [noise.rotation**2] * 3)

    def _of_serial(self, f: Frames, around: Drivers, end: Array, target: Target) -> Array:
        """Covariance (6, 6) of the target, at a pose (4, 4), of an arm at these frames."""
        if self._covariance is None:
            return self._scatter()
        n = self.chain.n
        units = _unit_motions(f, n, end)
        rows = np.zeros((6, len(self._covariance)))
        rows[:, : 6 * (n - 1)] = units[1:n].transpose(1, 0, 2).reshape(6, -1)
        if target == "tool":
            rows[:, 6 * (n - 1) : 6 * n] = units[n]
        full = self._full
        shown = (*full.of_arm, *full.of_tool) if target == "tool" else full.of_arm
        for effect, first in zip(self.model.effects, self._first, strict=True):
            if any(effect is e for e in shown):
                for j, terms in enumerate((*columns(effect, around), *shape_columns(effect, around)), first):
                    rows[:, j] = _moved(terms, units)
        curves = full.curves
        for k, (own, sizes) in enumerate(curves.columns(around.samples.q[0])):
            columns_of = slice(self._first[curves.of[k]] + own.start, self._first[curves.of[k]] + own.stop)
            rows[:, columns_of] = np.outer(units[curves.place[k]][:, curves.direction[k]], sizes)
        used = np.flatnonzero(rows.any(axis=0))  # of a curve's functions four
        rows = rows[:, used]
        return np.asarray(self._scatter() + rows @ self._covariance[np.ix_(used, used)] @ rows.T)

    def _of_closed(self, around: Drivers, target: Target) -> Array:
        """Covariance (6, 6) by the parameters and effects of a Delta: what lies in its base is not the arm's."""
        known = self.calibration.uncertainty
        assert known is not None
        model = replace(self.model, frames=("",), T_frame_base=np.eye(4)[None], leaders=(), instruments=())
        if target == "tip":
            model = replace(model, T_tip_tool=np.eye(4), effects=self._full.of_arm)
        view = RowView.of(model, around.samples, around)
        last = self.chain.tool_place
        rows = np.zeros((6, len(known.covariance)))
        for j, parameter in enumerate(known.parameters):
            if 0 < parameter.place < last or (parameter.place == last and target == "tool"):
                column = np.zeros(6)
                if parameter.direction >= 6:
                    view.constant_column(parameter.place, parameter.direction - 6, column)
                else:
                    view.column(parameter.place, np.eye(6)[parameter.direction], column)
                rows[:, j] = column
        j = len(known.parameters)
        shown = (*self._full.of_arm, *self._full.of_tool) if target == "tool" else self._full.of_arm
        for effect in self.model.effects:
            if any(effect is e for e in shown):
                for terms in (*columns(effect, around), *shape_columns(effect, around)):
                    rows[:, j] = view.moved_by(terms)
                    j += 1
            else:
                j += len(effect.values)
        return np.asarray(rows @ known.covariance @ rows.T)

    def unseen(self, q: Array) -> tuple[str, ...]:
        """Names of joints outside the calibrated range, where no learned curve is used."""
        low, high = self.calibration.seen
        margin = _MARGIN * (high - low)
        out = (q < low - margin) | (q > high + margin)
        return tuple(name for name, outside in zip(self.chain.names, out, strict=True) if outside)

    def unwatched(self, stamp: float) -> bool:
        """Whether something depends on time and this is longer past the calibration than it lasted, or before it."""
        of = self._full
        timed = any(e.driver == "time" for e in (*of.of_arm, *of.of_tool, *of.of_cell))
        return timed and bool(self.calibration.driver_limits.time(np.array(stamp)) != stamp)

    def _around(self, postures: Array, at: ArmState) -> Drivers:
        signals = tuple(_lasting(track) for track in at.signals) if self.needs else ()
        # efforts must be seen beside the weight that they hold, which takes as long as all the rest
        effort = at.effort if self.needs_effort else np.full(len(at.effort), np.nan)
        samples = replace(at, signals=signals, effort=effort).samples(self.chain, postures, self._arm)
        return Drivers(samples, self._arm)


@dataclass(frozen=True)
class _Parts:
    """A model's effects by what they move: the arm, the tool, or the cell. curves: those of the arm that are computed
    together; of_arm: the others.
    """

    model: Model
    curves: AxisCurves
    of_arm: tuple[Effect, ...]
    of_tool: tuple[Effect, ...]
    of_cell: tuple[Effect, ...]

    @classmethod
    def of(cls, model: Model) -> _Parts:
        curves = AxisCurves.among(model.effects if is_serial_arm(model.chain) else (), model.chain)
        true = [e for i, e in enumerate(model.effects) if e.direction != JOINTS and i not in curves.of]
        return cls(
            model,
            curves,
            tuple(e for e in true if e.place not in ("base", "tool", "tracker") or e.direction == PAIRS),
            tuple(e for e in true if e.place == "tool" and e.direction != PAIRS),
            tuple(e for e in true if e.place in ("base", "tracker")),
        )

    def twists(self, around: Drivers) -> dict[int, Array]:
        """What the arm's effects move, (6, N) by place."""
        twists, _ = motion(self.of_arm, around)
        self.curves.add_to(twists, around.samples.q)
        return twists

    def poses(self, postures: Array, around: Drivers, target: Target, base: Array | None) -> Array:
        """Poses of the target (N, 4, 4) in the base link, or seen from where the base (4, 4) is, with the cell's."""
        twists, chain = self.twists(around), self.model.chain
        if base is None:
            return self.behind(_tip(chain, postures, twists), around, target)
        in_cell, scale = motion(self.of_cell, around)
        for place, twist in in_cell.items():
            twists[place] = twists[place] + twist if place in twists else twist
        T = base @ self.behind(_tip(chain, postures, twists), around, target)
        T[:, :3, 3] *= scale[:, None]
        return T

    def joints(self, q: Array, around: Drivers) -> Array:
        """Where the joints stand when they report q (n,)."""
        return self.turned(q, self.twists(around))

    def turned(self, q: Array, twists: Mapping[int, Array]) -> Array:
        """Joints (n,) at q (n,) with what these twists turn them by about their own axes."""
        chain = self.model.chain
        out = np.array(q, dtype=float)
        for place, twist in twists.items():
            j = place - chain.first_place
            if 0 <= j < chain.n:
                out[j] += twist[5 if chain.revolute[j] else 2, 0]
        return out

    def behind(self, T_base_tip: Array, around: Drivers, target: Target) -> Array:
        """Poses of the target, (N, 4, 4)."""
        if target == "tip":
            return T_base_tip
        T = T_base_tip @ self.model.T_tip_tool
        twists, _ = motion(self.of_tool, around)
        for twist in twists.values():
            T = T @ error_transform(twist.T)
        return T


def _tip(chain: Mechanism, postures: Array, twists: Mapping[int, Array]) -> Array:
    """Poses of the tip in the base link, (N, 4, 4). Raises NotReachable for what a Delta cannot take."""
    if is_serial_arm(chain):
        return frames(chain, postures, twists).transform(-1)
    T = tool_frames(chain, np.eye(4), postures, twists).transform(-1)
    if not np.isfinite(T).all():
        raise NotReachable("posture", "no platform fits the arms there", "stay where the platform fits")
    return np.asarray(chain.T_base_root @ T)


def _lasting(track: SignalTrack) -> SignalTrack:
    """A track of at least two values: what was received once stays as it was."""
    stamps, values = track.stamps, track.values
    if len(stamps) == 1:
        stamps, values = np.r_[stamps - 1.0, stamps], np.repeat(values, 2, axis=0)
    return replace(track, stamps=stamps, values=values)


def _unit_motions(f: Frames, n: int, end: Array) -> Array:
    """Motions (n + 1, 6, 6) of the end, at a pose (4, 4), in the base, per unit of each direction (columns) of the
    arm's places 0 … n − 1, and of the end itself.
    """
    out = np.zeros((n + 1, 6, 6))
    R, p = f.axes[:n, :, :, 0].transpose(0, 2, 1), f.p[:n, :, 0]
    out[:n, :3, :3] = out[:n, 3:, 3:] = R
    out[:n, :3, 3:] = so3.hat(p - end[:3, 3]) @ R
    out[n, :3, :3] = out[n, 3:, 3:] = end[:3, :3]
    return out


def _moved(terms: Sequence[Term], units: Array) -> Array:
    """Motion (6,) that the terms of one amplitude make together, per unit."""
    out = np.zeros(6)
    for term in terms:
        if term.place != READING:
            out += units[term.place][:, term.direction] * float(term.size[0])
    return out


def _deviations_covariance(calibration: Calibration) -> Array | None:
    """Covariance of deviations at places 1 … n − 1, six each, at the tool, six, and of the effects' values.

    In the gauge of least change: what could as well stand before a joint as behind it is put where it changes the
    drawing least, as :mod:`modcal_core.calibration.parameters` does, here to first order.
    """
    known = calibration.uncertainty
    if known is None:
        return None
    chain, n, P = calibration.calibrated.chain, calibration.calibrated.chain.n, len(known.parameters)
    if not is_serial_arm(chain):
        return known.covariance  # its constants have no such freedom
    selected = np.zeros((6 * n, P))
    for j, parameter in enumerate(known.parameters):
        if parameter.place > 0:
            selected[6 * (parameter.place - 1) + parameter.direction, j] = 1.0
    passing = passing_directions(chain, calibration.calibrated.T_tip_tool)
    inner = slice(0, 6 * (n - 1))
    unit = np.tile([PRIOR_LENGTH_M] * 3 + [PRIOR_ANGLE_RAD] * 3, n - 1)[:, None]
    moved = np.linalg.pinv(passing[inner] / unit, rcond=1e-9) @ (selected[inner] / unit)
    selected -= passing @ moved
    E = len(known.covariance) - P
    B = np.block([[selected, np.zeros((6 * n, E))], [np.zeros((E, P)), np.eye(E)]])
    return np.asarray(B @ known.covariance @ B.T, dtype=float)
