"""Where the target is in the images by the arm, and how every parameter of arm, base and tool moves it there.

The tool of the model is whichever the arm carries, its frame the other: ``T_frame_tool`` is T_camera_target where the
target is on the tip, T_target_camera where the camera is. A motion of the tool, (shift of its origin, turn) along the
frame's axes, becomes the twist (a, b) of the target as the camera sees it.

A fit has a minimal set of parameters, and what it leaves out moves the tool as some of those do. So the prior
covariance of the set is that of all faults of an arm, brought to it by the derivatives of a general arm's readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from modcal_core.calibration import (
    Model,
    ModelParameter,
    View,
    choose_parameters,
    drop_fixed,
    exact_samples,
    general_samples,
    linearise,
    model_at,
    ordered_candidates,
)
from modcal_core.effects import Drivers, Effect, prior_stds
from modcal_core.geometry import Array, combined, se3, so3
from modcal_core.measurements import POSE, Samples, SignalTrack
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.robots import body_jacobian


@dataclass(frozen=True)
class ArmFaults:
    """What E faults of an arm, all of usual size, do to the A parameters of a fit, (A, E). place, turns: of each fault,
    (E,). stated: their size, where somebody states it.
    """

    moves: Array
    place: np.ndarray
    turns: np.ndarray
    stated: float | None = None

    @cached_property
    def _each(self) -> tuple[Array, Array]:
        """Covariances of the parameters by faults of lengths, and of angles, (A, A)."""
        lengths, angles = self.moves[:, ~self.turns], self.moves[:, self.turns]
        return lengths @ lengths.T, angles @ angles.T

    def covariance(self, ratio: float = 1.0) -> Array:
        """Prior covariance of the parameters, (A, A). ratio: scale of length faults over that of angle faults."""
        return np.asarray(ratio**2 * self._each[0] + self._each[1])

    def information(self, size: float, ratio: float) -> Array:
        """Its inverse, for faults of this size."""
        C = size**2 * self.covariance(ratio)
        scale = 1.0 / np.sqrt(np.diag(C))
        return np.asarray(np.linalg.inv(C * np.outer(scale, scale)) * np.outer(scale, scale))


def arm_faults(
    model: Model, parameters: Sequence[ModelParameter], views: Sequence[View], fixed: Sequence[str] = ()
) -> ArmFaults:
    """The faults of these parameters of an arm. views, fixed: as they were chosen for."""
    every = [p for p in drop_fixed(ordered_candidates(model.chain, model.frames, views), fixed) if p.of_arm]
    samples = general_samples(model, views, each=max(12, len(every)))
    J = linearise(model, every, np.zeros(len(every)), samples).J.T
    at = {p.name: i for i, p in enumerate(every)}
    kept = J[:, [at[p.name] for p in parameters]]
    moves = combined(kept, J) * np.array([p.prior_std for p in every])
    return ArmFaults(moves, np.array([p.place for p in every]), np.array([p.turns for p in every]))


@dataclass(frozen=True)
class ImageMoments:
    """stamps: of the images [s], (N,); empty where only their order is known. approach: the direction each joint last
    moved in, −1, 0 (unknown) or 1, (N, n). effort: of the actuators, (N, n). Empty where unknown. signals: tracks of
    whatever else was recorded. stop: number of the stop of each image, which images of other cameras share, (N,);
    empty where none does.
    """

    stamps: Array = field(default_factory=lambda: np.empty(0))
    approach: Array = field(default_factory=lambda: np.empty((0, 0)))
    effort: Array = field(default_factory=lambda: np.empty((0, 0)))
    signals: tuple[SignalTrack, ...] = ()
    stop: np.ndarray = field(default_factory=lambda: np.empty(0, int))

    def select(self, rows: np.ndarray) -> ImageMoments:
        """Moments of some of the images."""
        each = (self.stamps, self.approach, self.effort, self.stop)
        stamps, approach, effort, stop = (a[rows] if len(a) else a for a in each)
        return ImageMoments(stamps, approach, effort, self.signals, stop)

    def samples(self, model: Model, q: Array, velocity: Array) -> Samples:
        """Pose samples (N) of a model at these moments: for drivers and derivatives."""
        N = len(q)
        known = {name: value for name in ("approach", "effort") if len(value := getattr(self, name)) == N}
        timed = len(self.stamps) == N and N > 0
        known |= {"stamps": self.stamps if timed else np.arange(N, dtype=float), "velocity": velocity}
        exact = exact_samples(model, q, np.zeros(N, int), np.full(N, POSE, dtype=KIND_NAMES))
        return replace(exact, signals=self.signals, clock=timed, **known)


NOTHING_KNOWN = ImageMoments()

_FREE = 10.0  # m, rad; standard deviation of what nothing is known of
_MOVING = 1e-3  # rad/s, m/s; below, a clock shows nothing


class ValuePrior(NamedTuple):
    """start (V,): of a fit's values. mean (V,), information (V, V): of their prior. free (V,): which are fitted."""

    start: Array
    mean: Array
    information: Array
    free: np.ndarray


