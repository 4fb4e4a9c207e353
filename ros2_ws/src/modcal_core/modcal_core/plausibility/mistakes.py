"""Mistakes that people make with a recording, each with how to undo it: joints, units, direction, conventions.

A mistake says how the samples would look had it not been made. Whether that fits better is for others to judge:
:mod:`conventions` by likelihood, :mod:`plausibility` where a model misses by far.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import Any

import numpy as np

from modcal_core.geometry import Array, so3
from modcal_core.measurements import Samples

# Sequences of three axes; upper case about moving axes, lower case about fixed ones, as SciPy writes them
THREE_AXES = tuple(s for w in ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX") for s in (w, w.lower()))
TWO_AXES = ("ZYZ", "ZXZ", "zyz", "zxz")
_SHIFTS = (-3, -2, -1, 1, 2, 3)  # stations, by which readings may have slipped against the joints


@dataclass(frozen=True)
class Mistake:
    """offender, remedy: of the refusal. undone: the samples without it. touches: what it changes: "rotation" of the
    readings alone, "reading", or "joints". log_volume: by how much undoing it shrinks a reading's volume, in logarithm.
    """

    offender: str
    remedy: str
    undone: Callable[[Samples], Samples]
    touches: str
    log_volume: float = 0.0


def inverse_pose() -> Mistake:
    """The tracker's pose in the tool, where the tool's pose in the tracker is meant."""

    def undone(samples: Samples) -> Samples:
        R = np.swapaxes(samples.R, 1, 2)
        return replace(samples, R=R, reading=-(R @ samples.reading[..., None])[..., 0])

    return Mistake(
        "readings look like inverse poses (tracker in tool)",
        "record the tool in the tracker's frame",
        undone,
        "reading",
    )


def of_joints(names: tuple[str, ...]) -> Iterator[Mistake]:
    """Two joints swapped, one that turns the other way, degrees for radians and the reverse."""
    for i, j in combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[i], order[j] = j, i
        yield Mistake(
            f"joints {names[i]} and {names[j]} look swapped",
            "correct the names in joint_states",
            lambda s, order=order: replace(s, q=s.q[:, order]),  # type: ignore[misc]
            "joints",
        )
    for i, name in enumerate(names):
        sign = np.ones(len(names))
        sign[i] = -1.0
        yield Mistake(
            f"joint {name} looks reversed",
            "correct its sign, or the axis in the URDF",
            lambda s, sign=sign: replace(s, q=s.q * sign),  # type: ignore[misc]
            "joints",
        )
    yield Mistake(
        "joint positions look like degrees", "record radians", lambda s: replace(s, q=np.radians(s.q)), "joints"
    )
    yield Mistake(
        "joint positions look converted to radians twice",
        "record radians",
        lambda s: replace(s, q=np.degrees(s.q)),
        "joints",
    )


def of_several_joints(names: tuple[str, ...]) -> Iterator[Mistake]:
    """Two joints or more that turn the other way, two that are swapped and turn the other way, three that stand under
    each other's names, all in reverse order, one that is counted together with another.
    """
    n = len(names)
    for count in range(2, n + 1):
        for some in combinations(range(n), count):
            sign = np.ones(n)
            sign[list(some)] = -1.0
            yield Mistake(
                f"joints {_listed([names[i] for i in some])} look reversed",
                "correct their signs, or the axes in the URDF",
                lambda s, sign=sign: replace(s, q=s.q * sign),  # type: ignore[misc]
                "joints",
            )
    for i, j in combinations(range(n), 2):
        for reversed_ in ((i,), (j,), (i, j)):
            order, sign = list(range(n)), np.ones(n)
            order[i], order[j] = j, i
            sign[list(reversed_)] = -1.0
            yield Mistake(
                f"joints {names[i]} and {names[j]} look swapped, and {_listed([names[r] for r in reversed_])} reversed",
                "correct the names and the signs in joint_states",
                lambda s, order=order, sign=sign: replace(s, q=s.q[:, order] * sign),  # type: ignore[misc]
                "joints",
            )
    orders = [(i, j, k) for a, b, c in combinations(range(n), 3) for i, j, k in ((a, b, c), (a, c, b))]
    for i, j, k in orders:
        order = list(range(n))
        order[i], order[j], order[k] = j, k, i
        said = f"joints {_listed([names[x] for x in sorted((i, j, k))])} look interchanged"
        yield _reordered(said, order)
        for r in (i, j, k):
            sign = np.ones(n)
            sign[r] = -1.0
            yield _reordered(f"{said}, and {names[r]} reversed", order, sign)
    yield _reordered("joints look written in reverse order", list(range(n))[::-1])
    for i, j in permutations(range(n), 2):
        for factor, how in ((-1.0, "the sum of both"), (1.0, "its difference to the other")):
            to = np.eye(n)
            to[i, j] = factor
            yield Mistake(
                f"joint {names[i]} looks counted together with {names[j]} ({how}, as coupled drives are)",
                f"write the angle between its two links as the position of {names[i]}",
                lambda s, to=to: replace(s, q=s.q @ to.T),  # type: ignore[misc]
                "joints",
            )


def _reordered(offender: str, order: list[int], sign: Array | float = 1.0) -> Mistake:
    remedy = "correct the names in joint_states"
    return Mistake(offender, remedy, lambda s: replace(s, q=s.q[:, order] * sign), "joints")


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else names[0]


def of_units() -> Iterator[Mistake]:
    """Positions in millimetres where metres are meant, and the reverse."""
    for scale, said, remedy in (
        (1e-3, "positions look like millimetres", "record metres"),
        (1e3, "positions look like metres taken for millimetres", "state the unit m"),
    ):
        yield Mistake(
            said,
            remedy,
            lambda s, scale=scale: replace(s, reading=scale * s.reading),  # type: ignore[misc]
            "reading",
            3.0 * float(np.log(scale)),
        )


def of_rarer_units() -> Iterator[Mistake]:
    """Positions in centimetres or inches where metres are meant."""
    for unit, scale in (("centimetres", 1e-2), ("inches", 0.0254)):
        yield Mistake(
            f"positions look like {unit}",
            "record metres",
            lambda s, scale=scale: replace(s, reading=scale * s.reading),  # type: ignore[misc]
            "reading",
            3.0 * float(np.log(scale)),
        )


def of_axes() -> Iterator[Mistake]:
    """Positions in a left-handed frame: one coordinate of the other sign, or two columns swapped."""
    for i, axis in enumerate("xyz"):
        sign = np.ones(3)
        sign[i] = -1.0
        yield Mistake(
            f"positions look mirrored (sign of {axis}, a left-handed frame)",
            f"correct the sign of {axis}",
            lambda s, sign=sign: replace(s, reading=s.reading * sign),  # type: ignore[misc]
            "reading",
        )
    for i, j in ((0, 1), (0, 2), (1, 2)):
        order = [0, 1, 2]
        order[i], order[j] = j, i
        yield Mistake(
            f"positions look as if columns {'xyz'[i]} and {'xyz'[j]} were swapped (a left-handed frame)",
            "correct the order of the columns",
            lambda s, order=order: replace(s, reading=s.reading[:, order]),  # type: ignore[misc]
            "reading",
        )


def left_handed() -> Mistake:
    """The same where orientations do not say which: one is the others, seen from another side."""
    return Mistake(
        "positions look mirrored (a left-handed frame: two columns swapped, or one of the other sign)",
        "correct the order or the signs of the columns",
        lambda s: replace(s, reading=s.reading * [1.0, 1.0, -1.0]),
        "reading",
    )


def mirror_image() -> Mistake:
    """Poses of an arm that is the mirror image of its URDF: a right arm with the description of a left one."""
    mirror = np.diag([1.0, 1.0, -1.0])
    return Mistake(
        "the arm looks like the mirror image of its URDF (a left arm's description for a right one, or a left-handed "
        "frame)",
        "give the URDF of this arm, or readings in a right-handed frame",
        lambda s: replace(s, reading=s.reading @ mirror, R=mirror @ s.R @ mirror),
        "reading",
    )


def of_axes_of_the_pose() -> Iterator[Mistake]:
    """Positions alone in the axes of the tool, of the inverse pose, or turned once too often."""
    frame = "give positions and orientations in the tracker's frame"
    yield Mistake(
        "positions look as if they were given along the axes of the tool, and orientations in the tracker's frame",
        frame,
        lambda s: replace(s, reading=_turned(s.R, s.reading)),
        "reading",
    )
    yield Mistake(
        "positions look like those of inverse poses (tracker in the tool's frame), and orientations do not",
        frame,
        lambda s: replace(s, reading=-_turned(s.R, s.reading)),
        "reading",
    )
    yield Mistake(
        "positions look turned by the orientation once too often (into a wrong frame)",
        frame,
        lambda s: replace(s, reading=_turned(np.swapaxes(s.R, 1, 2), s.reading)),
        "reading",
    )
    yield Mistake(
        "positions look like those of inverse poses, turned once too often (into a wrong frame)",
        frame,
        lambda s: replace(s, reading=-_turned(np.swapaxes(s.R, 1, 2), s.reading)),
        "reading",
    )


def _turned(R: Array, p: Array) -> Array:
    return np.asarray((R @ p[..., None])[..., 0])


def of_pairing() -> Iterator[Mistake]:
    """Readings that belong to the station before or after."""
    for shift in _SHIFTS:

        def undone(samples: Samples, shift: int = shift) -> Samples:
            rows = np.arange(max(0, -shift), len(samples) - max(0, shift))
            return replace(samples.select(rows), **_reading_of(samples.select(rows + shift)))

        side = "late" if shift > 0 else "early"
        yield Mistake(
            f"readings look {side} by {abs(shift)} station{'s' if abs(shift) > 1 else ''}",
            "the tracker's clock is off: synchronise it with the joints' and record again",
            undone,
            "reading",
        )


def of_rotations(stated: str | None = None) -> Iterator[Mistake]:
    """Orders of quaternions, inverse orientations, and Euler angles composed by another sequence than was meant.

    stated: the Euler sequence that composed the readings, where it is known; all are tried otherwise.
    """
    if stated is None:
        yield _quaternion("quaternions look like w x y z read as x y z w", lambda q: q[:, [1, 2, 3, 0]])
        yield _quaternion("quaternions look like x y z w read as w x y z", lambda q: q[:, [3, 0, 1, 2]])
        yield _quaternion("quaternions look like w z y x read as x y z w", lambda q: q[:, [3, 2, 1, 0]])
        yield _quaternion("quaternions look like w x y z conjugated", lambda q: q[:, [1, 2, 3, 0]] * [-1, -1, -1, 1])
        yield Mistake(
            "orientations look inverse (conjugate quaternions)",
            "publish the orientation of the tool in the tracker's frame",
            lambda s: replace(s, R=np.swapaxes(s.R, 1, 2)),
            "rotation",
        )
        yield Mistake(
            "rotation vectors look like radians read as degrees",
            "state the unit rad",
            lambda s: replace(s, R=so3.exp(np.degrees(so3.log(s.R)))),
            "rotation",
        )
    # about fixed axes is about moving ones in the reverse order: the same rotations
    composed = tuple(s for s in THREE_AXES + TWO_AXES if s.isupper()) if stated is None else (stated,)
    for by in composed:
        yield _euler(by, by, 180.0 / np.pi, False)
        for meant in THREE_AXES + TWO_AXES:
            # the same three numbers are found again but for a second branch, which matters from one kind to the other
            for other_branch in (False, True) if (by in TWO_AXES) != (meant in TWO_AXES) else (False,):
                if meant != by:
                    yield _euler(by, meant, 1.0, other_branch)


def _quaternion(offender: str, order: Callable[[Array], Array]) -> Mistake:
    return Mistake(
        offender,
        "publish unit quaternions x y z w",
        lambda s: replace(s, R=so3.from_quaternion(order(so3.to_quaternion(s.R)))),
        "rotation",
    )


def _euler(by: str, meant: str, scale: float, other_branch: bool) -> Mistake:
    def undone(samples: Samples) -> Samples:
        from scipy.spatial.transform import Rotation  # takes time to load, and only doubtful readings need it

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # where two axes are parallel only their sum is known, which will do
            angles = np.asarray(Rotation.from_matrix(samples.R).as_euler(by))  # type: ignore[call-overload]
        if other_branch:
            middle = -angles[:, 1] if by in TWO_AXES else np.pi - angles[:, 1]
            angles = np.stack([angles[:, 0] + np.pi, middle, angles[:, 2] + np.pi], axis=1)
        return replace(samples, R=Rotation.from_euler(meant, scale * angles).as_matrix())

    if by == meant:
        return Mistake(f"Euler angles {by} look like radians read as degrees", "state the unit rad", undone, "rotation")
    return Mistake(
        f"Euler angles composed as {_axes(by)} look like {_axes(meant)}",
        f"compose them as {_axes(meant)}; in the mapping of modcal import: sequence: {meant}",
        undone,
        "rotation",
    )


def _axes(sequence: str) -> str:
    about, other = ("moving", "fixed") if sequence.isupper() else ("fixed", "moving")
    return f"{sequence} about {about} axes (= {sequence[::-1].swapcase()} about {other} ones)"


def _reading_of(samples: Samples) -> dict[str, Any]:
    return {"reading": samples.reading, "R": samples.R, "frame": samples.frame, "kind": samples.kind}
