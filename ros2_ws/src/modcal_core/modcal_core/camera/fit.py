"""The fit: arm, base, tool, clock, lens and the sheet's shape from all corners of all images, in one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.arm_poses import ArmPoses
from modcal_core.camera.corners import READOUT, SHAPE_NAMES, CornerTable, corner_rows, grams, residuals
from modcal_core.camera.equations import Equations, OtherBlock, Sizes, SolvedEquations
from modcal_core.camera.further import FurtherCamera, further_cameras, places_of
from modcal_core.camera.lens import Lens
from modcal_core.camera.priors import CLOCK_S, CommonPrior
from modcal_core.camera.sizes import START, likeliest, usual
from modcal_core.camera.state import CameraState as CameraState
from modcal_core.geometry.so3 import Array

_STEPS = 30  # at the same sizes
_MET = 1e-4  # gain of −2 log likelihood
_ROUNDS = 4  # of fitting and finding the sizes; they settle in two or three
_SETTLED = 0.05  # change of a size's logarithm
_DAMPED = 1e6  # at which no step helps
_MOVING = 1e-3  # rad/s, m/s; below, a clock shows nothing


@dataclass(frozen=True)
class CameraFit:
    """table, poses, prior: what was fitted. state: where it ended. sizes: of the errors. covariance: of parameters,
    clock, lens, shape, readout and the places of Z values of markers, (P + 16 + Z, P + 16 + Z). equations: at the
    state. pixels: residuals (M, 2), the images' own twists not put in. converged: whether it met. arm_stated: whether
    the size of the arm's faults was.
    """

    table: CornerTable
    poses: ArmPoses
    prior: CommonPrior
    state: CameraState
    sizes: Sizes
    covariance: Array
    equations: Equations
    pixels: Array
    converged: bool
    arm_stated: bool = False

    @property
    def rms_px(self) -> float:
        """RMS distance of corners from the model [px]."""
        w = self.table.weight
        return float(np.sqrt((w @ (self.pixels**2).sum(1)) / max(w.sum(), 1.0)))

    @property
    def misfit(self) -> float:
        """−2 log of the likelihood of the images, everything integrated out, and of sizes as usual as these."""
        return self.equations.solve(self.sizes).misfit() + usual(self.sizes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows of the covariance."""
        return (
            *self.poses.names,
            "clock",
            *(f"lens/{n}" for n in self.state.lens.names),
            *(f"sheet/{n}" for n in SHAPE_NAMES),
            "readout",
            *(f"places/{i}" for i in range(self.table.places * self.table.markers)),
        )


def fit_camera(
    table: CornerTable,
    poses: ArmPoses,
    lens: Lens,
    prior: CommonPrior,
    sizes: Sizes = START,
    arm: float | None = None,
    fixed_sizes: bool = False,
    begin: CameraState | None = None,
) -> CameraFit:
    """The fit from this lens and from base and tool of the poses' model, nominal arm.

    sizes: to begin with. arm: size of the arm's faults in units of its prior, where it is stated. fixed_sizes: take the
    sizes as they are. begin: a state to begin with instead.
    """
    state = begin or CameraState(poses.start, 0.0, lens, prior.shape)
    afar = sizes == START
    if arm is not None:
        sizes = replace(sizes, arm=arm)
    converged = False
    equations = equations_at(table, poses, prior, state)
    for _ in range(_ROUNDS):
        state, equations, converged = _descend(table, poses, prior, state, sizes)
        if fixed_sizes:
            break
        new = likeliest(equations, sizes, arm, afar=afar)
        afar = False
        settled = bool(np.abs(new.logs - sizes.logs).max() < _SETTLED)
        sizes = new
        if settled:
            break
    if not fixed_sizes:
        state, equations, converged = _descend(table, poses, prior, state, sizes)
    pixels = missed_pixels(table, poses, state)
    covariance = equations.solve(sizes).covariance()
    return CameraFit(table, poses, prior, state, sizes, covariance, equations, pixels, converged, arm is not None)


