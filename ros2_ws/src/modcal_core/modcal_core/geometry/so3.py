"""Rotations: exponential, logarithm, quaternions (x y z w), fixed-axis roll-pitch-yaw, and the mean on the manifold.

Every function takes any number of leading batch axes. The exponential is Rodrigues' formula
``R = I + a [w]x + b [w]x^2`` with ``a = sin t / t`` and ``b = (1 - cos t) / t^2``, ``t = |w|``; both are series below
``t = 0.01``, where the quotients would lose digits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_LOG_SERIES_BELOW = 1e-4  # rad; the next term of the series is then below 1e-18
# Of the coefficients of the exponential: 1, t², t⁴. The next terms are below 2e-16, where quotients would lose digits
_SERIES_BELOW = 1e-2  # rad
_SERIES = ((1.0, -1 / 6, 1 / 120), (1 / 2, -1 / 24, 1 / 720), (1 / 6, -1 / 120, 1 / 5040))


# A vector times this is its skew-symmetric matrix, flat
HAT = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)

_EYE = np.eye(3)
_FIRST, _LATER = [1, 2, 0], [2, 0, 1]  # rows and columns of the odd part


def hat(w: ArrayLike) -> Array:
    """Skew-symmetric matrices (..., 3, 3) of vectors (..., 3): ``hat(w) @ u == cross(w, u)``."""
    w = np.asarray(w, dtype=float)
    return np.asarray((w @ HAT).reshape(*w.shape, 3))


def cross(a: Array, b: Array, out: Array | None = None) -> Array:
    """Cross products (3, N) of vectors (3, N), component-major: in one sweep a component, without copies."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape)) if out is None else out
    np.multiply(a[1], b[2], out=out[0])
    out[0] -= a[2] * b[1]
    np.multiply(a[2], b[0], out=out[1])
    out[1] -= a[0] * b[2]
    np.multiply(a[0], b[1], out=out[2])
    out[2] -= a[1] * b[0]
    return out


def rodrigues_coefficients(angle: Array) -> tuple[Array, Array, Array]:
    """(sin t / t, (1 - cos t) / t^2, (t - sin t) / t^3) for angles t [rad], accurate down to zero."""
    t2 = angle * angle
    small = angle < _SERIES_BELOW
    a, b, c = (first + t2 * (second + t2 * third) for first, second, third in _SERIES)
    if small.all():  # as in most calibrations
        return a, b, c
    safe = np.where(small, 1.0, angle)
    half, sine = np.sin(0.5 * safe) / safe, np.sin(safe) / safe
    return np.where(small, a, sine), np.where(small, b, 2.0 * half * half), np.where(small, c, (1.0 - sine) / safe**2)


def exp(w: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return exp_and_left_jacobian(w)[0]


def exp_rows(w: Array) -> tuple[tuple[Array, Array, Array], ...]:
    """Columns of :func:`exp` of rotation vectors (3, N) [rad], three rows (N,) each: components first, uncopied."""
    x, y, z = w
    xx, yy, zz = x * x, y * y, z * z
    a, b, _ = rodrigues_coefficients(np.sqrt(xx + yy + zz))
    ax, ay, az = a * x, a * y, a * z
    bx, by = b * x, b * y
    xy, xz, yz = bx * y, bx * z, by * z
    return (
        (1.0 - b * (yy + zz), xy + az, xz - ay),
        (xy - az, 1.0 - b * (xx + zz), yz + ax),
        (xz + ay, yz - ax, 1.0 - b * (xx + yy)),
    )


def exp_and_left_jacobian(w: ArrayLike) -> tuple[Array, Array]:
    """(:func:`exp`, left Jacobian) (..., 3, 3) of rotation vectors (..., 3) [rad]: ``exp(w + d) ≈ exp(J d) exp(w)`` for
    small d; transposed, the right one.
    """
    w = np.asarray(w, dtype=float)
    a, b, c = rodrigues_coefficients(np.sqrt(np.einsum("...i,...i->...", w, w)))
    W = hat(w)
    WW = W @ W
    b = b[..., None, None]
    return _EYE + a[..., None, None] * W + b * WW, _EYE + b * W + c[..., None, None] * WW


def log(R: ArrayLike) -> Array:
    """Rotation vectors (..., 3) [rad] of rotation matrices (..., 3, 3), with angle in [0, π]."""
    R = np.asarray(R, dtype=float)
    q = to_quaternion(R)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    v, s = q[..., :3], q[..., 3]
    n = np.linalg.norm(v, axis=-1)
    small = n < _LOG_SERIES_BELOW
    safe = np.where(small, 1.0, n)
    # 2 atan2(n, s) / n, as a series in n near zero where s is near one
    scale = np.where(small, 2.0 + n * n / 3.0, 2.0 * np.arctan2(safe, s) / safe)
    return v * scale[..., None]


def left_jacobian_inverse(w: ArrayLike) -> Array:
    """Inverse left Jacobian (..., 3, 3) of SO(3): ``log(exp(d) exp(w)) ≈ w + J⁻¹ d`` for small d."""
    w = np.asarray(w, dtype=float)
    angle = np.linalg.norm(w, axis=-1)
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    half = 0.5 * safe
    k = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - half / np.tan(half)) / (safe * safe))
    W = hat(w)
    return np.eye(3) - 0.5 * W + k[..., None, None] * (W @ W)


