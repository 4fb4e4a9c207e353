"""Assemblies at random, and five modules worth of an ordinary arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modcal_core.modules.library import Assembly, published

LIBRARY = published()
JOINTS = ("JR", "JP")
LINKS = ("LC", "LP", "LR-I", "LR-II")


def random_assembly(rng: np.random.Generator, joints: int | None = None) -> Assembly:
    """Any assembly of the published library, of 1 to 8 joints."""
    n = int(rng.integers(1, 9)) if joints is None else joints

    def draw(high: int) -> int:
        return int(rng.integers(high))

    parts = [(JOINTS[draw(2)], draw(4), LINKS[draw(4)], draw(8), draw(4)) for _ in range(n)]
    return Assembly.build((draw(8), draw(4)), parts)


def numbered(assembly: Assembly, serials: Sequence[str]) -> Assembly:
    """The same of these physical modules, one serial number each, base to gripper."""
    return replace(
        assembly, modules=tuple(replace(m, serial=s) for m, s in zip(assembly.modules, serials, strict=True))
    )


def five_joints() -> Assembly:
    """The published answer of the two-pose task: base, LR-I, two LP, LR-II, LC."""
    return Assembly.build(
        (0, 1),
        [
            ("JR", 1, "LR-I", 4, 0),
            ("JR", 0, "LP", 7, 2),
            ("JR", 0, "LP", 7, 2),
            ("JR", 2, "LR-II", 7, 2),
            ("JR", 1, "LC", 6, 1),
        ],
    )
