"""A recording of a displaced arm, spoiled in one way or two, and the words that name what was done to it.

Most rows spoil readings and joints; those of the description leave the recording as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.hypotheses.hand_eye import HandEye, placed
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.hypotheses.rows import scattered, unrelated
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import frames

pytestmark = pytest.mark.slow

CHAIN = ur10()
NAMES = CHAIN.names
N = 70
WORLD = record(11, N)
CLEAN = WORLD.samples
LATER, SOME = np.arange(N) >= 40, np.arange(N) % 5 < 2
P, R, Q = CLEAN.reading, CLEAN.R, CLEAN.q
T = se3.transform(R, P)
BACK = np.swapaxes(R, 1, 2)
ORDER = np.arange(N)
BY_NAME = np.array(sorted(ORDER, key=lambda k: str(k + 1)))
OTHER = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
AWAY = se3.exp([0.3, -0.2, 0.1, 0.2, 0.1, -0.3])
FLIP = np.diag([-1.0, -1.0, 1.0])
OFFSET = np.array([0.03, -0.05, 0.04])
RANGE = np.linalg.norm(P, axis=1)
AZIMUTH, ELEVATION = np.arctan2(P[:, 1], P[:, 0]), np.arcsin(P[:, 2] / RANGE)


def spoiled(p: Array = P, R: Array = R, q: Array = Q, rows: np.ndarray | None = None, kind: str = "pose") -> Samples:
    """Other readings and joints, at all stations or at some."""
    if rows is not None:
        p, R, q = (np.where(rows.reshape(-1, *[1] * (x.ndim - 1)), y, x) for x, y in ((P, p), (CLEAN.R, R), (Q, q)))
    R = np.broadcast_to(np.eye(3), R.shape) if kind == "point" else R
    return replace(CLEAN, reading=p, R=R, q=q, kind=np.full(N, kind))


def poses(T: Array, rows: np.ndarray | None = None, kind: str = "pose") -> Samples:
    return spoiled(T[:, :3, 3], T[:, :3, :3], rows=rows, kind=kind)


def reordered(rows: Array, kind: str = "pose") -> Samples:
    return spoiled(P[rows], R[rows], kind=kind)


def joint(j: int, column: Array, **how: object) -> Samples:
    q = Q.copy()
    q[:, j] = column
    return spoiled(q=q, **how)  # type: ignore[arg-type]


def quaternions(order: list[int]) -> Array:
    return Rotation.from_quat(Rotation.from_matrix(R).as_quat()[:, order]).as_matrix()


def mixed(i: int, j: int, values: list[list[float]]) -> Array:
    B = np.eye(6)
    B[np.ix_((i, j), (i, j))] = values
    return np.asarray(Q @ B.T)


def settling(kept: float) -> Array:
    out = [P[0]]
    for row in P[1:]:
        out.append(kept * out[-1] + (1.0 - kept) * row)
    return np.array(out)


def set_to_zero(kind: str) -> Samples:
    """The tracker is set to zero three times."""
    out = T.copy()
    for a, b in ((0, 20), (20, 45), (45, N)):
        out[a:b] = se3.inverse(T[a]) @ T[a:b]
    return poses(out, kind=kind)


def of_link(first: int, last: int, kind: str = "pose") -> Samples:
    f = frames(CHAIN, Q)
    seen = AWAY @ se3.inverse(f.transform(first)) @ f.transform(last) @ se3.exp([0.1, 0.05, 0.2, 0.4, 0.3, -0.2])
    return poses(seen, kind=kind)


def swapped_pairs() -> Array:
    rows = ORDER.copy()
    for k in range(0, N - 1, 6):
        rows[[k, k + 1]] = rows[[k + 1, k]]
    return rows


def some_mixed() -> Array:
    rows, rng = ORDER.copy(), np.random.default_rng(2)
    some = np.sort(rng.choice(N, 20, replace=False))
    rows[some] = np.roll(rng.permutation(some), 1)
    return rows


SWAPPED = Q[:, [0, 2, 1, 3, 4, 5]]
W_FIRST = quaternions([3, 0, 1, 2])
ELBOW = Q[:, 2]
AT_LATER = "at stations 40 to 69"
RECORDINGS: dict[str, tuple[Callable[[], Samples], tuple[str, ...]]] = {
    # of some stations
    "w first": (lambda: spoiled(R=W_FIRST, rows=LATER), ("w x y z", AT_LATER)),
    "two trackers": (lambda: poses(AWAY @ T, SOME), ("base (or the tracker) is displaced",)),
    "two targets": (lambda: poses(T @ AWAY, SOME), ("tool (or the target on it) is displaced",)),
    "a part in mm": (lambda: spoiled(1e3 * P, rows=LATER, kind="point"), (f"millimetres {AT_LATER}",)),
    "tool's axes in a part": (lambda: spoiled((BACK @ P[..., None])[..., 0], rows=LATER), ("given along the axes of the tool", AT_LATER)),
    "turned behind": (lambda: spoiled(R=R @ FLIP, rows=SOME), ("orientations look turned by 1", "of the tool at 28")),
    "three reversed": (lambda: spoiled(q=Q * [-1, 1, -1, -1, 1, 1], rows=LATER), (NAMES[0], NAMES[2], NAMES[3], f"look reversed {AT_LATER}")),
    "zero of the tracker": (lambda: set_to_zero("pose"), ("tracker", "stations 0 to 19, 20 to 44, 45 to 69")),
    # of one joint or two
    "never reported": (lambda: joint(2, 0.0 * ELBOW), ("joint elbow_joint is reported as standing still",)),
    "zero of a joint": (lambda: joint(3, Q[:, 3] + 0.5 * np.pi), ("wrist_1_joint reads 90",)),
    "revolutions": (lambda: joint(3, Q[:, 3] / (2 * np.pi)), ("wrist_1_joint", "counted in revolutions")),
    "stale, points": (
        lambda: joint(2, np.where(LATER, ELBOW[40], ELBOW), kind="point"),
        ("joint elbow_joint keeps its reported position at stations 4",),
    ),
    "of another arm": (
        lambda: joint(2, np.random.default_rng(2).permutation(ELBOW), kind="point"),
        ("joint elbow_joint was not where it was reported",),
    ),
    "coupled": (lambda: joint(2, ELBOW + Q[:, 1], kind="point"), (f"joint elbow_joint looks counted together with {NAMES[1]}",)),
    # of all joints
    "counted on": (lambda: spoiled(q=Q[:, [1, 2, 3, 4, 5, 0]]), ("all by 1 place", f"{NAMES[1]} under the name {NAMES[0]}")),
    "any order": (
        lambda: spoiled(q=Q[:, [3, 1, 5, 0, 2, 4]], kind="point"),
        (f"{NAMES[3]} under the name {NAMES[0]}", f"{NAMES[4]} under the name {NAMES[5]}"),
    ),
    "sum and difference": (
        lambda: spoiled(q=mixed(2, 3, [[1, 1], [1, -1]]), kind="point"),
        (f"{NAMES[2]} = 0.5 {NAMES[2]} + 0.5 {NAMES[3]}; {NAMES[3]} = 0.5 {NAMES[2]} - 0.5 {NAMES[3]}",),
    ),
    "other scales": (lambda: spoiled(q=Q * [1, 1, 1, 1.25, 1, 0.8]), (f"{NAMES[3]} = 0.8 {NAMES[3]}; {NAMES[5]} = 1.25 {NAMES[5]}",)),
    # of columns
    "z late": (lambda: spoiled(np.c_[P[:, :2], np.roll(P[:, 2], 1)]), ("column z of the positions looks late by 1",)),
    "orientations late": (lambda: spoiled(R=np.roll(R, 1, axis=0)), ("orientations look late by 1 station:",)),
    "two frames": (lambda: spoiled(R=OTHER @ R), (f"turned by {np.degrees(np.linalg.norm([0.3, -0.5, 0.2])):.3g}°",)),
    "z in inches": (lambda: spoiled(P * [1, 1, 1 / 0.0254]), ("coordinate z of the readings looks 39.",)),
    "offset": (lambda: spoiled(P - BACK @ OFFSET), ("not as those of one point of the tool",)),
    "random turns": (
        lambda: spoiled(R=Rotation.random(N, random_state=2).as_matrix()),
        ("positions correlate with the posture and orientations do not",),
    ),
    "inverse positions": (lambda: spoiled(-(BACK @ P[..., None])[..., 0]), ("inverse poses (tracker in the tool",)),
    "turned too often": (lambda: spoiled((R @ P[..., None])[..., 0]), ("by the orientation once too often",)),
    "steps": (lambda: spoiled(np.diff(P, axis=0, prepend=0 * P[:1])), ("increments",)),
    "polar": (
        lambda: spoiled(np.stack([RANGE, np.degrees(-AZIMUTH), 90 - np.degrees(ELEVATION)], axis=1)),
        ("(range, azimuth, zenith angle; angles in degrees, range in metres, azimuth clockwise)",),
    ),
    # of rows
    "a part is late": (lambda: reordered(np.r_[:40, 39 : N - 1]), ("readings at stations 40 to 69 look late by 1",)),
    "file names": (lambda: reordered(BY_NAME), ("stand in the order of file names",)),
    "halves": (lambda: reordered(np.roll(ORDER, 30), "point"), ("two parts that are exchanged",)),
    "a part in reverse": (lambda: reordered(np.r_[:45, N - 1 : 44 : -1]), ("belong to other stations, in another order of rows",)),
    "two and two": (lambda: reordered(swapped_pairs()), ("belong to other stations, in another order of rows",)),
    "some": (lambda: reordered(some_mixed()), ("belong to other stations",)),
    "permuted": (lambda: reordered(np.random.default_rng(4).permutation(N)), ("in another order of rows",)),
    "mean of rows": (
        lambda: spoiled(np.array([P[max(0, i - 1) : i + 2].mean(axis=0) for i in ORDER])),
        ("readings look filtered: each as the mean of 3 rows about its own",),
    ),
    "settling": (lambda: spoiled(settling(0.5), kind="point"), ("filtered: each as if 50% of the reading before",)),
    # of another link
    "link": (lambda: of_link(0, 5), (f"the link before {NAMES[5]} (", f"{NAMES[-1]} does not move")),
    "link seen from a link": (lambda: of_link(2, 5, "point"), (f"link behind {NAMES[1]}", f"link before {NAMES[5]} (")),
    # two mistakes at once
    "mirrored and swapped": (
        lambda: spoiled(P * [1, -1, 1], q=SWAPPED, kind="point"),
        ("positions look mirrored", f"joints {NAMES[1]} and {NAMES[2]} look swapped"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("how", RECORDINGS)
def test_what_was_written_down_wrongly_is_named(how: str) -> None:
    made, words = RECORDINGS[how]
    found = disagreement(made(), CHAIN)
    assert found.remedy
    for word in words:
        assert word in found.what


def with_origin(j: int, T: Array) -> Chain:
    origins = CHAIN.origins.copy()
    origins[j] = T
    return CHAIN.with_origins(origins)


def other_module(j: int) -> Array:
    """The origin of a joint behind another link: turned about x, and longer."""
    return np.asarray(
        CHAIN.origins[j] @ se3.transform(Rotation.from_euler("x", 90, degrees=True).as_matrix(), OFFSET * 4)
    )


def turned_origin() -> Array:
    return np.asarray(CHAIN.origins[3] @ se3.transform(OTHER, np.zeros(3)))


def two_links() -> Chain:
    origins = with_origin(1, other_module(1)).origins.copy()
    origins[4, :3, 3] += [0.2, 0.1, 0.0]
    return CHAIN.with_origins(origins)


DESCRIPTIONS: dict[str, tuple[Callable[[], Chain], tuple[str, ...]]] = {
    "turn": (lambda: with_origin(3, turned_origin()), (f"joint {NAMES[3]} in the URDF",)),
    "axis": (
        lambda: replace(CHAIN, axes=np.where(ORDER[:6, None] == 2, [1.0, 0.0, 0.0], CHAIN.axes)),
        (f"joint {NAMES[2]} looks as if it turned about 0 0 1",),
    ),
    "module": (lambda: with_origin(3, other_module(3)), (f"link before joint {NAMES[3]} is another", "turned by 90")),
    "two modules": (two_links, ("more than one link of the URDF is different",)),
    "slides": (lambda: replace(CHAIN, revolute=CHAIN.revolute & (ORDER[:6] != 3)), (f"joint {NAMES[3]} is prismatic in the URDF",)),
}  # fmt: skip


@pytest.mark.parametrize("how", DESCRIPTIONS)
def test_what_is_wrong_in_the_description_is_named(how: str) -> None:
    made, words = DESCRIPTIONS[how]
    found = disagreement(CLEAN, made())
    for word in words:
        assert word in found.what


def test_readings_that_look_filtered_and_are_not_are_searched_on() -> None:
    """Every fourth reading is the last one of before: no filter explains it, and what is left is asked all the same."""
    held = P[4 * (ORDER // 4)]
    found = disagreement(spoiled(held, R[4 * (ORDER // 4)]), CHAIN)
    assert found is None or "filtered" not in found.what


def test_nothing_is_said_of_what_is_clean_and_of_nonsense() -> None:
    rng = np.random.default_rng(0)
    nonsense = spoiled(rng.uniform(-1.0, 1.0, (N, 3)), Rotation.random(N, random_state=0).as_matrix())
    noisy = spoiled(P + 0.02 * rng.normal(size=(N, 3)))  # no joint may be blamed for it
    slightly = spoiled(R=Rotation.from_rotvec([0.01, 0.0, 0.0]).as_matrix() @ R)  # what a displaced arm may do
    one_posture, few = CLEAN.select(np.zeros(N, int)), CLEAN.select(np.arange(15))
    for samples in (CLEAN, nonsense, noisy, slightly, one_posture, few):
        assert disagreement(samples, CHAIN) is None


def test_an_arm_that_only_slides_has_no_axis_to_blame() -> None:
    """Orientations that its joints cannot make are no link's fault."""
    gantry = Chain.build(("x", "y", "z"), [np.eye(4)] * 4, np.eye(3), [False] * 3, [-1.0] * 3, [1.0] * 3)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 3))
    T = se3.transform(Rotation.random(60, random_state=0).as_matrix(), q)
    assert disagreement(samples_of(gantry, q, T), gantry) is None


