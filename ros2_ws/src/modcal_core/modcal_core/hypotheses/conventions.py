"""Conventions, units and joints that people mix up: of a whole recording, each with how to undo it."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations, permutations, product

import numpy as np

from modcal_core.geometry import Array, so3
from modcal_core.hypotheses.hand_eye import HandEye
from modcal_core.hypotheses.hypothesis import COMMON, RARE, VERY_RARE, Hypothesis, family, listed

# Sequences of three axes; upper case about moving axes, lower case about fixed ones, as SciPy writes them
THREE_AXES = tuple(s for w in ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX") for s in (w, w.lower()))
TWO_AXES = ("ZYZ", "ZXZ", "zyz", "zxz")
_ANGLES = (("radians", 1.0), ("degrees", np.pi / 180.0), ("gon", np.pi / 200.0), ("milliradians", 1e-3))
_USUAL = ("XYZ", "ZYX", "xyz", "zyx", "ZYZ", "zyz")
_COUNTED = (  # how a joint is counted, and the factor that undoes it
    ("in degrees", np.pi / 180.0),
    ("in revolutions", 2.0 * np.pi),
    ("twice as far", 0.5),
    ("half as far", 2.0),
    ("at the motor, before a gear of 100", 0.01),
    ("at the motor, before a gear of 50", 0.02),
    ("in millimetres", 1e-3),
)
_MAX_TURN = 1.05  # times a half or a whole turn; angles are no larger
INVERSE = "readings look like inverse poses (tracker in tool)"


def of_recording(case: HandEye, stated: str | None = None) -> list[Hypothesis]:
    """All that may be so of a whole recording. stated: the Euler sequence that composed its orientations, if known."""
    common = [*units(), *joints(case.names), *(axes() if case.poses else [left_handed()])]
    rare = [*rarer_units(), *several_joints(case.names), *_polar(case.p)]
    if case.poses:
        common.append(inverse_pose())
        rare += [*axes_of_the_pose(), mirror_image()]
    else:  # nothing but the joints says which way a mirrored point moves, so that both hide each other
        mirror = left_handed()
        rare += [_both(mirror, h) for h in joints(case.names)]
    rare += in_degrees(case.names)
    common += zeros(case)
    return [*family(COMMON, common), *family(RARE, rare), *(turns(stated) if case.poses else [])]


def _both(first: Hypothesis, then: Hypothesis) -> Hypothesis:
    """Two mistakes, of which either alone leaves nothing that agrees."""
    what, remedy = f"{first.what}, and {then.what}", f"{first.remedy}; then {then.remedy}"
    return Hypothesis(what, remedy, lambda c: then.undone(first.undone(c)), 0.0)


def turns(stated: str | None = None) -> list[Hypothesis]:
    """What may be wrong with orientations alone: exotic pairs of Euler sequences are the rarer ones."""
    plain: list[Hypothesis] = []
    exotic: list[Hypothesis] = []
    for h in rotations(stated):
        usual = "composed" not in h.what or stated is not None
        (plain if usual or all(s in _USUAL for s in re.findall(r" ([xyzXYZ]{3}) about", h.what)) else exotic).append(h)
    return [*family(COMMON, plain), *family(RARE, exotic)]


def _reading(what: str, remedy: str, p: Callable[[HandEye], Array], volume: float = 0.0) -> Hypothesis:
    return Hypothesis(what, remedy, lambda c: c.read(p(c), volume=volume), 0.0)


def _of_joints(what: str, remedy: str, M: Array) -> Hypothesis:
    """Joints whose positions are M (n, n) times the reported ones."""
    return Hypothesis(what, remedy, lambda c: c.moved(c.q @ M.T), 0.0, touches="joints")


# --- readings --------------------------------------------------------------------------------------------------------


def inverse_pose() -> Hypothesis:
    """The tracker's pose in the tool, where the tool's pose in the tracker is meant."""

    def undone(c: HandEye) -> HandEye:
        R = np.swapaxes(c.R, 1, 2)
        return c.read(-turned(R, c.p), R)

    return Hypothesis(INVERSE, "record the tool in the tracker's frame", undone, COMMON)


def units() -> Iterator[Hypothesis]:
    """Positions in millimetres where metres are meant, and the reverse."""
    yield _scaled("positions look like millimetres", "record metres", 1e-3)
    yield _scaled("positions look like metres taken for millimetres", "state the unit m", 1e3)


def rarer_units() -> Iterator[Hypothesis]:
    """Positions in centimetres or inches where metres are meant."""
    for unit, scale in (("centimetres", 1e-2), ("inches", 0.0254)):
        yield _scaled(f"positions look like {unit}", "record metres", scale)


def _scaled(what: str, remedy: str, scale: float) -> Hypothesis:
    return _mapped(what, remedy, scale * np.eye(3))


def _mapped(what: str, remedy: str, M: Array) -> Hypothesis:
    """Positions that are M (3, 3) times the written ones."""
    return _reading(what, remedy, lambda c: c.p @ M.T, float(np.linalg.slogdet(M)[1]))


def axes() -> Iterator[Hypothesis]:
    """Positions in a left-handed frame: one coordinate of the other sign, or two columns swapped."""
    for i, axis in enumerate("xyz"):
        what = f"positions look mirrored (sign of {axis}, a left-handed frame)"
        yield _mapped(what, f"correct the sign of {axis}", _signs(3, (i,)))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        what = f"positions look as if columns {'xyz'[i]} and {'xyz'[j]} were swapped (a left-handed frame)"
        yield _mapped(what, "correct the order of the columns", np.eye(3)[_exchanged(3, i, j)])


def left_handed() -> Hypothesis:
    """The same where orientations do not say which: one is the others, seen from another side."""
    what = "positions look mirrored (a left-handed frame: two columns swapped, or one of the other sign)"
    return _mapped(what, "correct the order or the signs of the columns", _signs(3, (2,)))


def mirror_image() -> Hypothesis:
    """Poses of an arm that is the mirror image of its URDF: a right arm with the description of a left one."""
    mirror = np.diag([1.0, 1.0, -1.0])
    return Hypothesis(
        "the arm looks like the mirror image of its URDF (a left arm's description for a right one, or a left-handed "
        "frame)",
        "give the URDF of this arm, or readings in a right-handed frame",
        lambda c: c.read(c.p @ mirror, mirror @ c.R @ mirror),
        0.0,
    )


def axes_of_the_pose() -> Iterator[Hypothesis]:
    """Positions alone in the axes of the tool, of the inverse pose, or turned once too often."""
    for what, sign, back in (
        ("were given along the axes of the tool, and orientations in the tracker's frame", 1.0, False),
        ("were those of inverse poses (tracker in the tool's frame), and orientations were not", -1.0, False),
        ("were turned by the orientation once too often (into a wrong frame)", 1.0, True),
        ("were those of inverse poses, turned once too often (into a wrong frame)", -1.0, True),
    ):

        def p(c: HandEye, sign: float = sign, back: bool = back) -> Array:
            return sign * turned(np.swapaxes(c.R, 1, 2) if back else c.R, c.p)

        yield _reading(f"positions look as if they {what}", "give positions and orientations in the tracker's frame", p)


def turned(R: Array, p: Array) -> Array:
    """Positions (N, 3) turned by orientations (N, 3, 3)."""
    return np.asarray((R @ p[..., None])[..., 0])


def increments() -> Hypothesis:
    """How far the target went since the station before."""
    h = _reading(
        "positions look like differences to the last station (increments), and not like places",
        "record places in the tracker's frame, or add the differences up",
        lambda c: np.cumsum(c.p, axis=0),
    )
    return replace(h, price=RARE)


def _polar(position: Array) -> Iterator[Hypothesis]:
    """Angles and a range in the columns of x, y and z, in any order, as instruments measure them."""
    size = np.abs(position).max(axis=0)
    lengths = (("metres", 1.0), ("millimetres", 1e-3))
    ways = product((2, 0, 1), (False, True), _ANGLES, lengths, (False, True), (False, True))
    for far, swapped, (unit, angle), (length, metre), zenith, clockwise in ways:
        around, up = [k for k in range(3) if k != far][:: -1 if swapped else 1]
        most = _MAX_TURN * np.pi / angle
        if size[around] > 2.0 * most or size[up] > most:
            continue

        def undone(
            c: HandEye,
            columns: tuple[int, int, int] = (around, up, far),
            scales: tuple[float, float] = (angle, metre),
            how: tuple[bool, bool] = (zenith, clockwise),
        ) -> HandEye:
            a, e, r = (c.p[:, k] for k in columns)
            a, e, r = scales[0] * a, scales[0] * e, scales[1] * r
            e = 0.5 * np.pi - e if how[0] else e
            a = -a if how[1] else a
            xyz = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
            grown = np.log(np.maximum(np.abs(r) ** 2 * np.abs(np.cos(e)), 1e-9))
            return c.read(r[:, None] * xyz, volume=grown + 2.0 * np.log(scales[0]) + np.log(scales[1]))

        order = sorted(((around, "azimuth"), (up, "zenith angle" if zenith else "elevation"), (far, "range")))
        what = f"positions look like polar coordinates ({', '.join(name for _, name in order)}; angles in {unit}, "
        what += f"range in {length}{', azimuth clockwise' if clockwise else ''})"
        yield Hypothesis(what, "write x, y and z in metres", undone, 0.0)


# --- orientations ----------------------------------------------------------------------------------------------------


def rotations(stated: str | None = None) -> Iterator[Hypothesis]:
    """Orders of quaternions, inverse orientations, and Euler angles composed by another sequence than was meant.

    stated: the Euler sequence that composed the readings, where it is known; all are tried otherwise.
    """
    if stated is None:
        for what, order, sign in (
            ("w x y z read as x y z w", [1, 2, 3, 0], 1.0),
            ("x y z w read as w x y z", [3, 0, 1, 2], 1.0),
            ("w z y x read as x y z w", [3, 2, 1, 0], 1.0),
            ("w x y z conjugated", [1, 2, 3, 0], np.array([-1.0, -1.0, -1.0, 1.0])),
        ):
            yield _orientation(
                f"quaternions look like {what}",
                "publish unit quaternions x y z w",
                lambda R, o=order, s=sign: so3.from_quaternion(so3.to_quaternion(R)[:, o] * s),  # type: ignore[misc]
            )
        yield _orientation(
            "orientations look inverse (conjugate quaternions)",
            "publish the orientation of the tool in the tracker's frame",
            lambda R: np.swapaxes(R, 1, 2),
        )
        yield _orientation(
            "rotation vectors look like radians read as degrees",
            "state the unit rad",
            lambda R: so3.exp(np.degrees(so3.log(R))),
        )
    # about fixed axes is about moving ones in the reverse order: the same rotations
    composed = tuple(s for s in THREE_AXES + TWO_AXES if s.isupper()) if stated is None else (stated,)
    for by in composed:
        what = f"Euler angles {by} look like radians read as degrees"
        yield _orientation(what, "state the unit rad", lambda R, by=by: _composed(R, by, by, 180.0 / np.pi))  # type: ignore[misc]
        for meant in THREE_AXES + TWO_AXES:
            # the same three numbers are found again but for a second branch, which matters from one kind to the other
            for branch in (False, True) if (by in TWO_AXES) != (meant in TWO_AXES) else (False,):
                if meant != by:
                    yield _orientation(
                        f"Euler angles composed as {_axes(by)} look like {_axes(meant)}",
                        f"compose them as {_axes(meant)}; in the mapping of modcal import: sequence: {meant}",
                        lambda R, by=by, meant=meant, b=branch: _composed(R, by, meant, 1.0, b),  # type: ignore[misc]
                    )
    yield _orientation(
        "orientations look like rotation vectors read as Euler angles",
        "state rotation vectors",
        lambda R: so3.exp(_angles(R, "xyz")),
    )


def _orientation(what: str, remedy: str, R: Callable[[Array], Array]) -> Hypothesis:
    return Hypothesis(what, remedy, lambda c: c.read(R=R(c.R)), 0.0, touches="orientations")


def _angles(R: Array, sequence: str) -> Array:
    from scipy.spatial.transform import Rotation  # takes time to load, and only doubtful readings need it

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where two axes are parallel only their sum is known, which will do
        return np.asarray(Rotation.from_matrix(R).as_euler(sequence))  # type: ignore[call-overload]


def _composed(R: Array, by: str, meant: str, scale: float, other_branch: bool = False) -> Array:
    from scipy.spatial.transform import Rotation

    angles = _angles(R, by)
    if other_branch:
        middle = -angles[:, 1] if by in TWO_AXES else np.pi - angles[:, 1]
        angles = np.stack([angles[:, 0] + np.pi, middle, angles[:, 2] + np.pi], axis=1)
    return np.asarray(Rotation.from_euler(meant, scale * angles).as_matrix())


def _axes(sequence: str) -> str:
    about, other = ("moving", "fixed") if sequence.isupper() else ("fixed", "moving")
    return f"{sequence} about {about} axes (= {sequence[::-1].swapcase()} about {other} ones)"


# --- joints ----------------------------------------------------------------------------------------------------------


def joints(names: tuple[str, ...]) -> Iterator[Hypothesis]:
    """Two joints swapped, one that turns the other way, degrees for radians and the reverse."""
    every = np.eye(len(names))
    for i, j in combinations(range(len(names)), 2):
        yield _ordered(f"joints {names[i]} and {names[j]} look swapped", _exchanged(len(names), i, j))
    for i, name in enumerate(names):
        remedy = "correct its sign, or the axis in the URDF"
        yield _of_joints(f"joint {name} looks reversed", remedy, _signs(len(names), (i,)))
    yield _of_joints("joint positions look like degrees", "record radians", np.radians(every))
    yield _of_joints("joint positions look converted to radians twice", "record radians", np.degrees(every))


def several_joints(names: tuple[str, ...]) -> Iterator[Hypothesis]:
    """Two joints or more that turn the other way, two that are swapped and turn the other way, three that stand under
    each other's names, all in reverse order, one that is counted together with another.
    """
    n = len(names)
    for count in range(2, n + 1):
        for some in combinations(range(n), count):
            what = f"joints {listed(names[i] for i in some)} look reversed"
            yield _of_joints(what, "correct their signs, or the axes in the URDF", _signs(n, some))
    for i, j in combinations(range(n), 2):
        for back in ((i,), (j,), (i, j)):
            what = f"joints {names[i]} and {names[j]} look swapped, and {listed(names[r] for r in back)} reversed"
            yield _ordered(what, _exchanged(n, i, j), back)
    for a, b, c in combinations(range(n), 3):
        for i, j, k in ((a, b, c), (a, c, b)):
            order = list(range(n))
            order[i], order[j], order[k] = j, k, i
            what = f"joints {listed(names[x] for x in (a, b, c))} look interchanged"
            yield _ordered(what, order)
            for r in (i, j, k):
                yield _ordered(f"{what}, and {names[r]} reversed", order, (r,))
    yield _ordered("joints look written in reverse order", list(range(n))[::-1])
    for i, j in permutations(range(n), 2):
        for factor, how in ((-1.0, "the sum of both"), (1.0, "its difference to the other")):
            what = f"joint {names[i]} looks counted together with {names[j]} ({how}, as coupled drives are)"
            remedy = f"write the angle between its two links as the position of {names[i]}"
            yield _of_joints(what, remedy, np.eye(n) + factor * np.outer(np.eye(n)[i], np.eye(n)[j]))


def zeros(case: HandEye) -> Iterator[Hypothesis]:
    """A joint that is counted from a quarter or half turn; of the first and the last that is base and tool as well."""
    for j in (j for j in range(1, case.chain.n - 1) if case.chain.revolute[j]):
        for turn in (0.5 * np.pi, -0.5 * np.pi, np.pi):
            what = f"joint {case.names[j]} reads {np.degrees(turn):.1f}° too much: its zero is different"
            off, remedy = turn * np.eye(case.chain.n)[j], f"check how the position of {case.names[j]} gets into "
            undone = lambda c, off=off: c.moved(c.q - off)  # noqa: E731
            yield Hypothesis(what, f"{remedy}joint_states", undone, 0.0, touches="joints")


def in_degrees(names: tuple[str, ...]) -> Iterator[Hypothesis]:
    """One joint that is written in degrees, in revolutions, twice or half as far."""
    for how, factor in _COUNTED:
        for i, name in enumerate(names):
            what, remedy = f"joint {name} is apparently counted {how}", f"check how the position of {name} gets into "
            scale = np.diag(np.where(np.arange(len(names)) == i, factor, 1.0))
            yield _of_joints(what, f"{remedy}joint_states", scale)


def _ordered(what: str, order: list[int], back: tuple[int, ...] = ()) -> Hypothesis:
    remedy = f"correct the names{' and the signs' if back else ''} in joint_states"
    return _of_joints(what, remedy, _signs(len(order), back) @ np.eye(len(order))[order])


def _signs(n: int, back: tuple[int, ...]) -> Array:
    return np.diag(np.where(np.isin(np.arange(n), back), -1.0, 1.0))


def _exchanged(n: int, i: int, j: int) -> list[int]:
    return [j if k == i else i if k == j else k for k in range(n)]


def of_some_rows(case: HandEye) -> list[Hypothesis]:
    """What may be so of some rows only: these of the whole recording that are met most."""
    plain = [*units(), *rarer_units(), *axes()]  # against the base that the others agree on
    plain += [*joints(case.names), *in_degrees(case.names)]
    rare: list[Hypothesis] = list(several_joints(case.names))
    if case.poses:
        plain.append(inverse_pose())
        rare += [*axes_of_the_pose(), mirror_image()]
        plain += [*rotations()]
    return [*family(COMMON, plain), *family(VERY_RARE, rare)]
