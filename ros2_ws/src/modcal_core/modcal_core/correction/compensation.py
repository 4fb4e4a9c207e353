"""What to command so that the arm's tool truly comes to be where it is wanted.

The calibrated geometry gives a posture near the seed. From there Newton's method goes on with the whole prediction, its
derivatives taken by differences: loads, gears and play are then those of the posture itself, and a gear error that is
steep (amplitude times cycles of some hundredths) is no slower than a flat one. Play is on the side that each joint will
have come from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.correction.correction import ArmState, Correction, Target
from modcal_core.errors import NotReachable
from modcal_core.geometry import Array, descend, se3
from modcal_core.robots import Delta, delta_inverse, inverse, is_delta, is_serial_arm

TOLERANCE_M, TOLERANCE_RAD = 1e-7, 1e-7
_DIFFERENCE = 1e-6  # rad or m
_MAX_STEPS = 12
_EFFECTS_M, _EFFECTS_RAD = 5e-3, 2e-2  # what effects may add to the reach of an arm
_RESTARTS = 12  # each takes some ten milliseconds where there is nothing to be found
_TILTED = 0.05  # rad; a Delta's platform stays level, and what is asked beyond its own errors is refused
_SINGULAR = 1e-3  # smallest gain of the joints, m or rad a rad, that still counts as one

_Posture = tuple[Array, Array, Array]  # joint positions, the error there, and what it loses per unit of each joint


@dataclass(frozen=True)
class Command:
    """A posture to command. q: joint positions (n,). position [m], rotation [rad]: what it misses by prediction.

    steps: of Newton's method. unseen: joints that it takes where the calibration has never seen them. singular: whether
    the arm can hardly move there in some direction.
    """

    q: Array
    position: float
    rotation: float
    steps: int
    unseen: tuple[str, ...]
    singular: bool


def compensate(
    correction: Correction,
    desired: Array,
    seed: Array,
    at: ArmState,
    target: Target = "tip",
    frame: str = "",
    rng: np.random.Generator | None = None,
    tolerance_m: float = TOLERANCE_M,
    tolerance_rad: float = TOLERANCE_RAD,
) -> Command:
    """The command that brings tip or tool to a true pose (4, 4), in the base link or in a tracker frame.

    seed: posture (n,) near which it is sought. at: the present conditions; the arm arrives from ``at.q``. rng: draws
    other postures to begin from where the seed leads nowhere; without it the answer is near the seed or there is none.
    Raises NotReachable, MissingDriver, BadTable (unknown frame).
    """
    correction.require(at)
    chain = correction.chain
    level = desired if not frame else se3.inverse(correction.base_in(frame)) @ desired
    # where the tip would be wanted in the base link if geometry were all
    goal = level if target == "tip" else level @ se3.inverse(correction.model.T_tip_tool)
    if is_serial_arm(chain):
        try:
            q = inverse(chain, goal, seed, rng=rng, restarts=_RESTARTS, tolerance=1e-7)
        except NotReachable as plain:  # an arm may be longer, or a joint farther from its limit, than by geometry
            if not (plain.position < _EFFECTS_M and plain.rotation < _EFFECTS_RAD):
                raise
            q = plain.posture
    else:
        assert is_delta(chain)
        q = _of_delta(chain, goal, seed)
    # which side a joint comes from is settled by the plain way there, and once: play must not flip to and fro
    arriving = at.arriving(q)
    controlled = correction.controlled(level).T

    def linearised(q: Array) -> tuple[Array, Array]:
        """The error at a command (n,), seen from the target, and what it loses per unit of each joint.

        (6,) and (6, n); of a Delta only what its joints can do away with.
        """
        postures = q + np.concatenate([np.zeros((1, len(q))), _DIFFERENCE * np.eye(len(q))])
        errors = se3.error(correction.poses(postures, arriving, target, frame), desired) @ controlled
        return errors[0], -(errors[1:] - errors[0]).T / _DIFFERENCE

    enough = 0.01 * min(tolerance_m, tolerance_rad)

    def step(here: _Posture, damping: float) -> tuple[_Posture, float]:
        q, error, J = here
        full = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(error)), error)
        new = np.clip(q + full, chain.lower, chain.upper)
        there = new, *linearised(new)
        return there, _size(there[1])

    begin: _Posture = q, *linearised(q)
    steps = 0
    if _size(begin[1]) > enough:
        found = descend(begin, lambda here: _size(here[1]), step, lambda here, *_: _size(here[1]) <= enough, _MAX_STEPS)
        begin, steps = found.place, found.steps
    q, error, J = begin
    position, rotation = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    if not is_serial_arm(chain):
        left = se3.error(correction.poses(q[None], arriving, target, frame), desired)[0, 3:]
        if float(np.linalg.norm(left)) > _TILTED:
            said = f"the platform cannot turn so: {np.degrees(np.linalg.norm(left)):.1f}° are left"
            raise NotReachable("desired pose", said, "ask for a level tool, turned about the base's z", 0.0)
    if not (position <= tolerance_m and rotation <= tolerance_rad):
        x, y, z = desired[:3, 3]
        raise NotReachable(
            f"true pose of the {target} at ({x:.3f}, {y:.3f}, {z:.3f}) m in {frame or chain.base}",
            f"the best command found misses it by {1e3 * position:.3g} mm, {rotation:.3g} rad",
            "stay away from singular postures and joint limits, or approach from another side",
            position,
            rotation,
        )
    gains = np.linalg.svd(J, compute_uv=False)
    return Command(q, position, rotation, steps, correction.unseen(q), bool(gains[min(J.shape) - 1] < _SINGULAR))


def _of_delta(chain: Delta, goal: Array, seed: Array) -> Array:
    """The posture of a Delta with its tip at a pose's place, turned about z as it is, as near to the seed as may be."""
    yaw = float(np.arctan2(goal[1, 0], goal[0, 0]))
    if chain.has_shaft:
        now = chain.shaft_ratio * float(seed[-1])
        yaw += 2.0 * np.pi * round((now - yaw) / (2.0 * np.pi))
        low, high = sorted(chain.shaft_ratio * np.array([chain.lower[-1], chain.upper[-1]]))
        yaw += 2.0 * np.pi * (int(yaw < low) - int(yaw > high))
    return delta_inverse(chain, goal[:3, 3], yaw if chain.has_shaft else 0.0)


def _size(error: Array) -> float:
    return float(np.linalg.norm(error))