def refused(samples: Samples) -> str:
    with pytest.raises(BadRecording) as found:
        calibrate(samples, CHAIN, np.random.default_rng(0), look_for_effects=False)
    return str(found.value)


def test_a_calibration_is_refused_by_what_is_named() -> None:
    reading = WORLD.world.tool_in_tracker(Q * [1, 1, -1, 1, 1, 1])[:, :3, 3]
    assert "elbow_joint" not in refused(spoiled(reading))  # orientations agree with it as it is
    nonsense = np.random.default_rng(3).uniform(-1.0, 1.0, (N, 3))
    drifting = replace(spoiled(nonsense, kind="point"), sigma_position=np.full(N, 0.15))
    assert "readings: go on moving while the joints stand still, by 150 mm" in refused(drifting)


def test_a_target_of_its_own_in_each_frame_is_named_in_the_refusal() -> None:
    frame = ORDER % 2
    points = record(11, N, "point").samples
    reading = points.reading + (R @ (frame[:, None] * [0.2, 0.1, 0.0])[..., None])[..., 0]
    two = replace(points, reading=reading, frame=frame, frames=("a", "b"))
    assert "frames a, b: agree with the arm one by one, not together" in refused(two)


WRONG: dict[str, Callable[[Samples, np.random.Generator], Samples]] = {
    "cyclic": lambda s, _: replace(s, q=np.roll(s.q, 1, axis=1)),
    "inverse": lambda s, _: replace(s, reading=-np.einsum("nij,ni->nj", s.R, s.reading)),
    "two joints": lambda s, rng: replace(s, q=np.c_[s.q[:, 0], rng.permuted(s.q[:, 1:3], axis=0), s.q[:, 3:]]),
    "a half": lambda s, rng: replace(s, q=np.r_[s.q[:100], rng.permutation(s.q[100:])]),
}


def test_readings_that_do_not_depend_on_joints_are_told_from_those_that_are_written_down_wrongly() -> None:
    rng, clean = np.random.default_rng(3), record(12, 200).samples
    others = replace(clean, q=record(13, len(clean)).samples.q)
    with pytest.raises(BadRecording, match="do not seem to belong together"):
        calibrate(others, CHAIN, rng)
    for spoil in WRONG.values():
        case = HandEye.holding(spoil(clean, rng), CHAIN)
        assert not unrelated(case)
        assert not scattered(placed(case))


def test_readings_that_scatter_about_the_arm_are_refused_as_that() -> None:
    clean = record(12, 200).samples
    noisy = replace(clean, reading=clean.reading + np.random.default_rng(4).normal(0.0, 0.05, clean.reading.shape))
    with pytest.raises(BadRecording, match="readings: follow the arm and scatter about it"):
        calibrate(noisy, CHAIN, np.random.default_rng(0))