def equations_at(table: CornerTable, poses: ArmPoses, prior: CommonPrior, state: CameraState) -> Equations:
    """The equations at a state."""
    T, motions = poses.tool_motions(state.values, state.offset_s)
    joints = poses.joint_motions(state.values, T)
    N, P = len(T), motions.shape[2]
    by_clock = np.einsum("nij,nj->ni", joints, poses.velocity)[:, :, None]
    clocked = bool(np.abs(poses.velocity).max(initial=0.0) > _MOVING)
    moved = poses.as_twists(T, np.concatenate([motions, by_clock], axis=2))
    shifts = np.zeros((N, 6, 3))
    shifts[:, :3] = poses.R_frame_root(poses.model_at(state.values))  # along axes that other cameras share
    sweep = moved[:, :, P] if clocked else None
    rows = corner_rows(table, state.lens, state.shape, poses.seen(T), state.readout_s, sweep)
    information = np.zeros((P + 1 + len(prior.mean), P + 1 + len(prior.mean)))
    information[:P, :P] = np.diag(poses.prior_std**-2)
    further = further_cameras(poses)
    places = places_of(further, P)
    for camera, first in zip(further, places, strict=True):
        own = slice(first, first + len(camera.own))
        information[own, own] = camera.information
    information[P, P] = CLOCK_S**-2
    information[P + 1 :, P + 1 :] = prior.information
    common_free = prior.free.copy()
    common_free[READOUT] &= clocked
    return Equations(
        grams(table, rows),
        moved,
        poses.as_twists(T, joints),
        poses.as_twists(T, shifts),
        np.r_[poses.of_arm, False],
        np.r_[state.values - poses.expected, state.offset_s, state.common - prior.mean],
        information,
        np.r_[np.ones(P, bool), clocked, common_free],
        int((table.weight > 0.0).sum()),
        poses.rows_beside(state.values, P + 1),
        tuple(_block(camera, poses, state, first) for camera, first in zip(further, places, strict=True)),
        poses.faults,
        prior.places,
        poses.moments.stop,
    )


def _block(camera: FurtherCamera, poses: ArmPoses, state: CameraState, first: int) -> OtherBlock:
    """The images of a further camera, whose own values begin at ``first``."""
    there = camera.state(poses, state, state.values[first : first + len(camera.own)])
    own = camera.poses.with_effects(poses.model.effects)
    return OtherBlock(equations_at(camera.table, own, camera.prior, there), camera.columns(poses, first))


def missed_pixels(table: CornerTable, poses: ArmPoses, state: CameraState) -> Array:
    """By how much corners (M, 2) are elsewhere than the model has them [px]."""
    T, _ = poses.tool_motions(state.values, state.offset_s)
    sweep = None
    if np.abs(poses.velocity).max(initial=0.0) > _MOVING:
        by_clock = np.einsum("nij,nj->ni", poses.joint_motions(state.values, T), poses.velocity)
        sweep = poses.as_twists(T, by_clock[:, :, None])[:, :, 0]
    return residuals(table, state.lens, state.shape, poses.seen(T), state.readout_s, sweep)


def _possible(poses: ArmPoses, state: CameraState) -> bool:
    """Whether all lenses have a focal length."""
    every = [state]
    further = further_cameras(poses)
    for camera, first in zip(further, places_of(further, len(state.values)), strict=True):
        every.append(camera.state(poses, state, state.values[first : first + len(camera.own)]))
    return all(bool((s.lens.values[:2] > 0.0).all() and np.isfinite(s.common).all()) for s in every)


def _descend(
    table: CornerTable, poses: ArmPoses, prior: CommonPrior, state: CameraState, sizes: Sizes
) -> tuple[CameraState, Equations, bool]:
    """(state, equations there, whether it met): damped Gauss-Newton steps at these sizes."""
    equations = equations_at(table, poses, prior, state)
    solved = equations.solve(sizes)
    damping = 1e-6
    for _ in range(_STEPS):
        new_state = state.moved(solved.step(damping))
        new: SolvedEquations | None = None
        if _possible(poses, new_state):
            there = equations_at(table, poses, prior, new_state)
            new = there.solve(sizes)
        if new is not None and new.cost <= solved.cost + _MET:
            gain = solved.cost - new.cost
            state, equations, solved = new_state, there, new
            damping = max(0.1 * damping, 1e-9)
            if gain < _MET * (1.0 + 1e-6 * solved.cost):
                return state, equations, True
        else:
            damping = max(10.0 * damping, 1e-6)
            if damping > _DAMPED:
                return state, equations, True
    return state, equations, False