def from_quaternion(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions x y z w (..., 4); they are normalised first."""
    q = np.asarray(q, dtype=float)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    R = np.empty(q.shape[:-1] + (3, 3))
    R[..., 0, 0] = 1.0 - 2.0 * (y * y + z * z)
    R[..., 0, 1] = 2.0 * (x * y - z * w)
    R[..., 0, 2] = 2.0 * (x * z + y * w)
    R[..., 1, 0] = 2.0 * (x * y + z * w)
    R[..., 1, 1] = 1.0 - 2.0 * (x * x + z * z)
    R[..., 1, 2] = 2.0 * (y * z - x * w)
    R[..., 2, 0] = 2.0 * (x * z - y * w)
    R[..., 2, 1] = 2.0 * (y * z + x * w)
    R[..., 2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return R


def to_quaternion(R: ArrayLike) -> Array:
    """Quaternions x y z w (..., 4) of rotation matrices (..., 3, 3); of the two signs, one that divides safely.

    Of the four ways to write q from R, the one with the largest divisor is taken, so no angle loses digits.
    """
    R = np.asarray(R, dtype=float)
    trace = np.trace(R, axis1=-2, axis2=-1)[..., None, None]
    K = np.empty((*R.shape[:-2], 4, 4))  # 4 q qᵀ
    K[..., :3, :3] = R + np.swapaxes(R, -1, -2) + (1.0 - trace) * _EYE
    K[..., 3, :3] = K[..., :3, 3] = R[..., _LATER, _FIRST] - R[..., _FIRST, _LATER]
    K[..., 3:, 3:] = 1.0 + trace
    best = np.diagonal(K, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(K, best[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def from_rpy(rpy: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of URDF roll-pitch-yaw (..., 3) [rad]: ``Rz(yaw) Ry(pitch) Rx(roll)``."""
    roll, pitch, yaw = np.moveaxis(np.asarray(rpy, dtype=float)[..., None] * _EYE, -2, 0)
    return exp(yaw) @ exp(pitch) @ exp(roll)


def to_rpy(R: ArrayLike) -> Array:
    """URDF roll-pitch-yaw (..., 3) [rad] of rotation matrices, exact to rounding even at pitch ±90°.

    Near that pitch roll and yaw are each ill-defined but their sum is not: roll is read off after yaw has been undone,
    so the triple always gives back the rotation.
    """
    R = np.asarray(R, dtype=float)
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    s, c = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(s * R[..., 0, 2] - c * R[..., 1, 2], c * R[..., 1, 1] - s * R[..., 0, 1])
    return np.stack([roll, pitch, yaw], axis=-1)


def mean(R: ArrayLike) -> Array:
    """Mean rotation (..., 3, 3) of rotations (..., n, 3, 3): the one with least squared chordal distance.

    It is the polar factor of the sum, so q and −q cannot pull it apart.
    """
    R = np.asarray(R, dtype=float)
    return nearest_rotation(R.sum(axis=-3))


def nearest_rotation(A: ArrayLike) -> Array:
    """Rotation (..., 3, 3) closest to A (..., 3, 3) in the Frobenius norm (special orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(np.asarray(A, dtype=float))
    sign = np.ones(U.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(U @ Vt))
    return (U * sign[..., None, :]) @ Vt
