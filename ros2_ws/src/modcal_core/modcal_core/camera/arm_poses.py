"""Where the target is in the images by the arm, and how every parameter of arm, base and tool moves it there.

The tool of the model is whichever the arm carries, its frame the other: ``T_frame_tool`` is T_camera_target where the
target is on the tip, T_target_camera where the camera is. A motion of the tool, (shift of its origin, turn) along the
frame's axes, becomes the twist (a, b) of the target as the camera sees it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.linearise import linearise, model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter, View
from modcal_core.calibration.structure import choose_parameters, exact_samples
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.recording import POSE
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import body_jacobian

FREE_M, FREE_RAD = 10.0, 10.0  # standard deviations of what nothing is known of


@dataclass(frozen=True)
class ArmPoses:
    """The arm at N images. model: base and tool as found first. parameters: P, what a fit may change. q: (N, n).

    velocity: of the joints [rad/s, m/s], (N, n), zeros where it stood. camera_on_tip: else the target is.
    """

    model: Model
    parameters: tuple[ModelParameter, ...]
    q: Array
    velocity: Array
    camera_on_tip: bool

    def select(self, rows: np.ndarray) -> ArmPoses:
        """The same arm at some of the images."""
        return replace(self, q=self.q[rows], velocity=self.velocity[rows])

    def at_postures(self, q: Array) -> ArmPoses:
        """The same arm, standing, at other postures (M, n)."""
        return replace(self, q=q, velocity=np.zeros_like(q))

    @property
    def prior_std(self) -> Array:
        """What is expected of each parameter, (P,) [m, rad]: of base and tool nothing."""
        return np.array(
            [p.prior_std if p.of_arm else (FREE_RAD if p.turns else FREE_M) for p in self.parameters], dtype=float
        )

    @property
    def of_arm(self) -> np.ndarray:
        """Which parameters change the arm itself, (P,) bool."""
        return np.array([p.of_arm for p in self.parameters], dtype=bool)

    def model_at(self, values: Array) -> Model:
        """The model with these values put in."""
        return model_at(self.model, self.parameters, values)

    def tool_motions(self, values: Array, offset_s: float = 0.0) -> tuple[Array, Array]:
        """(T_frame_tool (N, 4, 4), its derivative (N, 6, P): shift of the tool's origin and turn, along the frame).

        offset_s: by how much later than stated the joints were where the images say.
        """
        q = self.q + offset_s * self.velocity
        now = self.model_at(values)
        N = len(q)
        rows = exact_samples(now, q, np.zeros(N, int), np.array([POSE] * N, dtype=KIND_NAMES))
        J = linearise(self.model, self.parameters, values, rows).J
        turn = now.T_frame_base[0, :3, :3] @ now.chain.T_base_root[:3, :3]
        parts = (turn @ part.reshape(-1, 3, N).transpose(2, 1, 0) for part in (J[:, : 3 * N], J[:, 3 * N :]))
        return now.predict(q), np.concatenate(list(parts), axis=1)

    def joint_motions(self, values: Array, T: Array) -> Array:
        """Motion of the tool per unit of each joint, (N, 6, n), as in :meth:`tool_motions`. T: T_frame_tool."""
        now = self.model_at(values)
        at_tip = body_jacobian(now.serial, self.q)
        at_tool = se3.adjoint(se3.inverse(now.T_tip_tool)) @ at_tip
        R = T[:, :3, :3]
        return np.concatenate([R @ at_tool[:, :3], R @ at_tool[:, 3:]], axis=1)

    def seen(self, T: Array) -> Array:
        """T_camera_target of T_frame_tool, (N, 4, 4)."""
        return se3.inverse(T) if self.camera_on_tip else T

    def as_twists(self, T: Array, motions: Array) -> Array:
        """Twists (N, 6, K) of the target seen from the camera, for motions of the tool (N, 6, K) at T_frame_tool."""
        shift, turn = motions[:, :3], motions[:, 3:]
        if self.camera_on_tip:
            Rt = np.swapaxes(T[:, :3, :3], 1, 2)
            return np.concatenate([-Rt @ shift, -Rt @ turn], axis=1)
        return np.concatenate([shift + so3.hat(T[:, :3, 3]) @ turn, turn], axis=1)


def arm_poses(
    chain: Chain,
    q: Array,
    velocity: Array,
    T_frame_base: Array,
    T_tip_tool: Array,
    camera_on_tip: bool,
    fixed: Sequence[str] = (),
    hand_eye_only: bool = False,
) -> ArmPoses:
    """The nominal arm, base and tool where they were found first, with the parameters that a fit may change.

    fixed: names, places or patterns that stay as they are. hand_eye_only: of base and tool alone.
    """
    frame = "target" if camera_on_tip else "camera"
    model = Model(chain, (frame,), np.asarray(T_frame_base)[None], np.asarray(T_tip_tool))
    views = (View(POSE, 0),)
    # All of base and tool, and beside them all of the arm, though some of it is the same motion: a shift along the
    # first joint is base or arm. Were it the arm's alone, its prior would hold the base where it was found first.
    placed = choose_parameters(model, views, fixed, among=lambda p: not p.of_arm).parameters
    arm = () if hand_eye_only else choose_parameters(model, views, fixed, among=lambda p: p.of_arm).parameters
    parameters = sorted((*placed, *arm), key=lambda p: (p.place, p.direction))
    return ArmPoses(model, tuple(parameters), np.asarray(q), np.asarray(velocity), camera_on_tip)