@dataclass(frozen=True)
class ArmPoses:
    """The arm at N images of one camera. model: base and tool as found first, and the effects that it has. parameters:
    what a fit may change besides the effects; values of both, in this order, are P. q: (N, n).

    velocity: of the joints [rad/s, m/s], (N, n), zeros where it stood. camera_on_tip: else the target is. moments: what
    else is known of the arm at the images. faults: expected of those parameters that are the arm's, None where there
    are none.
    """

    model: Model
    parameters: tuple[ModelParameter, ...]
    q: Array
    velocity: Array
    camera_on_tip: bool
    moments: ImageMoments = NOTHING_KNOWN
    faults: ArmFaults | None = None

    def select(self, rows: np.ndarray) -> ArmPoses:
        """The same arm at some of the images."""
        return replace(self, q=self.q[rows], velocity=self.velocity[rows], moments=self.moments.select(rows))

    def at_postures(self, q: Array) -> ArmPoses:
        """The same arm, standing, at other postures (M, n)."""
        return replace(self, q=q, velocity=np.zeros_like(q), moments=NOTHING_KNOWN)

    def with_effects(self, effects: Sequence[Effect]) -> ArmPoses:
        """The same arm with these effects in place of those it has."""
        return replace(self, model=self.model.with_effects(tuple(effects)))

    @property
    def arm_stated(self) -> float | None:
        """The size of the arm's faults, where it is stated."""
        return self.faults.stated if self.faults is not None else None

    @property
    def nominal(self) -> ArmPoses:
        """The same arm as it is drawn, of which base and tool alone are fitted."""
        return replace(self, parameters=tuple(p for p in self.parameters if not p.of_arm), faults=None)

    @property
    def count(self) -> int:
        """P."""
        return len(self.parameters) + sum(len(e.values) for e in self.model.effects)

    @cached_property
    def values(self) -> ValuePrior:
        """What is expected of the P values. Base and tool are free; ``faults`` refines what is expected of the arm."""
        own = np.array([p.prior_std if p.of_arm else _FREE for p in self.parameters])
        parts = [(np.zeros(len(own)), np.zeros(len(own)), own)]
        for effect in self.model.effects:  # settings are expected to be as they were found
            settings = np.where(np.arange(len(effect.values)) < len(effect.amplitudes), 0.0, effect.values)
            parts.append((effect.values, settings, prior_stds(effect, self.drivers())))
        start, mean, std = (np.concatenate(part) for part in zip(*parts, strict=True))
        return ValuePrior(start, mean, np.diag(std**-2.0), np.ones(len(std), bool))

    @property
    def moves(self) -> bool:
        """Whether the arm moved while images were taken, so that they show a clock."""
        return bool(np.abs(self.velocity).max(initial=0.0) > _MOVING)

    @property
    def of_arm(self) -> np.ndarray:
        """Which values change the arm's own geometry, (P,) bool."""
        own = np.zeros(self.count, bool)
        own[: len(self.parameters)] = [p.of_arm for p in self.parameters]
        return own

    def drivers(self, offset_s: float = 0.0) -> Drivers:
        """What effects depend on, at the images."""
        q = self.q + offset_s * self.velocity
        return self.model.drivers(self.moments.samples(self.model, q, self.velocity))

    def model_at(self, values: Array) -> Model:
        """The model with these values put in."""
        return model_at(self.model, self.parameters, values)

    def tool_motions(self, values: Array, offset_s: float = 0.0) -> tuple[Array, Array]:
        """T_frame_tool (N, 4, 4), the joints read so late [s], and shift and turn along the frame (N, 6, P)."""
        at = self.drivers(offset_s)
        now = self.model_at(values)
        J = linearise(self.model, self.parameters, values, at.samples, drivers=at).J
        return now.predict_samples(at.samples), self.of_root(now, J.reshape(-1, 6, len(self.q)))

    def of_root(self, now: Model, motions: Array) -> Array:
        """Motions (K, 6, N) of the tool, position and turn as seen from the root, along the frame, (N, 6, K)."""
        K, _, N = motions.shape
        return np.asarray(self.R_frame_root(now) @ motions.transpose(2, 1, 0).reshape(N, 2, 3, K)).reshape(N, 6, K)

    @staticmethod
    def R_frame_root(now: Model) -> Array:
        """The turn from the arm's root to the frame, (3, 3)."""
        return np.asarray(now.T_frame_base[0, :3, :3] @ now.chain.T_base_root[:3, :3])

    def tool_at(self, values: Array, offset_s: float = 0.0) -> Array:
        """T_frame_tool, (N, 4, 4)."""
        return self.model_at(values).predict_samples(self.drivers(offset_s).samples)

    def half_motions(self, T: Array) -> tuple[Array, Array]:
        """Twists of the target (N, 6, 6) per motion of the half in the world, and of that on the arm. T: T_frame_tool.

        A motion is a shift and a turn, about the frame's origin along its axes, or about the tool's along its own.
        """
        R, p = T[:, :3, :3], T[:, :3, 3]
        eye, zero = np.broadcast_to(np.eye(3), R.shape), np.zeros(R.shape)
        by_world = np.block([[eye, -so3.hat(p)], [zero, eye]])
        return self.as_twists(T, by_world), self.as_twists(T, np.block([[R, zero], [zero, R]]))

    def own_motions(self, values: Array, T: Array) -> Array:
        """Motion of the tool, as in :meth:`tool_motions`, per unit of each joint, and per shift along the axes of the
        arm's root, which all cameras share, (N, 6, n + 3). T: T_frame_tool.
        """
        now, R = self.model_at(values), T[:, None, :3, :3]
        at_tool = se3.adjoint(se3.inverse(now.T_tip_tool)) @ body_jacobian(now.serial, self.q)
        joints = (R @ at_tool.reshape(len(R), 2, 3, -1)).reshape(at_tool.shape)
        shifts = np.zeros((len(R), 6, 3))
        shifts[:, :3] = self.R_frame_root(now)
        return np.concatenate([joints, shifts], axis=2)

    def seen(self, T: Array) -> Array:
        """T_camera_target of T_frame_tool, (N, 4, 4)."""
        return se3.inverse(T) if self.camera_on_tip else T

    def as_twists(self, T: Array, motions: Array) -> Array:
        """Twists (N, 6, K) of the target seen from the camera, for motions of the tool (N, 6, K) at T_frame_tool."""
        shift, turn = motions[:, :3], motions[:, 3:]
        if self.camera_on_tip:
            back = -np.swapaxes(T[:, :3, :3], 1, 2)
            return np.concatenate([back @ shift, back @ turn], axis=1)
        return np.concatenate([shift + so3.hat(T[:, :3, 3]) @ turn, turn], axis=1)


