"""Arms that the tests of planning share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.tables import from_table

IRB1410 = Path(__file__).resolve().parents[2] / "examples" / "robots" / "irb1410.yaml"
POINT = np.array([0.05, 0.02, 0.12])


def irb1410_table() -> dict[str, Any]:
    data = yaml.safe_load(IRB1410.read_text())
    assert isinstance(data, dict)
    return data


def irb1410() -> Chain:
    return from_table(irb1410_table())


def rotation(axis: int, angle: float) -> Array:
    """A turn about one axis, written out, so that nothing of the code under test is in it."""
    c, s = np.cos(angle), np.sin(angle)
    b, d = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[b, b], R[b, d], R[d, b], R[d, d] = c, -s, s, c
    return R


def dh_point(table: dict[str, Any], q: Array, errors: dict[str, float], point: Array) -> Array:
    """The measured point (3,) of an erring DH arm, from the base outwards with 3 × 3 matrices."""

    def err(name: str) -> float:
        return errors.get(name, 0.0)

    p = np.array([err("base/x"), err("base/y"), err("base/z")])
    R = rotation(0, err("base/rx")) @ rotation(1, err("base/ry")) @ rotation(2, err("base/rz"))
    for row, angle in zip(table["joints"], q, strict=True):
        theta, d, a, alpha = (row[key] + err(f"{row['name']}/{key}") for key in ("theta", "d", "a", "alpha"))
        R = R @ rotation(2, theta + angle)
        p = p + R @ np.array([a, 0.0, d])
        R = R @ rotation(0, alpha)
    return p + R @ (point + np.array([err("point/x"), err("point/y"), err("point/z")]))
