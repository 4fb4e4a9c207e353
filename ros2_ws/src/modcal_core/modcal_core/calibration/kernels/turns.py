"""Turns as complex numbers: of joints about their axes, and of bodies as quaternions in two halves.

A turn by q about z multiplies ``x + iy`` by ``e^{iq}``. A quaternion ``w + xi + yj + zk`` is written ``A + B i`` with
``A = w + zk`` and ``B = x + yk``, two numbers of the plane spanned by 1 and k, in which k is the imaginary unit. Since
``i A = conj(A) i``, products are

    (A + B i)(C + D i) = (A C − B conj(D)) + (A D + B conj(C)) i,

and a turn by q about z from the left multiplies both halves by ``e^{iq/2}``. Quaternions are arrays (..., 2) of complex
numbers, or what is the same memory, rows w, z, x, y of real ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modcal_core.geometry import Array, so3

Complex = NDArray[np.complex128]

_ONE_EACH = np.eye(4).view(complex)  # the quaternions w, z, x and y, (4, 2)


def unit(angle: Array) -> Complex:
    """``e^{i angle}`` for angles [rad], to rounding.

    By the tangent t of half the angle, ``(1 − t²) / (1 + t²) + i 2t / (1 + t²)``: one function for two, and one that
    NumPy has in vectors.
    """
    t = np.tan(0.5 * angle)
    scale = t * t
    scale += 1.0
    np.divide(2.0, scale, out=scale)
    out = np.empty(angle.shape, dtype=complex)
    np.multiply(t, scale, out=out.imag)
    np.subtract(scale, 1.0, out=out.real)
    return out


def quaternions(R: Array) -> Complex:
    """Quaternions (..., 2) of rotation matrices (..., 3, 3)."""
    return np.ascontiguousarray(so3.to_quaternion(R)[..., [3, 2, 0, 1]]).view(complex)


def from_left(m: Complex) -> Array:
    """Matrices (..., 4, 4) that multiply by quaternions (..., 2) from the left: rows q times it are rows m q."""
    return np.ascontiguousarray(product(m[..., None, :], _ONE_EACH)).view(float)


def product(a: Complex, b: Complex) -> Complex:
    """Quaternions ``a b``, (..., 2)."""
    A, B, C, D = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    return np.stack([A * C - B * np.conj(D), A * D + B * np.conj(C)], axis=-1)


def log_between(a: Complex, b: Complex) -> Array:
    """Rotation vectors (3, N) [rad] of ``a b⁻¹``, for quaternions (N, 2), with angles in [0, π]."""
    A, B = a.T
    C, D = b.T
    along, across = A * np.conj(C), A * D  # of the quotient, w + zk and x + yk
    along += B * np.conj(D)
    np.subtract(B * C, across, out=across)
    w = along.real
    out = np.empty((3, len(a)))
    out[0], out[1], out[2] = across.real, across.imag, along.imag
    sine = out[0] * out[0]
    sine += out[1] * out[1]
    sine += out[2] * out[2]
    np.sqrt(sine, out=sine)
    scale = np.arctan2(sine, np.abs(w))
    scale *= np.copysign(2.0, w)
    scale /= np.maximum(sine, np.finfo(float).tiny)
    out *= scale
    return out