def with_parameters(poses: ArmPoses, fixed: Sequence[str] = ()) -> ArmPoses:
    """The poses of an arm with the parameters that a fit may change. fixed: names, places or patterns that stay."""
    model, views = poses.model, (View(POSE, 0),)
    # All of base and tool, and beside them all of the arm, though some of it is the same motion: a shift along the
    # first joint is base or arm. Were it the arm's alone, its prior would hold the base where it was found first.
    placed = choose_parameters(model, views, fixed, among=lambda p: not p.of_arm).parameters
    arm = choose_parameters(model, views, fixed, among=lambda p: p.of_arm).parameters
    parameters = sorted((*placed, *arm), key=lambda p: (p.place, p.direction))
    faults = arm_faults(model, [p for p in parameters if p.of_arm], views, fixed) if arm else None
    return replace(poses, parameters=tuple(parameters), faults=faults)


def with_stated(poses: ArmPoses, error_m: float | None) -> ArmPoses:
    """The poses of an arm whose faults have the size at which the nominal arm is off by this RMS [m] at the tool, over
    the images; None: nobody states it. What base and tool can take of it is left out: the same images place both.
    """
    arm, faults = poses.of_arm, poses.faults
    if error_m is None or faults is None:
        return poses
    _, motions = poses.at_postures(poses.q).tool_motions(poses.values.start)
    J = motions[:, :3].reshape(-1, motions.shape[2])
    off = J[:, arm] @ np.linalg.cholesky(faults.covariance())
    rest = off - J[:, ~arm] @ np.linalg.lstsq(J[:, ~arm], off, rcond=1e-9)[0]
    rms = float(np.sqrt((rest**2).sum() / len(poses.q)))
    return replace(poses, faults=replace(faults, stated=error_m / max(rms, 1e-12)))
